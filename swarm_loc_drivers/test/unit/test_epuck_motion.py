"""From velocities to wheels and from steps to poses."""

import math
from collections import Counter

import numpy as np
import pytest
from epuck_body import GEOMETRY
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from swarm_loc_drivers.common.odometry import OdometryState
from swarm_loc_drivers.common.robot_driver import STANDING_CLOCK_S, STILL, Velocity, VelocityCommand
from swarm_loc_drivers.epuck.driver import WheelOdometry
from swarm_loc_drivers.epuck.hardware import EPUCK1, EPUCK2, as_counter
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.swarm.error_models import OdometryModel
from swarm_loc_estimator.swarm.swarm import Robot

SECOND = 1_000_000_000
NOISE = 2e-4
RATE = st.floats(-1000.0, 1000.0)
AHEAD = (0.05, 0.0, 0.0)


@given(speed=st.floats(-0.5, 0.5), turn_rate=st.floats(-20.0, 20.0))
def test_beyond_the_limit_the_curve_stays(speed: float, turn_rate: float) -> None:
    left, right = (EPUCK2.rate(c) for c in EPUCK2.wheel_commands(GEOMETRY, speed, turn_rate))
    wanted_left = (speed - 0.5 * GEOMETRY.wheel_separation * turn_rate) / GEOMETRY.metres_per_step
    wanted_right = (speed + 0.5 * GEOMETRY.wheel_separation * turn_rate) / GEOMETRY.metres_per_step
    slower = min(1.0, EPUCK2.max_rate / max(abs(wanted_left), abs(wanted_right), 1e-9))

    # near its limit the timer knows steps of 2.3 %
    assert left == pytest.approx(slower * wanted_left, rel=0.012, abs=0.5)
    assert right == pytest.approx(slower * wanted_right, rel=0.012, abs=0.5)


class Watch:
    """A clock and real time, both set by hand."""

    def __init__(self) -> None:
        self.now_ns = SECOND
        self.steady_s = 0.0

    def run(self, seconds: float) -> None:
        """Let both go on."""
        self.now_ns += round(seconds * SECOND)
        self.steady_s += seconds


def command_with(watch: Watch) -> tuple[VelocityCommand, Counter[str]]:
    counts: Counter[str] = Counter()
    command = VelocityCommand(0.5, lambda: watch.now_ns, counts, lambda: watch.steady_s)
    return command, counts


def test_a_velocity_counts_until_its_time_is_over() -> None:
    watch = Watch()
    command, counts = command_with(watch)
    assert command.velocity() == STILL
    command.set(AHEAD)
    watch.run(0.5)
    assert command.velocity() == AHEAD
    watch.run(0.01)
    assert command.velocity() == STILL
    watch.run(-0.2)
    assert command.velocity() == STILL
    assert counts == {"stale_cmd_vel": 1}


@pytest.mark.parametrize(("clock_ns", "steady_s"), [(0, STANDING_CLOCK_S + 0.01), (-1, 0.0)])
def test_a_clock_that_stands_still_or_jumps_back_stops_the_robot(clock_ns: int, steady_s: float) -> None:
    watch = Watch()
    command, _ = command_with(watch)
    command.set(AHEAD)
    assert command.velocity() == AHEAD
    watch.now_ns += clock_ns
    watch.steady_s += steady_s
    assert command.velocity() == STILL


def test_a_velocity_that_comes_while_an_old_one_expires_is_kept() -> None:
    coming: list[Velocity] = []

    def clock() -> int:
        if coming:
            command.set(coming.pop())
        return now_ns

    now_ns = SECOND
    command = VelocityCommand(0.5, clock, Counter())
    command.set((0.01, 0.0, 0.0))
    now_ns += SECOND
    coming.append(AHEAD)  # in another thread, when the old velocity has just been read
    assert command.velocity() == STILL
    assert command.velocity() == AHEAD


@pytest.mark.parametrize(
    "velocity", [(math.nan, 0.0, 0.0), (0.0, 0.0, math.inf), (0.0, -math.inf, math.nan), (1e308, 0.0, 0.0)]
)
def test_what_is_not_finite_or_absurd_is_dropped(velocity: Velocity) -> None:
    command, counts = command_with(Watch())
    command.set(AHEAD)
    command.set(velocity)
    assert command.velocity() == AHEAD
    assert counts == {"bad_cmd_vel": 1}


