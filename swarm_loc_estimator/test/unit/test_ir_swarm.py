"""Laws of a swarm that hears each other's light: located through IR alone, honestly, in any order."""

from collections.abc import Sequence

import numpy as np
import pytest
from core_geometry import nees, wrapped
from core_run import settled
from hypothesis import given, settings
from hypothesis import strategies as st
from ir_swarm import SECOND, Event, Light, Plan, Run, play, simulate

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.timeline.estimator import Estimate, Status
from swarm_loc_estimator.timeline.settings import Settings

SLOW = Settings(horizon_s=4.0, fix_window_s=60.0)


def errors(run: Run, estimate: Estimate) -> FloatArray:
    difference: FloatArray = wrapped(estimate.poses - run.truth[estimate.stamp_ns])
    return difference


PLANS = [
    Plan(known=[4]),
    Plan(fixed=[0, 8]),
    Plan(fixed=[0, 8], walking=True),
    Plan(columns=4, fixed=[0, 15]),
]


@pytest.mark.parametrize("plan", PLANS, ids=["one surveyed in", "two fixed", "walking", "chains"])
def test_all_are_located_through_infrared_from_one_surveyed_in_or_two_with_fixes(plan: Plan) -> None:
    """The mean of all robots' normalised errors: they have much in common, so over some worlds."""
    normal = []
    for seed in range(4):
        run = simulate(plan, seed)
        estimator, estimates = play(run, settings=SLOW)
        assert (estimates[0].status == Status.WAITING).sum() >= plan.columns**2 - 1
        last = estimates[-2]
        assert (last.status == Status.TRACKED).all()
        error = errors(run, last)
        assert np.hypot(error[:, 0], error[:, 1]).max() < 0.02
        assert np.abs(error[:, 2]).max() < 0.12
        normal += [nees(errors(run, e), e.covariances).mean() for e in estimates[-20:-1:6]]
        counts = settled(estimator)
        assert counts["USED"] > 20 * counts["GATED"]
        lost = {reason: count for reason, count in estimator.drops.items() if reason.startswith("ir_")}
        assert sum(lost.values()) < 0.1 * counts["USED"], lost  # robots may walk into each other
    assert 0.8 < np.mean(normal) < 6.0


def test_robots_that_stand_for_long_do_not_take_repeated_errors_for_news() -> None:
    """Elements differ by an unknown 10 %: every exchange of two robots errs as the one before."""
    normal = []
    for seed in range(4):
        run = simulate(Plan(fixed=[0, 8], seconds=40.0, differ=0.1), seed)
        _, estimates = play(run, settings=SLOW)
        normal.append(nees(errors(run, estimates[-2]), estimates[-2].covariances).mean())
    assert 0.8 < np.mean(normal) < 6.0


def test_robots_that_all_start_unknown_wait_however_much_they_hear() -> None:
    estimator, estimates = play(simulate(Plan(seconds=6.0), 0))
    assert (estimates[-1].status == Status.WAITING).all()
    assert set(estimator.drops) == {"not_localized"}


def outcome(
    run: Run, arrivals: Sequence[tuple[int, Event]], period_s: float
) -> tuple[Estimate, dict[str, int], dict[str, int]]:
    estimator, estimates = play(run, arrivals, SLOW, period_s)
    end_ns = max(run.truth) + 4 * SECOND
    last = estimator.tick(end_ns)
    assert last.stamp_ns == end_ns
    assert len(estimates) > 5
    return last, estimator.drops, settled(estimator)


@settings(max_examples=8)
@given(
    seed=st.integers(0, 10**6),
    late_s=st.sampled_from([0.1, 1.0, 3.5]),
    lost=st.sampled_from([0.0, 0.2]),
    walking=st.booleans(),
)
def test_lateness_loss_and_repetition_of_matrices_change_nothing(
    seed: int, late_s: float, lost: float, walking: bool
) -> None:
    """Far and near come apart, in any order, also after one of them was used alone, and some come twice."""
    run = simulate(Plan(seconds=8.0, fixed=[0], known=[4], walking=walking), seed)
    rng = np.random.default_rng(seed)
    events = [event for event in run.events if rng.uniform() >= lost]
    orderly = [(event.stamp_ns, event) for event in events]
    wild = [(event.stamp_ns + int(rng.uniform(0.0, late_s) * SECOND), event) for event in events]
    doubled = [k for k in rng.integers(len(wild), size=6) if isinstance(wild[k][1], Light)]
    wild += [wild[k] for k in doubled]
    one, one_drops, one_counts = outcome(run, orderly, 0.5)
    other, other_drops, other_counts = outcome(run, wild, 0.3)
    np.testing.assert_array_equal(one.status, other.status)
    np.testing.assert_allclose(np.nan_to_num(wrapped(one.poses - other.poses)), 0.0, atol=1e-9)
    np.testing.assert_allclose(one.covariances, other.covariances, atol=1e-9)
    assert one_counts == other_counts
    assert other_drops.pop("duplicate", 0) == one_drops.pop("duplicate", 0) + len(doubled)
    assert one_drops == other_drops
