"""Laws: what is not finite never enters, every datum is used or counted, a jump back in time starts anew."""

import math
from dataclasses import replace

import numpy as np
import pytest
from core_geometry import marker_frame, nees, seen
from core_messages import POSE, POSE_TWO, POSITION, SECOND, T0, Event, detection, give_fix, joined
from core_run import on_time, play, settled, ticks
from core_world import MOUNT, Plan, World, simulate
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator, Status
from swarm_loc_estimator.timeline.settings import Policy, Settings

END = T0 + 4 * SECOND


def world() -> World:
    return simulate(Plan(2, 4.0), 1)


def assert_sound(estimate: Estimate) -> None:
    """What is located has finite numbers and positive definite covariances, the rest is not a number."""
    located = estimate.status != Status.WAITING
    assert np.isnan(estimate.poses[~located]).all()
    assert np.isfinite(estimate.poses[located]).all()
    for covariance in estimate.covariances[located]:
        scale = np.sqrt(np.diag(covariance))
        assert np.linalg.eigvalsh(covariance / np.outer(scale, scale)).min() > 0.0


def spoiled(name: str, value: float, content: int = POSE_TWO) -> NDArray[np.void]:
    one = detection(1000, marker_frame(0.0, 0.0, 1.0, 0.0), content)
    one[name].flat[0] = value
    return one


BAD_NUMBERS = [
    (name, value, content)
    for name in ("position", "orientation", "covariance", "alternative_position", "alternative_orientation")
    for value in (math.nan, math.inf, -math.inf, 1e300, 1e-300)
    for content in (POSITION, POSE, POSE_TWO)
]


