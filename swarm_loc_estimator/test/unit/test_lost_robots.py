"""Robots that are lost, join or start late, and lossy links."""

import html
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from core_geometry import marker_frame, nees, seen
from core_messages import (
    POSE,
    POSE_TWO,
    POSITION,
    SECOND,
    T0,
    Event,
    batch_of,
    detection,
    give_fix,
    odometry_bytes,
    quaternion,
)
from core_run import SPARSE, distances, on_time, play, ticks
from core_world import MOUNT, Plan, World, simulate
from lost_world import CAUSES, FIX_COVARIANCE, FIXED, HOME, TICK_NS, fix_of, lose
from mapping_world import LidarRobot, room_map
from test_lidar_in_map import CELL, hand_in, sent, swarm_at

from bench.shared.bags import copy_part
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.health import Level
from swarm_loc_estimator.common.messages.cdr import ODOMETRY, POSE_WITH_COVARIANCE
from swarm_loc_estimator.common.messages.poses import encode_fix
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.filter.measurements import LossReason, select
from swarm_loc_estimator.filter.models import CARTESIAN
from swarm_loc_estimator.filter.state import InitialPose, new_innovations
from swarm_loc_estimator.filter.update import PREDICT, fuse
from swarm_loc_estimator.mapping.map_file import save_map
from swarm_loc_estimator.odometry.preintegration import Preintegrated
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.offline.recorded_bag import Loss, LossError, Network
from swarm_loc_estimator.offline.replay import PeriodicSchedule, Runner, replay
from swarm_loc_estimator.offline.report.report import html_report, text_report
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.sensors.fix import FixRows, about_robots
from swarm_loc_estimator.sensors.inputs import Batch
from swarm_loc_estimator.sensors.odometry import OdometryRows
from swarm_loc_estimator.swarm.swarm import Anchor, Landmark, Robot, Swarm
from swarm_loc_estimator.timeline.estimate import LOSS_CAUSES, LossReport
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator, Status
from swarm_loc_estimator.timeline.fusion import Fusion
from swarm_loc_estimator.timeline.local_origin import about, described_origin
from swarm_loc_estimator.timeline.settings import Policy, Settings

LATE = {1.2: 1.2, 1.5: 2.2, 1.8: 1.8, 2.1: 2.1}
"""When fixes that are wrong were measured and when they come [s]."""


def test_every_reason_has_words_and_a_story() -> None:
    assert {*LOSS_CAUSES} == {*LossReason}
    assert {*CAUSES} == {*LossReason} - {LossReason.FRAME}


@pytest.mark.parametrize("why", CAUSES, ids=lambda why: why.name.lower())
def test_a_lost_robot_is_named_with_the_reason(why: LossReason, tmp_path: Path) -> None:
    lost = lose(why, tmp_path)
    estimator, cause = lost.estimator, CAUSES[why]
    loss = estimator.loss_of(0)
    assert loss is not None
    assert (loss.robot, loss.why, loss.cause) == (0, why, cause)
    assert 0 <= lost.now_ns - loss.stamp_ns < 1_000_000_000
    assert loss.text(loss.stamp_ns + 3_000_000_000) == f"lost 3.0 s ago: {cause}"
    assert estimator.counters[f"lost: {why.name.lower().replace('_', ' ')}"] == 1
    # /diagnostics
    report = lost.report()
    assert (report.level, report.values["status"]) == (Level.WARN, "waiting")
    assert report.message.startswith(loss.text(lost.now_ns))
    # replay
    result = lost.result
    assert result.status[-1, 0] == Status.WAITING
    at_s = max(0, loss.stamp_ns - int(result.stamp_ns[0])) * 1e-9
    remark = f"{result.swarm.robots[0].name} was lost once: {cause} (at {at_s:.1f} s)."
    assert result.loss_remarks == [remark]
    result = replace(result, remarks=(remark,))
    assert remark in text_report(result)
    assert f"<li>{html.escape(remark)}</li>" in html_report(result, {})


