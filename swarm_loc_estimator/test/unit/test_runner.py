"""Schedules of the runner: which poses a recording gets."""

import numpy as np

from swarm_loc_estimator.offline.replay import ListedSchedule, PeriodicSchedule, Runner
from swarm_loc_estimator.sensors.inputs import Batch
from swarm_loc_estimator.sensors.odometry import OdometryRows
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.timeline.estimator import Estimator

SECOND = 1_000_000_000
HOUR = 3600 * SECOND


def test_a_stretch_of_inputs_may_last_for_hours() -> None:
    schedule = PeriodicSchedule(SECOND)
    schedule.begin(SECOND // 2)
    assert schedule.due(5 * HOUR) == [k * SECOND for k in range(1, 5 * 3600 + 1)]
    assert schedule.due(5 * HOUR) == []
    assert schedule.rest(5 * HOUR + 1) == [5 * HOUR + SECOND]
    assert schedule.jumps == 0


def test_nothing_is_due_while_the_clock_was_set_ahead() -> None:
    schedule = PeriodicSchedule(SECOND)
    schedule.begin(0)
    assert schedule.due(2 * SECOND) == [SECOND, 2 * SECOND]
    schedule.begin(9 * HOUR)
    assert schedule.due(9 * HOUR + SECOND) == [9 * HOUR + SECOND]
    assert schedule.rest(20 * HOUR) == [20 * HOUR + SECOND]
    assert schedule.jumps == 2


def test_listed_instants_all_come_once() -> None:
    schedule = ListedSchedule(np.array([1, 5, 9]))
    assert [schedule.due(0), schedule.due(5), schedule.due(6), schedule.rest(7)] == [[], [1, 5], [], [9]]


def test_what_arrives_at_a_tick_counts_at_the_next_one() -> None:
    """As the live node reads what had come before its tick began."""
    swarm = Swarm((Robot("a", start=(0.0, 0.0, 0.0)),))
    runner = Runner(Estimator(swarm), PeriodicSchedule(SECOND))
    stamps_ns = np.array([SECOND // 2, SECOND])
    pose = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0]])
    odometry = OdometryRows.without_twist(np.zeros(2, dtype=np.int64), stamps_ns, pose, stamps_ns)
    runner.take(Batch.of(int(stamps_ns[0]), int(stamps_ns[1]), odometry=odometry))
    runner.finish(int(stamps_ns[1]))
    result = runner.result("two", (0, SECOND), {}, {})
    assert result.stamp_ns.tolist() == [SECOND, 2 * SECOND]
    assert result.poses[0, 0, 0] == 0.0
    assert result.poses[1, 0, 0] >= 0.01  # and on, at the speed that it has by then


def test_without_inputs_there_are_no_poses() -> None:
    runner = Runner(Estimator(Swarm((Robot("a"),))), PeriodicSchedule(SECOND))
    runner.finish(HOUR)
    assert runner.result("nothing", (0, HOUR), {}, {}).poses.shape == (0, 1, 3)
