"""Law: what arrives within the horizon counts the same in any order, and whenever the estimator ticks."""

import math
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from core_geometry import marker_frame, seen, wrapped
from core_messages import POSE, POSE_TWO, POSITION, SECOND, T0, Event, detection, give_fix, joined
from core_run import on_time, play, settled, ticks
from core_world import MOUNT, Plan, World, simulate
from hypothesis import example, given, settings
from hypothesis import strategies as st

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator, Status
from swarm_loc_estimator.timeline.settings import Policy, Settings

Arrival = tuple[int, Event]
EXACT = Settings(fusion_period_s=0.0)


@dataclass
class Outcome:
    """An estimator at the end of a run, and its last estimate."""

    estimator: Estimator
    estimate: Estimate


def outcome(
    world: World,
    arrivals: Sequence[Arrival],
    at_ns: Sequence[int],
    settings: Settings = EXACT,
    resting_ns: Container[int] = (),
) -> Outcome:
    estimator = Estimator(world.swarm, settings)
    return Outcome(estimator, play(estimator, arrivals, at_ns, resting_ns)[-1])


def assert_same(a: Outcome, b: Outcome) -> None:
    np.testing.assert_array_equal(a.estimate.status, b.estimate.status)
    difference = wrapped(a.estimate.poses - b.estimate.poses)
    np.testing.assert_array_equal(np.isnan(a.estimate.poses), np.isnan(b.estimate.poses))
    np.testing.assert_allclose(np.nan_to_num(difference), 0.0, atol=1e-9)
    np.testing.assert_allclose(a.estimate.covariances, b.estimate.covariances, atol=1e-9)
    np.testing.assert_allclose(a.estimate.fix_age_s, b.estimate.fix_age_s, atol=1e-9)
    assert settled(a.estimator) == settled(b.estimator)


USUAL: dict[str, Any] = {
    "robots": 4,
    "content": POSE,
    "start_known": (True,),
    "fusion_period_s": 0.2,
    "delay_s": None,
    "outliers": 0.0,
    "lost_after": 2,
    "late_s": 1.0,
    "lasting": 0.0,
    "sparse": False,
}
"""What the examples below have in common."""


@settings(max_examples=15)
@given(
    seed=st.integers(0, 10**6),
    robots=st.integers(1, 4),
    content=st.sampled_from([POSE, POSITION, POSE_TWO]),
    start_known=st.sampled_from([(True,), (False,), (True, False), (True, True, False)]),
    fusion_period_s=st.sampled_from([0.0, 0.2, 0.5]),
    delay_s=st.sampled_from([None, 0.0, 0.3, 1.0]),
    outliers=st.sampled_from([0.0, 0.1, 0.6]),
    lost_after=st.sampled_from([2, 12]),
    late_s=st.sampled_from([0.3, 1.0, 1.9]),
    lasting=st.sampled_from([0.0, 1.0]),
    sparse=st.booleans(),
)
@example(  # robots that start unknown, are gated and lost, in the sparse filter
    **(USUAL | {"seed": 7, "start_known": (True, False), "outliers": 0.1, "sparse": True})
)
@example(  # a sighting at the very stamp of the newest odometry
    **(USUAL | {"seed": 3312, "outliers": 0.1, "sparse": True})
)
@example(  # the last of a period comes with the first of the next, or before it
    **(USUAL | {"seed": 235, "robots": 2, "fusion_period_s": 0.5, "late_s": 0.3})
)
@example(  # periods of a large swarm, which wait
    **(USUAL | {"seed": 11, "delay_s": 0.3, "late_s": 0.3, "sparse": True})
)
def test_any_lateness_loss_repetition_and_ticking_gives_the_same(
    seed: int,
    robots: int,
    content: int,
    start_known: Sequence[bool],
    fusion_period_s: float,
    delay_s: float | None,
    outliers: float,
    lost_after: int,
    late_s: float,
    lasting: float,
    sparse: bool,
) -> None:
    rng = np.random.default_rng(seed)
    plan = Plan(robots, 3.5, 0.2, content=content, start_known=start_known, outliers=outliers, flips=0.1)
    world = simulate(replace(plan, lasting=lasting, survey=lasting), seed)
    chosen = Settings(
        fusion_period_s=fusion_period_s,
        fusion_delay_s=delay_s or 0.0,
        sparse_from=2 if sparse else 250,
        lost_after=lost_after,
        # so that a small swarm's measurements are fused together, too, and wait
        policy=Policy(large_from=1, batch_from=5)
        if delay_s is None
        else Policy(large_from=1, batch_from=5, delay_from=1),
    )
    events = [event for event in world.events if rng.uniform() < 0.9]
    silent = rng.integers(robots)  # for longer than its motion counts as known
    events = [
        e for e in events if e.pose is None or e.robot != silent or not 1.2 < (e.stamp_ns - T0) / SECOND < 2.6
    ]
    end_ns = T0 + 11 * SECOND // 2
    orderly = [(event.stamp_ns, event) for event in events]
    arrivals = [(event.stamp_ns + int(rng.uniform(0, late_s) * SECOND), event) for event in events]
    arrivals += [arrivals[k] for k in rng.integers(0, len(arrivals), 5)]
    resting = {int(t) for t in rng.integers(T0, end_ns, 40)}
    wild = sorted({*ticks(T0, end_ns, 0.09), *resting})
    assert_same(
        outcome(world, orderly, ticks(T0, end_ns, 0.25), chosen),
        outcome(world, arrivals, wild, chosen, resting),
    )


