"""Robots with lidars in a known map: poses, replay, order of arrival, wrong starts, descriptions."""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from core_geometry import nees, wrapped
from core_messages import odometry_bytes
from mapping_world import LIDAR, SWEEP_NS, LidarRobot, room_map, scan_bytes
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.mapping.map_file import save_map
from swarm_loc_estimator.mapping.messages import ScanMessage
from swarm_loc_estimator.sensors.inputs import Ingest, input_topics
from swarm_loc_estimator.swarm.swarm import Pose2, Robot, StartSigma, Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm, save_swarm
from swarm_loc_estimator.timeline.estimate import Contradicted
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator, Status

CELL, ODOMETRY_NS = 0.05, 40_000_000
SIGMA = StartSigma(0.05, 0.05, 0.05)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of the room."""
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
) -> list[tuple[str, int, bytes]]:
    """Topic, arrival and bytes: odometry, and each sweep when it is over, with some beams at people."""
    robot = kind(np.random.default_rng(seed))
    found = []
    for at_ns in range(0, until_ns + 1, ODOMETRY_NS):
        data = odometry_bytes("a", at_ns, robot.odometry(np.array([at_ns])))
        found.append(("a/odom", at_ns, data))
    for k, at_ns in enumerate(range(0, until_ns - SWEEP_NS + 1, SWEEP_NS)):
        scan = robot.scan(at_ns)
        beams = np.arange(7 * k, 7 * k + blocked) % len(scan.ranges)
        scan.ranges[beams] = np.minimum(scan.ranges[beams], 0.5)
        scan = scan._replace(stamp_ns=at_ns + late_ns)
        found.append(("a/scan", at_ns + late_ns + SWEEP_NS, scan_bytes(change(scan))))
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