def test_replay_lists_all_losses_of_a_robot_that_is_located_again(tmp_path: Path) -> None:
    """Its fixes jump there and back; who has jumped once is believed less."""
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("a/odom", ODOMETRY)
        bag.add_topic("a/fix", POSE_WITH_COVARIANCE)
        for k in range(60):
            stamp_ns = k * 500_000_000
            bag.write("a/odom", stamp_ns, odometry_bytes("a", stamp_ns))
            pose = np.add(HOME, (1.0 if 10 <= k < 30 else 0.0, 0.0, 0.0))
            bag.write("a/fix", stamp_ns, encode_fix("map", stamp_ns, pose, FIX_COVARIANCE))
    result = replay(tmp_path / "bag", FIXED)
    assert result.status[-1, 0] == Status.TRACKED
    begin_ns = int(result.stamp_ns[0])
    times = ", ".join(f"{(stamp_ns - begin_ns) * 1e-9:.1f} s" for stamp_ns in (6_000_000_000, 15_500_000_000))
    remark = f"a was lost 2 times: several absolute fixes in a row were gated (at {times})."
    assert result.remarks == (remark,)
    assert result.counters["lost: off fixes"] == 2


def test_a_loss_that_late_data_move_back_is_listed_once() -> None:
    """The third of the fixes that are gated is another one when a late one comes."""
    estimator = Estimator(FIXED)
    runner, end_ns = Runner(estimator, PeriodicSchedule(TICK_NS)), T0 + 3 * SECOND
    wrong = {round(T0 + at_s * SECOND): round(T0 + later_s * SECOND) for at_s, later_s in LATE.items()}
    arrivals = {arrival_ns: stamp_ns for stamp_ns, arrival_ns in wrong.items()}
    for now_ns in range(T0, end_ns, TICK_NS):
        runner.take(batch_of([(now_ns, Event(0, now_ns, (0.0, 0.0, 0.0)))]))
        if now_ns < T0 + SECOND:
            runner.take(fix_of(now_ns, np.array(HOME), now_ns))
        elif now_ns in arrivals:
            runner.take(fix_of(arrivals[now_ns], np.add(HOME, (1.0, 0.0, 0.0)), now_ns))
    runner.finish(end_ns)
    assert [one.stamp_ns for one in estimator.losses] == [T0 + 1_800_000_000]
    assert runner.result("late", (T0, end_ns), {}, {}).losses == (*estimator.losses,)


def remarks_of(swarm: Swarm, *losses: LossReport) -> list[str]:
    none, waiting = np.zeros((1, len(swarm.robots), 3)), np.zeros((1, len(swarm.robots)), dtype=np.uint8)
    columns = np.array([0]), none, none[..., None], waiting
    return ReplayResult("x", swarm, *columns, losses=losses, heading_known=waiting > 0).loss_remarks


def test_many_losses_are_listed_in_few_words() -> None:
    losses = [LossReport(k % 30, LossReason.GATED, k * SECOND, "gated") for k in range(600)]
    remarks = remarks_of(Swarm(tuple(Robot(f"r{k}") for k in range(30))), *losses)
    assert len(remarks) == 21
    assert remarks[-1] == "10 more robots were lost."
    assert max(map(len, remarks)) < 150


def test_the_end_of_a_local_frame_is_no_fault_in_the_report() -> None:
    assert remarks_of(FIXED, LossReport(0, LossReason.FRAME, 0, LOSS_CAUSES[LossReason.FRAME])) == []


@pytest.mark.parametrize("period_s", [0.0, 0.2])
def test_the_fix_that_shows_that_a_robot_is_too_uncertain_is_kept(period_s: float) -> None:
    settings = Settings(lost_sigma=0.1, horizon_s=5.0, fusion_period_s=period_s, sparse_from=2)
    estimator = Estimator(Swarm(tuple(Robot(name, start=(0.0, 0.0, 0.0)) for name in "ab")), settings)
    for now_s in np.arange(1.0, 31.0):
        t = now_s - 1.0 + 0.1 * np.arange(10)
        driven = {"robot": "a", "stamp_s": t, "pose": np.multiply.outer(t, (0.5, 0.0, 0.0))}
        fix = {"robot": "a", "stamp_s": t[1:2], "pose": driven["pose"][1:2], "covariance": [np.eye(3) * 1e-4]}
        readings = {"odometry": driven} | ({"fixes": fix} if now_s == 29.0 else {})
        estimator.step(now_s, now_ns=None, **readings)
    assert estimator.counters == {"measurements used": 0, "constraints kept": 1, "lost: uncertain": 1}