@example(  # a description that is opened again
    seed=1384, start_known=(True,), fusion_period_s=0.0, late_s=0.3, part=0.0, sparse=False
)
@settings(max_examples=15)
@given(
    seed=st.integers(0, 10**6),
    start_known=st.sampled_from([(True,), (False,), (True, False)]),
    fusion_period_s=st.sampled_from([0.0, 0.2, 0.5]),
    late_s=st.sampled_from([0.3, 1.0]),
    part=st.sampled_from([0.0, 0.5, 0.8]),
    sparse=st.booleans(),
)
def test_fusing_a_few_steps_at_each_tick_gives_the_same(
    seed: int, start_known: Sequence[bool], fusion_period_s: float, late_s: float, part: float, sparse: bool
) -> None:
    rng = np.random.default_rng(seed)
    world = simulate(Plan(4, 3.5, 0.2, start_known=start_known, outliers=0.1, flips=0.1), seed)
    # so long a horizon that nothing is too old, however long it waits
    chosen = Settings(
        fusion_period_s=fusion_period_s,
        sparse_from=2 if sparse else 250,
        horizon_s=20.0,
        lost_after=2,
        policy=Policy(large_from=1, batch_from=5),
    )
    arrivals = [(event.stamp_ns + int(rng.uniform(0, late_s) * SECOND), event) for event in world.events]
    at_ns = ticks(T0, T0 + 6 * SECOND, 0.09)
    in_parts = Estimator(world.swarm, chosen)
    estimates = play(in_parts, arrivals, at_ns, has_budget=lambda: bool(rng.uniform() < part))
    assert all(np.isfinite(one.poses[one.status != Status.WAITING]).all() for one in estimates)
    for _ in range(2):  # what was begun, then what has come since
        last = in_parts.tick(at_ns[-1])
    assert not in_parts.is_fusing
    assert_same(outcome(world, arrivals, at_ns, chosen), Outcome(in_parts, last))


def test_poses_are_given_while_fusing_takes_several_ticks() -> None:
    """By what was known before it began: never by less."""
    world = small()
    estimator = Estimator(world.swarm, replace(EXACT, fusion_period_s=0.2))
    play(estimator, delayed(driving(world, 1.0), lambda _: 0.0), ticks(T0, T0 + SECOND))
    late = [sighting(world, t, 0.1 * t) for t in (0.31, 0.51, 0.71, 0.91)]
    arrivals = [(T0 + SECOND + 1, event) for event in late]
    before = estimator.tick(T0 + SECOND).covariances
    known = np.trace(own_covariance(estimator))
    (estimate,), ticked = play(estimator, arrivals, [T0 + SECOND + 1], has_budget=lambda: False), 1
    while estimator.is_fusing:
        np.testing.assert_allclose(estimate.covariances, before, rtol=1e-6)
        estimate, ticked = estimator.tick(T0 + SECOND + 1, has_budget=lambda: False), ticked + 1
    assert ticked > 2
    assert np.trace(own_covariance(estimator)) < 0.98 * known
    assert not np.allclose(estimate.covariances, before, rtol=1e-3)


def own_covariance(estimator: Estimator) -> FloatArray:
    """Of the position of the first robot, by the filter: the estimate adds errors that repeat."""
    return np.asarray(estimator._timeline.state.filter.block(np.arange(2)))


def small(robots: int = 1) -> World:
    """One landmark ahead; nobody moves unless the test says so."""
    plan = Plan(robots, 0.1, landmarks=3, noise=0.0)
    world = simulate(plan, 0)
    chosen = [replace(robot, start=(0.0, 0.0, 0.0)) for robot in world.swarm.robots]
    return replace(world, swarm=replace(world.swarm, robots=tuple(chosen)), events=())


def odometry(seconds: float, x: float, robot: int = 0) -> Event:
    return Event(robot, T0 + round(seconds * SECOND), (x, 0.0, 0.0))


