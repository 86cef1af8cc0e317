"""Faults are reported, and no robot is TRACKED with a wrong pose; with seeds that no figure comes from."""

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.integrity.faults import seconds
from bench.integrity.live import run_late_start
from bench.integrity.scenarios import SCENARIOS
from bench.integrity.scoring import Blame, Named, blame_of, score
from bench.integrity.sensors import SENSOR_SCENARIOS
from swarm_loc_estimator.timeline.estimate import Contradicted

SEED = 23


@pytest.mark.parametrize(
    ("scenario", "about", "kind"),
    [
        ("false_sightings", "epuck1", Contradicted.SIGHTINGS),
        ("turned_camera", "epuck1", Contradicted.DESCRIPTION),
        ("two_odometry_sources", "epuck1", Contradicted.ODOMETRY),
        ("odometry_reset_origin_blind", "epuck1", Contradicted.RESET),
        ("heading_reset_blind", "epuck1", Contradicted.RESET),
        ("twist_only", "epuck1", Contradicted.CONSTANT),
        ("scans_late", "lidar of turtlebot", Contradicted.LATE),
    ],
)
def test_a_fault_is_named_and_misleads_nobody(scenario: str, about: str, kind: Contradicted) -> None:
    found = score(SCENARIOS[scenario](SEED))
    assert found.misleading_share <= 0.001
    assert (about, kind) in found.reported


def test_noise_that_the_description_hides_is_found_and_costs_no_robot() -> None:
    found = score(SCENARIOS["w2_on_w0_file"](SEED))
    assert found.misleading_share <= 0.001
    assert found.tracked_share >= 0.99
    assert found.position_m <= 0.015
    assert any(kind == Contradicted.DESCRIPTION for _, kind in found.reported)


def test_a_landmark_that_was_moved_is_named() -> None:
    fault = SCENARIOS["moved_landmark"](SEED)
    found = score(fault)
    assert found.misleading_share <= 0.001
    assert (fault.about, Contradicted.DESCRIPTION) in found.reported


def test_starts_that_are_wrong_give_way_and_nothing_is_said_where_nothing_is_wrong() -> None:
    moved, clean = (score(SCENARIOS[name](SEED)) for name in ("wrong_starts", "clean_w0"))
    assert moved.misleading_share <= 0.001
    assert moved.recovery_s <= 3.0
    assert not clean.reported
    assert clean.tracked_share == 1.0


def test_a_kidnapped_robot_comes_back() -> None:
    found = score(SCENARIOS["kidnapped"](SEED))
    assert found.misleading_share <= 0.6 / 300.0  # two more images, up to 0.3 s late, of 300 robot-seconds
    assert found.recovery_s <= 3.0


@pytest.mark.timeout(400)
def test_an_estimator_that_starts_late_locates_robots_that_map(tmp_path: Path) -> None:
    found = run_late_start(SEED, tmp_path)
    assert found.misleading_share <= 0.001
    assert found.recovery_s <= 3.0
    assert found.tracked_share >= 0.8


@pytest.mark.parametrize("scenario", SENSOR_SCENARIOS)
def test_readings_are_wrong_during_a_fault_only_and_of_nobody_else(scenario: str) -> None:
    wrong = []
    for seed in (1, 2):
        fault = SENSOR_SCENARIOS[scenario](seed)
        end_s = fault.run.duration_s if fault.ends_s is None else fault.ends_s
        ((sensor, readings),) = fault.readings.items()
        changed = _rows(readings) ^ _rows(fault.healthy[sensor])
        time_s = seconds(fault.run, np.array([stamp_ns for _, stamp_ns, _ in changed]))
        assert time_s.min() >= fault.begins_s
        assert time_s.max() < end_s
        assert time_s.max() - time_s.min() > 0.8 * (end_s - fault.begins_s)
        if sensor != "detections" and fault.concerned:
            assert {robot for robot, *_ in changed} == fault.concerned
        assert np.all(np.diff(readings.arrival_ns) >= 0)
        wrong.append(changed)
    assert wrong[0] != wrong[1]


def _rows(rows: Any) -> set[tuple[int, int, bytes]]:
    """Robot, stamp and all of each row."""
    columns = [
        column[name] if name else column for column in rows for name in column.dtype.names or ("",)
    ]  # fields one by one, without padding
    texts = (
        [pickle.dumps(one) if column.dtype == object else one.tobytes() for one in column]
        for column in columns
    )
    return set(
        zip(rows.robot.tolist(), rows.stamp_ns.tolist(), map(b"".join, zip(*texts, strict=True)), strict=True)
    )


@pytest.mark.parametrize(
    "scenario", ["ceiling_camera_moved", "gyro_zero", "mocap_swapped", "uwb_repeated", "scans_late"]
)
def test_without_its_fault_a_world_is_as_it_is_described(scenario: str) -> None:
    fault = SENSOR_SCENARIOS[scenario](SEED)
    found = score(replace(fault, readings=fault.healthy, ends_s=None, concerned=frozenset()))
    assert found.misleading_share <= 0.001
    assert found.tracked_share >= 0.98
    assert found.nees <= 6.0
    assert found.blame == Blame(fault.run.duration_s, 0)


def test_a_source_counts_as_named_from_the_fault_on_and_symptoms_accuse_nobody() -> None:
    fault = replace(SENSOR_SCENARIOS["mocap_swapped"](SEED), begins_s=15.0, guilty=frozenset({"a", "b"}))
    named = [
        Named(3.0, "a", Contradicted.SIGHTINGS),
        Named(17.0, "c", Contradicted.SUSPENDED),
        Named(18.0, "c", Contradicted.DESCRIPTION),
        Named(18.0, "d", Contradicted.POSE),
        Named(19.0, "b", Contradicted.DESCRIPTION),
        Named(21.0, "a", Contradicted.DESCRIPTION),
    ]
    assert blame_of(fault, named) == Blame(4.0, 1)
    assert blame_of(fault, named[:4]) == Blame(fault.run.duration_s, 1)


def test_detections_that_claim_too_much_are_named_and_do_not_disturb_others() -> None:
    found = score(SENSOR_SCENARIOS["sure_detections"](SEED))
    assert found.blame is not None
    assert found.blame.named_s <= 5.0
    assert found.blame.accused == 0
    assert found.blame.others_ratio <= 1.5
    assert found.blame.others_after_ratio <= 1.2
