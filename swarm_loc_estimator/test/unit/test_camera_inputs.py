"""Sightings of cameras: from messages to measurements, and those of bearings alone."""

import math
from dataclasses import replace

import numpy as np
import pytest
from core_geometry import homogeneous, marker_frame, nees, seen, wrapped
from core_messages import POSE_TWO, POSITION, T0, detection, joined
from core_run import on_time, play, settled, ticks
from core_world import Plan, World, simulate
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.detections import DETECTION_DTYPE
from swarm_loc_estimator.filter.measurements import NOBODY, Measurements
from swarm_loc_estimator.filter.models import BEARING, CARTESIAN, MODELS, POLAR
from swarm_loc_estimator.sensors.camera import (
    _FLOOR_M,
    _FLOOR_RAD,
    _FLOOR_SHARE,
    CONTENT_BEARING,
    DetectionRows,
    SightingConverter,
)
from swarm_loc_estimator.sensors.sensor import DropCounts
from swarm_loc_estimator.swarm.error_models import SensorModel
from swarm_loc_estimator.swarm.swarm import CameraMount, Face, Landmark, Robot, Swarm
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_estimator.timeline.settings import Settings

LEVEL = CameraMount(x=0.04, z=0.05)
MOUNTS = [
    LEVEL,
    CameraMount(x=-0.1, y=0.03, z=0.2, yaw=2.5),
    CameraMount(x=0.04, y=-0.02, z=0.3, yaw=-0.4, pitch=0.6),
    CameraMount(y=0.1, z=0.1, yaw=1.0, pitch=-0.3, roll=0.9),
]
MARK = Landmark(7, 1.3, 0.8, 0.25, 2.9)
FACE = Face("left", 3, 0.01, 0.03, 0.04, math.pi / 2)


def swarm(mount: CameraMount | None = LEVEL, sensor: SensorModel | None = None) -> Swarm:
    seer = Robot("seer", camera=mount, sensor=sensor or SensorModel(), faces=(Face("front", 1, yaw=0.0),))
    return Swarm((seer, Robot("other", faces=(FACE,))), (MARK, Landmark(8, 1.0, 0.0, 0.1)))


def converted(
    detections: NDArray[np.void], swarm: Swarm, robot: int = 0
) -> tuple[Measurements, dict[str, int]]:
    count, drops = detections.size, DropCounts(len(swarm.sources))
    received = np.frombuffer(detections.tobytes(), dtype=DETECTION_DTYPE)
    stamps = np.full(count, T0)
    rows = DetectionRows(np.full(count, robot), stamps, received, stamps)
    return SightingConverter(swarm, drops).convert(rows), dict(drops.total)


def planar(mount: CameraMount, base: FloatArray, mark: FloatArray) -> FloatArray:
    """Where a marker lies as seen from a level sensor at the mount's place, turned by its yaw: (3,)."""
    sensor = homogeneous(base[0], base[1], 0.0, base[2]) @ homogeneous(mount.x, mount.y, 0.0, mount.yaw)
    relative = np.linalg.inv(sensor) @ mark
    return np.array([relative[0, 3], relative[1, 3], math.atan2(relative[1, 2], relative[0, 2])])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("mount", MOUNTS)
def test_a_rendered_landmark_comes_back_as_the_measurement_in_the_plane(
    mount: CameraMount, seed: int
) -> None:
    base = np.random.default_rng(seed).uniform(-1, 1, 3)
    mark = marker_frame(MARK.x, MARK.y, MARK.z, MARK.yaw or 0.0)
    measured, dropped = converted(detection(7, seen(base, mount, mark)), swarm(mount))
    expected = planar(mount, base, mark)
    np.testing.assert_allclose(measured.value[0], expected, atol=1e-12)
    assert not dropped
    assert measured.model[0] == CARTESIAN
    assert (measured.observer[0], measured.target[0]) == (0, NOBODY)
    np.testing.assert_allclose(measured.sensor[0], [mount.x, mount.y, mount.yaw])
    np.testing.assert_allclose(measured.marker[0], [MARK.x, MARK.y, MARK.yaw or 0.0])
    position, _ = converted(detection(7, seen(base, mount, mark), POSITION), swarm(mount))
    distance, bearing = math.hypot(expected[0], expected[1]), math.atan2(expected[1], expected[0])
    np.testing.assert_allclose(position.value[0, :2], [distance, bearing], atol=1e-12)
    assert (position.model[0], position.has_heading[0]) == (POLAR, 0)
    direction = detection(7, seen(base, mount, mark), CONTENT_BEARING)
    direction["position"] *= 1e4  # its length means nothing
    direction["orientation"] = np.nan
    towards, dropped = converted(direction, swarm(mount))
    assert not dropped
    np.testing.assert_allclose(towards.value[0, 0], bearing, atol=1e-12)
    assert (towards.model[0], towards.has_heading[0]) == (BEARING, 0)
    assert towards.gate < position.gate
    np.testing.assert_allclose(towards.covariance[0], np.diag([SensorModel().bearing_sigma ** 2, 1.0, 1.0]))
    direction["position"] = 0.0
    assert converted(direction, swarm(mount))[1] == {"non_finite": 1}