def test_a_robot_that_was_never_located_only_waits_also_after_a_command() -> None:
    estimator = Estimator(Swarm((Robot("a", camera=None),)))
    estimator.forget(0, T0)
    estimator.receive(batch_of([(T0, Event(0, T0, (0.0, 0.0, 0.0)))]))
    estimator.tick(T0)
    assert estimator.loss_of(0) is None
    assert estimator.losses == []
    assert not any(name.startswith("lost") for name in estimator.counters)


DEMO = Path(__file__).parents[3] / "bags" / "eight_one_robot_fast"
NAMES = ["a/odom", "b/odom"]


def batch(topics: list[int]) -> MessageBatch:
    """Messages of these topics, whose bytes say their numbers."""
    return MessageBatch.of([SerializedMessage(one, b"%d" % k, k) for k, one in enumerate(topics)])


TOPICS = [int(one) for one in np.random.default_rng(1).integers(0, 2, 4000)]


def kept(loss: Loss, cuts: list[int], topics: list[int] = TOPICS) -> set[int]:
    """Numbers of the messages that pass, of batches cut at these places."""
    network, whole, passed = Network(loss, NAMES), batch(topics), list[int]()
    for begin, end in zip([0, *cuts], [*cuts, whole.size], strict=True):
        passed += [log_ns for _, log_ns, _ in network.passed(whole.chosen(slice(begin, end))).messages()]
    assert network.lost == len(topics) - len(passed)
    return {*passed}


def test_the_same_messages_are_lost_whatever_is_read_at_once() -> None:
    loss = Loss(0.3, 7)
    once = kept(loss, [])
    assert once == kept(loss, [1, 17, 1500])
    assert 0.68 < len(once) / len(TOPICS) < 0.72
    assert once != kept(Loss(0.3, 8), [])
    assert kept(Loss(0.0, 7), []) == set(range(len(TOPICS)))


def test_what_is_lost_of_a_topic_does_not_depend_on_others() -> None:
    mixed = kept(Loss(0.5, 3), [])
    own = [k for k, topic in enumerate(TOPICS) if topic == 0]
    alone = kept(Loss(0.5, 3), [], [0] * len(own))
    assert {own[k] for k in alone} == {k for k in mixed if TOPICS[k] == 0}
    other = kept(Loss(0.5, 3), [], [1] * len(own))
    assert alone != other


def test_a_greater_share_loses_the_same_and_more() -> None:
    assert kept(Loss(0.6, 2), []) < kept(Loss(0.2, 2), [])


def test_a_replay_with_losses_is_the_same_twice_and_has_all_of_the_truth(tmp_path: Path) -> None:
    copy_part(DEMO, tmp_path / "bag", 5.0)
    shutil.copy(DEMO / "swarm.yaml", tmp_path / "bag")
    whole = replay(tmp_path / "bag")
    first, second, other = (replay(tmp_path / "bag", loss=Loss(0.4, seed)) for seed in (1, 1, 2))
    assert first.poses.tobytes() == second.poses.tobytes()
    assert not np.array_equal(first.poses, other.poses)
    received = [
        sum(n for name, n in one.counters.items() if name.startswith("messages")) for one in (whole, first)
    ]
    lost = received[0] - received[1]
    assert 0.3 < lost / received[0] < 0.5
    assert f"{lost} messages were dropped at random: 0.4 of all." in first.remarks
    (name,) = whole.truth
    assert len(first.truth[name].stamp_ns) == len(whole.truth[name].stamp_ns)


@pytest.mark.parametrize(
    ("share", "seed", "said"),
    [
        (1.0, 0, r"share = 1.0 of a loss must lie in \[0, 0.99\]"),
        (float("nan"), 0, "share = nan"),
        (0.1, -1, "seed = -1 of a loss must lie in"),
    ],
)
def test_a_loss_out_of_range_is_refused(share: float, seed: int, said: str) -> None:
    with pytest.raises(LossError, match=said):
        Loss(share, seed)


DENSE = Settings()
FILTERS = pytest.mark.parametrize("settings", [DENSE, SPARSE], ids=["dense", "sparse"])


