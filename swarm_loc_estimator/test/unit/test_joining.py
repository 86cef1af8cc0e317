"""Robots start unknown, get lost, are found again, fall silent and leave, and do the others no harm."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from core_geometry import marker_frame, nees, seen
from core_messages import POSE, POSE_TWO, POSITION, SECOND, T0, Event, detection, give_fix, quaternion
from core_run import on_time, play, settled, ticks
from core_world import MOUNT, Plan, World, simulate

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.filter.models import CARTESIAN
from swarm_loc_estimator.filter.state import InitialPose, new_innovations
from swarm_loc_estimator.filter.update import PREDICT, fuse
from swarm_loc_estimator.odometry.preintegration import Preintegrated
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.sensors.fix import about_robots
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator, Status
from swarm_loc_estimator.timeline.fusion import Fusion
from swarm_loc_estimator.timeline.settings import Policy, Settings


def errors(world: World, estimates: list[Estimate]) -> FloatArray:
    """Distances (T, N) between estimates and truth [m]; NaN where not located."""
    return np.array([np.hypot(*(e.poses - world.at(e.stamp_ns))[:, :2].T) for e in estimates])


def run(world: World, seconds: float, keep: Callable[[Event], bool] = lambda _: True) -> list[Estimate]:
    arrivals = [arrival for arrival in on_time(world) if keep(arrival[1])]
    return play(Estimator(world.swarm), arrivals, ticks(T0, T0 + round(seconds * SECOND)))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("content", [POSE, POSITION, POSE_TWO])
def test_a_swarm_with_unknown_starts_finds_itself(content: int, seed: int) -> None:
    world = simulate(Plan(2, 12.0, content=content, start_known=(False,), landmarks=5, flips=0.0), seed)
    estimates = run(world, 12.0)
    assert (estimates[0].status == Status.WAITING).all()
    assert (estimates[-1].status == Status.TRACKED).all()
    error = errors(world, estimates)
    assert error[-1].max() < 0.05
    for estimate in estimates:
        located = estimate.status != Status.WAITING
        difference = (estimate.poses - world.at(estimate.stamp_ns))[located]
        assert (nees(difference, estimate.covariances[located]) < 35.0).all()
    assert all(np.isnan(e.poses[e.status == Status.WAITING]).all() for e in estimates)


@pytest.mark.parametrize("seed", range(4))
def test_a_robot_that_sees_no_landmark_is_located_through_another(seed: int) -> None:
    world = simulate(Plan(2, 15.0, start_known=(True, False), landmarks=4), seed)
    for event in world.events:
        if event.robot == 1:
            event.detections["id"][event.detections["id"] >= 1000] = 99
    estimates = run(world, 15.0)
    error = errors(world, estimates)
    assert np.isfinite(error[-1, 1])
    assert np.nanmax(error[:, 1]) < 0.3
    assert estimates[-1].fix_age_s[1] == -1.0


@pytest.mark.parametrize("seed", range(5))
def test_mirrored_headings_do_not_mislead_a_robot_that_starts_unknown(seed: int) -> None:
    world = simulate(Plan(2, 10.0, content=POSE_TWO, start_known=(False,), landmarks=4, flips=0.4), seed)
    assert np.nanmax(errors(world, run(world, 10.0))) < 0.3


def standing(content: int, marks: int, mirrored: float = 0.0) -> list[Estimate]:
    """A robot that stands before landmarks and starts unknown."""
    world = simulate(Plan(1, 0.1, noise=0.0, start_known=(False,), landmarks=max(1, marks)), 0)
    base, arrivals = (0.1, 0.05, 0.3), []
    for k in range(60):
        stamp_ns = T0 + k * SECOND // 10
        arrivals.append((stamp_ns, Event(0, stamp_ns, (0.0, 0.0, 0.0))))
        for mark in world.swarm.landmarks[:marks]:
            one, other = (
                seen(base, MOUNT, marker_frame(mark.x, mark.y, mark.z, (mark.yaw or 0.0) + turn))
                for turn in (mirrored, 0.0)
            )
            found = detection(mark.id, one, content)
            found["alternative_orientation"] = quaternion(other[:3, :3])
            arrivals.append((stamp_ns, Event(0, stamp_ns, None, found)))
    return play(Estimator(world.swarm), arrivals, ticks(T0, T0 + 6 * SECOND))


@pytest.mark.parametrize(
    ("content", "marks", "mirrored"), [(POSITION, 1, 0.0), (POSE_TWO, 1, 0.6), (POSE_TWO, 1, -0.4)]
)
def test_what_fits_in_more_than_one_place_locates_nobody(content: int, marks: int, mirrored: float) -> None:
    assert {e.status[0] for e in standing(content, marks, mirrored)} == {Status.WAITING}


@pytest.mark.parametrize(
    ("content", "marks", "mirrored"), [(POSITION, 2, 0.0), (POSE, 1, 0.0), (POSE_TWO, 2, 0.6)]
)
def test_what_fits_in_one_place_only_locates_the_robot(content: int, marks: int, mirrored: float) -> None:
    last = standing(content, marks, mirrored)[-1]
    assert last.status[0] == Status.TRACKED
    np.testing.assert_allclose(last.poses[0], [0.1, 0.05, 0.3], atol=0.02)


@pytest.mark.parametrize("content", [POSE, POSITION])
@pytest.mark.parametrize("seed", range(4))
def test_a_robot_that_is_carried_away_is_found_again_and_harms_nobody(seed: int, content: int) -> None:
    plan = Plan(3, 16.0, content=content, landmarks=6, carried=(0,))
    world = simulate(plan, seed)
    estimates = run(world, 16.0)
    error = errors(world, estimates)
    assert error[81, 0] > 0.15 or np.isnan(error[81, 0])
    assert error[-1, 0] < 0.1
    assert np.nanmax(error[:, 1:]) < 0.15
    assert np.isfinite(error[:, 1:]).all()


def test_a_start_that_sightings_contradict_gives_way_to_them() -> None:
    world = simulate(Plan(1, 8.0), 0)
    robot = world.swarm.robots[0]
    x, y, theta = robot.start or (0.0, 0.0, 0.0)
    wrong = replace(robot, start=(x + 1.0, y - 1.0, theta + 1.0))
    world = replace(world, swarm=replace(world.swarm, robots=(wrong,)))
    estimator = Estimator(world.swarm)
    estimates = play(estimator, on_time(world), ticks(T0, T0 + 8 * SECOND))
    status = np.array([estimate.status[0] for estimate in estimates])
    assert status[0] == Status.UNCONFIRMED
    tracked = np.flatnonzero(status == Status.TRACKED)
    assert tracked[0] < 30  # ticks of 0.1 s
    assert errors(world, estimates)[tracked, 0].max() < 0.05


@pytest.mark.parametrize("many", [64, 1])
@pytest.mark.parametrize(
    ("lost_sigma", "lost_heading_sigma", "is_lost"),
    [(1e3, 10.0, False), (0.05, 10.0, True), (1e3, 0.2, True)],
)
def test_a_robot_too_unsure_after_a_silence_waits_and_is_found_again(
    lost_sigma: float, lost_heading_sigma: float, is_lost: bool, many: int
) -> None:
    world, silent_ns, heard_ns = simulate(Plan(1, 8.0), 1), T0 + 2 * SECOND, T0 + 7 * SECOND // 2
    limits = Settings(
        lost_sigma=lost_sigma,
        lost_heading_sigma=lost_heading_sigma,
        policy=Policy(large_from=1, batch_from=many),
    )
    arrivals = [(t, e) for t, e in on_time(world) if not silent_ns < t < heard_ns]
    estimates = play(Estimator(world.swarm, limits), arrivals, ticks(T0, T0 + 8 * SECOND))
    before = [e.status[0] for e in estimates if e.stamp_ns < heard_ns]
    after = [e.status[0] for e in estimates if e.stamp_ns >= heard_ns]
    assert Status.WAITING not in before
    assert (Status.WAITING in after) == is_lost
    assert after[-1] == Status.TRACKED
    assert errors(world, estimates)[-1, 0] < 0.05


@pytest.mark.parametrize(("lost_sigma", "lost_heading_sigma"), [(0.03, 10.0), (1e3, 0.08)])
def test_a_robot_too_uncertain_is_not_tracked_though_nothing_measures_it(
    lost_sigma: float, lost_heading_sigma: float
) -> None:
    """A heading alone makes no position uncertain, but one from which the position depends does."""
    world = simulate(Plan(2, 12.0), 1)
    arrivals = [(t, e) for t, e in on_time(world) if e.pose is not None or t < T0 + 4 * SECOND]
    instants = ticks(T0, T0 + 12 * SECOND)
    settings = Settings(lost_sigma=lost_sigma, lost_heading_sigma=lost_heading_sigma)
    limited = play(Estimator(world.swarm, settings), arrivals, instants)
    free = play(Estimator(world.swarm, Settings(lost_sigma=1e3, lost_heading_sigma=10.0)), arrivals, instants)
    for estimate, other in zip(limited, free, strict=True):
        variance = np.diagonal(estimate.covariances, axis1=1, axis2=2)
        beyond = variance[:, :2].max(axis=1) > lost_sigma**2
        unknown = variance[:, 2] > lost_heading_sigma**2
        # the part of the variance of the position that the heading explains
        explained = np.sum(estimate.covariances[:, :2, 2] ** 2, axis=1) / variance[:, 2]
        beyond |= unknown & (explained > 0.1 * variance[:, :2].sum(axis=1))
        was_tracked = other.status == Status.TRACKED
        np.testing.assert_array_equal(
            estimate.status, np.where(beyond & was_tracked, Status.UNCERTAIN, other.status)
        )
        np.testing.assert_array_equal(estimate.heading_known, ~unknown)
        np.testing.assert_array_equal(estimate.poses, other.poses)
        np.testing.assert_array_equal(estimate.covariances, other.covariances)
    assert (limited[40].status == Status.TRACKED).all()
    assert (limited[-1].status == Status.UNCERTAIN).any()


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_robot_unsure_at_one_of_many_measurements_is_lost_in_whatever_order_they_come(
    order: tuple[int, int],
) -> None:
    """Far from the origin of its track an unsure heading makes for an unsure place."""
    swarm = Swarm((Robot("a"),))
    tracks = OdometryTracks(swarm.robots)
    stamps_ns = T0 + np.array([0, SECOND // 10])
    tracks.extend(np.zeros(2, dtype=np.int64), stamps_ns, np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]))
    limits = Settings(lost_sigma=0.05, lost_heading_sigma=10.0)
    steps = Fusion(swarm, limits, tracks, {})
    state = steps.new_state()
    state.initialize(0, InitialPose(np.zeros(3), np.diag([1e-6, 1e-6, 1.0])), Preintegrated.begin(T0))
    fixes = about_robots(0, stamps_ns, np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)), CARTESIAN)
    rows, work = select(fixes, np.array(order)), new_innovations(2, 1, 1)
    results = np.zeros(2, dtype=np.uint8), np.zeros(2)
    fuse(rows, 0, PREDICT, T0, tracks.arrays, state.arrays(), steps._limits, work, *results)
    assert (work.lost > 0).tolist() == [True, False]
    steps._deinitialize(state, work, T0)
    assert not state.tracked[0]


def test_a_robot_silent_for_a_minute_comes_back() -> None:
    world = simulate(Plan(2, 70.0, camera_hz=1.0), 2)
    begin_ns, end_ns = T0 + 5 * SECOND, T0 + 65 * SECOND
    estimator = Estimator(world.swarm)
    arrivals = [(t, e) for t, e in on_time(world) if e.robot != 0 or not begin_ns < t < end_ns]
    estimates = play(estimator, arrivals, ticks(T0, T0 + 70 * SECOND, 0.5))
    status = np.array([estimate.status for estimate in estimates])
    assert set(status[16:120, 0]) <= {Status.STALE, Status.WAITING}
    assert (status[6:, 1] == Status.TRACKED).all()
    error = errors(world, estimates)
    assert error[:, 1].max() < 0.15
    assert error[-1, 0] < 0.1


def test_a_robot_that_leaves_does_not_hold_the_others_up() -> None:
    world = simulate(Plan(3, 10.0), 3)
    stay = run(world, 10.0, lambda e: e.robot != 2 or e.stamp_ns < T0 + 3 * SECOND)
    assert stay[-1].status[2] != Status.TRACKED
    assert errors(world, stay)[-1, :2].max() < 0.05


def test_an_operator_seats_and_forgets_a_robot() -> None:
    world = simulate(Plan(1, 6.0, landmarks=0), 1)
    estimator = Estimator(world.swarm)
    play(estimator, on_time(world), ticks(T0, T0 + 3 * SECOND))
    stamp_ns = T0 + 2 * SECOND
    assert not estimator.set_pose(0, stamp_ns, world.at(stamp_ns)[0], np.diag([1e-6, 1e-6, 1e-6]))
    rest = [arrival for arrival in on_time(world) if arrival[0] > T0 + 3 * SECOND]
    last = play(estimator, rest, ticks(T0 + 3 * SECOND, T0 + 4 * SECOND))[-1]
    assert errors(world, [last])[0, 0] < 0.02
    estimator.forget(0, T0 + 4 * SECOND)
    assert estimator.tick(T0 + 4 * SECOND).status[0] == Status.WAITING
    assert estimator.tick(T0 + 5 * SECOND).status[0] == Status.WAITING


def test_a_robot_that_waits_enters_with_the_third_exact_fix_and_the_fourth_confirms_it() -> None:
    world = simulate(Plan(1, 4.0, landmarks=0, start_known=(False,)), 5)
    estimator, status = Estimator(world.swarm), []
    for stamp_ns, event in on_time(world):
        event.give(estimator, stamp_ns)
        if (stamp_ns - T0) % SECOND == 0:
            give_fix(estimator, 0, stamp_ns, world.at(stamp_ns)[0], 1e-6 * np.eye(3), stamp_ns)
            status.append((estimator.tick(stamp_ns).status[0], *estimator.counters.values()))
    waiting, assumed, tracked = Status.WAITING, Status.UNCONFIRMED, Status.TRACKED
    assert status == [(waiting, 0, 1), (waiting, 0, 2), (assumed, 0, 3), (tracked, 1, 3), (tracked, 2, 3)]
    assert not estimator.drops


def test_fixes_from_outside_locate_and_hold_a_robot() -> None:
    world = simulate(Plan(1, 6.0, landmarks=0, start_known=(False,)), 5)
    estimator = Estimator(world.swarm)
    rng = np.random.default_rng(0)
    estimates = []
    for stamp_ns, event in on_time(world):
        event.give(estimator, stamp_ns)
        pose = world.at(stamp_ns)[0] + 0.01 * rng.standard_normal(3)
        pose[2] = math.nan if rng.uniform() < 0.5 else pose[2]
        give_fix(estimator, 0, stamp_ns, pose, 1e-4 * np.eye(3), stamp_ns)
        estimates.append(estimator.tick(stamp_ns))
    assert estimates[-1].fix_age_s[0] == 0.0
    last = estimates[-1].poses[0] - world.at(estimates[-1].stamp_ns)[0]
    assert nees(last, estimates[-1].covariances[0]) < 20.0
    assert settled(estimator)["GATED"] < 5
