"""The MRCLAM benchmark finds sets, hides what a run must not see, and carries models over by robot name."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from bench.mrclam import __main__ as mrclam
from bench.mrclam import report as reporting
from bench.mrclam.jobs import MODELS, Done, Job, Sums, collected, jobs_of
from bench.mrclam.sets import (
    NoSetsError,
    find_sets,
    transferred,
    unknown_start,
    with_two_seeing,
    without_robots,
    without_sightings,
)
from bench.shared.common import save_plot, write_figures
from swarm_loc_estimator.common.messages.detections import DETECTION_DTYPE
from swarm_loc_estimator.offline.calibration.recording import Recording
from swarm_loc_estimator.sensors.camera import DetectionRows
from swarm_loc_estimator.sensors.odometry import NO_ODOMETRY
from swarm_loc_estimator.swarm.error_models import SensorModel
from swarm_loc_estimator.swarm.swarm import Face, Landmark, Robot, Swarm

SWARM = Swarm(
    tuple(Robot(f"robot{k}", "create", faces=(Face("body", k),), start=(0.0, 0.0, 0.0)) for k in (1, 2, 3)),
    (Landmark(10), Landmark(11, 1.0)),
)


def seen(*observations: tuple[int, list[int]]) -> Recording:
    """A recording in which robots (by index) see ids."""
    found = [
        (robot, stamp_ns, marker) for stamp_ns, (robot, ids) in enumerate(observations) for marker in ids
    ]
    robots, stamps_ns, ids = np.array(found, dtype=np.int64).T
    rows = np.zeros(len(found), DETECTION_DTYPE)
    rows["id"] = ids
    return Recording("r", NO_ODOMETRY, DetectionRows(robots, stamps_ns, rows, stamps_ns), {})


def ids_of(recording: Recording) -> list[list[int]]:
    """What is seen, picture by picture."""
    seen = recording.detections
    return [seen.detection["id"][seen.stamp_ns == stamp_ns].tolist() for stamp_ns in range(3)]


def test_masks_hide_what_they_say() -> None:
    recording = seen((0, [10, 2]), (1, [11, 1, 3]), (2, [10, 11]))
    assert ids_of(without_robots(recording, SWARM)) == [[10], [11], [10, 11]]
    assert ids_of(without_sightings(recording)) == [[], [], []]
    assert ids_of(with_two_seeing(recording, SWARM, (0, 2))) == [[10, 2], [1, 3], [10, 11]]
    assert ids_of(recording) == [[10, 2], [11, 1, 3], [10, 11]]


def test_models_go_by_name_and_strangers_get_the_mean() -> None:
    fitted = Swarm(
        tuple(replace(SWARM.robots[k], sensor=SensorModel(range_offset=0.1 * (k + 1))) for k in (0, 1))
    )
    found = transferred(fitted, SWARM).robots
    assert [robot.sensor.range_offset for robot in found] == pytest.approx([0.1, 0.2, 0.15])
    assert [robot.name for robot in found] == ["robot1", "robot2", "robot3"]
    assert all(robot.start == (0.0, 0.0, 0.0) for robot in found)
    assert all(robot.start is None for robot in unknown_start(SWARM).robots)


def test_sets_are_found_by_their_numbers(tmp_path: Path) -> None:
    for number in (2, 7):
        (tmp_path / f"MRCLAM_Dataset{number}").mkdir()
        (tmp_path / f"MRCLAM_Dataset{number}" / "Robot2_Odometry.dat").touch()
    assert list(find_sets(tmp_path)) == [2, 7]
    assert list(find_sets(tmp_path / "MRCLAM_Dataset7")) == [7]


def test_a_folder_without_sets_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(NoSetsError, match="holds no MRCLAM set"):
        find_sets(tmp_path)
    assert mrclam.main([str(tmp_path / "nowhere")]) == 1
    assert "There is no folder" in capsys.readouterr().err


def test_sums_add_up_to_pooled_figures() -> None:
    pooled = Sums(1, 0.01, 0.0, 3.0, 1, 1) + Sums(3, 0.03, 0.0, 9.0, 3, 0)
    wanted = {"position_rmse_m": 0.1, "heading_rmse_deg": 0.0, "nees": 3.0, "misleading_share": 0.25}
    assert pooled.figures == pytest.approx(wanted)
    assert len(jobs_of(1, SWARM)) == 2 * (5 + 3)


def folder_with(parent: Path, *numbers: int) -> Path:
    """A folder with empty sets."""
    for number in numbers:
        (parent / f"MRCLAM_Dataset{number}").mkdir(parents=True)
        (parent / f"MRCLAM_Dataset{number}" / "Robot1_Odometry.dat").touch()
    return parent


def test_sets_to_fit_and_to_test_are_numbers_or_folders(tmp_path: Path) -> None:
    here, there = folder_with(tmp_path / "a", 1, 2), folder_with(tmp_path / "b", 2, 7)
    own = {k: here / f"MRCLAM_Dataset{k}" for k in (1, 2)}
    other = {k: there / f"MRCLAM_Dataset{k}" for k in (2, 7)}
    choose = partial(mrclam.chosen_sets, folder=here)
    assert choose([]) == ((1, own[1]), own)
    assert choose(["2"]) == ((2, own[2]), own)
    assert choose(["1", "2", str(other[7])]) == ((1, own[1]), {2: own[2], 7: other[7]})
    assert choose([str(other[7]), "1"]) == ((7, other[7]), {1: own[1]})
    assert choose([str(there)]) == ((1, own[1]), other)  # set 1 is fitted to where FIT holds several
    assert mrclam.chosen_sets([str(there)], tmp_path / "nowhere") == ((2, other[2]), other)
    assert choose(["1", str(there)]) == ((1, own[1]), other)
    with pytest.raises(NoSetsError, match=r"no set 5 in .*, only 1, 2; name its folder"):
        choose(["5"])
    with pytest.raises(NoSetsError, match="are both set 2; test one of them"):
        choose(["1", "2", str(there)])
    with pytest.raises(NoSetsError, match="are both set 2; rename one"):
        choose([str(other[2]), "2"])


def test_a_job_that_fails_leaves_the_figures_of_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sums = Sums(1, 0.01, np.radians(2.0) ** 2, 3.0, 1, 0, 0.05)
    all_done = [Done(job, sums) for job in jobs_of(1, SWARM) if job.column != "smoother"]
    all_done += [Done(Job(1, model, "smoother"), None, "it has no odometry.") for model in MODELS]
    results = collected(all_done)
    assert results.figures["set1.plain.landmarks_robots.position_rmse_m"] == pytest.approx(0.1)
    assert not any("smoother" in name for name in results.figures)
    results.figures["set1.replay.speed_factor"] = 100.0
    monkeypatch.setattr(reporting, "write_figures", partial(write_figures, folder=tmp_path))
    monkeypatch.setattr(reporting, "save_plot", partial(save_plot, folder=tmp_path))
    reporting.report(results, [1])
    shown = capsys.readouterr().out
    assert shown.count("0.1000/2.00/3.0/0.00") == 2 * 5
    assert "set 1 plain, smoother failed: it has no odometry." in shown
    assert "set1.plain.odometry.nees" in (tmp_path / "mrclam.json").read_text(encoding="utf-8")
