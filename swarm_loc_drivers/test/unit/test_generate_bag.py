"""A generated bag holds the simulated run, message by message."""

from pathlib import Path

import numpy as np
import pytest

from bench.scenarios.eight_run import EightSettings, simulate_eight
from bench.scenarios.generate_bag import main
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.messages.detections import decode_detections
from swarm_loc_estimator.common.messages.poses import decode_odometry, decode_pose_stamped
from swarm_loc_estimator.swarm.swarm_file import load_swarm


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "an eight"
    assert main(["eight", str(path), "--seed", "3", "--duration", "6"]) == 0
    return path


def test_the_description_is_that_of_the_run(bag: Path) -> None:
    assert load_swarm(bag / "swarm.yaml") == simulate_eight(EightSettings(seed=3, duration_s=6.0)).swarm


def test_messages_come_when_they_arrived_with_the_stamps_of_what_they_show(bag: Path) -> None:
    run = simulate_eight(EightSettings(seed=3, duration_s=6.0))
    with BagReader(bag) as reader:
        assert {topic.name for topic in reader.topics} == {
            f"epuck{robot}/{topic}"
            for robot in range(1, 6)
            for topic in ("odom", "detections", "ground_truth")
        }
        messages = list(reader.messages())
    odometry = [
        (log_ns, decode_odometry(data)) for topic, _, log_ns, data in messages if topic == "epuck2/odom"
    ]
    rows = run.odometry[run.odometry["robot"] == 1]
    assert [log_ns for log_ns, _ in odometry] == rows["arrival_ns"].tolist()
    assert [one.stamp_ns for _, one in odometry] == rows["stamp_ns"].tolist()
    np.testing.assert_allclose([one.pose for _, one in odometry], rows["pose"], atol=1e-12)
    assert odometry[0][1].frame_id == "epuck2/odom"
    assert np.mean([one.twist[0] for _, one in odometry[1:]]) == pytest.approx(0.06, abs=0.003)
    images = [
        (log_ns, decode_detections(data))
        for topic, _, log_ns, data in messages
        if topic == "epuck2/detections"
    ]
    frames = run.frames[run.frames["robot"] == 1]
    assert [log_ns for log_ns, _ in images] == frames["arrival_ns"].tolist()
    assert [one.stamp_ns for _, one in images] == frames["stamp_ns"].tolist()
    assert [len(one.detections) for _, one in images] == frames["count"].tolist()
    shown = run.sightings[frames[0]["first"] : frames[0]["first"] + frames[0]["count"]]
    assert images[0][1].detections["id"].tolist() == shown["marker_id"].tolist()
    np.testing.assert_allclose(images[0][1].detections["position"][:, 2], shown["value"][:, 0])


def test_ground_truth_is_that_of_the_simulation(bag: Path) -> None:
    run = simulate_eight(EightSettings(seed=3, duration_s=6.0))
    with BagReader(bag) as reader:
        truth = [decode_pose_stamped(data) for _, _, _, data in reader.messages(["epuck5/ground_truth"])]
    assert len(truth) == 61
    assert {one.frame_id for one in truth} == {"map"}
    stamps = np.array([one.stamp_ns for one in truth])
    np.testing.assert_allclose([one.pose for one in truth], run.truth.at(4, stamps), atol=1e-12)


def test_an_existing_bag_is_not_overwritten(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["eight", str(bag)])
    assert f"{bag} exists already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("swarm", "option", "value", "limits"),
    [
        ("eight", "--duration", "1", "[2, 3600] s"),
        ("aerial", "--duration", "nan", "[2, 3600] s"),
        ("droplets", "--duration", "inf", "[2, 3600] s"),
        ("aerial", "--robots", "0", "[1, 20]"),
        ("eight", "--robots", "10", "[1, 9]"),
        ("pictures", "--seed", "-1", "[0, 2.14748e+09]"),
        ("droplets", "--boards", "-1", "[0, 2.14748e+09]"),
        ("eight", "--speed", "nan", "[0.001, 0.12] m/s"),
        ("pictures", "--speed", "0", "[0.001, 0.12] m/s"),
        ("eight", "--speed", "-0.06", "[0.001, 0.12] m/s"),
        ("eight", "--speed", "5", "[0.001, 0.12] m/s"),
    ],
)
def test_a_value_out_of_range_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], swarm: str, option: str, value: str, limits: str
) -> None:
    with pytest.raises(SystemExit):
        main([swarm, str(tmp_path / "bag"), option, value])
    assert f"argument {option}: {value} must be a number in {limits}" in capsys.readouterr().err
    assert not (tmp_path / "bag").exists()
