"""The dataset's import, on a small folder made here: a robot on a circle among three landmarks."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from swarm_loc_estimator.cli.import_mrclam import main
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.messages.detections import decode_detections
from swarm_loc_estimator.common.messages.poses import decode_odometry, decode_pose_stamped
from swarm_loc_estimator.offline.datasets.mrclam import MrclamError, integrate, read_dataset
from swarm_loc_estimator.swarm.swarm import Face
from swarm_loc_estimator.swarm.swarm_file import load_swarm

START_S = 1_248_272_272.841
START_NS = 1_248_272_272_841_000_000
LANDMARKS = {6: (3.0, 1.0), 7: (-2.0, 4.0), 8: (0.5, -3.0)}
BARCODES = {1: 5, 2: 14, 6: 72, 7: 27, 8: 54}
SPEED, RATE = 0.1, 0.25
UNKNOWN = 99


def true_pose(time_s: float) -> np.ndarray:
    """On an exact circle from (1, 2) heading 0.5."""
    step = np.array([SPEED * time_s, 0.0, RATE * time_s])
    return np.asarray(se2.compose([1.0, 2.0, 0.5], se2.exp(step)))


def write(path: Path, rows: Sequence[tuple[float, ...]], separator: str = " \t ") -> None:
    lines = [
        separator.join(f"{value:.3f}" if value > 1e6 else f"{value:.8g}" for value in row) for row in rows
    ]
    path.write_text("# a comment\n" + "\n".join(lines) + "\n")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Robot 1 with everything, robot 2 with odometry only."""
    rng = np.random.default_rng(5)
    odometry_s = np.cumsum(rng.choice([0.01, 0.04, 0.3], 600)).round(3) - 0.01
    write(tmp_path / "Robot1_Odometry.dat", [(START_S + t, SPEED, RATE) for t in odometry_s])
    write(tmp_path / "Robot2_Odometry.dat", [(START_S + 0.5 * k, 0.0, 0.0) for k in range(20)])
    write(
        tmp_path / "Robot1_Groundtruth.dat",
        [(START_S + 0.05 * k - 5, *true_pose(0.05 * k - 5)) for k in range(1500)],
    )
    sightings = []
    for second in range(1, 40):
        pose = true_pose(second)
        for subject, place in LANDMARKS.items():
            x, y = se2.transform_points(se2.inverse(pose), np.array(place))
            sightings.append((START_S + second, BARCODES[subject], math.hypot(x, y), math.atan2(y, x)))
    sightings.append((START_S + 39, UNKNOWN, 2.0, 0.5))
    write(tmp_path / "Robot1_Measurement.dat", sightings)
    write(tmp_path / "Barcodes.dat", list(BARCODES.items()))
    write(tmp_path / "Landmark_Groundtruth.dat", [(s, x, y, 0.001, 0.001) for s, (x, y) in LANDMARKS.items()])
    return tmp_path


def test_commands_become_exact_arcs_that_hold_to_the_next_row() -> None:
    rng = np.random.default_rng(1)
    stamp_ns = np.cumsum(rng.integers(0, 400_000_000, 50))
    twist = rng.uniform(-1, 1, (50, 2))
    twist[10:20, 1] = 0.0
    pose = np.zeros(3)
    track = integrate(stamp_ns, twist)
    for k in range(50):
        np.testing.assert_allclose(se2.between(track.pose[k], pose), 0.0, atol=1e-12)
        if k < 49:
            step_s = (stamp_ns[k + 1] - stamp_ns[k]) * 1e-9
            pose = se2.compose(pose, se2.exp(np.array([twist[k, 0] * step_s, 0.0, twist[k, 1] * step_s])))