class Wheels:
    """Counters that do what was commanded, read once at some steps, and the odometry of them."""

    def __init__(self, rate: tuple[float, float] = (0.0, 0.0), steps: tuple[int, int] = (0, 0)) -> None:
        self.counts: Counter[str] = Counter()
        self.odometry = WheelOdometry(GEOMETRY, NOISE, self.counts)
        self.steps = np.array(steps, dtype=float)
        self.now_ns = SECOND
        self.first = self.state()
        self.command(*rate)

    def command(self, left: float, right: float) -> None:
        """Change the rates."""
        self.rates = np.array([left, right])
        self.odometry.note_rates(self.now_ns, left, right)

    def run(self, seconds: float) -> None:
        """Turn."""
        self.now_ns += round(seconds * SECOND)
        self.steps += self.rates * seconds

    def read(self) -> OdometryState | None:
        """Report the counters."""
        left, right = (as_counter(math.floor(s + 1e-6)) for s in self.steps)
        return self.odometry.update(self.now_ns, left, right)

    def state(self) -> OdometryState:
        """Report the counters, which tell where the robot is."""
        state = self.read()
        assert state is not None
        return state


def test_an_arc_is_an_arc_through_many_wraps_of_the_counters() -> None:
    wheels = Wheels((1000.0, 800.0), (32000, -32700))
    for _ in range(4000):
        wheels.run(0.05)
        state = wheels.state()
    paths = np.array([200e3, 160e3]) * GEOMETRY.metres_per_step
    turn = (paths[1] - paths[0]) / GEOMETRY.wheel_separation
    expected = se2.exp([paths.mean(), 0.0, turn])
    assert state.pose[:2] == pytest.approx(expected[:2], abs=2e-3)
    assert float(se2.wrap_angle(state.pose[2] - turn)) == pytest.approx(0.0, abs=1e-6)
    assert not wheels.counts


def test_through_a_long_gap_the_robot_is_believed_to_have_obeyed() -> None:
    wheels = Wheels((-800.0, -800.0))
    wheels.run(0.1)
    wheels.read()
    wheels.run(300.0)
    wheels.odometry.note_rates(wheels.now_ns, 0.0, 0.0)  # said on reconnecting, just before the reading
    state = wheels.state()
    assert state.pose[0] == pytest.approx(-800.0 * 300.1 * GEOMETRY.metres_per_step, abs=1e-3)
    assert not wheels.counts


def test_one_corrupt_reading_is_left_out() -> None:
    wheels = Wheels((400.0, 400.0))
    wheels.run(0.1)
    assert wheels.odometry.update(wheels.now_ns, 0x2828, 40) is None
    wheels.run(0.1)
    state = wheels.state()
    assert state.pose == pytest.approx([80 * GEOMETRY.metres_per_step, 0.0, 0.0], abs=1e-9)
    assert wheels.counts == {"implausible_counters": 1}


def test_a_robot_that_may_have_misunderstood_is_believed_by_its_counters() -> None:
    wheels = Wheels((20.0, 20.0))
    wheels.rates = np.array([-700.0, 20.0])  # by a command that was twisted on the way
    wheels.run(1.0)
    wheels.odometry.doubt_rates(wheels.now_ns - SECOND, EPUCK1.max_rate)
    state = wheels.state()
    turn = 720 * GEOMETRY.metres_per_step / GEOMETRY.wheel_separation
    assert float(se2.wrap_angle(state.pose[2] - turn)) == pytest.approx(0.0, abs=1e-9)
    assert not wheels.counts


def test_a_command_that_takes_its_time_is_no_fault() -> None:
    wheels = Wheels((600.0, 600.0))
    wheels.run(1.0)
    wheels.read()
    wheels.odometry.note_rates(wheels.now_ns, 0.0, 0.0)  # under way for 0.2 s, while readings come
    for _ in range(4):
        wheels.run(0.05)
        assert wheels.read() is not None
    wheels.rates = np.zeros(2)
    wheels.run(0.05)
    assert wheels.read() is not None
    assert not wheels.counts


