"""Trajectories in the format of TUM: written, read again, refused where broken, and as ground truth."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_estimator.cli.calibrate import main as calibrate
from swarm_loc_estimator.cli.replay import main
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.offline.calibration.recording import read_recording
from swarm_loc_estimator.offline.export import TumError, read_truth, read_tum, write_tum
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.offline.report.report import text_report
from swarm_loc_estimator.offline.result import ReplayResult

BAG = Path(__file__).resolve().parents[3] / "bags" / "eight_one_robot_slow"
LINE = "12.5 1 2 0 0 0 0 1"


@pytest.fixture(scope="module")
def result() -> ReplayResult:
    """A run of one robot with ground truth in its bag."""
    return replay(BAG)


@given(
    stamps_ns=st.lists(st.integers(0, 4 * 10**18), min_size=1, max_size=5, unique=True),
    pose=st.tuples(st.floats(-100.0, 100.0), st.floats(-100.0, 100.0), st.floats(-3.14, 3.14)),
)
def test_what_is_written_is_read(
    result: ReplayResult,
    tmp_path_factory: pytest.TempPathFactory,
    stamps_ns: list[int],
    pose: tuple[float, float, float],
) -> None:
    folder = tmp_path_factory.mktemp("tum")
    stamp_ns = np.array(sorted(stamps_ns))
    poses = np.tile(pose, (stamp_ns.size, 1))
    write_tum(replace(result, stamp_ns=stamp_ns, poses=poses[:, None], truth={}), folder)
    found = read_tum(folder / f"{result.swarm.robots[0].name}.tum")
    assert found.stamp_ns.tolist() == stamp_ns.tolist()
    np.testing.assert_allclose(found.pose, poses, atol=1e-9)


def test_poses_are_sorted_and_comments_ignored(tmp_path: Path) -> None:
    path = tmp_path / "a.tum"
    path.write_text("# seconds x y z qx qy qz qw\n2 1 0 0 0 0 1 0\n\n1.000000001 3 4 9 0 0 0 2\n")
    found = read_tum(path)
    assert found.stamp_ns.tolist() == [1_000_000_001, 2_000_000_000]
    np.testing.assert_allclose(found.pose, [[3.0, 4.0, 0.0], [1.0, 0.0, np.pi]])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "has no pose"),
        ("# nothing else\n", "has no pose"),
        (f"{LINE}\n12.6 1 2 0 0 0 1\n", "line 2: '12.6 1 2 0 0 0 1' is no pose: seconds x y z qx qy qz qw"),
        (f"{LINE} 9\n", "line 1"),
        ("stamp x y z qx qy qz qw\n", "line 1"),
        ("-1 1 2 0 0 0 0 1\n", "line 1"),
        ("1 nan 2 0 0 0 0 1\n", "has no pose"),
        ("nan 1 2 0 0 0 0\n", "line 1"),
        ("timestamp,x,y,z\n", "line 1"),
        ("\x00\x01", "line 1"),
    ],
)
def test_what_is_no_trajectory_is_refused(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "a.truth.tum"
    path.write_text(text)
    with pytest.raises(TumError) as refused:
        read_tum(path)
    assert said in str(refused.value)
    assert "a.truth.tum" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_poses_that_are_not_finite_are_left_out_and_counted(
    result: ReplayResult, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = result.swarm.robots[0].name
    write_tum(result, tmp_path)
    path = tmp_path / f"{name}.truth.tum"
    clean = read_tum(path)
    bad = [
        "1 nan 2 0 0 0 0 1",
        "nan 1 2 0 0 0 0 1",
        "inf 1 2 0 0 0 0 1",
        "1 1 2 0 0 0 0 0",
        "1 1 2 0 0 0 0 1e999",
    ]
    path.write_text("\n".join([*bad, *path.read_text().splitlines()]))
    found = read_tum(path)
    assert found.left_out == len(bad)
    assert np.array_equal(found.stamp_ns, clean.stamp_ns)
    assert np.array_equal(found.pose, clean.pose)
    assert main([str(BAG), "--out", str(tmp_path / "out"), "--truth", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert f"Ground truth of {name}: {len(bad)} poses that are not finite are left out." in said
    assert "No ground truth" not in said


def test_marks_of_editors_and_indented_comments_are_ignored(tmp_path: Path) -> None:
    path = tmp_path / "a.tum"
    path.write_text(f"\ufeff# x\n  # y\n\t{LINE}\r\n \t \n", encoding="utf-8")
    assert read_tum(path).stamp_ns.tolist() == [12_500_000_000]
    path.write_text(f"\ufeff{LINE}\n", encoding="utf-8")
    assert read_tum(path).stamp_ns.tolist() == [12_500_000_000]


@pytest.mark.parametrize(("off_s", "where"), [(-500, "before"), (1000, "after")])
def test_truth_of_another_clock_is_said_and_the_poses_are_written(
    result: ReplayResult, tmp_path: Path, capsys: pytest.CaptureFixture[str], off_s: int, where: str
) -> None:
    robot = result.swarm.robots[0].name
    moved = replace(result, stamp_ns=result.stamp_ns + off_s * 10**9, truth={})
    write_tum(moved, tmp_path)
    (tmp_path / f"{robot}.tum").rename(tmp_path / f"{robot}.truth.tum")
    assert main([str(BAG), "--out", str(tmp_path / "out"), "--truth", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert said.count(f"Ground truth of {robot} is of another time, begins ") == 1
    assert f" s {where} the first pose, and is not used." in said
    assert "No ground truth to compare with." in said
    assert len((tmp_path / "out/poses.csv").read_text().splitlines()) > 100
    assert (tmp_path / "out/report.html").exists()


def test_ground_truth_replaces_that_of_the_bag(
    result: ReplayResult, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, swarm = result.swarm.robots[0].name, result.swarm
    write_tum(result, tmp_path)
    truth = read_truth(tmp_path, swarm)
    again = replay(BAG, swarm, truth=truth)
    assert again.poses.tobytes() == result.poses.tobytes()
    assert again.summaries[name].position_rmse == pytest.approx(
        result.summaries[name].position_rmse, abs=1e-6
    )
    moved = Trajectory(truth[name].stamp_ns, truth[name].pose + np.array([10.0, 0.0, 0.0]))
    assert replay(BAG, swarm, truth={name: moved}).summaries[name].position_rmse > 9.0
    assert main([str(BAG), "--out", str(tmp_path / "out"), "--truth", str(tmp_path)]) == 0
    table = [line for line in text_report(again).splitlines() if line.startswith(f"{name} ")]
    assert table[0] in capsys.readouterr().out


def test_a_folder_without_ground_truth_is_refused(result: ReplayResult, tmp_path: Path) -> None:
    name = result.swarm.robots[0].name
    (tmp_path / f"{name}.tum").write_text(LINE)  # an estimate, as --tum writes it
    with pytest.raises(TumError, match=rf"has no ground truth of a robot, such as {name}\.truth\.tum\."):
        read_truth(tmp_path, result.swarm)


def test_a_calibration_uses_ground_truth_of_files(result: ReplayResult, tmp_path: Path) -> None:
    swarm, name = result.swarm, result.swarm.robots[0].name
    first = Trajectory(np.array([1, 2, 2, 3]), np.arange(12.0).reshape(4, 3))
    assert read_recording(BAG, swarm, truth={name: first}).truth[name].stamp_ns.tolist() == [1, 2, 3]
    write_tum(result, tmp_path)
    (short := tmp_path / "short").mkdir()
    lines = (tmp_path / f"{name}.truth.tum").read_text().splitlines(keepends=True)
    (short / f"{name}.truth.tum").write_text("".join(lines[:2]))
    for folder, status in ((short, 1), (tmp_path, 0)):
        out = ["--out", str(tmp_path / "new.yaml"), "--plain", "--evaluations", "1"]
        assert calibrate([str(BAG), "--truth", str(folder), *out]) == status
