"""The bags of the repository replay as well as is said of them, and to the same poses every time."""

from pathlib import Path

import numpy as np

from bench.shared.bags import copy_part
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.settings import Settings

BAGS = Path(__file__).parents[3] / "bags"
BEGINNING_S = 30.0


def replayed(bag: str, description: str = "swarm.yaml", settings: Settings | None = None) -> ReplayResult:
    return replay(BAGS / bag, load_swarm(BAGS / bag / description), settings)


def assert_good(result: ReplayResult, metres: float, degrees: float, nees: tuple[float, float]) -> None:
    """RMSE of all robots together at most so large, NEES within a range."""
    errors = result.overall
    assert errors.position_rmse < metres
    assert np.degrees(errors.heading_rmse) < degrees
    assert nees[0] < errors.nees < nees[1]


def test_twenty_droplets_are_located_by_infrared_and_byte_for_byte_the_same_again(tmp_path: Path) -> None:
    """3.1 mm, 1.3 degrees, NEES 1.2, two of them with fixes; again for half a minute."""
    result = replayed("droplets_twenty")
    assert_good(result, 0.0045, 1.7, (0.8, 4.5))
    assert np.isfinite(result.poses[-1]).all()
    copy_part(BAGS / "droplets_twenty", tmp_path / "beginning", BEGINNING_S)
    again = replay(tmp_path / "beginning", result.swarm)
    same = len(again.stamp_ns) - 3  # the last ones lack what the cut has taken
    assert same > 250
    assert np.isfinite(again.poses[same - 1]).all(axis=-1).sum() > 10
    for name in ("stamp_ns", "poses", "covariances"):
        assert getattr(again, name)[:same].tobytes() == getattr(result, name)[:same].tobytes()


def test_the_robots_of_the_demo_are_located_to_millimetres() -> None:
    """2.7 mm and 1.1 degrees."""
    assert_good(replayed("eight_five_robots"), 0.0035, 1.5, (2.0, 3.6))


def test_five_robots_that_calibrate_themselves_are_located_to_millimetres() -> None:
    """3.3 mm in the world of systematic errors, 7 mm if not described, 21 mm by the paper's filter."""
    assert_good(replayed("eight_five_robots_w2", "self_calibrating.yaml"), 0.0045, 1.5, (0.8, 3.5))
    assert_good(replayed("eight_five_robots_w2"), 0.0095, 1.8, (0.8, 4.5))
    paper = replayed("eight_five_robots_w2", settings=Settings(max_fault_score=1e9))
    assert paper.overall.position_rmse > 0.015


def test_e_pucks_are_located_by_anonymous_detections_from_above_and_byte_for_byte_the_same_again() -> None:
    """6.4 mm and 3.1 degrees, with unknown starts and nothing else."""
    result, again = (replayed("aerial_five") for _ in range(2))
    assert_good(result, 0.008, 4.0, (1.5, 4.0))
    assert np.isnan(result.poses[0]).all()
    assert np.isfinite(result.poses[200:]).all(axis=-1).mean() > 0.95
    assert result.counters["identities answered"] >= 5
    for name in ("stamp_ns", "poses", "covariances"):
        assert getattr(again, name).tobytes() == getattr(result, name).tobytes()