def sighting(world: World, seconds: float, x: float, robot: int = 0, off: float = 0.02) -> Event:
    mark = world.swarm.landmarks[0]
    frame = marker_frame(mark.x + off, mark.y + 0.5 * off, mark.z, mark.yaw or 0.0)
    return Event(
        robot, T0 + round(seconds * SECOND), None, detection(mark.id, seen((x, 0.0, 0.0), MOUNT, frame))
    )


def driving(world: World, until_s: float, robot: int = 0, step_s: float = 0.05) -> list[Event]:
    """Odometry and sightings of a robot that drives straight ahead."""
    seconds = np.arange(0.0, until_s, step_s)
    rows = [odometry(t, 0.1 * t, robot) for t in seconds]
    return rows + [sighting(world, t, 0.1 * t, robot) for t in seconds[3::3]]


def delayed(events: Sequence[Event], late_s: Callable[[Event], float]) -> list[Arrival]:
    return [(event.stamp_ns + round(late_s(event) * SECOND), event) for event in events]


def since_start(event: Event) -> float:
    return (event.stamp_ns - T0) / SECOND


@pytest.mark.parametrize("first_s", [0.0, 0.5])
def test_a_robot_s_first_odometry_may_come_last(first_s: float) -> None:
    """The start pose holds where the odometry begins, also for a robot that nobody has measured since."""
    world = small(2)
    events = driving(world, 3.0) + [odometry(t, 0.2 * t, 1) for t in np.arange(first_s, 3.0, 0.05)]
    late = delayed(events, lambda e: 1.5 if e.robot == 1 and since_start(e) < first_s + 0.4 else 0.0)
    at_ns = ticks(T0, T0 + 4 * SECOND)
    assert_same(outcome(world, delayed(events, lambda _: 0.0), at_ns), outcome(world, late, at_ns))


def test_a_sighting_before_the_odometry_begins_is_untied_whenever_ticks_fall() -> None:
    world = small()
    rows = [odometry(t, 0.0) for t in np.arange(1.01, 2.0, 0.05)]
    events = [*rows, sighting(world, 1.005, 0.0), sighting(world, 1.03, 0.0)]
    at_once = outcome(world, delayed(events, lambda _: 0.0), [T0, T0 + 2 * SECOND])
    often = outcome(world, delayed(events, lambda _: 0.0), ticks(T0, T0 + 2 * SECOND, 0.004))
    assert_same(at_once, often)
    assert at_once.estimator.drops == {"not_localized": 1}


@pytest.mark.parametrize("step_s", [0.05, 0.3, 0.9])
def test_odometry_that_comes_at_the_edge_of_the_horizon_changes_what_lay_before_it(step_s: float) -> None:
    world = small()
    rows = [odometry(t, 0.1 * t + 0.05 * math.sin(5 * t)) for t in np.arange(0.0, 6.0, step_s)]
    events = rows + [sighting(world, t, 0.1 * t) for t in np.arange(0.1, 6.0, 0.11)]
    late = delayed(events, lambda e: 1.995 if e.pose and int(since_start(e) / step_s) % 3 == 1 else 0.0)
    at_ns = ticks(T0, T0 + 8 * SECOND, 0.005)
    assert_same(outcome(world, delayed(events, lambda _: 0.0), at_ns), outcome(world, late, at_ns))


def test_odometry_after_a_long_silence_may_be_late() -> None:
    world = small()
    rows = [odometry(t, 0.0) for t in (*np.arange(0.0, 1.0, 0.05), *np.arange(6.0, 8.0, 0.05))]
    events = rows + [sighting(world, t, 0.0) for t in np.arange(0.1, 8.0, 0.1)]
    late = delayed(events, lambda e: 1.5 if e.pose and since_start(e) > 5.0 else 0.0)
    at_ns = ticks(T0, T0 + 10 * SECOND)
    assert_same(outcome(world, delayed(events, lambda _: 0.0), at_ns), outcome(world, late, at_ns))


