"""Simulated motion against closed forms and its noise against its variance."""

import math

import numpy as np
import pytest

from bench.scenarios.lived_run import Driven, drive
from swarm_loc_drivers.sim.differential_drive import Drive, LastingNoise, integrate, twist_of, wheel_paths
from swarm_loc_drivers.sim.run import Trajectories
from swarm_loc_drivers.sim.scenarios.eight import Lemniscate
from swarm_loc_estimator.common.arrays import FloatArray

SEPARATION = 0.053
IDEAL = Drive(SEPARATION, wheel_noise=0.0)
START = np.zeros((1, 3))


def driven_at(
    speed: float,
    turn_rate: float,
    steps: int,
    model: Drive = IDEAL,
    start: FloatArray = START,
    step_s: float = 0.01,
) -> Driven:
    """Robots that are commanded a constant twist."""
    speeds, turn_rates = np.full(len(start), speed), np.full(len(start), turn_rate)
    rng = np.random.default_rng(1)
    return drive(rng, start, lambda *_: (speeds, turn_rates), model, step_s=step_s, steps=steps)


@pytest.mark.parametrize(("speed", "turn_rate"), [(0.06, 0.3), (0.1, -1.2), (0.0, 0.8), (-0.05, 0.4)])
def test_an_ideal_robot_drives_the_arc_of_its_twist(speed: float, turn_rate: float) -> None:
    driven = driven_at(speed, turn_rate, 700, start=np.array([[0.4, -0.2, 2.0]]))
    heading = 2.0 + turn_rate * 7.0
    radius = speed / turn_rate
    expected = [
        0.4 + radius * (math.sin(heading) - math.sin(2.0)),
        -0.2 - radius * (math.cos(heading) - math.cos(2.0)),
    ]
    np.testing.assert_allclose(driven.truth[-1, 0, :2], expected, atol=1e-12)
    assert math.remainder(driven.truth[-1, 0, 2] - heading, 2 * math.pi) == pytest.approx(0.0, abs=1e-12)


def test_a_straight_line_is_as_long_as_speed_times_time() -> None:
    driven = driven_at(0.06, 0.0, 500)
    np.testing.assert_allclose(driven.truth[-1, 0], [0.3, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(driven.reported[-1, 0], [0.3, 0.0, 0.0], atol=1e-12)


def test_odometry_integrates_to_the_true_arc_but_for_its_midpoint_rule() -> None:
    wheels = wheel_paths(np.full((1000, 1), 0.06), np.full((1000, 1), 0.4), SEPARATION, 0.01)
    end = integrate(twist_of(wheels, SEPARATION))[-1, 0]
    radius = 0.06 / 0.4
    np.testing.assert_allclose(end[:2], [radius * math.sin(4.0), radius * (1 - math.cos(4.0))], atol=2e-7)


def test_wheel_noise_grows_with_the_path_of_each_wheel() -> None:
    robots, noise, speed, turn_rate = 20000, 2e-5, 0.06, 0.8
    driven = driven_at(speed, turn_rate, 10, Drive(SEPARATION, noise), np.zeros((robots, 3)))
    right, left = 0.1 * (speed + 0.5 * SEPARATION * turn_rate), 0.1 * (speed - 0.5 * SEPARATION * turn_rate)
    heading_variance = noise * (right + left) / SEPARATION**2
    turned = driven.truth[-1, :, 2]
    assert turned.mean() == pytest.approx(0.08, abs=5 * math.sqrt(heading_variance / robots))
    assert turned.var() == pytest.approx(heading_variance, rel=0.04)
    along = driven.truth[-1, :, 0]
    assert along.var() == pytest.approx(0.25 * noise * (right + left), rel=0.06)
    covariance = np.cov(along, turned)[0, 1]
    expected = 0.5 * noise * (right - left) / SEPARATION
    assert covariance == pytest.approx(expected, abs=0.03 * math.sqrt(along.var() * turned.var()))


def test_lasting_noise_has_the_variance_of_white_noise_over_longer_times() -> None:
    wheels, lasting_steps = 20_000, 10
    noise = LastingNoise(np.random.default_rng(3), (wheels,), step_s=0.005, time_s=0.05)
    steps = np.array([noise.next() for _ in range(200)])
    bound = 5.0 * math.sqrt(2.0 / wheels)  # of a sample variance, relative
    for begin, count in ((0, 20), (0, 200), (100, 100)):
        spread_over = (lasting_steps**2 - 1) / (3.0 * lasting_steps)  # steps' worth that both ends share out
        variance = steps[begin : begin + count].sum(axis=0).var()
        assert variance == pytest.approx(count - spread_over, rel=bound)
    assert 0.98 < (200 - spread_over) / 200 < 1.0  # a second of simulated time
    assert steps[0].var() == pytest.approx(1.0 / lasting_steps, rel=bound)


def test_slip_loses_its_share_of_a_turn_and_odometry_does_not_know() -> None:
    driven = driven_at(0.0, 1.0, 100, Drive(SEPARATION, 0.0, turn_slip=0.05))
    assert driven.truth[-1, 0, 2] == pytest.approx(0.95)
    assert driven.reported[-1, 0, 2] == pytest.approx(1.0)


def test_the_eight_has_the_papers_length_and_curvature() -> None:
    eight = Lemniscate(0.6)
    assert eight.length == pytest.approx(3.1465, abs=1e-4)
    travelled = np.linspace(0.0, eight.length, 20001)
    pose, curvature = eight.at(travelled)
    step = np.linalg.norm(np.diff(pose[:, :2], axis=0), axis=1)
    np.testing.assert_allclose(step, eight.length / 20000, rtol=1e-3)
    assert 1.0 / np.abs(curvature).max() == pytest.approx(0.2, rel=1e-6)
    turn = np.diff(np.unwrap(pose[:, 2]))
    np.testing.assert_allclose(turn, 0.5 * (curvature[1:] + curvature[:-1]) * eight.length / 20000, atol=2e-6)
    direction = np.diff(pose[:, :2], axis=0)
    middle = np.unwrap(pose[:, 2])[:-1] + 0.5 * turn
    np.testing.assert_allclose(
        np.arctan2(direction[:, 1], direction[:, 0]), np.arctan2(np.sin(middle), np.cos(middle)), atol=1e-3
    )


def test_between_two_stamps_a_robot_keeps_its_twist() -> None:
    driven = driven_at(0.1, 2.0, 4, step_s=0.5)
    track = Trajectories(np.arange(5, dtype=np.int64) * 500_000_000, driven.truth)
    pose = track.at(0, np.array([730_000_000]))[0]
    np.testing.assert_allclose(pose, [0.05 * math.sin(1.46), 0.05 * (1 - math.cos(1.46)), 1.46], atol=1e-12)
    np.testing.assert_allclose(track.at(0, track.stamp_ns), track.poses[:, 0], atol=1e-15)
    np.testing.assert_allclose(track.all_at(np.array([730_000_000]))[0, 0], pose)


def test_truth_outside_the_simulated_time_is_refused() -> None:
    track = Trajectories(np.array([0, 10], dtype=np.int64), np.zeros((2, 1, 3)))
    with pytest.raises(ValueError, match="leave the simulated time"):
        track.at(0, np.array([11]))