def test_bag_tells_what_the_files_tell(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(folder), str(tmp_path / "bag")]) == 0
    printed = capsys.readouterr().out
    assert "robot 2 has no measurement file: it sees nothing." in printed
    assert "robot 2 has no ground truth: it starts unknown and is not evaluated." in printed
    with BagReader(tmp_path / "bag") as bag:
        messages = list(bag.messages())
    assert [m[2] for m in messages] == sorted(m[2] for m in messages)
    odometry = [decode_odometry(m[3]) for m in messages if m[0] == "robot1/odom"]
    assert len(odometry) == 600
    assert (odometry[0].frame_id, odometry[0].child_frame_id) == ("robot1/odom", "robot1/base_link")
    assert {one.stamp_ns % 1_000_000 for one in odometry} == {0}
    assert odometry[5].twist == (SPEED, 0.0, RATE)
    start = true_pose((odometry[0].stamp_ns - START_NS) * 1e-9)
    for one in odometry[::50]:
        expected = true_pose((one.stamp_ns - START_NS) * 1e-9)
        np.testing.assert_allclose(se2.compose(start, one.pose), expected, atol=1e-6)
    truth = [decode_pose_stamped(m[3]) for m in messages if m[0] == "robot1/ground_truth"]
    assert truth[0].frame_id == "map"
    assert truth[0].stamp_ns == START_NS - 1_000_000_000  # a second before anything else


def test_sightings_are_positions_in_the_optical_frame(folder: Path, tmp_path: Path) -> None:
    main([str(folder), str(tmp_path / "bag")])
    with BagReader(tmp_path / "bag") as bag:
        arrays = [decode_detections(m[3]) for m in bag.messages(["robot1/detections"])]
        assert bag.losses == []
    assert [len(a.detections) for a in arrays] == [3] * 38 + [4]
    assert arrays[0].frame_id == "robot1/camera_optical_frame"
    assert arrays[0].stamp_ns == START_NS + 1_000_000_000
    last = arrays[-1].detections
    assert last["id"].tolist() == [72, 27, 54, UNKNOWN]
    np.testing.assert_allclose(last["position"][3], [-2.0 * math.sin(0.5), 0.0, 2.0 * math.cos(0.5)])
    assert (last["content"] == 1).all()
    assert (last["family"] == 255).all()
    assert (last["covariance"][:, 0, 0] == -1.0).all()
    assert np.isnan(last["corners_px"]).all()


def test_description_names_barcodes_and_true_start(folder: Path, tmp_path: Path) -> None:
    main([str(folder), str(tmp_path / "bag")])
    swarm = load_swarm(tmp_path / "bag" / "swarm.yaml")
    one, two = swarm.robots
    assert one.faces == (Face("body", 5, yaw=None),)
    assert two.start is None
    assert {mark.id: (mark.x, mark.y, mark.yaw) for mark in swarm.landmarks} == {
        BARCODES[s]: (x, y, None) for s, (x, y) in LANDMARKS.items()
    }
    with BagReader(tmp_path / "bag") as bag:
        first = decode_odometry(next(bag.messages(["robot1/odom"]))[3])
    assert one.start is not None
    np.testing.assert_allclose(one.start, true_pose((first.stamp_ns - START_NS) * 1e-9), atol=1e-5)


def test_exchanged_barcodes_are_found_and_named(folder: Path) -> None:
    write(folder / "Barcodes.dat", list({**BARCODES, 6: 54, 8: 72}.items()))
    dataset = read_dataset(folder)
    assert dict(dataset.barcode_of) == BARCODES
    text = " ".join(dataset.remarks)
    assert "sightings of barcode 54 lie" in text
    assert "barcode 72, noted for landmark 8, fits and is used instead." in text


def test_wrong_barcode_without_partner_is_left_and_named(folder: Path) -> None:
    landmarks = {**LANDMARKS, 7: (9.0, 9.0)}
    write(folder / "Landmark_Groundtruth.dat", [(s, x, y, 0.001, 0.001) for s, (x, y) in landmarks.items()])
    dataset = read_dataset(folder)
    assert dict(dataset.barcode_of) == BARCODES
    assert any("no exchange explains it; it was left as noted" in remark for remark in dataset.remarks)


def test_right_barcodes_and_missing_truth_raise_no_objection(folder: Path) -> None:
    assert not any("barcode" in remark for remark in read_dataset(folder).remarks)
    (folder / "Robot1_Groundtruth.dat").unlink()
    write(folder / "Barcodes.dat", list({**BARCODES, 6: 54, 8: 72}.items()))
    assert read_dataset(folder).barcode_of[6] == 54