def test_no_number_in_a_sighting_breaks_anything() -> None:
    run = world()
    clean = play(Estimator(run.swarm), on_time(run), ticks(T0, END))[-1]
    estimator = Estimator(run.swarm)
    bad = [
        Event(k % 2, T0 + SECOND + k * SECOND // 50, None, spoiled(*number))
        for k, number in enumerate(BAD_NUMBERS)
    ]
    estimates = play(estimator, on_time(run) + [(e.stamp_ns, e) for e in bad], ticks(T0, END, 0.05))
    for estimate in estimates:
        assert_sound(estimate)
    assert np.abs(estimates[-1].poses - clean.poses).max() < 0.05
    assert estimator.drops["non_finite"] == 30


@pytest.mark.parametrize("sigma", [1e-150, 1e-10, 1e-6, 1e-3, 1e3, 1e10, 1e100, 1e153])
@pytest.mark.parametrize("fusion_period_s", [0.0, 0.5])
def test_absurd_published_covariances_never_break_the_filter(sigma: float, fusion_period_s: float) -> None:
    run = world()
    estimator = Estimator(run.swarm, Settings(fusion_period_s=fusion_period_s))
    for event in run.events:
        for one in event.detections:
            one["covariance"] = sigma**2 * np.eye(6)
    for estimate in play(estimator, on_time(run), ticks(T0, END)):
        assert_sound(estimate)
    handed = sum(event.detections.size for event in run.events)
    assert sum(settled(estimator).values()) + estimator.drops.get("bad_covariance", 0) == handed


@pytest.mark.parametrize(
    ("pose", "reason"),
    [
        ((math.nan, 0.0, 0.0), "odometry_non_finite"),
        ((0.0, math.inf, 0.0), "odometry_non_finite"),
        ((1e9, 0.0, 0.0), "odometry_absurd"),
        ((0.0, 0.0, -1e9), "odometry_absurd"),
        ((500.0, 0.0, 0.0), "odometry_jump"),
    ],
)
def test_absurd_odometry_is_counted_and_does_no_harm(pose: tuple[float, float, float], reason: str) -> None:
    run = world()
    estimator = Estimator(run.swarm)
    bad = Event(0, T0 + 2 * SECOND + 1, pose)
    estimates = play(estimator, [*on_time(run), (bad.stamp_ns, bad)], ticks(T0, END))
    assert estimator.drops[reason] >= 1
    assert np.linalg.norm(estimates[-1].poses[:, :2] - run.at(END)[:, :2], axis=1).max() < 0.05
    for estimate in estimates:
        assert_sound(estimate)


GOOD = np.array([0.3, 0.2, 0.1])


@pytest.mark.parametrize("order", ["seat", "fix"])
@pytest.mark.parametrize(
    ("pose", "covariance", "reason"),
    [
        ([math.nan, 0.0, 0.0], np.eye(3), "non_finite"),
        ([0.0, math.inf, 0.0], np.eye(3), "non_finite"),
        ([1e200, 0.0, 0.0], np.eye(3), "absurd"),
        (GOOD, -np.eye(3), "bad_covariance"),
        (GOOD, math.nan * np.eye(3), "bad_covariance"),
        (GOOD, np.diag([1.0, -1.0, 1.0]), "bad_covariance"),
        (GOOD, [[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]], "bad_covariance"),
        (GOOD, [[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], "bad_covariance"),
    ],
)
def test_seats_and_fixes_are_checked(
    order: str, pose: FloatArray, covariance: FloatArray, reason: str
) -> None:
    run = world()
    estimator = Estimator(run.swarm)
    play(estimator, on_time(run), ticks(T0, END))
    before = estimator.drops.get(reason, 0)
    if order == "seat":
        assert estimator.set_pose(0, END, pose, covariance) == reason
    else:
        give_fix(estimator, 0, END, pose, covariance, END)
    assert_sound(estimator.tick(END))
    assert estimator.drops[reason] == before + 1


def test_an_exact_coordinate_is_refused_for_a_seat_and_has_the_least_noise_in_a_fix() -> None:
    run, flat = world(), np.diag([0.0, 1.0, 1.0])
    estimator = Estimator(run.swarm)
    play(estimator, on_time(run), ticks(T0, END))
    assert estimator.set_pose(0, END, GOOD, flat) == "bad_covariance"
    before = estimator.drops["bad_covariance"]
    give_fix(estimator, 0, END, run.at(END)[0], flat, END)
    assert_sound(estimator.tick(END))
    assert estimator.drops["bad_covariance"] == before
    fixes, _, _ = estimator.recent()
    assert fixes.covariance[-1, 0, 0] == pytest.approx(5e-4**2)


def test_a_robot_is_seated_from_its_first_odometry_on_and_before_that_refused() -> None:
    estimator = Estimator(world().swarm)
    assert estimator.set_pose(0, T0, GOOD, 1e-4 * np.eye(3)) == "not_localized"
    assert estimator.tick(T0).status[0] == Status.WAITING
    assert estimator.drops == {"not_localized": 1}
    Event(0, T0 + 1, (0.0, 0.0, 0.0)).give(estimator, T0 + 1)
    assert not estimator.set_pose(0, T0 + 1, GOOD, 1e-4 * np.eye(3))
    np.testing.assert_allclose(estimator.tick(T0 + 1).poses[0], GOOD, atol=1e-12)
    assert estimator.drops == {"not_localized": 1}


def test_an_ancient_first_odometry_does_not_poison_the_track() -> None:
    """As from a driver whose clock was not set yet."""
    run = world()
    estimator = Estimator(run.swarm)
    early = [(T0 - 1, Event(robot, 0, (0.0, 0.0, 0.0))) for robot in (0, 1)]
    last = play(estimator, early + on_time(run), ticks(T0, END))[-1]
    plain = play(Estimator(run.swarm), on_time(run), ticks(T0, END))[-1]
    np.testing.assert_allclose(last.poses, plain.poses, atol=1e-9)
    assert estimator.drops["odometry_too_old"] == 2


@pytest.mark.parametrize("silence_s", [0.4, 0.95, 1.9, 60.0, 7 * 86400.0])
def test_after_any_silence_the_covariance_is_sound_and_the_robot_found_again(silence_s: float) -> None:
    run = world()
    gap_ns = round(silence_s * SECOND)

    def shifted(event: Event) -> Event:
        return replace(event, stamp_ns=event.stamp_ns + gap_ns)

    begin_ns, end_ns = T0 + 3 * SECOND // 2, END + gap_ns
    events = [event for event in run.events if event.stamp_ns < begin_ns]
    events += [shifted(event) for event in run.events if event.stamp_ns >= begin_ns]
    events = [e for e in events if e.robot == 1 or not begin_ns <= e.stamp_ns < begin_ns + SECOND // 2]
    arrivals = [(event.stamp_ns, event) for event in events]
    at_ns = ticks(T0, begin_ns, 0.05) + ticks(begin_ns + gap_ns, end_ns, 0.05)
    estimates = play(Estimator(run.swarm), arrivals, at_ns)
    for estimate in estimates:
        assert_sound(estimate)
    error = estimates[-1].poses - run.at(END)
    assert (nees(error, estimates[-1].covariances) < 25.0).all()
    assert np.linalg.norm(error[:, :2], axis=1).max() < 0.1


@pytest.mark.parametrize("turn_rate", [0.0, 1.5])
def test_precise_sightings_during_a_silence_keep_the_covariance_positive(turn_rate: float) -> None:
    """What a silent robot's motion adds must not shrink again as it is thought to turn."""
    run = simulate(Plan(1, 0.1, noise=0.0, landmarks=1), 0)
    start = (0.0, 0.0, 0.0)
    swarm = replace(run.swarm, robots=(replace(run.swarm.robots[0], start=start),))
    estimator = Estimator(swarm)
    mark = swarm.landmarks[0]
    frame = marker_frame(mark.x, mark.y, mark.z, mark.yaw or 0.0)
    for k in range(80):
        now_ns, heading = T0 + k * SECOND // 20, turn_rate * k / 20
        x = 0.3 * math.sin(heading) if turn_rate else 0.015 * k
        y = 0.3 - 0.3 * math.cos(heading) if turn_rate else 0.0
        if k < 20 or k > 38:
            Event(0, now_ns, (x, y, heading)).give(estimator, now_ns)
        one = detection(mark.id, seen((x, y, heading), MOUNT, frame))
        one["covariance"] = 1e-6 * np.eye(6)
        Event(0, now_ns, None, one).give(estimator, now_ns)
        assert_sound(estimator.tick(now_ns))


@pytest.mark.parametrize("fusion_period_s", [0.5, 1.0])
def test_poses_before_the_newest_measurement_have_sound_covariances(fusion_period_s: float) -> None:
    run = simulate(Plan(2, 4.0, speed=0.5), 2)
    settings = Settings(fusion_period_s=fusion_period_s, policy=Policy(large_from=1))
    for estimate in play(Estimator(run.swarm, settings), on_time(run), ticks(T0, END, 0.05)):
        assert_sound(estimate)


@pytest.mark.parametrize("seed", range(3))
def test_every_detection_is_used_or_counted(seed: int) -> None:
    rng = np.random.default_rng(seed)
    run = simulate(Plan(3, 4.0, outliers=0.2, start_known=(True, False), content=POSE), seed)
    unknown = joined([detection(k, marker_frame(0, 0, 1, 0)) for k in (0, 77, 78)])
    handed, arrivals = 0, []
    for stamp_ns, event in on_time(run):
        change = rng.uniform()
        stamp = stamp_ns + (9 * SECOND if change < 0.05 else -9 * SECOND if change < 0.1 else 0)
        detections = (
            joined([event.detections, unknown]) if change > 0.9 and not event.pose else event.detections
        )
        for _ in range(1 + (change > 0.95)):
            arrivals.append((stamp_ns, replace(event, stamp_ns=stamp, detections=detections)))
            handed += 1 if event.pose else detections.size
    estimator = Estimator(run.swarm)
    play(estimator, arrivals, ticks(T0, END))
    rows = sum(event.pose is not None for _, event in arrivals)
    used_rows = int(estimator._tracks.arrays.filled.sum())
    kept = settled(estimator)
    assert kept["OPEN"] == 0
    assert used_rows < rows
    assert used_rows + kept["USED"] + kept["CONSTRAINT"] + sum(estimator.drops.values()) == handed
    assert {"unknown_id", "future_stamp", "too_old", "duplicate", "gated"} <= set(estimator.drops)


def test_a_jump_back_in_time_resets_once_and_goes_on() -> None:
    run = world()
    estimator = Estimator(run.swarm)
    first = play(estimator, on_time(run), ticks(T0, END))[-1]
    used = estimator.used
    event = next(event for event in run.events if event.detections.size)
    event.give(estimator, END)
    again = play(estimator, on_time(run), ticks(T0, END))[-1]
    assert estimator.time_jumps == 1
    assert estimator.used == used
    assert estimator.drops == {"reset": event.detections.size}
    np.testing.assert_array_equal(again.poses, first.poses)
    estimator.tick(T0)
    estimator.tick(T0 + SECOND)
    assert estimator.time_jumps == 2


def test_data_from_before_the_jump_are_from_the_future_after_it() -> None:
    run = world()
    estimator = Estimator(run.swarm)
    play(estimator, on_time(run), ticks(T0, END))
    Event(0, END, (0.0, 0.0, 0.0)).give(estimator, T0)
    Event(0, END, None, spoiled("position", 0.0)).give(estimator, T0)
    assert estimator.drops["future_stamp"] == 2


@pytest.mark.parametrize(("ahead_ns", "drops"), [(90_000_000, {}), (110_000_000, {"future_stamp": 2})])
def test_a_stamp_may_be_ahead_of_the_clock_by_its_tolerance(ahead_ns: int, drops: dict[str, int]) -> None:
    estimator = Estimator(world().swarm, Settings(future_tolerance_s=0.1))
    estimator.tick(T0)
    Event(0, T0 + ahead_ns, (0.0, 0.0, 0.0)).give(estimator, T0)
    Event(0, T0 + ahead_ns, None, detection(1000, marker_frame(0.0, 0.0, 1.0, 0.0))).give(estimator, T0)
    estimator.tick(T0 + ahead_ns)
    assert estimator.drops.get("future_stamp", 0) == drops.get("future_stamp", 0)
    assert sum(settled(estimator).values()) == (0 if drops else 1)
    assert bool(estimator._tracks.arrays.filled[0]) == (not drops)


def test_memory_stays_bounded_over_a_long_run() -> None:
    run = world()
    estimator = Estimator(run.swarm)
    sizes = []
    for lap in range(12):
        for event in run.events:
            moved = replace(event, stamp_ns=event.stamp_ns + lap * 4 * SECOND)
            moved.give(estimator, moved.stamp_ns)
            if event.robot == 0 and event.pose:
                estimator.tick(moved.stamp_ns)
        line = estimator._timeline
        sizes.append((estimator._tracks.arrays.stamp_ns.shape[1], len(line._checkpoints), len(line.buffer)))
    assert len({size[0] for size in sizes}) == 1
    assert max(size[1] for size in sizes) <= 45
    assert max(size[2] for size in sizes[3:]) <= 1.5 * sizes[2][2]


def test_drops_are_counted_for_the_robot_whose_data_they_are() -> None:
    estimator = Estimator(Swarm((Robot("a"), Robot("b"), Robot("c"))))
    now_ns = T0 + 10 * SECOND
    stamps_ns = {0: now_ns + 3 * SECOND, 1: now_ns - 1000 * SECOND, 2: now_ns}
    estimator.tick(now_ns)
    for robot, stamp_ns in stamps_ns.items():
        Event(robot, stamp_ns, (0.0, 0.0, 0.0)).give(estimator, now_ns)
    give_fix(estimator, 2, now_ns, np.zeros(3), np.diag([1.0, 1.0, -1.0]), now_ns)
    give_fix(estimator, 1, now_ns, np.zeros(3), np.zeros((3, 3)), now_ns)
    estimator.tick(now_ns)
    expected: list[dict[str, int]] = [
        {"future_stamp": 1},
        {"fix_without_covariance": 1, "odometry_too_old": 1},
        {"bad_covariance": 1},
    ]
    assert [dict(estimator.drops_of(robot)) for robot in range(3)] == expected
    assert estimator.drops == {reason: 1 for of_one in expected for reason in of_one}
