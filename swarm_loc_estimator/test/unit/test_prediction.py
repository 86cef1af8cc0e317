"""Prediction with errors that last: against sampling, and in one step as in many."""

import numpy as np
import pytest
from core_messages import SECOND, T0

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.filter.measurements import LossReason
from swarm_loc_estimator.filter.prediction import new_scratch, predict, write_predicted
from swarm_loc_estimator.filter.state import InitialPose, SwarmState
from swarm_loc_estimator.odometry.preintegration import Preintegrated
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.swarm.calibration_states import (
    CAMERA_YAW,
    DISTANCE_SCALE,
    TURN_BIAS,
    TURN_SCALE,
    ParameterTable,
)
from swarm_loc_estimator.swarm.error_models import OdometryModel, SensorModel
from swarm_loc_estimator.swarm.swarm import CameraMount, Robot

BIAS_SIGMA, DISTANCE_SIGMA, TURN_SIGMA, BIAS_TIME_S = 0.005, 0.01, 0.005, 20.0
STEP_NS = SECOND // 20
MODEL = OdometryModel(
    wheel_noise=1e-9,
    distance_scale_sigma=DISTANCE_SIGMA,
    turn_scale_sigma=TURN_SIGMA,
    turn_bias_sigma=BIAS_SIGMA,
    turn_bias_time_s=BIAS_TIME_S,
)
PRIOR = 1e-4 * np.eye(3)


def drive(speed: float, turn_rate: float, seconds: float) -> tuple[OdometryTracks, SwarmState]:
    """Two robots that drive the same, the second without errors that last."""
    robots = [Robot("a", odometry=MODEL), Robot("b", odometry=OdometryModel(wheel_noise=1e-9))]
    tracks, state = OdometryTracks(robots), SwarmState(ParameterTable.of(robots))
    stamps = T0 + STEP_NS * np.arange(round(seconds * 20) + 1, dtype=np.int64)
    pose, raw = np.zeros(3), []
    for _ in stamps:
        raw.append(pose)
        pose = se2.compose(pose, se2.exp(np.array([speed, 0.0, turn_rate]) * 0.05))
    for robot in range(2):
        tracks.extend(np.full(stamps.size, robot), stamps, np.array(raw))
        state.initialize(robot, InitialPose(np.array([0.3, -0.2, 1.0]), PRIOR), Preintegrated.begin(T0))
    return tracks, state


def preintegrated(tracks: OdometryTracks, robot: int, stamp_ns: int) -> Preintegrated:
    sample = tracks.at(np.array([robot]), np.array([stamp_ns]))
    return Preintegrated(stamp_ns, sample.covariance[0], sample.jacobian[0])


def to(state: SwarmState, tracks: OdometryTracks, seconds: float, robot: int = 0) -> None:
    stamp_ns = T0 + round(seconds * 1e9)
    predict(state.arrays(), robot, preintegrated(tracks, robot, stamp_ns), new_scratch())


@pytest.mark.parametrize(("speed", "turn_rate"), [(0.1, 0.0), (0.1, 0.4)])
def test_one_long_prediction_is_many_short_ones(speed: float, turn_rate: float) -> None:
    """Only the bias's decay along a bend tells them apart: it is taken as even over the time."""
    tracks, many = drive(speed, turn_rate, 4.0)
    many.parameter[0, :3] = [0.02, 0.02, -0.01]
    once = many.copy()
    to(once, tracks, 4.0)
    for seconds in np.linspace(0.1, 4.0, 40):
        to(many, tracks, seconds)
    np.testing.assert_allclose(once.transform, many.transform, atol=8e-3)
    np.testing.assert_allclose(once.parameter, many.parameter, atol=1e-12)
    p, q = once.filter.covariance, many.filter.covariance
    scale = np.sqrt(np.outer(np.diag(q), np.diag(q)))
    np.testing.assert_allclose(p / scale, q / scale, atol=0.08)
    np.testing.assert_array_equal(p, p.T)
    assert np.linalg.eigvalsh(p / scale).min() > 0.0


def test_an_error_of_the_pose_is_not_changed_by_how_the_odometry_errs() -> None:
    """Right-invariant, it moves the whole path alike; else what moves everything would seem observed."""
    tracks, state = drive(0.1, 0.4, 4.0)
    state.parameter[0, :3] = [0.1, 0.2, -0.2]
    state.filter.set_prior(np.arange(6, 9), 1e-18 * np.eye(3))
    state.filter.set_prior(np.arange(3), np.diag([1.0, 2.0, 3.0]))
    other, error = state.copy(), np.array([0.3, -0.5, 0.7])
    other.transform[0] = se2.compose(se2.exp(error), state.transform[0])
    for seconds in np.linspace(0.1, 4.0, 40):
        to(state, tracks, seconds)
        to(other, tracks, seconds)
    np.testing.assert_allclose(
        other.transform[0], se2.compose(se2.exp(error), state.transform[0]), atol=1e-12
    )
    np.testing.assert_allclose(state.filter.covariance[:3, :3], np.diag([1.0, 2.0, 3.0]), atol=1e-3)