def run(world: World, settings: Settings | None = None) -> list[Estimate]:
    return play(Estimator(world.swarm, settings), on_time(world), ticks(T0, int(world.stamp_ns[-1])))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("settings", "content"),
    [(DENSE, POSE), (DENSE, POSITION), (DENSE, POSE_TWO), (SPARSE, POSE), (SPARSE, POSITION)],
)
def test_a_swarm_with_unknown_starts_finds_itself(content: int, seed: int, settings: Settings) -> None:
    world = simulate(Plan(2, 12.0, content=content, start_known=(False,), landmarks=5, flips=0.0), seed)
    estimates = run(world, settings)
    assert (estimates[0].status == Status.WAITING).all()
    assert (estimates[-1].status == Status.TRACKED).all()
    error = distances(world, estimates)
    assert error[-1].max() < 0.05
    for estimate in estimates if settings is DENSE else []:
        located = estimate.status != Status.WAITING
        difference = (estimate.poses - world.at(estimate.stamp_ns))[located]
        assert (nees(difference, estimate.covariances[located]) < 35.0).all()
    assert all(np.isnan(e.poses[e.status == Status.WAITING]).all() for e in estimates)


@pytest.mark.parametrize("seed", range(4))
@FILTERS
def test_a_robot_that_sees_no_landmark_is_located_through_another(seed: int, settings: Settings) -> None:
    world = simulate(Plan(2, 15.0, start_known=(True, False), landmarks=4), seed)
    for event in world.events:
        if event.robot == 1:
            event.detections["id"][event.detections["id"] >= 1000] = 99
    estimates = run(world, settings)
    error = distances(world, estimates)
    assert np.isfinite(error[-1, 1])
    assert np.nanmax(error[:, 1]) < 0.3
    assert estimates[-1].fix_age_s[1] == -1.0


@pytest.mark.parametrize("seed", range(5))
def test_mirrored_headings_do_not_mislead_a_robot_that_starts_unknown(seed: int) -> None:
    world = simulate(Plan(2, 10.0, content=POSE_TWO, start_known=(False,), landmarks=4, flips=0.4), seed)
    assert np.nanmax(distances(world, run(world))) < 0.3


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
@FILTERS
def test_a_robot_that_is_carried_away_is_lost_and_found_again_and_harms_nobody(
    seed: int, content: int, settings: Settings
) -> None:
    """It is lost because its sightings are gated and speak against it; its odometry knows nothing of it."""
    world = simulate(Plan(4, 16.0, content=content, landmarks=6, carried=(0,)), seed)
    estimates = run(world, settings)
    error, status = distances(world, estimates), np.array([e.status for e in estimates])
    assert error[81, 0] > 0.15 or np.isnan(error[81, 0])
    assert Status.WAITING in status[81 : 81 + 30, 0]  # ticks of 0.1 s
    assert Status.WAITING not in status[1:81, 0]
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
    assert distances(world, estimates)[tracked, 0].max() < 0.05


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
    assert distances(world, estimates)[-1, 0] < 0.05


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
    fuse(rows, 0, PREDICT, True, tracks.arrays, state.arrays(), steps._limits, work, *results)
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
    error = distances(world, estimates)
    assert error[:, 1].max() < 0.15
    assert error[-1, 0] < 0.1


@FILTERS
def test_a_robot_that_leaves_does_not_hold_the_others_up(settings: Settings) -> None:
    world = simulate(Plan(3, 10.0), 3)
    left = tuple(e for e in world.events if e.robot != 2 or e.stamp_ns < T0 + 3 * SECOND)
    stay = run(replace(world, events=left), settings)
    assert stay[-1].status[2] != Status.TRACKED
    assert distances(world, stay)[-1, :2].max() < 0.05


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


@pytest.mark.parametrize("far", [(5e5, 5e6), (-3e4, 0.0), (4999.0, 0.0)])
@pytest.mark.parametrize("has_start", [True, False])
def test_a_lidar_in_a_far_map_sees_what_it_sees_near(
    tmp_path: Path, far: tuple[float, float], has_start: bool
) -> None:
    found: list[Any] = []
    for x, y in ((0.0, 0.0), far):
        drawn = room_map(CELL)
        path, _ = save_map(replace(drawn, corner=drawn.corner + np.array([x, y])), tmp_path / "room")
        swarm = swarm_at(path, LidarRobot.start + np.array([x + 0.03, y, 0.02]))
        if not has_start:
            swarm = replace(swarm, robots=(replace(swarm.robots[0], start=None),))
        estimate = hand_in(Estimator(swarm), sent(7 * SECOND, seed=1))[-1]
        assert estimate.status[0] == Status.TRACKED
        found.append((estimate.poses[0] - [x, y, 0.0], estimate.covariances[0]))
    assert found[1][0] == pytest.approx(found[0][0], abs=1e-5)
    assert found[1][1] == pytest.approx(found[0][1], rel=1e-3, abs=1e-10)


