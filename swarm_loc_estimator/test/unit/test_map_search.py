"""Starts in a known map: where a robot without a start is found, and what it says where it is not."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from core_geometry import wrapped
from mapping_world import BEAMS, LIDAR, ROOM, SWEEP_NS, LidarRobot, room_map
from test_lidar_in_map import CELL, ODOMETRY_NS, hand_in, sent, swarm_at

from swarm_loc_estimator.common.se2 import compose
from swarm_loc_estimator.filter.measurements import Verdict
from swarm_loc_estimator.filter.models import SCAN
from swarm_loc_estimator.mapping.map_file import save_map
from swarm_loc_estimator.mapping.messages import ScanMessage
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.estimator import Estimator, Status

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of the room, which a niche makes unlike itself when turned."""
    return save_map(room_map(CELL), tmp_path_factory.mktemp("maps") / "room")[0]


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