def test_the_read_out_is_what_the_prediction_would_be() -> None:
    tracks, state = drive(0.1, 0.3, 4.0)
    state.parameter[0, :3] = [0.02, 0.02, -0.01]
    to(state, tracks, 1.0)
    before = state.copy()
    at = preintegrated(tracks, 0, T0 + 3 * SECOND)
    transform, covariance = np.empty(3), np.empty((3, 3))
    write_predicted(state.arrays(), 0, at, new_scratch(), transform, covariance)
    np.testing.assert_array_equal(state.transform, before.transform)
    np.testing.assert_array_equal(state.filter.covariance, before.filter.covariance)
    to(state, tracks, 3.0)
    np.testing.assert_allclose(transform, state.transform[0], atol=1e-12)
    reported = state.filter.covariance[:3, :3] + state.sources.excess[0]
    np.testing.assert_allclose(covariance, reported, atol=1e-12)


def test_the_spread_is_that_of_sampled_motion() -> None:
    """Heading and place of many robots whose scales and changing bias are drawn."""
    speed, turn_rate, seconds, samples = 0.1, 0.3, 4.0, 4000
    tracks, state = drive(speed, turn_rate, seconds)
    rng, dt = np.random.default_rng(0), 0.05
    true = se2.compose(np.array([0.3, -0.2, 1.0]), np.zeros((samples, 3)))
    bias = BIAS_SIGMA * rng.standard_normal(samples)
    along = speed * (1.0 + DISTANCE_SIGMA * rng.standard_normal(samples))
    turning = turn_rate * (1.0 + TURN_SIGMA * rng.standard_normal(samples))
    kept = np.exp(-dt / BIAS_TIME_S)
    for _ in range(round(seconds / dt)):
        twist = np.column_stack([along, np.zeros(samples), turning + bias]) * dt
        true = se2.compose(true, se2.exp(twist))
        bias = kept * bias + np.sqrt(1.0 - kept**2) * BIAS_SIGMA * rng.standard_normal(samples)
    state.filter.set_prior(np.arange(3), 1e-12 * np.eye(3))
    to(state, tracks, seconds)
    track = tracks.at(np.array([0]), np.array([T0 + round(seconds * 1e9)])).pose[0]
    pose = se2.compose(state.transform[0], track)
    spread = np.cov((true - pose).T)
    scale = np.sqrt(np.outer(np.diag(spread), np.diag(spread)))
    predicted = se2.pose_covariance(pose, state.filter.covariance[:3, :3])
    np.testing.assert_allclose(predicted / scale, spread / scale, atol=0.08)


def test_a_camera_that_sways_forgets_its_yaw_and_keeps_its_variance() -> None:
    camera = CameraMount(yaw_sigma=0.02, yaw_time_s=5.0)
    robots = [Robot("a", camera=camera, sensor=SensorModel(distance_scale_sigma=0.03))]
    tracks, state = OdometryTracks(robots), SwarmState(ParameterTable.of(robots))
    stamps = T0 + SECOND * np.arange(11, dtype=np.int64)
    tracks.extend(np.zeros(11, dtype=np.int64), stamps, np.zeros((11, 3)))
    state.initialize(0, InitialPose(np.zeros(3), PRIOR), Preintegrated.begin(T0))
    state.parameter[0, CAMERA_YAW : CAMERA_YAW + 2] = [0.03, 0.01]
    state.filter.covariance[3:, 3:] = [[1e-4, 2e-5], [2e-5, 4e-4]]
    once = state.copy()
    to(once, tracks, 4.0)
    for seconds in np.linspace(0.5, 4.0, 8):
        to(state, tracks, float(seconds))
    left = np.exp(-4.0 / 5.0)
    for found in (once, state):
        np.testing.assert_allclose(found.parameter[0, CAMERA_YAW:], [0.03 * left, 0.01, 0.0, 0.0], rtol=1e-9)
        wanted = [[1e-4 * left**2 + 4e-4 * (1.0 - left**2), 2e-5 * left], [2e-5 * left, 4e-4]]
        np.testing.assert_allclose(found.filter.covariance[3:, 3:], wanted, rtol=1e-9)


def test_losing_a_robot_keeps_what_was_learned_of_its_sensors_and_not_how_that_depends_on_its_pose() -> None:
    tracks, state = drive(0.1, 0.3, 1.0)
    state.parameter[0, :3] = [0.02, 0.02, -0.01]
    to(state, tracks, 1.0)
    assert state.filter.covariance[:3, 6:].any()
    learned, variance = state.parameter[0].copy(), np.diag(state.filter.covariance)[6:].copy()
    state.deinitialize(0, LossReason.COMMAND, T0)
    assert not state.filter.covariance[:3, 6:].any()
    np.testing.assert_array_equal(state.parameter[0], learned)
    np.testing.assert_array_equal(np.diag(state.filter.covariance)[6:], variance)
    assert (TURN_BIAS, DISTANCE_SCALE, TURN_SCALE) == (0, 1, 2)  # the order of sigma
