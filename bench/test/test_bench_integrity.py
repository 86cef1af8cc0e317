"""Faults are reported, and no robot is TRACKED with a wrong pose; with seeds that no figure comes from."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.integrity.late_start import run_late_start
from bench.integrity.scenarios import SCENARIOS
from bench.integrity.scoring import score
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
    assert ("epuck1", Contradicted.NOISE) in found.reported


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