def test_a_face_is_seen_on_the_robot_that_carries_it() -> None:
    measured, _ = converted(detection(FACE.id, marker_frame(0, 0, 1, 0)), swarm())
    assert (measured.observer[0], measured.target[0]) == (0, 1)
    np.testing.assert_allclose(measured.marker[0], [FACE.x, FACE.y, FACE.yaw or 0.0])


def test_a_marker_that_shows_no_heading_gives_range_and_bearing_even_from_a_pose() -> None:
    measured, _ = converted(detection(8, marker_frame(0, 0, 1, 0)), swarm())
    assert (measured.model[0], measured.has_heading[0]) == (POLAR, 0)


def test_the_second_solution_becomes_the_alternative() -> None:
    mark = marker_frame(MARK.x, MARK.y, MARK.z, MARK.yaw or 0.0)
    one = detection(7, seen(np.zeros(3), LEVEL, mark), POSE_TWO)
    other = marker_frame(MARK.x + 0.05, MARK.y, MARK.z, 2.0)
    mirrored = seen(np.zeros(3), LEVEL, other)
    one["alternative_position"] = mirrored[:3, 3]
    one["alternative_orientation"] = Rotation.from_matrix(mirrored[:3, :3]).as_quat()
    measured, _ = converted(one, swarm())
    assert measured.has_second[0]
    np.testing.assert_allclose(measured.value[0], planar(LEVEL, np.zeros(3), mark), atol=1e-12)
    np.testing.assert_allclose(measured.second[0], planar(LEVEL, np.zeros(3), other), atol=1e-12)


@pytest.mark.parametrize("mount", MOUNTS)
def test_a_published_covariance_is_carried_into_the_plane(mount: CameraMount) -> None:
    rng = np.random.default_rng(5)
    mark = marker_frame(MARK.x, MARK.y, MARK.z, MARK.yaw or 0.0)
    relative = seen(np.zeros(3), mount, mark)
    sigma = 1e-4 * rng.uniform(0.5, 2.0, 6)
    one = detection(7, relative)
    one["covariance"][0] = np.diag(sigma**2)
    measured, _ = converted(one, swarm(mount))
    samples = np.repeat(detection(7, relative), 4000)
    errors = sigma * rng.standard_normal((4000, 6))
    samples["position"] += errors[:, :3]
    samples["orientation"] = (
        Rotation.from_rotvec(errors[:, 3:]) * Rotation.from_quat(samples["orientation"])
    ).as_quat()
    spread = np.cov(converted(samples, swarm(mount))[0].value.T)
    floor = _FLOOR_M + _FLOOR_SHARE * np.hypot(*measured.value[0, :2])
    expected = measured.covariance[0] - np.diag(np.square([floor, floor, _FLOOR_RAD]))
    np.testing.assert_allclose(spread, expected, atol=0.08 * np.abs(expected).max())


def test_without_a_covariance_the_sensor_s_noise_counts() -> None:
    sensor = SensorModel(
        forward_sigma=0.3, left_sigma=0.2, heading_sigma=0.1, range_sigma=0.05, bearing_sigma=0.4
    )
    sensor = replace(sensor, range_sigma_per_m=0.5)
    one = detection(7, marker_frame(0.0, 0.0, 2.0, 0.0))
    measured, _ = converted(one, swarm(LEVEL, sensor))
    np.testing.assert_allclose(measured.covariance[0], np.diag([0.09, 0.04, 0.01]))
    one["content"] = POSITION
    measured, _ = converted(one, swarm(LEVEL, sensor))
    np.testing.assert_allclose(np.diag(measured.covariance[0]), [(0.05 + 0.5 * 2.0) ** 2, 0.16, 1.0])


def test_calibration_corrects_range_bearing_and_time() -> None:
    sensor = SensorModel(
        range_log_scale=0.1, range_skew=0.2, range_curve=0.5, range_offset=-0.03, robot_range_offset=0.01,
        bearing_scale=1.1, bearing_curve=0.3, bearing_offset=0.02, time_offset_s=-0.15,
    )  # fmt: skip
    both = joined([detection(marker, marker_frame(0, 0, 0, 0), POSITION) for marker in (7, FACE.id)])
    both["position"] = [-0.6, 0.0, 1.8]  # 0.6 m to the left, 1.8 m ahead
    measured, _ = converted(both, swarm(LEVEL, sensor))
    bearing, distance = math.atan2(0.6, 1.8), math.hypot(0.6, 1.8)
    expected = distance * math.exp(0.1 + 0.2 * bearing + 0.5 * bearing**2) - 0.03
    np.testing.assert_allclose(measured.value[:, 0], [expected, expected + 0.01])
    np.testing.assert_allclose(measured.value[:, 1], 1.1 * bearing + 0.3 * bearing**2 + 0.02)
    np.testing.assert_array_equal(measured.stamp_ns, T0 - 150_000_000)