@given(st.lists(st.tuples(st.floats(0.0, 0.5), st.floats(0.0, 1.0)), min_size=1, max_size=20))
def test_a_robot_may_read_its_counters_at_any_time_between_question_and_answer(
    exchanges: list[tuple[float, float]],
) -> None:
    counts: Counter[str] = Counter()
    odometry = WheelOdometry(GEOMETRY, NOISE, counts)
    odometry.note_rates(SECOND, 600.0, 600.0)
    odometry.update(SECOND, 0, 0)
    asked_ns = SECOND + SECOND // 100
    for took_s, share in exchanges:
        way_ns = round(0.5 * took_s * SECOND)
        steps = as_counter(math.floor(600.0 * (1e-9 * (asked_ns - SECOND) + share * took_s)))
        assert odometry.update(asked_ns + way_ns, steps, steps, doubt_ns=way_ns) is not None
        asked_ns += 2 * way_ns + SECOND // 100
    assert not counts


def test_a_robot_that_was_switched_off_is_counted_from_anew_and_less_sure() -> None:
    wheels = Wheels((400.0, 400.0), (20000, 20000))
    wheels.run(1.0)
    sure = wheels.state()
    wheels.run(0.5)
    wheels.steps = np.zeros(2)
    assert wheels.read() is None
    wheels.run(0.5)
    lost = wheels.state()
    wheels.run(0.5)
    after = wheels.state()
    assert lost.pose == pytest.approx(sure.pose)
    assert math.sqrt(lost.covariance[0, 0]) > 0.5 * 400 * GEOMETRY.metres_per_step
    assert after.pose[0] - lost.pose[0] == pytest.approx(200 * GEOMETRY.metres_per_step, abs=1e-9)
    assert wheels.counts == {"implausible_counters": 1, "counter_restarts": 1}


def test_time_that_stands_tells_nothing() -> None:
    assert Wheels().read() is None


@pytest.mark.parametrize("back_s", [0.051, 5.0])
def test_a_step_of_the_clock_costs_no_way(back_s: float) -> None:
    wheels = Wheels((1000.0, 1000.0), (32700, 32700))
    for jump_s in (0.0, back_s, 0.0):
        wheels.run(0.05)
        wheels.now_ns -= round(jump_s * SECOND)
        state = wheels.state()
    assert state.pose == pytest.approx([150 * GEOMETRY.metres_per_step, 0.0, 0.0], abs=1e-9)
    assert wheels.counts == {"time_jumps": 1}


def test_counters_that_begin_anew_with_time_tell_no_way() -> None:
    wheels = Wheels((400.0, 400.0), (20000, 20000))
    wheels.run(1.0)
    before = wheels.state()
    wheels.now_ns, wheels.steps = SECOND // 2, np.zeros(2)
    jumped = wheels.state()
    wheels.run(0.5)
    after = wheels.state()
    assert jumped.pose == pytest.approx(before.pose)
    assert jumped.covariance[0, 0] > before.covariance[0, 0]
    assert after.pose[0] - jumped.pose[0] == pytest.approx(200 * GEOMETRY.metres_per_step, abs=1e-9)
    assert wheels.counts == {"time_jumps": 1, "counter_restarts": 1}


@given(legs=st.lists(st.tuples(RATE, RATE, st.integers(1, 20)), min_size=1, max_size=12))
def test_the_covariance_is_that_of_the_estimators_model(legs: list[tuple[float, float, int]]) -> None:
    wheels = Wheels()
    states = [wheels.first]
    for left, right, readings in legs:
        wheels.command(left, right)
        for _ in range(readings):
            wheels.run(0.05)
            states.append(wheels.state())
    poses = np.array([state.pose for state in states])
    stamps = np.array([state.stamp_ns for state in states])

    model = OdometryModel(wheel_separation=GEOMETRY.wheel_separation, wheel_noise=NOISE, timeout_s=60.0)
    tracks = OdometryTracks([Robot("one", odometry=model)])
    tracks.extend(np.zeros(len(stamps), np.int64), stamps, poses)
    covariance = tracks.at(np.zeros(1, np.int64), stamps[-1:]).covariance[0]
    jacobian = se2.error_to_pose_jacobian(poses[-1])
    expected = jacobian @ covariance @ jacobian.T

    last = states[-1]
    excess: NDArray[np.float64] = last.covariance - expected
    # chords against arcs, and the cut-off fraction of a step on top
    assert np.abs(excess).max() <= 0.02 * np.abs(expected).max() + 1e-5
    assert np.linalg.eigvalsh(last.covariance)[0] > 0.0