@pytest.mark.parametrize("what", ["odometry", "sightings", "orders"])
def test_what_shares_a_stamp_counts_the_same_in_any_order(what: str) -> None:
    world = small()
    base = delayed(driving(world, 2.0), lambda _: 0.0)
    pair = [odometry(1.0, 0.08), odometry(1.0, 0.09)]
    if what == "sightings":  # alike in their first number
        pair = [sighting(world, 0.97, 0.1), sighting(world, 0.97, 0.1)]
        pair[1].detections["position"][0, 0] += 0.01
    outcomes = []
    for order in (pair, pair[::-1]):
        estimator = Estimator(world.swarm, EXACT)
        play(estimator, base, ticks(T0, T0 + SECOND))
        for number, event in enumerate(order):
            if what == "orders":
                _give_order(estimator, number if order is pair else 1 - number)
            else:
                event.give(estimator, T0 + SECOND + number * SECOND // 2)
            last = estimator.tick(T0 + SECOND + number * SECOND // 2 + 1)
        outcomes.append(Outcome(estimator, last))
    assert_same(*outcomes)


def _give_order(estimator: Estimator, number: int) -> None:
    """A seat, or a fix at the same instant."""
    pose, covariance = np.array([0.0, 0.1, 0.2]), 1e-4 * np.eye(3)
    if number:
        give_fix(estimator, 0, T0 + SECOND, pose, covariance, T0 + SECOND)
    else:
        estimator.set_pose(0, T0 + SECOND, pose, covariance)


def test_a_repeated_message_counts_once_and_two_sightings_of_a_marker_twice() -> None:
    world = small()
    events = driving(world, 1.0)
    estimator = Estimator(world.swarm, EXACT)
    play(estimator, delayed(events + events, lambda _: 0.0), ticks(T0, T0 + SECOND))
    rows = sum(event.pose is not None for event in events)
    assert estimator.drops == {"duplicate": len(events) - rows, "odometry_duplicate": rows}
    twice = joined([sighting(world, 0.8, 0.08, off=o).detections for o in (0.0, 0.01)])
    Event(0, T0 + 8 * SECOND // 10, None, twice).give(estimator, T0 + SECOND)
    estimator.tick(T0 + SECOND)
    assert estimator.used == len(events) - rows + 2


def test_late_orders_count_at_their_own_time() -> None:
    world = small()
    arrivals = delayed(driving(world, 3.0), lambda _: 0.0)
    results = []
    for asked_s in (1.0, 2.4):
        estimator = Estimator(world.swarm, EXACT)
        play(
            estimator,
            [a for a in arrivals if a[0] <= T0 + asked_s * SECOND],
            ticks(T0, T0 + int(asked_s * SECOND)),
        )
        estimator.set_pose(0, T0 + SECOND, (0.5, 0.5, 1.0), 1e-6 * np.eye(3))
        rest = [a for a in arrivals if a[0] > T0 + asked_s * SECOND]
        last = play(estimator, rest, ticks(T0 + int(asked_s * SECOND), T0 + 3 * SECOND))[-1]
        results.append(Outcome(estimator, last))
    assert_same(*results)


def test_a_clock_that_wobbles_neither_resets_nor_breaks() -> None:
    world = small()
    estimator = Estimator(world.swarm, EXACT)
    play(estimator, delayed(driving(world, 6.0), lambda _: 0.0), ticks(T0, T0 + 6 * SECOND))
    back_ns = T0 + 6 * SECOND - 4 * SECOND // 10
    sighting(world, 3.65, 0.365).give(estimator, back_ns)
    assert np.isfinite(estimator.tick(back_ns).poses).all()
    assert estimator.time_jumps == 0
    assert estimator.drops == {"too_old": 1}


@pytest.mark.parametrize("lasting", [0.0, 1.0])
@pytest.mark.parametrize("sparse_from", [2, 250])
def test_the_same_data_give_the_same_bytes(sparse_from: int, lasting: float) -> None:
    plan = Plan(3, 3.0, flips=0.1, content=POSE_TWO, lasting=lasting, survey=lasting)
    world, chosen = (simulate(plan, 3), Settings(sparse_from=sparse_from))
    a, b = (outcome(world, on_time(world), ticks(T0, T0 + 3 * SECOND), chosen).estimate for _ in range(2))
    assert a.poses.tobytes() == b.poses.tobytes()
    assert a.covariances.tobytes() == b.covariances.tobytes()


@settings(max_examples=6)
@given(seed=st.integers(0, 10**6), content=st.sampled_from([POSITION, POSE_TWO]))
def test_robots_that_wait_long_are_located_at_the_same_instant(seed: int, content: int) -> None:
    """Each sees a landmark at once, so has some clues, and more when it has turned."""
    plan = Plan(2, 6.0, 0.04, landmarks=2, start_known=(False,), camera_hz=6.67, watching=True)
    world = simulate(replace(plan, content=content, flips=0.4), seed)
    rng = np.random.default_rng(seed)
    arrivals = delayed(world.events, lambda _: rng.uniform(0.0, 1.9))
    orderly = outcome(world, delayed(world.events, lambda _: 0.0), ticks(T0, T0 + 8 * SECOND, 0.25))
    assert_same(orderly, outcome(world, arrivals, ticks(T0, T0 + 8 * SECOND, 0.11)))
    assert settled(orderly.estimator)["CONSTRAINT"] > 5
