"""Coordinates far from the origin of `map`, as in UTM: the same poses and covariances as near it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mapping_world import LidarRobot, room_map
from test_lidar_in_map import CELL, hand_in, sent, swarm_at

from swarm_loc_estimator.mapping.map_file import save_map
from swarm_loc_estimator.sensors.fix import FixRows
from swarm_loc_estimator.sensors.inputs import Batch
from swarm_loc_estimator.sensors.odometry import OdometryRows
from swarm_loc_estimator.swarm.swarm import Anchor, Landmark, Robot, Swarm
from swarm_loc_estimator.timeline.estimator import Estimator, Status
from swarm_loc_estimator.timeline.local_origin import about, described_origin

SECOND = 1_000_000_000


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
