"""A robot between the goals of a mapper: looks around, goes there though its wheels slip, and stops."""

import math

import numpy as np
import pytest

from swarm_loc_drivers.common.robot_driver import STILL
from swarm_loc_drivers.pushbot.stop_and_go import MapGoal, StopAndGo, StopAndGoSettings
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.mapping.mapper import SCAN_TURN, START_TURN

PERIOD_S = 0.02
SETTINGS = StopAndGoSettings()


class Robot:
    """Wheels that do as they are commanded, and slip in turns."""

    def __init__(self, pose: FloatArray, slip: float = 0.0) -> None:
        self.motion = StopAndGo(SETTINGS)
        self.pose, self.slip = pose.astype(float), slip
        self.odometry = np.zeros(3)
        self.now_ns = 0
        self.turned = 0.0

    def step(self) -> bool:
        """One message of odometry; whether the robot is commanded to move."""
        self.now_ns += round(1e9 * PERIOD_S)
        reported = np.array([*self.odometry[:2], wrap_angle(self.odometry[2])])
        velocity = self.motion.command(self.now_ns, reported)
        forward, _, rate = velocity
        self.turned += PERIOD_S * rate
        for pose, turned in ((self.odometry, rate), (self.pose, (1.0 - self.slip) * rate)):
            pose[:2] += PERIOD_S * forward * np.array([math.cos(pose[2]), math.sin(pose[2])])
            pose[2] += PERIOD_S * turned
        return velocity != STILL

    def until_still(self) -> None:
        """Let it do all it has to."""
        while self.step():
            pass

    def send(self, x: float, y: float) -> None:
        """Send it, from where it truly is."""
        pose = np.array([*self.pose[:2], wrap_angle(self.pose[2])])
        assert self.motion.take_goal(MapGoal(self.now_ns, pose, np.array([x, y])))

    def go(self, x: float, y: float) -> None:
        """Send it, and let it go and look around."""
        self.send(x, y)
        self.until_still()


def looked_around() -> Robot:
    robot = Robot(np.array([1.0, 2.0, 0.7]))
    robot.until_still()
    return robot


def test_a_first_scan_begins_slowly_and_goes_twice_around() -> None:
    robot = Robot(np.zeros(3))
    robot.step()
    assert robot.odometry[2] == pytest.approx(PERIOD_S / 6.0)
    robot.until_still()
    assert robot.turned == pytest.approx(START_TURN, abs=0.03)
    assert math.hypot(*robot.pose[:2]) == 0.0


def test_goals_are_reached_and_each_is_looked_around_from() -> None:
    robot = looked_around()
    for goal in ((1.8, 2.5), (1.0, 1.2), (1.0, 2.0)):
        before = robot.turned
        robot.go(*goal)
        assert math.dist(robot.pose[:2], goal) < 0.02
        assert robot.turned - before > SCAN_TURN - math.pi - 0.1
    assert robot.motion.goals == 3


def test_wheels_that_slip_are_found_out_by_the_second_goal() -> None:
    robot = Robot(np.array([1.0, 2.0, 0.7]), slip=0.05)
    robot.until_still()
    robot.go(1.9, 2.4)
    for goal in ((1.0, 1.5), (2.0, 2.0)):
        robot.go(*goal)
        assert math.dist(robot.pose[:2], goal) < 0.02
    assert robot.motion.ratio == pytest.approx(0.95, abs=1e-6)


def test_a_goal_ends_the_look_around_before() -> None:
    robot = looked_around()
    before = robot.turned
    robot.go(1.5, 2.0)
    assert robot.turned - before > SCAN_TURN - math.pi
    robot.motion.take_goal(MapGoal(robot.now_ns, robot.pose.copy(), np.array([1.0, 2.0])))
    for _ in range(300):
        robot.step()
    robot.go(1.5, 1.5)
    assert math.dist(robot.pose[:2], (1.5, 1.5)) < 0.02


def test_a_goal_where_the_robot_is_makes_it_look_again() -> None:
    robot = looked_around()
    before, place = robot.turned, robot.pose[:2].copy()
    robot.go(*place)
    assert robot.turned - before == pytest.approx(SCAN_TURN, abs=0.03)
    np.testing.assert_array_equal(robot.pose[:2], place)


def test_without_a_goal_it_looks_again_after_a_while() -> None:
    robot = looked_around()
    before_ns = robot.now_ns
    while not robot.step():
        pass
    assert robot.now_ns - before_ns == pytest.approx(1e9 * SETTINGS.patience_s, abs=1e8)


def test_where_two_scans_bring_no_goal_it_looks_from_another_place() -> None:
    """A mapper that was stopped for a while has lost a robot whose odometry has not restarted."""
    robot = looked_around()
    robot.go(1.5, 2.0)
    place = robot.pose[:2].copy()
    for way in (0.0, 0.4):
        while not robot.step():
            pass
        robot.until_still()
        assert math.dist(robot.pose[:2], place) == pytest.approx(way, abs=0.01)
    assert robot.motion.restarts == 0