@pytest.mark.parametrize("far", [(5e5, 5e6), (-2e5, 9e6)])
def test_fixes_far_away_give_the_same_covariances(far: tuple[float, float]) -> None:
    """Also where nothing is described: the first fix tells where the swarm is."""
    found: list[Any] = []
    for x, y in ((0.0, 0.0), far):
        estimator = Estimator(Swarm((Robot("a"),)))
        stamps = np.arange(20) * SECOND // 10
        zeros = np.zeros(20, dtype=np.int64)
        path = np.stack([0.02 * np.arange(20), np.zeros(20), np.zeros(20)], axis=-1)
        odometry = OdometryRows(zeros, stamps, path, np.zeros((20, 3)), stamps)
        covariance = np.tile(np.diag([1e-4, 1e-4, 1e-4]), (20, 1, 1))
        fixes = FixRows(zeros, stamps, path + np.array([x, y, 0.0]), covariance, stamps)
        estimator.receive(Batch.of(0, int(stamps[-1]), odometry=odometry, fixes=fixes))
        estimate = estimator.tick(int(stamps[-1]))
        assert estimate.status[0] == Status.TRACKED
        assert estimate.poses[0] == pytest.approx(path[-1] + np.array([x, y, 0.0]), abs=1e-6)
        assert estimate.map_to_odom[0] == pytest.approx([x, y, 0.0], abs=1e-6)
        assert estimator.set_pose(0, int(stamps[-1]), [x + 1.0, y, 0.0], np.eye(3) * 1e-4) == ""
        assert estimator.tick(int(stamps[-1])).poses[0] == pytest.approx([x + 1.0, y, 0.0], abs=1e-6)
        found.append(estimate.covariances[0])
    assert found[1] == pytest.approx(found[0], rel=1e-6)


def test_a_description_moves_there_and_back() -> None:
    swarm = Swarm(
        (Robot("a", start=(5e5, 5e6, 1.0)),),
        landmarks=(Landmark(1, 5e5, 5e6),),
        anchors=(Anchor(1, 5e5, 5e6),),
    )
    origin = described_origin(swarm)
    local = about(swarm, origin)
    assert origin == pytest.approx([5e5, 5e6])
    assert local.origin == (5e5, 5e6)
    assert local.robots[0].start == (0.0, 0.0, 1.0)
    assert (local.landmarks[0].x, local.anchors[0].y) == (0.0, 0.0)
    assert about(local, -origin) == swarm
    assert not described_origin(Swarm((Robot("a", start=(4000.0, 0.0, 0.0)),))).any()


@pytest.mark.parametrize("liar_x", [0.0, 9e6])
@pytest.mark.parametrize("rate", [1, 50])
def test_a_first_fix_far_from_all_others_keeps_none_out(liar_x: float, rate: int) -> None:
    """A receiver without a signal, say: it sends first, and more often than others."""
    estimator = Estimator(Swarm(tuple(Robot(name) for name in "abc")))
    stamps = np.arange(60) * SECOND // 10
    for at_ns in stamps.tolist():
        robots = np.array([*[0] * rate, *([1, 2] if at_ns else [])])
        poses = np.where(robots[:, None] == 0, [liar_x, 0.0, 0.0], [5e5, 5e6, 0.0])
        many, at = np.tile(np.diag([1e-4, 1e-4, 1e-4]), (robots.size, 1, 1)), np.full(robots.size, at_ns)
        at[:rate] -= np.arange(rate) * 1000
        fixes = FixRows(robots, at, poses, many, at)
        who, zeros = np.arange(3), np.zeros((3, 3))
        odometry = OdometryRows(who, np.full(3, at_ns), zeros, zeros, np.full(3, at_ns))
        estimator.receive(Batch.of(int(at_ns) - SECOND // 10, int(at_ns), odometry=odometry, fixes=fixes))
        estimate = estimator.tick(int(at_ns))
    assert (estimate.status[1:] == Status.TRACKED).all()
    assert estimate.poses[1:] == pytest.approx(np.tile([5e5, 5e6, 0.0], (2, 1)), abs=1e-2)
