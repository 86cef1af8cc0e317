"""Robots with lidars in a known map: poses, replay, order of arrival, wrong and unknown starts, delays."""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from core_geometry import nees, wrapped
from core_messages import SECOND, odometry_bytes
from mapping_world import BEAMS, LIDAR, ROOM, SWEEP_NS, LidarRobot, room_map, scan_bytes
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.common.se2 import compose, exp, inverse
from swarm_loc_estimator.filter.measurements import Verdict
from swarm_loc_estimator.filter.models import SCAN
from swarm_loc_estimator.mapping.map_file import save_map
from swarm_loc_estimator.mapping.messages import (
    DelayBelief,
    ScanMessage,
    at_odometry,
    described_delay,
    learned_delay,
)
from swarm_loc_estimator.sensors.inputs import Ingest, input_topics
from swarm_loc_estimator.swarm.error_models import SingleLidar
from swarm_loc_estimator.swarm.swarm import Pose2, Robot, StartSigma, Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm, save_swarm
from swarm_loc_estimator.timeline.estimate import Contradicted
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator, Status

CELL, ODOMETRY_NS = 0.05, 40_000_000
SIGMA = StartSigma(0.05, 0.05, 0.05)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of the room, which a niche makes unlike itself when turned."""
    return save_map(room_map(CELL), tmp_path_factory.mktemp("maps") / "room")[0]


def swarm_at(room: Path | None, start: FloatArray) -> Swarm:
    x, y, theta = start.tolist()
    pose: Pose2 = (x, y, theta)
    return Swarm((Robot("a", start=pose, start_sigma=SIGMA, lidar=LIDAR),), map=room)


class Weaver(LidarRobot):
    """A robot that looks to the left and to the right and back."""

    def odometry(self, stamp_ns: NDArray[np.int64]) -> FloatArray:
        """Poses (n, 3) by odometry at times (n,)."""
        time_s = 1e-9 * stamp_ns
        return np.stack([0.1 * np.sin(time_s), 0.0 * time_s, 0.6 * np.sin(1.5 * time_s)], axis=-1)


def sent(
    until_ns: int,
    seed: int,
    blocked: int = 0,
    kind: type[LidarRobot] = LidarRobot,
    late_ns: int = 0,
    change: Callable[[ScanMessage], ScanMessage] = lambda scan: scan,
    topic: str = "scan",
    lidar: SingleLidar = LIDAR,
) -> list[tuple[str, int, bytes]]:
    """Topic, arrival and bytes: odometry, and each sweep when it is over, with some beams at people."""
    robot = kind(np.random.default_rng(seed))
    found = []
    for at_ns in range(0, until_ns + 1, ODOMETRY_NS):
        data = odometry_bytes("a", at_ns, robot.odometry(np.array([at_ns])))
        found.append(("a/odom", at_ns, data))
    for k, at_ns in enumerate(range(0, until_ns - SWEEP_NS + 1, SWEEP_NS)):
        scan = robot.scan(at_ns, lidar)
        beams = np.arange(7 * k, 7 * k + blocked) % len(scan.ranges)
        scan.ranges[beams] = np.minimum(scan.ranges[beams], 0.5)
        scan = scan._replace(stamp_ns=at_ns + late_ns)
        found.append((f"a/{topic}", at_ns + late_ns + SWEEP_NS, scan_bytes(change(scan))))
    return sorted(found, key=lambda one: one[1])


def hand_in(estimator: Estimator, messages: list[tuple[str, int, bytes]]) -> list[Estimate]:
    """Hand in messages one by one; returns the estimate after each."""
    ingest, estimates = Ingest(estimator.swarm), []
    for topic, at_ns, data in messages:
        one = SerializedMessage(ingest.handle_of[topic], data, at_ns)
        for batch in ingest.read(MessageBatch.of([one])):
            estimator.receive(batch)
        estimates.append(estimator.tick(at_ns))
    return estimates


def test_poses_are_right_within_their_covariance(room: Path) -> None:
    """Over seeds, with a start off by its standard deviation and a quarter of the beams at people."""
    until_ns, squares = 4_000_000_000, []
    for seed in range(8):
        start = LidarRobot.start + np.random.default_rng(seed).standard_normal(3) * 0.05
        swarm = swarm_at(room, start)
        estimator = Estimator(swarm)
        estimate = hand_in(estimator, sent(until_ns, seed, blocked=90))[-1]
        error = wrapped(estimate.poses[0] - LidarRobot().pose(until_ns))
        assert estimate.status[0] == Status.TRACKED
        assert np.hypot(error[0], error[1]) < CELL
        assert abs(error[2]) < 0.03
        assert estimator.used >= 18
        squares.append(float(nees(error[None], estimate.covariances)[0]))
    assert np.mean(squares) < 4.5


@pytest.mark.parametrize(("late_s", "described_s"), [(0.0, 0.0), (0.3, 0.0), (0.3, 0.3), (0.0, 0.3)])
def test_scans_that_are_stamped_late_are_named_and_poses_are_right(
    room: Path, late_s: float, described_s: float
) -> None:
    until_ns, squares = 6_000_000_000, []
    for seed in range(4):
        swarm = swarm_at(room, LidarRobot.start + np.random.default_rng(seed).standard_normal(3) * 0.05)
        lidar = replace(LIDAR, delay_s=-described_s)
        estimator = Estimator(replace(swarm, robots=(replace(swarm.robots[0], lidar=lidar),)))
        messages = sent(until_ns, seed, kind=Weaver, late_ns=round(1e9 * late_s))
        estimate = hand_in(estimator, [one for one in messages if one[1] <= until_ns])[-1]
        error = wrapped(estimate.poses[0] - Weaver().pose(until_ns))
        squares.append(float(nees(error[None], estimate.covariances)[0]))
        assert estimate.status[0] == Status.TRACKED
        named = {one.about: one for one in estimator.contradictions(until_ns)}
        if late_s == described_s:
            assert not named
            continue
        assert {one.kind for one in named.values()} == {Contradicted.LATE}
        said = re.search(r"set lidar.delay_s to (\S+),", named["lidar of a"].text)
        assert said is not None
        assert float(said[1]) == pytest.approx(-late_s, abs=0.04)
    assert np.mean(squares) < 4.5


REAR = {"x": -0.1, "y": 0.05, "yaw": -0.5 * math.pi}
TWO_LIDARS = replace(LIDAR, others={"scan_rear": REAR})


def half(scan: ScanMessage) -> ScanMessage:
    """The first half of the beams."""
    return scan._replace(ranges=scan.ranges[: BEAMS // 2])


def sent_by_two(
    until_ns: int, seed: int, late_ns: int = 0, rear_as: Callable[[ScanMessage], ScanMessage] = half
) -> list[tuple[str, int, bytes]]:
    """Odometry, and the sweeps of two lidars that see one side each, at the same time; one may be late."""
    front = sent(until_ns, seed, kind=Weaver, change=half)
    lidar = TWO_LIDARS.all["scan_rear"]
    rear = sent(until_ns, seed + 50, 0, Weaver, late_ns, rear_as, "scan_rear", lidar)
    both = sorted(front + [one for one in rear if one[0] != "a/odom"], key=lambda one: one[1])
    return [one for one in both if one[1] <= until_ns]


@pytest.mark.parametrize("late_s", [0.0, 0.3])
def test_two_lidars_with_a_half_each_locate_a_robot(room: Path, late_s: float) -> None:
    """Either alone has the delay that it is named with."""
    until_ns, squares = 6_000_000_000, []
    for seed in range(4):
        start = LidarRobot.start + np.random.default_rng(seed).standard_normal(3) * 0.05
        robot = replace(swarm_at(room, start).robots[0], lidar=TWO_LIDARS)
        estimator = Estimator(Swarm((robot,), map=room))
        estimate = hand_in(estimator, sent_by_two(until_ns, seed, round(1e9 * late_s)))[-1]
        error = wrapped(estimate.poses[0] - Weaver().pose(until_ns))
        squares.append(float(nees(error[None], estimate.covariances)[0]))
        assert estimate.status[0] == Status.TRACKED
        assert estimator.used >= 50
        said = [one.text for one in estimator.contradictions(until_ns)]
        assert len(said) == (late_s > 0.0)
        for text in said:
            found = re.search(r"scans of a/scan_rear .* set lidar.others.scan_rear.delay_s to (\S+),", text)
            assert found is not None
            assert float(found[1]) == pytest.approx(-late_s, abs=0.04)
    assert np.mean(squares) < 4.5


@pytest.mark.parametrize("begin_ns", [0, 4 * SECOND])
def test_a_lidar_that_contradicts_the_other_one_is_named_and_moves_nothing(room: Path, begin_ns: int) -> None:
    """It is left out if it agreed before; else nobody knows which one is right: the robot is not tracked."""

    def too_far(scan: ScanMessage) -> ScanMessage:
        return half(scan._replace(ranges=scan.ranges * (1.5 if scan.stamp_ns >= begin_ns else 1.0)))

    until_ns, squares = 12 * SECOND, []
    for seed in range(3):
        start = LidarRobot.start + np.random.default_rng(seed).standard_normal(3) * 0.05
        robot = replace(swarm_at(room, start).robots[0], lidar=TWO_LIDARS)
        estimator = Estimator(Swarm((robot,), map=room))
        estimates = hand_in(estimator, sent_by_two(until_ns, seed, rear_as=too_far))
        for one in estimates[len(estimates) // 6 :]:
            error = wrapped(one.poses[0] - Weaver().pose(one.stamp_ns))
            squares.append(float(nees(error[None], one.covariances)[0]))
        assert estimates[-1].status[0] == (Status.TRACKED if begin_ns else Status.UNCONFIRMED)
        named = estimator.contradictions(until_ns)
        assert [(one.about, one.kind) for one in named] == [("lidar scan_rear of a", Contradicted.SUSPENDED)]
    assert np.mean(squares) < 4.5
    assert max(squares) < 25.0


def test_a_lost_robot_is_found_by_two_lidars_with_a_half_each(room: Path) -> None:
    robot = Robot("a", lidar=TWO_LIDARS)
    estimator, until_ns = Estimator(Swarm((robot,), map=room)), 12_000_000_000
    estimate = hand_in(estimator, sent_by_two(until_ns, seed=1))[-1]
    assert estimate.status[0] == Status.TRACKED
    assert np.abs(wrapped(estimate.poses[0] - Weaver().pose(until_ns))).max() < CELL


def test_a_pause_of_odometry_loses_no_robot_that_is_where_it_then_reports(room: Path) -> None:
    until_ns, squares = 7_000_000_000, []
    for seed in range(4):
        estimator = Estimator(swarm_at(room, LidarRobot.start + np.array([0.03, -0.02, 0.03])))
        kept = [one for one in sent(until_ns, seed) if not 2_100_000_000 < one[1] < 4_300_000_000]
        estimates = hand_in(estimator, kept)
        error = wrapped(estimates[-1].poses[0] - LidarRobot().pose(until_ns))
        assert all(one.status[0] == Status.TRACKED for one in estimates if one.stamp_ns > 4_600_000_000)
        squares.append(float(nees(error[None], estimates[-1].covariances)[0]))
    assert np.mean(squares) < 4.5


class Spinner(Weaver):
    """A robot that turns by up to 1.8 rad/s."""

    def odometry(self, stamp_ns: NDArray[np.int64]) -> FloatArray:
        """Poses (n, 3) by odometry at times (n,)."""
        return super().odometry(stamp_ns) * [1.0, 1.0, 2.0]


def backwards(scan: ScanMessage) -> ScanMessage:
    """The same beams, listed in the other direction, without a word about their times."""
    last = scan.angle_min + (len(scan.ranges) - 1) * scan.angle_increment
    return scan._replace(ranges=scan.ranges[::-1], angle_min=last, angle_increment=-scan.angle_increment)


@pytest.mark.parametrize("kind", [Spinner, LidarRobot])
@pytest.mark.parametrize("is_wrong", [True, False])
def test_beams_that_are_measured_against_their_order_are_found_and_named(
    room: Path, kind: type[LidarRobot], is_wrong: bool
) -> None:
    until_ns, squares = 5_000_000_000, []
    for seed in range(4):
        estimator = Estimator(swarm_at(room, LidarRobot.start + np.array([0.03, -0.02, 0.03])))
        messages = sent(until_ns, seed, kind=kind, change=backwards if is_wrong else lambda scan: scan)
        estimate = hand_in(estimator, messages)[-1]
        error = wrapped(estimate.poses[0] - kind().pose(until_ns))
        squares.append(float(nees(error[None], estimate.covariances)[0]))
        assert estimate.status[0] == Status.TRACKED
        named = [one.about for one in estimator.contradictions(until_ns)]
        assert named == (["lidar of a"] if is_wrong else [])
    assert np.mean(squares) < 4.5


def test_headers_as_drivers_write_them_give_the_same_poses(room: Path) -> None:
    """Ranges of what met nothing, ends of angles and numbers of beams differ between drivers."""
    until_ns, start = 3_000_000_000, LidarRobot.start + np.array([0.03, 0.0, 0.0])

    def nothing_met(value: float) -> Callable[[ScanMessage], ScanMessage]:
        def change(scan: ScanMessage) -> ScanMessage:
            far = scan.ranges > 1.5
            return scan._replace(ranges=np.where(far, value, scan.ranges), range_max=1.5)

        return change

    poses = []
    for value in (math.inf, 1.5, 0.0, math.nan, -math.inf):
        estimator = Estimator(swarm_at(room, start))
        poses.append(hand_in(estimator, sent(until_ns, seed=1, change=nothing_met(value)))[-1].poses)
        assert estimator.used >= 14
    assert all(one.tobytes() == poses[0].tobytes() for one in poses)
    cropped = sent(until_ns, 1, change=lambda scan: scan._replace(ranges=scan.ranges[:300]))
    estimator = Estimator(swarm_at(room, start))
    assert hand_in(estimator, cropped)[-1].status[0] == Status.TRACKED
    assert estimator.used >= 14


def test_scans_that_cannot_be_used_are_counted_of_their_robot(room: Path) -> None:
    estimator = Estimator(swarm_at(room, LidarRobot.start))
    hand_in(estimator, sent(1_000_000_000, 1, change=lambda scan: scan._replace(angle_increment=0.0)))
    assert dict(estimator.drops_of(0)) == {"scan_bad_geometry": 5} == dict(estimator.drops)


def test_the_order_of_arrival_does_not_matter(room: Path) -> None:
    until_ns, swarm = 1_200_000_000, swarm_at(room, LidarRobot.start + np.array([0.03, -0.04, 0.03]))
    messages = sent(until_ns, seed=1)
    mixed = [messages[k] for k in 1 + np.random.default_rng(3).permutation(len(messages) - 1)]
    results = []
    for order in (messages, [messages[0], *mixed]):
        estimator = Estimator(swarm)
        results.append(hand_in(estimator, [(topic, until_ns, data) for topic, _, data in order])[-1])
        assert estimator.used == 6
    assert results[1].poses == pytest.approx(results[0].poses, abs=1e-9)
    assert results[1].covariances == pytest.approx(results[0].covariances, abs=1e-9)


@pytest.mark.parametrize("shift", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.6)])
def test_a_wrong_start_is_never_tracked(room: Path, shift: tuple[float, float, float]) -> None:
    estimator = Estimator(swarm_at(room, LidarRobot.start + shift))
    statuses = [int(one.status[0]) for one in hand_in(estimator, sent(3_000_000_000, seed=1))]
    assert Status.TRACKED not in statuses
    assert statuses[-1] == Status.WAITING
    assert estimator.drops["scan_off_map"] == 3


def test_a_scan_with_many_people_does_not_confirm_a_start(room: Path) -> None:
    """But it is used."""
    until_ns, start = 3_000_000_000, LidarRobot.start + np.array([0.03, 0.0, 0.0])
    found = {}
    for blocked in (30, 150):
        estimator = Estimator(swarm_at(room, start))
        found[blocked] = hand_in(estimator, sent(until_ns, seed=1, blocked=blocked))[-1].status[0]
        assert estimator.used >= 10
    assert found == {30: Status.TRACKED, 150: Status.UNCONFIRMED}


def test_a_robot_that_is_carried_away_is_contradicted_and_then_lost(room: Path) -> None:
    """Its odometry has not noticed: scans of another place come from a robot that was at home before."""
    until_ns, home = 8_000_000_000, LidarRobot()
    estimator, names = Estimator(swarm_at(room, home.start)), set()
    assert hand_in(estimator, sent(until_ns, seed=1))[-1].status[0] == Status.TRACKED
    stands, elsewhere = home.odometry(np.array([until_ns])), home.scan(until_ns // 2)
    status = []
    for at_ns in range(until_ns + SWEEP_NS, until_ns + 13 * SWEEP_NS, SWEEP_NS):
        odometry = odometry_bytes("a", at_ns, stands)
        scan = scan_bytes(elsewhere._replace(stamp_ns=at_ns - SWEEP_NS))
        status += hand_in(estimator, [("a/odom", at_ns, odometry), ("a/scan", at_ns, scan)])
        names |= {(one.about, one.kind) for one in estimator.contradictions(at_ns)}
    assert names == {("a", Contradicted.POSE)}
    assert status[-1].status[0] == Status.WAITING


@pytest.mark.parametrize("push", [(0.4, 0.0, 0.0), (0.0, -0.3, 0.2), (-0.3, 0.2, 0.0), (0.15, 0.3, -0.3)])
@pytest.mark.parametrize("blocked", [0, 18])
def test_one_scan_finds_a_robot_that_was_pushed(
    room: Path, push: tuple[float, float, float], blocked: int
) -> None:
    """Its odometry has not noticed; the first scan afterwards tells, also with a few beams at people."""
    at_ns, after = 4_000_000_000, LidarRobot()
    estimator = Estimator(swarm_at(room, after.start))
    assert hand_in(estimator, sent(at_ns, seed=1))[-1].status[0] == Status.TRACKED
    after.start = compose(compose(after.pose(at_ns), push), inverse(after.odometry(np.array([at_ns]))[0]))
    for begin_ns in range(at_ns, at_ns + 5 * SWEEP_NS, SWEEP_NS):
        end_ns, scan = begin_ns + SWEEP_NS, after.scan(begin_ns)
        scan.ranges[:blocked] = np.minimum(scan.ranges[:blocked], 0.5)
        odometry = odometry_bytes("a", end_ns, after.odometry(np.array([end_ns])))
        estimate = hand_in(estimator, [("a/odom", end_ns, odometry), ("a/scan", end_ns, scan_bytes(scan))])[
            -1
        ]
        error = wrapped(estimate.poses[0] - after.pose(end_ns))
        assert estimate.status[0] == Status.TRACKED
        assert np.hypot(error[0], error[1]) < CELL
        assert nees(error[None], estimate.covariances)[0] < 16.0


def test_scans_are_only_taken_with_a_map(room: Path) -> None:
    with_map, without = swarm_at(room, LidarRobot.start), swarm_at(None, LidarRobot.start)
    assert "a/scan" in {topic.name for topic in input_topics(with_map)}
    assert "a/scan" not in {topic.name for topic in input_topics(without)}
    blind = replace(with_map, robots=(replace(with_map.robots[0], lidar=type(LIDAR)()),))
    assert "a/scan" not in {topic.name for topic in input_topics(blind)}


def test_the_description_names_the_map_from_its_folder(room: Path, tmp_path: Path) -> None:
    swarm = swarm_at(room, LidarRobot.start)
    save_swarm(swarm, tmp_path / "x" / "swarm.yaml")
    assert load_swarm(tmp_path / "x" / "swarm.yaml") == swarm
    assert f"map: ../../{room.parent.name}/room.yaml" in (tmp_path / "x" / "swarm.yaml").read_text()


def test_a_wrong_map_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "swarm.yaml"
    path.write_text("fileversion: 1\nrobots: {a: {}}\nmap: 3\n", encoding="utf-8")
    with pytest.raises(UserError, match=r"map is 3 but must be the path of a map's .yaml file, from here"):
        load_swarm(path)
    path.write_text("fileversion: 1\nrobots: {a: {}}\nmap: none.yaml\n", encoding="utf-8")
    with pytest.raises(UserError, match=r"none\.yaml"):
        Estimator(load_swarm(path))


PERIOD_S, COVARIANCE = 0.2, np.diag([0.01, 0.01, 0.005]) ** 2
START = np.array([2.0, -1.0, 2.5])
Way = Callable[[FloatArray], FloatArray]


def weaving(time_s: FloatArray) -> FloatArray:
    """Poses (n, 3) by odometry of a robot that looks to the left and to the right and back."""
    return np.stack([0.1 * np.sin(time_s), 0.0 * time_s, 0.6 * np.sin(1.5 * time_s)], axis=-1)


def straight(time_s: FloatArray) -> FloatArray:
    return np.multiply.outer(time_s, [0.3, 0.0, 0.0])


def circling(time_s: FloatArray) -> FloatArray:
    return exp(np.multiply.outer(time_s, [0.3, 0.0, 0.8]))


def after(
    belief: DelayBelief, way: Way, late_s: float, seed: int, begin_s: float = 5.0, until_s: float = 15.0
) -> DelayBelief:
    """The belief after scans that are `late_s` older than their stamps, on a way."""
    rng = np.random.default_rng(seed)
    for time_s in np.arange(begin_s, until_s, PERIOD_S).tolist():
        true = compose(START, way(np.array([time_s - late_s]))[0])
        seen = true + np.sqrt(0.3) * np.sqrt(np.diag(COVARIANCE)) * rng.standard_normal(3)
        belief = learned_delay(belief, round(1e9 * time_s), seen, COVARIANCE, way(time_s - belief.lag_s))
    return belief


@pytest.mark.parametrize("late_s", [0.0, 0.1, 0.237, 0.4])
def test_a_robot_that_turns_to_and_fro_tells_the_delay(late_s: float) -> None:
    for seed in range(5):
        belief = after(described_delay(0.0), weaving, late_s, seed)
        assert belief.mean_s == pytest.approx(late_s, abs=0.02)
        assert belief.sigma_s < 0.02
        assert belief.is_refuted == (late_s > 0.06)


def test_one_slip_that_looks_like_a_lag_does_not_refute_the_described_delay() -> None:
    """A robot sets off, and moves 12 cm less than its wheels say, as if its scan were 0.3 s older."""
    belief, covariance = described_delay(0.0), np.diag([0.01, 0.01, 0.005]) ** 2
    stands = np.zeros((belief.lag_s.size, 3))
    belief = learned_delay(belief, 10_000_000_000, np.zeros(3), covariance, stands)
    drives = np.column_stack([0.8 - 0.4 * belief.lag_s, stands[:, 1:]])
    belief = learned_delay(belief, 12_000_000_000, np.array([0.68, 0.0, 0.0]), covariance, drives)
    assert belief.chance[0] > 0.6
    assert belief.lag_s[belief.median] == 0.0


@pytest.mark.parametrize("way", [straight, circling])
def test_steady_motion_tells_nothing_and_poses_are_right_within_that(way: Way) -> None:
    now = np.array([14.8])
    for seed in range(5):
        belief = after(described_delay(0.0), way, 0.3, seed)
        assert not belief.is_refuted
        pose, covariance = at_odometry(belief, way(now)[0])
        error = wrapped(pose - compose(START, way(now)[0]))
        assert np.hypot(*error[:2]) > 0.05  # as of 0.3 s
        assert nees(error[None], (covariance + COVARIANCE)[None])[0] < 16.0


def test_a_lidar_that_begins_to_lag_is_found_and_so_is_its_recovery() -> None:
    for seed in range(5):
        belief = after(described_delay(0.0), weaving, 0.0, seed)
        for late_s, begin_s in ((0.25, 15.0), (0.0, 25.0)):
            belief = after(belief, weaving, late_s, seed, begin_s, begin_s + 5.0)
            assert belief.mean_s == pytest.approx(late_s, abs=0.03)
            assert belief.is_refuted == (late_s > 0.0)


def test_the_pose_is_that_of_the_delay() -> None:
    belief = after(described_delay(0.0), weaving, 0.4, 3)
    pose, covariance = at_odometry(belief, weaving(np.array([14.8]))[0])
    assert pose == pytest.approx(compose(START, weaving(np.array([14.8]))[0]), abs=0.03)
    assert np.sqrt(np.diag(covariance)).max() < 0.02


def test_scans_of_one_stamp_and_after_a_gap_are_not_compared() -> None:
    belief = after(described_delay(0.0), weaving, 0.0, 1)
    there, track = np.array([9.0, 9.0, 0.0]), belief.track
    for stamp_ns in (belief.stamp_ns, belief.stamp_ns + 2_000_000_000):
        assert (learned_delay(belief, stamp_ns, there, COVARIANCE, track).chance == belief.chance).all()


def without_start(room: Path) -> Swarm:
    swarm = swarm_at(room, LidarRobot.start)
    return replace(swarm, robots=(replace(swarm.robots[0], start=None),))


@pytest.mark.parametrize("seed", range(4))
def test_a_robot_without_a_start_is_found_by_its_map_while_it_drives(room: Path, seed: int) -> None:
    """Not by its first scan, and nowhere else."""
    estimator, until_ns = Estimator(without_start(room)), 9 * SECOND
    estimates = hand_in(estimator, sent(until_ns, seed, blocked=60))
    tracked = [one for one in estimates if one.status[0] == Status.TRACKED]
    assert estimates[-1].status[0] == Status.TRACKED
    assert tracked[0].stamp_ns > SECOND
    for one in tracked:
        error = wrapped(one.poses[0] - LidarRobot().pose(one.stamp_ns))
        assert np.hypot(error[0], error[1]) < 2.0 * CELL
        assert abs(error[2]) < 0.1


def test_a_robot_that_stands_is_not_believed_to_be_anywhere(room: Path) -> None:
    class Standing(LidarRobot):
        def odometry(self, stamp_ns: Any) -> Any:
            return np.zeros((len(stamp_ns), 3))

    estimator = Estimator(without_start(room))
    estimates = hand_in(estimator, sent(4 * SECOND, 1, kind=Standing))
    assert {int(one.status[0]) for one in estimates} == {Status.WAITING}
    assert estimator.drops["not_localized"] == 20


def test_a_robot_in_a_symmetric_room_says_that_it_may_be_at_several_places(tmp_path: Path) -> None:
    """A rectangle looks the same from its other end."""

    class InRectangle(LidarRobot):
        has_niche = False

    path, _ = save_map(room_map(CELL, has_niche=False), tmp_path / "rectangle")
    estimator = Estimator(without_start(path))
    estimates = hand_in(estimator, sent(9 * SECOND, 1, kind=InRectangle))
    assert {int(one.status[0]) for one in estimates} == {Status.WAITING}
    assert estimator.drops["scan_ambiguous"] > 10


@pytest.mark.parametrize("seed", range(3))
def test_a_robot_is_ambiguous_until_a_search_finds_no_other_place(room: Path, seed: int) -> None:
    """The niche, which tells the ends of the room apart, returns nothing: only the map shows it."""

    def without_niche(scan: ScanMessage) -> ScanMessage:
        beams = np.arange(BEAMS)
        robot = compose(LidarRobot.start, LidarRobot().odometry(scan.stamp_ns + SWEEP_NS // BEAMS * beams))
        angle = robot[:, 2] + LIDAR.yaw + scan.angle_increment * beams
        mount_y = compose(robot, [LIDAR.x, LIDAR.y, 0.0])[:, 1]
        is_niche = mount_y + scan.ranges * np.sin(angle) > ROOM[3] + 0.1
        return scan._replace(ranges=np.where(is_niche, math.inf, scan.ranges))

    estimator, verdicts = Estimator(without_start(room)), []
    for message in sent(20 * SECOND, seed, change=without_niche):
        if hand_in(estimator, [message])[0].status[0] == Status.TRACKED:
            break
        recent = estimator.recent()
        verdicts += recent.verdicts[recent.measurements.model == SCAN][-1:].tolist()
    of_a_scan = 1 + SWEEP_NS // ODOMETRY_NS
    assert len(verdicts) < 100 * of_a_scan
    first = verdicts.index(Verdict.SEVERAL_PLACES)
    assert set(verdicts[first:-of_a_scan]) == {Verdict.SEVERAL_PLACES}


def test_a_lost_robot_comes_back_by_the_map(room: Path) -> None:
    """Its start is wrong by a metre, so it is lost, and found where it is."""
    estimator, until_ns = Estimator(swarm_at(room, LidarRobot.start + np.array([0.0, 1.0, 0.0]))), 12 * SECOND
    estimates = hand_in(estimator, sent(until_ns, 3))
    error = wrapped(estimates[-1].poses[0] - LidarRobot().pose(until_ns))
    assert estimates[-1].status[0] == Status.TRACKED
    assert np.hypot(error[0], error[1]) < CELL
    assert estimator.counters["lost: off map"] == 1
    assert all(
        np.hypot(*(one.poses[0, :2] - LidarRobot().pose(one.stamp_ns)[:2])) < 2.0 * CELL
        for one in estimates
        if one.status[0] == Status.TRACKED
    )


def test_scans_that_fit_nowhere_are_named(room: Path) -> None:
    """A lidar that is mounted upside down, undescribed."""
    swarm = without_start(room)
    lidar = replace(swarm.robots[0].lidar, roll=math.pi)
    estimator = Estimator(replace(swarm, robots=(replace(swarm.robots[0], lidar=lidar),)))
    estimates = hand_in(estimator, sent(9 * SECOND, 2))
    assert {int(one.status[0]) for one in estimates} == {Status.WAITING}
    assert estimator.drops["scan_nowhere"] > 0


def test_scans_that_meet_nothing_locate_nobody(room: Path) -> None:
    estimator = Estimator(without_start(room))
    nothing = sent(3 * SECOND, 2, change=lambda scan: scan._replace(ranges=np.full(BEAMS, math.inf)))
    assert {int(one.status[0]) for one in hand_in(estimator, nothing)} == {Status.WAITING}
    assert estimator.drops["scan_nowhere"] > 5


def test_late_data_change_nothing_of_a_search(room: Path) -> None:
    """Scans that arrive before their odometry are searched for again."""
    until_ns, results = 6 * SECOND, []
    for late_ns in (0, 300_000_000):
        messages = [
            (topic, at_ns + late_ns * (topic == "a/odom"), data) for topic, at_ns, data in sent(until_ns, 1)
        ]
        estimator = Estimator(without_start(room))
        hand_in(estimator, sorted(messages, key=lambda one: one[1]))
        results.append(estimator.tick(until_ns + 300_000_000))
    assert results[0].status[0] == Status.TRACKED
    assert results[1].status[0] == Status.TRACKED
    assert results[1].poses[0] == pytest.approx(results[0].poses[0], abs=0.02)
