"""Pictures whose stamps are not exact, and faces that do not sit quite where they should."""

from dataclasses import replace

import numpy as np
import pytest
from core_geometry import marker_frame, nees, wrapped
from core_messages import POSITION, SECOND, T0, detection, joined
from core_run import on_time, play, ticks
from core_world import Plan, World, simulate
from numpy.typing import NDArray
from scipy.stats import chi2

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.filter.measurements import NOBODY, Measurements
from swarm_loc_estimator.filter.models import predict
from swarm_loc_estimator.filter.state import SwarmState
from swarm_loc_estimator.filter.update import relative_motion
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.sensors.camera import DetectionRows, SightingConverter
from swarm_loc_estimator.swarm.calibration_states import ParameterTable
from swarm_loc_estimator.swarm.error_models import OdometryModel
from swarm_loc_estimator.swarm.swarm import CameraMount, Face, Landmark, Robot, Swarm
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_estimator.timeline.settings import Policy, Settings

TIME_SIGMA_S = 0.04
SEER = Robot("seer", camera=CameraMount(x=0.04))
FACES = (Face("left", 3, 0.01, 0.03, 0.0, 1.5, position_sigma=0.003), Face("back", 4, -0.03, yaw=3.1))
SWARM = Swarm((SEER, Robot("other", faces=FACES)), (Landmark(7, 1.0, 0.2, 0.0, 3.0),))
BELIEF = SwarmState(ParameterTable.of(SWARM.robots, SWARM.landmarks)).arrays()


def with_time_sigma(swarm: Swarm, sigma_s: float) -> Swarm:
    robots = (replace(one, sensor=replace(one.sensor, time_sigma_s=sigma_s)) for one in swarm.robots)
    return replace(swarm, robots=tuple(robots))


def measured_of(swarm: Swarm, stamps: IntArray, seen: NDArray[np.void]) -> Measurements:
    """What the first robot's camera measures."""
    rows = DetectionRows(np.zeros(stamps.size, np.int64), stamps, seen, stamps)
    return SightingConverter(swarm).convert(rows)


def test_what_a_picture_shows_shares_the_error_of_its_stamp() -> None:
    seen = joined([detection(marker, marker_frame(1.0, 0.0, 0.0, 3.0)) for marker in (7, 3, 99, 7)])
    stamps = np.array([T0, T0, T0, T0 + SECOND])
    measured = measured_of(with_time_sigma(SWARM, 0.1), stamps, seen)
    np.testing.assert_allclose(measured.stamp_variance, [0.02, 0.02, 0.01])
    measured = measured_of(SWARM, stamps, seen)
    assert (measured.stamp_variance == 0.0).all()


def test_how_unsure_a_face_sits_adds_to_the_noise_of_its_sightings() -> None:
    for content, distance in ((2, 1.0), (POSITION, 0.8)):
        seen = joined(
            [detection(marker, marker_frame(distance, 0.0, 0.0, 3.0), content) for marker in (3, 4, 7)]
        )
        measured = measured_of(SWARM, np.full(3, T0), seen)
        sure, unsure = measured.covariance[1], measured.covariance[0]
        away = 1.0 if content != POSITION else float(measured.value[0, 0])
        np.testing.assert_allclose(unsure - sure, np.diag([9e-6, 9e-6 / away**2, 0.0]), atol=1e-15)
        np.testing.assert_allclose(measured.covariance[2], sure)


def test_what_is_left_of_systematic_errors_adds_to_the_noise_that_a_detection_tells() -> None:
    known, unknown = (detection(7, marker_frame(1.0, 0.0, 0.0, 3.0)) for _ in range(2))
    known["covariance"] = np.diag([1e-6, 2e-6, 3e-6, 4e-6, 5e-6, 6e-6])
    sensor = replace(SEER.sensor, residual_position_sigma=0.01, residual_heading_sigma=0.02)
    seers = SWARM, replace(SWARM, robots=(replace(SEER, sensor=sensor), SWARM.robots[1]))
    plain, more = (measured_of(swarm, np.full(2, T0), joined([known, unknown])).covariance for swarm in seers)
    np.testing.assert_allclose(more[0] - plain[0], np.diag([1e-4, 1e-4, 4e-4]), atol=1e-15)
    np.testing.assert_array_equal(more[1], plain[1])


