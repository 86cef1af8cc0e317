"""Swarms are localized by anonymous detections from above, in any order of arrival."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from aerial_world import AerialWorld, View, seen_from_above
from core_geometry import nees, wrapped
from core_messages import SECOND, T0, Event
from core_run import errors, on_time, play, settled, ticks
from core_world import Plan, World
from hypothesis import given, settings
from hypothesis import strategies as st

from swarm_loc_estimator.timeline.estimator import Estimate, Estimator, Status
from swarm_loc_estimator.timeline.settings import Settings

UNKNOWN = Plan(4, 15.0, 0.15, start_known=(False,))
Arrival = tuple[int, Event]


def run(
    world: World, arrivals: Sequence[Arrival], period_s: float = 0.25, settings: Settings | None = None
) -> tuple[Estimator, list[Estimate]]:
    estimator = Estimator(world.swarm, settings)
    last_ns = max(arrival_ns for arrival_ns, _ in arrivals)
    return estimator, play(estimator, arrivals, ticks(T0, last_ns, period_s))


@pytest.mark.parametrize("headings", [False, True])
@pytest.mark.parametrize("seed", [1, 2])
def test_robots_with_unknown_starts_are_localized_from_above_alone(seed: int, headings: bool) -> None:
    world = seen_from_above(UNKNOWN, View(headings=headings), seed).world
    estimator, estimates = run(world, on_time(world))
    error = errors(world, estimates)
    assert (estimates[0].status == Status.WAITING).all()
    assert (estimates[-1].status == Status.TRACKED).all()
    assert np.hypot(error[-1, :, 0], error[-1, :, 1]).max() < 0.04
    known = np.isfinite(error).all(axis=-1)
    covariances = np.array([one.covariances for one in estimates])
    assert 0.1 < np.mean(nees(error[known], covariances[known])) < 5.0
    assert estimator.counters["identities answered"] >= 4
    assert (estimates[-1].fix_age_s < 1.0).all()


def test_identities_are_told_with_their_probabilities() -> None:
    seen: AerialWorld = seen_from_above(UNKNOWN, View(), 1)
    estimator, _ = run(seen.world, on_time(seen.world))
    newest = estimator.identities
    assert newest is not None
    which = seen.robot[newest.stamp_ns]
    for robot, place in enumerate(newest.place.tolist()):
        assert place < 0 or which[place] == robot
    assert (newest.place >= 0).sum() >= 3
    assert (newest.probability[newest.place >= 0] >= 0.9).all()


def test_known_starts_are_confirmed_and_keep_their_accuracy() -> None:
    world = seen_from_above(replace(UNKNOWN, start_known=(True,)), View(), 3).world
    estimator, estimates = run(world, on_time(world))
    assert (estimates[-1].status == Status.TRACKED).all()
    assert "identities answered" not in estimator.counters
    assert np.hypot(*errors(world, estimates)[-1, :, :2].T).max() < 0.04


def test_a_robot_that_was_carried_away_finds_itself_anew() -> None:
    world = seen_from_above(replace(UNKNOWN, duration_s=30.0, carried=(1,)), View(), 1).world
    estimator, estimates = run(world, on_time(world))
    assert estimates[-1].status[1] == Status.TRACKED
    assert np.hypot(*errors(world, estimates)[-1, 1, :2]) < 0.04
    assert estimator.counters["identities answered"] >= 5


def test_robots_that_do_not_move_get_no_answer_and_its_reason() -> None:
    world = seen_from_above(replace(UNKNOWN, standing=(0, 1, 2, 3)), View(), 1).world
    estimator, estimates = run(world, on_time(world))
    assert (estimates[-1].status == Status.WAITING).all()
    assert estimator.counters["identities not moved"] > 50
    assert "identities answered" not in estimator.counters
    newest = estimator.identities
    assert newest is not None
    assert (newest.place == -1).all()
    assert (newest.probability < 0.5).all()


@settings(max_examples=5, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    start_known=st.sampled_from([(False,), (True, False), (True,)]),
    headings=st.booleans(),
    late_s=st.sampled_from([0.3, 1.9]),
    carried=st.booleans(),
)
def test_any_lateness_loss_and_repetition_gives_the_same(
    seed: int, start_known: Sequence[bool], headings: bool, late_s: float, carried: bool
) -> None:
    rng = np.random.default_rng(seed)
    plan = Plan(3, 7.0, 0.2, start_known=start_known, carried=(0,) if carried else ())
    world = seen_from_above(plan, View(detected=0.9, false=0.3, headings=headings), seed).world
    events = [event for event in world.events if rng.uniform() < 0.9]
    orderly = [(event.stamp_ns, event) for event in events]
    late = [(event.stamp_ns + int(rng.uniform(0, late_s) * SECOND), event) for event in events]
    late += [late[k] for k in rng.integers(0, len(late), 5)]
    end = (T0 + 10 * SECOND, Event(0, T0 + 8 * SECOND, (0.0, 0.0, 0.0)))
    (a, estimates), (b, others) = (
        run(world, [*one, end], period) for one, period in ((orderly, 0.25), (late, 0.11))
    )
    one, other = estimates[-1], others[-1]
    np.testing.assert_array_equal(one.status, other.status)
    difference = wrapped(one.poses - other.poses)
    np.testing.assert_array_equal(np.isnan(one.poses), np.isnan(other.poses))
    np.testing.assert_allclose(np.nan_to_num(difference), 0.0, atol=1e-9)
    np.testing.assert_allclose(one.covariances, other.covariances, atol=1e-9)
    assert settled(a) == settled(b)
    assert {k: v for k, v in a.counters.items() if "identities" in k} == {
        k: v for k, v in b.counters.items() if "identities" in k
    }


def test_blobs_that_are_nobodys_are_counted_and_change_nothing() -> None:
    """Known starts, and many more blobs than robots, all far away."""
    world = seen_from_above(replace(UNKNOWN, start_known=(True,)), View(), 5).world
    far = np.tile(next(event for event in world.events if event.aerial.size).aerial[:1], 20)
    far["x"] = 50.0 + np.arange(20)
    crowded = [
        (one.stamp_ns, replace(one, aerial=np.concatenate([one.aerial, far[: 20 * (one.aerial.size > 0)]])))
        for one in world.events
    ]
    estimator, estimates = run(world, crowded)
    _, clean = run(world, on_time(world))
    assert estimator.drops["aerial_unassigned"] + settled(estimator)["CONSTRAINT"] >= 20 * 25
    np.testing.assert_allclose(estimates[-1].poses, clean[-1].poses, atol=0.02)


def test_numbers_that_cannot_be_used_are_dropped_by_their_reasons() -> None:
    world = seen_from_above(replace(UNKNOWN, start_known=(True,), duration_s=2.0), View(), 6).world
    bad = next(event for event in world.events if event.aerial.size).aerial[:4].copy()
    bad["x"][0], bad["y"][1], bad["covariance"][2, 0, 0] = np.nan, 1e9, -2.0
    bad["covariance"][3, 0, 0] = -1.0  # not known: taken from the settings
    estimator, _ = run(world, [*on_time(world), (T0 + SECOND, Event(-1, T0 + SECOND - 1, aerial=bad))])
    drops = estimator.drops
    assert (drops["non_finite"], drops["absurd"], drops["bad_covariance"]) == (1, 1, 1)


def test_old_and_repeated_images_are_counted() -> None:
    world = seen_from_above(replace(UNKNOWN, duration_s=6.0), View(), 7).world
    images = [event for event in world.events if event.aerial.size]
    extra = [(images[-2].stamp_ns + SECOND // 10, images[-2]), (images[-1].stamp_ns, images[0])]
    estimator, _ = run(world, [*on_time(world), *extra])
    assert estimator.drops["duplicate"] == images[-2].aerial.size
    assert estimator.drops["too_old"] == images[0].aerial.size


def test_a_reset_forgets_who_is_who() -> None:
    world = seen_from_above(UNKNOWN, View(), 1).world
    estimator, _ = run(world, on_time(world))
    estimator.reset()
    assert estimator.identities is None
    assert (estimator.tick(T0 + 20 * SECOND).status == Status.WAITING).all()