def test_sparse_truth_stands_in_and_the_log_starts_with_it(folder: Path, tmp_path: Path) -> None:
    (folder / "Robot1_Groundtruth.dat").unlink()
    rows = [(1, START_S + t, *true_pose(t), 3, 0.001) for t in (10.0, 11.0, 20.0)]
    write(folder / "sparse_groundtruth.csv", rows, ",")
    assert main([str(folder), str(tmp_path / "bag")]) == 0
    robot = load_swarm(tmp_path / "bag" / "swarm.yaml").robots[0]
    assert robot.start is not None
    np.testing.assert_allclose(robot.start, true_pose(10.0), atol=1e-5)
    with BagReader(tmp_path / "bag") as bag:
        odometry = [decode_odometry(m[3]) for m in bag.messages(["robot1/odom"])]
        detections = list(bag.messages(["robot1/detections"]))
    assert odometry[0].stamp_ns == START_NS + 10_000_000_000
    for one in odometry[::40]:
        expected = true_pose((one.stamp_ns - START_NS) * 1e-9)
        np.testing.assert_allclose(se2.compose(robot.start, one.pose), expected, atol=1e-5)
    assert detections[0][2] >= odometry[0].stamp_ns


def test_truth_that_comes_late_costs_no_data(folder: Path, tmp_path: Path) -> None:
    write(folder / "Robot2_Odometry.dat", [(START_S + 0.5 * k, 0.0, 0.0) for k in range(400)])
    write(
        folder / "Robot2_Groundtruth.dat", [(START_S + 190, 1.0, 2.0, 0.0), (START_S + 190.1, 1.0, 2.0, 0.0)]
    )
    assert main([str(folder), str(tmp_path / "bag")]) == 0
    assert load_swarm(tmp_path / "bag" / "swarm.yaml").robots[1].start is None
    assert (
        "robot 2 starts unknown: its ground truth does not" in (tmp_path / "bag" / "swarm.yaml").read_text()
    )
    with BagReader(tmp_path / "bag") as bag:
        assert len(list(bag.messages(["robot2/odom"]))) == 400


def test_late_detections_keep_their_stamps_and_repeat(folder: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        assert main([str(folder), str(tmp_path / name / "bag"), "--delay-ms", "150", "300", "7"]) == 0
    assert (tmp_path / "one/bag/bag.mcap").read_bytes() == (tmp_path / "two/bag/bag.mcap").read_bytes()
    with BagReader(tmp_path / "one/bag") as bag:
        late = [m[2] - decode_detections(m[3]).stamp_ns for m in bag.messages(["robot1/detections"])]
        assert all(m[2] == decode_odometry(m[3]).stamp_ns for m in bag.messages(["robot1/odom"]))
    assert min(late) >= 150_000_000
    assert max(late) <= 300_000_000
    assert len(set(late)) > 30


def test_what_is_no_dataset_is_said(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    assert main([str(tmp_path / "empty"), str(tmp_path / "bag")]) == 1
    assert "holds no Robot<number>_Odometry.dat" in capsys.readouterr().err
    (folder / "Robot1_Measurement.dat").write_text("1.0 2 3.0 4.0\n1.0 x 3.0 4.0\n")
    assert main([str(folder), str(tmp_path / "bag")]) == 1
    assert "Robot1_Measurement.dat' cannot be read: could not convert" in capsys.readouterr().err
    (folder / "Robot1_Measurement.dat").write_text("1.0 2 3.0 4.0\n1.0 2 nan 4.0\n")
    with pytest.raises(MrclamError, match="not finite in row 2"):
        read_dataset(folder)
    (folder / "Barcodes.dat").unlink()
    assert main([str(folder), str(tmp_path / "bag")]) == 1
    assert "Barcodes.dat' cannot be read" in capsys.readouterr().err
    assert main([str(folder), str(tmp_path / "bag"), "--delay-ms", "300", "150", "7"]) == 1
    assert "--delay-ms 300 150 7: 0 <= LO <= HI and 0 <= SEED are needed." in capsys.readouterr().err