@pytest.mark.parametrize("target", [-1, 1])
def test_relative_motion_is_the_rate_of_what_is_predicted(target: int) -> None:
    """Robots drive arcs, with base_link ahead of the axle; rates against differences of predictions."""
    models = (OdometryModel(axle_offset=0.02, course_offset=0.1), OdometryModel(turn_scale=1.1))
    tracks = OdometryTracks([Robot(f"r{i}", odometry=model) for i, model in enumerate(models)])
    stamps = T0 + 10_000_000 * np.arange(300)
    for robot, (path, turn) in enumerate([(0.002, 0.011), (-0.001, -0.02)]):
        heading = turn * np.arange(300) + robot
        steps = path * np.column_stack([np.cos(heading + 0.5 * turn), np.sin(heading + 0.5 * turn)])
        place = np.cumsum(np.vstack([[[0.3, -0.8]], steps[:-1]]), axis=0)
        tracks.extend(np.full(300, robot), stamps, np.column_stack([place, heading]))
    one = Measurements.empty(1)
    one.observer[:], one.target[:], one.has_heading[:] = 0, target, True
    one.sensor[:], one.marker[:] = [0.04, 0.01, 0.2], [0.5, 0.3, -1.0]
    one.stamp_ns[:], one.stamp_variance[:] = T0 + 1_504_000_000, 1.0

    def predicted(shift_ns: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        now = one.stamp_ns + shift_ns
        poses = np.vstack([tracks.at(np.array([robot]), now).pose for robot in (0, 1)])
        value, jacobian = predict(one, poses[:1], poses[1:])
        return value[0], jacobian[0], poses

    motion = np.empty(3)
    _, jacobian, poses = predicted(0)
    relative_motion(one, 0, tracks.arrays, poses, motion)
    rate = wrapped((predicted(2_000_000)[0] - predicted(-2_000_000)[0])[None])[0] / 0.004
    np.testing.assert_allclose(jacobian[:, :3] @ motion, rate, rtol=0.01, atol=2e-3)
    one.stamp_variance[:] = 0.0
    relative_motion(one, 0, tracks.arrays, poses, motion)
    assert (motion == 0.0).all()


def test_a_robot_whose_motion_is_unknown_gives_no_rate() -> None:
    tracks = OdometryTracks([SEER])
    one = Measurements.empty(1)
    one.observer[:], one.target[:], one.stamp_variance[:], one.stamp_ns[:] = 0, NOBODY, 1.0, T0
    motion = np.full(3, np.nan)
    relative_motion(one, 0, tracks.arrays, np.zeros((2, 3)), motion)
    assert (motion == 0.0).all()  # nothing has come
    tracks.extend(
        np.zeros(2, np.int64), np.array([T0, T0 + SECOND // 10]), np.array([[0.0] * 3, [0.1, 0, 0]])
    )
    for after_s, expected in ((-1.0, 0.0), (0.05, -1.0), (0.3, -1.0), (5.0, 0.0)):
        one.stamp_ns[:] = T0 + round(after_s * SECOND)
        relative_motion(one, 0, tracks.arrays, np.zeros((2, 3)), motion)
        np.testing.assert_allclose(motion, [expected, 0.0, 0.0], atol=1e-9)


def mean_errors(world: World, swarm: Swarm, settings: Settings) -> tuple[FloatArray, float]:
    """NEES (N,) of each robot over time, and the mean squared error of positions [m^2]."""
    end_ns = int(world.stamp_ns[-1])
    estimates = play(Estimator(swarm, settings), on_time(world), ticks(T0, end_ns, 1.0))
    error = wrapped(np.array([one.poses - world.at(one.stamp_ns) for one in estimates]))[2:]
    squared: FloatArray = nees(error, np.array([one.covariances for one in estimates])[2:]).mean(axis=0)
    return squared, float(np.nanmean(error[..., :2] ** 2))


@pytest.mark.parametrize("many", [5, 1000])
def test_errors_are_admitted_where_stamps_err_and_who_trusts_them_errs_more(many: int) -> None:
    """Who trusts them doubts the whole description at last, which makes for large covariances."""
    settings = Settings(policy=Policy(large_from=1, batch_from=many))
    knowing, trusting = [], []
    for seed in range(12):
        rng = np.random.default_rng([seed, 7])
        world = simulate(Plan(3, 8.0, speed=0.4, turn_rate=1.5, reach=1.5), 400 + seed)
        events = [
            one
            if one.pose is not None
            else replace(one, stamp_ns=one.stamp_ns + round(rng.normal(0.0, TIME_SIGMA_S) * SECOND))
            for one in world.events
        ]
        world = replace(world, events=tuple(events))
        knowing.append(mean_errors(world, with_time_sigma(world.swarm, TIME_SIGMA_S), settings))
        trusting.append(mean_errors(world, world.swarm, settings))
    squared = np.array([one for one, _ in knowing])
    assert np.mean(squared) < chi2.ppf(1.0 - 1e-4, 3 * squared.size) / squared.size
    assert np.mean([error for _, error in trusting]) > 1.5 * np.mean([error for _, error in knowing])
