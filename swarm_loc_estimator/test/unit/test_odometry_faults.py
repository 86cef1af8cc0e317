"""Odometry that jumps, is reset, or has no pose: what is noticed, what is not believed, what is no fault."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from core_messages import SECOND, T0

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.odometry.tracks import OdometryTracks, TrackChange
from swarm_loc_estimator.offline.recorded_bag import read_bag, unwatched
from swarm_loc_estimator.offline.replay import PeriodicSchedule, Runner
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.sensors.camera import CameraSensor
from swarm_loc_estimator.sensors.inputs import Batch, Ingest
from swarm_loc_estimator.sensors.odometry import OdometrySensor
from swarm_loc_estimator.swarm.error_models import OdometryModel
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator, Status
from swarm_loc_estimator.timeline.timeline import HasBudget

BAGS = Path(__file__).parents[3] / "bags"
MODEL = OdometryModel(wheel_noise=1e-4)
MILLISECOND = 1_000_000


class Drive:
    """A robot that drives at random and stands for a share of the time, sampled at a millisecond."""

    def __init__(self, seed: int, seconds: float, *, stops: float = 0.2, abrupt: bool = False) -> None:
        self.rng = np.random.default_rng(seed)
        count = round(1e3 * seconds)
        rates = np.zeros((count, 3))
        begin = 0
        while begin < count:
            end = begin + int(self.rng.uniform(300, 4000))
            if self.rng.uniform() > stops:
                rates[begin:end, 0] = self.rng.uniform(-0.05, 0.3)
                rates[begin:end, 2] = self.rng.choice([0.0, self.rng.uniform(-2.0, 2.0)])
            begin = end
        if not abrupt:  # speeds change within 0.3 s, not at once as commands do
            smooth = np.ones(300) / 300
            rates = np.column_stack([np.convolve(column, smooth)[:count] for column in rates.T])
        turn = 1e-3 * np.concatenate([[0.0], np.cumsum(rates[:-1, 2])])
        heading = turn + 0.5e-3 * rates[:, 2]
        step = 1e-3 * rates[:, :1] * np.column_stack([np.cos(heading), np.sin(heading)])
        self.rates = rates
        self.pose = np.column_stack([np.concatenate([np.zeros((1, 2)), np.cumsum(step[:-1], axis=0)]), turn])

    def at(self, rows: IntArray) -> FloatArray:
        """Poses (k, 3) at milliseconds (k,)."""
        return np.column_stack([self.pose[rows, :2], se2.wrap_angle(self.pose[rows, 2])])

    def mean_rates(self, rows: IntArray, before_ms: IntArray | int) -> FloatArray:
        """Mean of the rates in so many milliseconds before milliseconds (k,)."""
        total = np.concatenate([np.zeros((1, 3)), np.cumsum(self.rates, axis=0)])
        first = np.maximum(rows - before_ms, 0)
        mean: FloatArray = (total[rows] - total[first]) / np.maximum(rows - first, 1)[:, None]
        return mean


def stamps_of(rows: IntArray) -> IntArray:
    stamps: IntArray = T0 + MILLISECOND * rows
    return stamps


def every(period_ms: int, drive: Drive) -> IntArray:
    return np.arange(0, len(drive.pose), period_ms)


def fed(
    rows: IntArray, pose: FloatArray, twist: FloatArray | None, model: OdometryModel = MODEL
) -> tuple[OdometryTracks, TrackChange]:
    """Tracks of one robot with messages at milliseconds (k,), and the change by all of them."""
    tracks = OdometryTracks([Robot("a", odometry=model)])
    return tracks, tracks.extend(np.zeros(rows.size, dtype=np.int64), stamps_of(rows), pose, twist)


def moved_from(pose: FloatArray, first: int, reset: tuple[float, float, float]) -> FloatArray:
    """Poses (k, 3) of odometry that goes on elsewhere from a row on."""
    origin = se2.compose(pose[first], np.array(reset))
    after = se2.compose(origin, se2.between(pose[first], pose[first:]))
    return np.concatenate([pose[:first], after])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "reset",
    [(0.0, 0.0, 0.2), (0.0, 0.0, -0.3), (0.0, 0.0, 1.5), (0.05, 0.0, 0.0), (0.0, 0.06, 0.0), (3.0, 1.0, 2.0)],
)
def test_a_reset_of_any_size_is_noticed_and_its_motion_is_unknown(
    reset: tuple[float, float, float], seed: int
) -> None:
    drive = Drive(seed, 40.0)
    rows = every(50, drive)
    pose, twist, first = drive.at(rows), drive.mean_rates(rows, 50), 600
    true, _ = fed(rows, pose, twist)
    tracks, change = fed(rows, moved_from(pose, first, reset), twist)
    assert change.jumps + change.resets == 1
    robot, instants = np.zeros(2, dtype=np.int64), stamps_of(rows[[first - 1, first]])
    before, after = tracks.at(robot, instants).covariance
    assert after[2, 2] - before[2, 2] == pytest.approx((MODEL.max_turn_rate * 0.05) ** 2 / 3.0)
    wrong = tracks.at(robot, instants).pose - true.at(robot, instants).pose
    assert np.abs(wrong[1]).max() < 0.15, "the step is the true one of 50 ms at most"


@pytest.mark.parametrize("turn", [1.0, -2.0, 3.0])
def test_without_a_twist_a_turn_beyond_the_maximum_rate_is_a_jump(turn: float) -> None:
    drive = Drive(5, 10.0)
    rows = every(50, drive)
    pose = moved_from(drive.at(rows), 100, (0.0, 0.0, turn))
    assert fed(rows, pose, None)[1].jumps == 1
    assert fed(rows, drive.at(rows), None)[1].jumps == 0


def test_a_driver_that_restarts_near_its_origin_after_a_pause_is_noticed() -> None:
    drive = Drive(6, 12.0)
    rows = every(50, drive)
    pose = 0.05 * drive.at(rows)
    kept = (rows < 5000) | (rows >= 5600)
    first = int(np.argmax(rows >= 5600))
    pose = np.concatenate([pose[:first], se2.between(pose[first], pose[first:])])
    assert fed(rows[kept], pose[kept], None)[1].resets == 1
    assert fed(rows, pose, None)[1].resets == 0, "a robot may come back to its origin"


def _stall(rng: np.random.Generator, count: int) -> IntArray:
    """Milliseconds of messages of a computer that stalls: 5 to 900 ms apart."""
    apart = rng.choice([5, 20, 60, 100, 130, 900], size=count, p=[0.1, 0.2, 0.3, 0.3, 0.08, 0.02])
    return np.cumsum(apart)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["before", "after", "instant", "smoothed", "world", "none", "linear only"])
@pytest.mark.parametrize("timing", ["20 Hz", "50 Hz", "2 Hz", "lost", "uneven"])
def test_good_odometry_has_no_fault(timing: str, kind: str, seed: int) -> None:
    """Twists of the step before or after, the instant, the last 100 ms, in the odom frame, or not filled."""
    drive = Drive(seed, 200.0, abrupt=kind == "after")
    rows = every({"20 Hz": 50, "50 Hz": 20, "2 Hz": 500}.get(timing, 50), drive)
    if timing == "lost":
        rows = rows[np.sort(drive.rng.choice(rows.size, rows.size * 7 // 10, replace=False))]
    if timing == "uneven":
        rows = _stall(drive.rng, 3000)
        rows = rows[rows < len(drive.pose)]
    pose, apart = drive.at(rows), np.diff(rows, prepend=0)
    twist = drive.mean_rates(rows, apart)
    if kind == "after":  # commands that hold until the next row
        twist = np.concatenate([twist[1:], twist[-1:]])
    elif kind == "instant":
        twist = drive.rates[rows]
    elif kind == "smoothed":
        twist = drive.mean_rates(rows, 100)
    elif kind == "world":
        cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        twist = np.column_stack([cos * twist[:, 0], sin * twist[:, 0], twist[:, 2]])
    elif kind != "before":
        twist = np.zeros_like(twist)
        twist[:, 0] = drive.mean_rates(rows, apart)[:, 0] if kind == "linear only" else 0.0
    change = fed(rows, pose, twist)[1]
    assert (change.jumps, change.resets) == (0, 0)


@pytest.mark.parametrize("bag", sorted(path.parent.name for path in BAGS.glob("*/*.mcap")))
def test_the_bags_have_no_fault(bag: str) -> None:
    swarm = load_swarm(BAGS / bag / "swarm.yaml")
    tracks, ingest = OdometryTracks(swarm.robots), Ingest(swarm)
    faults = 0
    with BagReader(BAGS / bag) as reader:
        for batch in reader.batches([topic.name for topic in ingest.topics]):
            for part in ingest.read(batch):
                rows = part[OdometrySensor.name]
                assert np.isfinite(rows.twist).all()
                change = tracks.extend(rows.robot, rows.stamp_ns, rows.pose, rows.twist)
                faults += change.jumps + change.resets
    assert faults == 0
    assert not tracks.integrates_twist().any()


def constant(pose: FloatArray) -> FloatArray:
    """Poses (k, 3) that a driver does not fill."""
    return np.tile([0.1, 0.0, 0.5], (len(pose), 1))


@pytest.mark.parametrize("only_heading", [False, True])  # as four recorded TurtleBots
@pytest.mark.parametrize("seed", range(4))
def test_twists_are_integrated_in_any_order_where_the_pose_or_the_heading_is_constant(
    seed: int, only_heading: bool
) -> None:
    drive = Drive(seed, 30.0, stops=0.3)
    rows = every(50, drive)
    pose, twist = drive.at(rows), drive.rates[rows]
    reported = np.column_stack([pose[:, :2], np.full(rows.size, 0.5)]) if only_heading else constant(pose)
    tracks = OdometryTracks([Robot("a", odometry=MODEL)])
    order, robot = np.arange(rows.size) + drive.rng.integers(0, 8, rows.size), np.zeros(rows.size, np.int64)
    for part in np.array_split(np.argsort(order, kind="stable"), 60):
        tracks.extend(robot[part], stamps_of(rows[part]), reported[part], twist[part])
    assert tracks.integrates_twist().all()
    (whole, change), instants = fed(rows, reported, twist), stamps_of(rows)
    assert change.jumps == 0
    found = tracks.at(robot, instants)
    np.testing.assert_array_equal(found.pose, whole.at(robot, instants).pose)
    moved = se2.between(found.pose[0], found.pose)
    way = np.hypot(*np.diff(pose[:, :2], axis=0).T).sum()
    assert np.hypot(*(moved - pose)[:, :2].T).max() < 0.01 + 0.01 * way
    assert np.abs(se2.wrap_angle(moved[:, 2] - pose[:, 2])).max() < 0.05
    np.testing.assert_array_equal(found.raw, reported)


def test_a_robot_that_drives_straight_on_has_a_heading() -> None:
    rows = np.arange(0, 60_000, 50)
    pose = np.column_stack([1e-4 * rows, 0.0 * rows, 0.0 * rows])
    noise = np.random.default_rng(2).normal([0.1, 0.0, 0.01], [0.0, 0.0, 0.02], (rows.size, 3))
    tracks, _ = fed(rows, pose, noise)
    assert not tracks.integrates_twist().any()


@pytest.mark.parametrize("bias", [0.0, 0.01])
def test_a_robot_that_stands_is_no_driver_without_poses(bias: float) -> None:
    rows = np.arange(0, 300_000, 50)
    noise = np.random.default_rng(1).normal([0.0, 0.0, bias], 0.01, (rows.size, 3))
    tracks, _ = fed(rows, constant(noise), noise)
    assert not tracks.integrates_twist().any()
    look = tracks.at(np.zeros(1, dtype=np.int64), stamps_of(rows[-1:]))
    np.testing.assert_array_equal(look.pose, look.raw)


def test_a_constant_pose_found_out_late_changes_no_motion_beyond_the_horizon_but_covers_it() -> None:
    rows = np.arange(0, 12_000, 50)
    twist = np.where(rows[:, None] >= 2000, [0.005, 0.0, 0.0], 0.0)
    tracks = OdometryTracks([Robot("a", odometry=MODEL)])
    robot = np.zeros(1, dtype=np.int64)
    for k, row in enumerate(rows.tolist()):
        tracks.trim(T0 + MILLISECOND * row - 2 * SECOND, T0 - 10 * SECOND)
        before = tracks.at(robot, np.array([T0 + MILLISECOND * row - 2 * SECOND])) if k else None
        change = tracks.extend(robot, stamps_of(rows[k : k + 1]), constant(twist[:1]), twist[k : k + 1])
        if tracks.integrates_twist().any():
            break
    assert row > 5000
    assert before is not None
    after = tracks.at(robot, np.array([T0 + MILLISECOND * row - 2 * SECOND]))
    np.testing.assert_array_equal(after.pose, before.pose)
    np.testing.assert_array_equal(after.covariance, before.covariance)
    assert change.changed_from_ns[0] >= T0 + MILLISECOND * (row - 2050)
    now = tracks.at(robot, stamps_of(rows[k : k + 1]))
    way = 0.005e-3 * (row - 2000)
    assert np.hypot(*(now.pose - after.pose)[0, :2]) == pytest.approx(0.01, abs=0.0005)
    assert math.sqrt(now.covariance[0, 0, 0]) > 0.8 * (way - 0.01)


def test_a_pose_that_moves_after_all_is_used_again() -> None:
    """Commanded twists while the wheels were blocked."""
    drive = Drive(3, 20.0, stops=0.0)
    rows = every(50, drive)
    pose, twist = drive.at(rows), drive.rates[rows]
    pose[:200] = pose[200]
    tracks, _ = fed(rows, pose, twist)
    assert not tracks.integrates_twist().any()
    robot = np.zeros(2, dtype=np.int64)
    ends = tracks.at(robot, stamps_of(rows[[200, -1]]))
    np.testing.assert_allclose(se2.between(*ends.pose), se2.between(*ends.raw), atol=1e-9)


class Naming(Estimator):
    """Collects the contradictions that it names at its ticks."""

    def __init__(self, swarm: Swarm) -> None:
        super().__init__(swarm)
        self.named: set[str] = set()

    def tick(self, now_ns: int, *, fuse: bool = True, has_budget: HasBudget = lambda: True) -> Estimate:
        """As usual."""
        estimate = super().tick(now_ns, fuse=fuse, has_budget=has_budget)
        self.named.update(one.text for one in self.contradictions(now_ns))
        return estimate


class Changed:
    """Replays of a bag whose odometry is changed; robots are named by their index."""

    def __init__(self, bag: str) -> None:
        self.folder = BAGS / bag
        self.swarm = load_swarm(self.folder / "swarm.yaml")

    def result(self, change: Callable[[Batch, int], Batch]) -> tuple[ReplayResult, set[str]]:
        """Result of a replay of changed batches, and the named contradictions."""
        estimator, begin_ns = Naming(self.swarm), list[int]()
        runner = Runner(estimator, PeriodicSchedule(SECOND // 10), keep_sightings=False)

        def take(batch: Batch) -> None:
            begin_ns.append(batch.begin_ns)
            runner.take(change(batch, begin_ns[0]))

        summary = read_bag(self.folder, self.swarm, take, unwatched)
        runner.finish(summary.range_ns[1])
        result = runner.result("changed", summary.range_ns, summary.truth, summary.received)
        return result, estimator.named


@pytest.mark.parametrize("turn", [None, 0.3])
def test_a_heading_reset_of_an_unseen_robot_misleads_nobody(turn: float | None) -> None:
    """The third robot's heading becomes 0, or turns by 0.3 rad, at 25 s; unseen from 24.5 to 35 s."""
    world, who = Changed("eight_five_robots"), 2
    first: list[FloatArray] = []

    def change(batch: Batch, begin_ns: int) -> Batch:
        rows = dict(batch.rows)
        odometry, seen = batch[OdometrySensor.name], batch[CameraSensor.name]
        late = (odometry.robot == who) & (odometry.stamp_ns >= begin_ns + 25 * SECOND)
        if late.any():
            if not first:
                first.append(odometry.pose[late][0].copy())
            heading = 0.0 if turn is None else first[0][2] + turn
            origin = np.array([*first[0][:2], heading])
            odometry.pose[late] = se2.compose(origin, se2.between(first[0], odometry.pose[late]))
        time_s = (seen.stamp_ns - begin_ns) * 1e-9
        own = np.isin(seen.detection["id"], [face.id for face in world.swarm.robots[who].faces])
        unseen = ((seen.robot == who) | own) & (time_s >= 24.5) & (time_s < 35.0)
        rows |= {CameraSensor.name: select(seen, ~unseen)} if seen.robot.size else {}
        return replace(batch, rows=rows)

    result, named = world.result(change)
    assert result.counters.get("odometry_jump", 0) + result.counters.get("odometry_reset", 0) == 1
    assert any("odometry of epuck3 jumped or was reset" in text for text in named)
    errors = result.summaries["epuck3"]
    assert errors.nees < 5.0
    assert errors.position_rmse < 0.03