def broken(name: str, value: float, content: int = POSE_TWO) -> NDArray[np.void]:
    one = detection(7, marker_frame(0.0, 0.0, 1.0, 0.0), content)
    one[name] = value
    return one


@pytest.mark.parametrize(
    ("one", "reason"),
    [
        (detection(99, marker_frame(0, 0, 1, 0)), "unknown_id"),
        (detection(1, marker_frame(0, 0, 1, 0)), "own_marker"),
        (broken("position", math.nan), "non_finite"),
        (broken("position", math.inf, POSITION), "non_finite"),
        (broken("covariance", math.nan), "non_finite"),
        (broken("orientation", math.nan), "non_finite"),
        (broken("orientation", 0.0), "non_finite"),
        (broken("orientation", 1e200), "non_finite"),
        (broken("alternative_orientation", math.nan), "non_finite"),
        (broken("alternative_position", math.nan), "non_finite"),
        (broken("position", 1e6), "absurd"),
        *((broken("content", content), "bad_content") for content in (0, 5, 7, 255)),
    ],
)
def test_what_cannot_be_used_is_dropped_with_a_reason(one: NDArray[np.void], reason: str) -> None:
    good = detection(7, marker_frame(0.0, 0.0, 1.0, 0.0))
    measured, dropped = converted(joined([one, good]), swarm())
    assert dropped == {reason: 1}
    assert measured.size == 1
    assert measured.reading[0] == 7


def test_numbers_that_the_content_does_not_promise_may_be_anything() -> None:
    one = detection(7, marker_frame(0.0, 0.0, 1.0, 0.0), POSITION)
    for name in ("orientation", "alternative_position", "alternative_orientation", "covariance"):
        one[name] = math.nan
    measured, dropped = converted(one, swarm())
    assert (measured.size, dropped) == (1, {})


def test_a_robot_without_a_camera_sees_nothing() -> None:
    measured, dropped = converted(detection(7, marker_frame(0, 0, 1, 0)), swarm(None))
    assert (measured.size, dropped) == (0, {"no_camera": 1})


def test_nothing_at_all_is_converted_to_nothing() -> None:
    empty = np.zeros(0, dtype=DETECTION_DTYPE)
    assert converted(empty, swarm())[0].size == 0
    assert converted(detection(7, marker_frame(0, 0, 1, 0)), Swarm((Robot("alone"),)))[1] == {"unknown_id": 1}


POSITION_BEARING_SIGHTINGS = 1


def errors(world: World, *, seeing: bool) -> tuple[FloatArray, FloatArray, dict[str, int]]:
    estimator = Estimator(world.swarm, Settings())
    events = []
    for arrival_ns, event in on_time(world):
        if event.detections.size:
            event.detections["content"] = CONTENT_BEARING
            event.detections["position"] *= 7.0  # its length means nothing
        if seeing or not event.detections.size:
            events.append((arrival_ns, event))
    at_ns = ticks(int(world.stamp_ns[0]), int(world.stamp_ns[-1]), 1.0)[2:]
    estimates = play(estimator, events, at_ns)
    error = wrapped(np.array([one.poses - world.at(one.stamp_ns) for one in estimates]))
    return error, np.array([one.covariances for one in estimates]), settled(estimator)


def test_bearings_make_poses_better_and_the_errors_stay_as_large_as_the_covariances_say() -> None:
    squared, seeing, blind = [], [], []
    for seed in range(6):
        plan = Plan(3, 8.0, content=POSITION_BEARING_SIGHTINGS)
        error, covariance, verdicts = errors(simulate(plan, 300 + seed), seeing=True)
        assert verdicts["USED"] > 100
        squared.append(nees(error, covariance).mean(axis=0))
        seeing.append(np.square(error).mean(axis=(0, 1)))
        blind.append(np.square(errors(simulate(plan, 300 + seed), seeing=False)[0]).mean(axis=(0, 1)))
    better = np.sqrt(np.mean(seeing, axis=0) / np.mean(blind, axis=0))
    assert (better < 0.7).all()
    few = len(squared) * len(squared[0])  # means over a run are correlated: each counts as one pose at least
    assert chi2.ppf(0.001, 3 * few) / few < np.mean(squared) < chi2.ppf(0.999, 3 * few) / few


def test_bearings_locate_a_robot_that_moves() -> None:
    """Together with its motion, as other measurements of one degree of freedom."""
    world = simulate(Plan(2, 8.0, content=POSITION_BEARING_SIGHTINGS, start_known=(False,)), 5)
    error, _, verdicts = errors(world, seeing=True)
    located = error[-1][np.isfinite(error[-1]).all(axis=1)]
    assert len(located)
    assert np.abs(located[:, :2]).max() < 0.3
    assert verdicts["USED"] > 0


@pytest.mark.parametrize("quarter", range(4))
def test_a_bearing_wraps(quarter: int) -> None:
    value = np.array([0.5 * math.pi * quarter + 0.1, 0.0, 0.0])
    predicted = np.array([0.5 * math.pi * quarter - 2.0 * math.pi])
    assert MODELS[BEARING].innovation(value, predicted) == pytest.approx([0.1])
