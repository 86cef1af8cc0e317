"""Bags of simulated swarms: written by the command, with images, and those of the repository."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from render_helpers import pixels_of
from repository_bags import assert_same_messages, options_of, words_of

from bench.scenarios.bags import CAMERA_INFO, COMPRESSED_IMAGE
from bench.scenarios.eight_run import CAMERA, EightSettings, simulate_eight, simulate_eight_images
from bench.scenarios.generate_bag import main
from bench.scenarios.lived_run import SimulatedRun
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.render.renderer import RobotCamera
from swarm_loc_drivers.sim.scenarios.eight import FAMILY
from swarm_loc_drivers.sim.worlds import W0
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.bags.writer import typestore
from swarm_loc_estimator.common.messages.detections import decode_detections
from swarm_loc_estimator.common.messages.poses import decode_odometry, decode_pose_stamped
from swarm_loc_estimator.swarm.swarm import Landmark
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_vision.markers.detector import DetectorSettings, MarkerDetector
from swarm_loc_vision.markers.families import family_named


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "an eight"
    assert main(["eight", str(path), "--seed", "3", "--duration", "6"]) == 0
    return path


@pytest.fixture(scope="module")
def run() -> SimulatedRun:
    """What the bag holds."""
    return simulate_eight(EightSettings(seed=3, duration_s=6.0))


def of_topic(
    messages: list[tuple[str, str, int, bytes]], name: str, decode: Callable[[bytes], Any]
) -> list[tuple[int, Any]]:
    """When the messages of a topic were recorded, and what they say."""
    return [(log_ns, decode(data)) for topic, _, log_ns, data in messages if topic == name]


def test_the_description_is_that_of_the_run(bag: Path, run: SimulatedRun) -> None:
    assert load_swarm(bag / "swarm.yaml") == run.swarm


def test_messages_come_when_they_arrived_with_the_stamps_of_what_they_show(
    bag: Path, run: SimulatedRun
) -> None:
    with BagReader(bag) as reader:
        assert {topic.name for topic in reader.topics} == {
            f"epuck{robot}/{topic}"
            for robot in range(1, 6)
            for topic in ("odom", "detections", "ground_truth")
        }
        messages = list(reader.messages())
    odometry = of_topic(messages, "epuck2/odom", decode_odometry)
    rows = run.odometry[run.odometry["robot"] == 1]
    assert [log_ns for log_ns, _ in odometry] == rows["arrival_ns"].tolist()
    assert [one.stamp_ns for _, one in odometry] == rows["stamp_ns"].tolist()
    np.testing.assert_allclose([one.pose for _, one in odometry], rows["pose"], atol=1e-12)
    assert odometry[0][1].frame_id == "epuck2/odom"
    assert np.mean([one.twist[0] for _, one in odometry[1:]]) == pytest.approx(0.06, abs=0.003)
    images = of_topic(messages, "epuck2/detections", decode_detections)
    frames = run.frames[run.frames["robot"] == 1]
    assert [log_ns for log_ns, _ in images] == frames["arrival_ns"].tolist()
    assert [one.stamp_ns for _, one in images] == frames["stamp_ns"].tolist()
    assert [len(one.detections) for _, one in images] == frames["count"].tolist()
    shown = run.sightings[frames[0]["first"] : frames[0]["first"] + frames[0]["count"]]
    assert images[0][1].detections["id"].tolist() == shown["marker_id"].tolist()
    np.testing.assert_allclose(images[0][1].detections["position"][:, 2], shown["value"][:, 0])


def test_ground_truth_is_that_of_the_simulation(bag: Path, run: SimulatedRun) -> None:
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


ARGUMENTS = ["--seed", "2", "--duration", "2.5", "--robots", "2", "--world", "w2"]


@pytest.fixture(scope="module")
def bag_image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "pictures"
    assert main(["pictures", str(path), *ARGUMENTS]) == 0
    return path


def test_every_picture_comes_with_its_calibration_and_late(bag_image: Path) -> None:
    store: Any = typestore()
    with BagReader(bag_image) as reader:
        messages = list(reader.messages())
    assert {topic.removeprefix("epuck1/").removeprefix("epuck2/") for topic, _, _, _ in messages} == {
        "odom",
        "ground_truth",
        "image_raw/compressed",
        "camera_info",
    }
    images, infos = (
        of_topic(messages, f"epuck2/{name}", lambda data, kind=kind: store.deserialize_cdr(data, kind))  # type: ignore[misc]
        for name, kind in (("image_raw/compressed", COMPRESSED_IMAGE), ("camera_info", CAMERA_INFO))
    )
    assert [one.header for _, one in images] == [one.header for _, one in infos]
    late_s = [
        log_ns * 1e-9 - one.header.stamp.sec - 1e-9 * one.header.stamp.nanosec for log_ns, one in images
    ]
    assert 0.15 <= min(late_s) < max(late_s) <= 0.3
    assert len(images) > 10
    assert {one.header.frame_id for _, one in images} == {"epuck2/camera_optical_frame"}
    image = cv2.imdecode(images[0][1].data, cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image.shape == (960, 1280)
    np.testing.assert_allclose(infos[0][1].k.reshape(3, 3), CameraModel().camera.matrix)


def test_the_same_arguments_give_the_same_bytes(bag_image: Path, tmp_path: Path) -> None:
    again = tmp_path / bag_image.name
    assert main(["pictures", str(again), *ARGUMENTS]) == 0
    assert (bag_image / "pictures.mcap").read_bytes() == (again / "pictures.mcap").read_bytes()


def test_a_detector_finds_the_landmarks_where_they_are() -> None:
    """Rendered without hidden errors, every landmark's corners are found where OpenCV projects them."""
    camera = CameraModel(exposure_s=1e-4, white_flux=1e8)  # no time to turn, the light of an ordinary image
    recorded = simulate_eight_images(EightSettings(seed=4, duration_s=2.0, robots=3, errors=W0), camera)
    run, family = recorded.run, family_named(FAMILY)
    detector = MarkerDetector(DetectorSettings(), {family: None})
    marks = {mark.id: mark for mark in run.swarm.landmarks}
    errors: list[float] = []
    for frame, image in zip(run.frames, recorded.images(), strict=True):
        robot = int(frame["robot"])
        pose = run.truth.at(robot, frame["stamp_ns"])
        found = detector.detect(image)
        assert set(found.id.tolist()) <= set(run.swarm.owner_of)
        for marker_id, corners in zip(found.id.tolist(), found.corners, strict=True):
            if marker_id in marks:
                mark = marks[marker_id]
                expected = pixels_of(RobotCamera(robot, camera, CAMERA), camera, pose, square_of(mark))
                errors += np.linalg.norm(corners - expected, axis=1).tolist()
    assert len(errors) > 4 * len(run.frames)
    assert np.median(errors) < 0.12
    assert np.quantile(errors, 0.95) < 0.3


def square_of(mark: Landmark) -> FloatArray:
    """Corners (4, 3) of a landmark, clockwise from the upper left of one who faces it."""
    yaw = mark.yaw or 0.0
    right = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    sides = 0.5 * mark.size * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
    corners: FloatArray = np.array([mark.x, mark.y, mark.z]) + sides[:, :1] * right + sides[:, 1:] * up
    return corners


SIMULATED = [
    "droplets_twenty",
    "eight_five_robots",
    "eight_five_robots_w2",
    "eight_one_robot_fast",
    "eight_one_robot_slow",
]


@pytest.mark.parametrize("name", SIMULATED)
def test_a_bag_comes_out_of_its_generator_again(name: str, tmp_path: Path) -> None:
    assert main([options_of(name)["swarm"], str(tmp_path / name), *words_of(name)]) == 0
    assert_same_messages(tmp_path / name, name)