def test_something_ahead_ends_a_drive_and_it_looks_around_there() -> None:
    robot = looked_around()
    place = robot.pose[:2].copy()
    robot.send(place[0] + 1.0, place[1])
    while math.dist(robot.pose[:2], place) < 0.4:
        robot.step()
    robot.motion.take_distance(SETTINGS.clearance - 0.01)
    before = robot.turned
    robot.until_still()
    assert math.dist(robot.pose[:2], place) < 0.42
    assert robot.turned - before == pytest.approx(SCAN_TURN, abs=0.03)
    assert robot.motion.halts == 1


@pytest.mark.parametrize("distance", [0.6, 1.5])
def test_a_body_that_is_held_ends_a_drive(distance: float) -> None:
    """It touches the edge of an obstacle beside its laser; then what is ahead comes no nearer."""
    robot, rng = looked_around(), np.random.default_rng(3)
    place = robot.pose[:2].copy()
    robot.send(place[0] + 1.0, place[1])
    while (way := math.dist(robot.pose[:2], place)) < 0.95 and not robot.motion.halts:
        robot.step()
        left = distance + max(0.0, 0.3 - way)
        robot.motion.take_distance(left + 0.016 * left**2 * rng.standard_normal())
    assert robot.motion.halts == 1
    assert math.dist(robot.pose[:2], place) - 0.3 < 0.06 + 0.09 * distance**2


def test_nothing_seen_ahead_is_no_obstacle() -> None:
    robot = looked_around()
    robot.motion.take_distance(math.nan)
    robot.go(1.5, 2.2)
    assert math.dist(robot.pose[:2], (1.5, 2.2)) < 0.02


@pytest.mark.parametrize("stamp_ns", [-1_000_000_000, 60_000_000_000_000])
def test_a_goal_of_another_time_is_none(stamp_ns: int) -> None:
    robot = looked_around()
    assert not robot.motion.take_goal(MapGoal(stamp_ns, robot.pose, np.array([2.0, 2.0])))
    assert not any(robot.step() for _ in range(10))


def test_a_goal_that_comes_again_counts_once() -> None:
    robot = looked_around()
    goal = MapGoal(robot.now_ns, robot.pose.copy(), np.array([1.2, 2.0]))
    assert robot.motion.take_goal(goal)
    assert not robot.motion.take_goal(goal)


def test_odometry_that_comes_late_changes_nothing() -> None:
    robot = looked_around()
    robot.send(1.6, 2.0)
    for _ in range(50):
        robot.step()
    before = robot.motion.command(robot.now_ns, robot.odometry)
    assert robot.motion.command(robot.now_ns - 40_000_000, np.zeros(3)) == before
    robot.until_still()
    assert math.dist(robot.pose[:2], (1.6, 2.0)) < 0.02
    assert not robot.motion.restarts


@pytest.mark.parametrize(("shift", "pause_s"), [(1.0, 0.0), (0.0, 3.0), (0.0, -10.0)])
def test_odometry_that_begins_anew_makes_a_first_scan(shift: float, pause_s: float) -> None:
    robot = looked_around()
    robot.odometry[0] += shift
    robot.now_ns += round(1e9 * pause_s)
    before = robot.turned
    robot.until_still()
    assert robot.turned - before == pytest.approx(START_TURN, abs=0.03)
    assert robot.motion.restarts == 1


def test_after_a_restart_it_turns_to_where_it_is_farthest_if_something_is_ahead() -> None:
    robot, open_heading = looked_around(), 1.7
    robot.odometry[0] += 1.0
    while robot.step():
        off = float(np.abs(wrap_angle(robot.pose[2] - open_heading)))
        robot.motion.take_distance(max(0.3, 2.0 - 2.0 * off))
    place = robot.pose[:2].copy()
    while not robot.step():
        pass
    robot.until_still()
    x, y = robot.pose[:2] - place
    assert math.hypot(x, y) == pytest.approx(0.4, abs=0.01)
    assert wrap_angle(math.atan2(y, x) - open_heading) == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize(("is_held", "drives"), [(False, 4), (True, 1)])
def test_a_lost_robot_turns_off_after_some_drives_and_where_something_holds_it(
    is_held: bool, drives: int
) -> None:
    robot = looked_around()
    robot.odometry[0] += 1.0
    robot.until_still()
    courses = []
    for _ in range(drives + 1):
        while not robot.step():
            pass
        place = robot.pose.copy()
        while robot.step():
            if is_held and math.dist(robot.pose[:2], place[:2]) > 0.02:
                robot.motion.take_distance(1.0)
        x, y = robot.pose[:2] - place[:2]
        courses.append(math.atan2(y, x) - place[2])
    assert wrap_angle(np.array(courses[:-1])) == pytest.approx(0.0, abs=0.02)
    assert wrap_angle(courses[-1]) == pytest.approx(2.4, abs=0.05)