@pytest.mark.parametrize("who", [[2], range(5)])
def test_robots_with_twists_only_are_as_accurate_as_before(who: Sequence[int]) -> None:
    world = Changed("eight_five_robots")

    def change(batch: Batch, _begin_ns: int) -> Batch:
        odometry = batch[OdometrySensor.name]
        odometry.pose[np.isin(odometry.robot, who)] = 0.0
        return batch

    result, named = world.result(change)
    assert {f"epuck{k + 1}" for k in who} == {text.split()[3] for text in named if "integrating" in text}
    assert result.overall.position_rmse < 0.004
    assert result.overall.nees < 4.0


@pytest.mark.parametrize("who", [[2], range(5)])
def test_constant_odometry_without_twists_is_named_and_its_robots_are_not_tracked(who: Sequence[int]) -> None:
    """As on shared topics, whose messages have no twist, from drivers that do not fill the pose."""
    world = Changed("eight_five_robots")

    def change(batch: Batch, _begin_ns: int) -> Batch:
        odometry = batch[OdometrySensor.name]
        frozen = np.isin(odometry.robot, who)
        odometry.pose[frozen], odometry.twist[frozen] = 0.0, np.nan
        return batch

    result, named = world.result(change)
    assert {f"epuck{k + 1}" for k in who} == {text.split()[3] for text in named if "constant pose" in text}
    tracked = result.status[result.stamp_ns > result.stamp_ns[0] + 15 * SECOND] == Status.TRACKED
    assert tracked[:, list(who)].mean() < 0.05
    assert tracked[:, [k for k in range(5) if k not in who]].all()
