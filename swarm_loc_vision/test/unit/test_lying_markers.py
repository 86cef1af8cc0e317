"""Markers that lie, from noisy corners to measurements; the description of a camera from control points."""

import math
from dataclasses import replace

import numpy as np
import pytest
from aerial_scenes import LENSES, floor_points, over_floor
from scipy.spatial.transform import Rotation

from bench.vision.scenes import CAMERA, project
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.filter.models import predict
from swarm_loc_estimator.sensors.camera import (
    _FLOOR_M,
    _FLOOR_RAD,
    _FLOOR_SHARE,
    DetectionRows,
    SightingConverter,
)
from swarm_loc_estimator.sensors.sensor import DropCounts
from swarm_loc_estimator.swarm.swarm import Face, FixedCamera, Robot, Swarm
from swarm_loc_vision.aerial.ground_control import AerialSettings, GroundCamera, solve_pose
from swarm_loc_vision.aerial.locate_camera import fixed_camera
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.markers.detector import Detections, detection_rows
from swarm_loc_vision.markers.pose import Seen, marker_poses, robot_body, solve_bodies, square

INTRINSICS = np.array([CAMERA[0, 0], CAMERA[1, 1], CAMERA[0, 2], CAMERA[1, 2]])
SIZE, SIGMA_PX = 0.05, 0.1
TOPS = tuple(
    Face(f"top{k}", k, x, 0.0, 0.1, yaw, SIZE, 0.0, lies=True)
    for k, x, yaw in ((1, 0.04, 0.3), (2, -0.04, 2.0))
)
BODY = {k: replace(at, sigma=0.0) for k, at in robot_body(Robot("a", faces=TOPS)).items()}
CAMERAS = (
    FixedCamera("straight", 0.0, 0.0, 1.2, yaw=0.4),
    FixedCamera("aslant", -0.8, 0.1, 1.1, pitch=0.9, roll=0.2),
    FixedCamera("far_aslant", -1.3, 0.2, 0.9, pitch=0.6, roll=-0.1),
)
OPTICAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def to_optical(camera: FixedCamera) -> tuple[FloatArray, FloatArray]:
    """Rotation (3, 3) and shift (3,) from map to the optical frame."""
    turn = OPTICAL @ Rotation.from_euler("ZYX", [camera.yaw, camera.pitch, camera.roll]).as_matrix().T
    return turn, -turn @ np.array([camera.x, camera.y, camera.z])


def looked(camera: FixedCamera, base: FloatArray, faces: int, rng: np.random.Generator) -> Seen:
    """The first faces of a robot at a pose (3,) in map, by their noisy corners."""
    turn, shift = to_optical(camera)
    robot = Rotation.from_euler("z", base[2]).as_matrix()
    corners = []
    for face in TOPS[:faces]:
        at = BODY[face.id]
        place = np.array([base[0], base[1], 0.0]) + robot @ at.position
        seen = project(turn @ robot @ at.rotation, turn @ place + shift, square(SIZE))
        corners.append(seen + SIGMA_PX * rng.normal(size=(4, 2)))
    covariance, lengths = np.tile(SIGMA_PX**2 * np.eye(8), (faces, 1, 1)), np.full(faces, SIZE)
    poses, _ = marker_poses(np.stack(corners), covariance, lengths, INTRINSICS)
    ids = np.array([face.id for face in TOPS[:faces]])
    return Seen(ids, np.stack(corners), covariance, lengths, poses)


def measured(camera: FixedCamera, base: FloatArray, seen: Seen) -> tuple[FloatArray, FloatArray]:
    """Errors (k, 3) and covariances (k, 3, 3) of the measurements, without the floor that is added to all."""
    count, zeros = len(seen.id), np.zeros(len(seen.id))
    found = Detections(seen.id * 0, seen.id, zeros, zeros, zeros, seen.corners, seen.poses, 0, {})
    rows = detection_rows(found, 16.0)
    swarm = Swarm((Robot("a", camera=None, faces=TOPS),), (), (camera,))
    drops, never = DropCounts(2), np.zeros(count, np.int64)
    one = SightingConverter(swarm, drops).convert(DetectionRows(np.full(count, 1), never, rows, never))
    assert not drops.total
    predicted, _ = predict(one, np.zeros((count, 3)), np.tile(base, (count, 1)))
    error = one.value - predicted
    error[:, 2] = se2.wrap_angle(error[:, 2])
    floor = _FLOOR_M + _FLOOR_SHARE * (camera.z - TOPS[0].z)
    return error, one.covariance - np.diag(np.square([floor, floor, _FLOOR_RAD]))


@pytest.mark.parametrize("faces", [1, 2])
@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.name)
def test_measurements_are_as_unsure_as_told(camera: FixedCamera, faces: int) -> None:
    """Of 400 means of three squares the mean is within 3 +- 0.4 (3 sigma); faces of one robot count once."""
    rng = np.random.default_rng(faces)
    squares = []
    for _ in range(400):
        base = np.array([*rng.uniform(-0.25, 0.25, 2), rng.uniform(-math.pi, math.pi)])
        seen = looked(camera, base, faces, rng)
        solve_bodies(seen, [BODY], INTRINSICS, None)
        errors, covariances = measured(camera, base, seen)
        squares.append(
            np.mean([e @ np.linalg.solve(c, e) * faces for e, c in zip(errors, covariances, strict=True)])
        )
    assert 2.4 < np.mean(squares) < 3.6


def test_two_faces_of_a_robot_have_a_better_heading_together() -> None:
    rng = np.random.default_rng(0)
    headings: dict[int, list[float]] = {1: [], 2: []}
    for faces, kept in headings.items():
        for _ in range(60):
            base = np.array([0.1, 0.1, rng.uniform(-math.pi, math.pi)])
            seen = looked(CAMERAS[0], base, faces, rng)
            solve_bodies(seen, [BODY], INTRINSICS, None)
            kept.append(measured(CAMERAS[0], base, seen)[0][0, 2])
    assert np.std(headings[2]) < 0.6 * np.std(headings[1])


@pytest.mark.parametrize("seed", range(4))
def test_a_pose_by_control_points_is_that_of_the_described_camera(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = over_floor(LENSES["barrel"], rng)
    fit = solve_pose(truth.camera, floor_points(truth, rng, 8), AerialSettings(control_sigma=0.001))
    camera = fixed_camera("up", fit.ground, 0.1)
    turn, shift = to_optical(camera)
    np.testing.assert_allclose(turn, fit.ground.rotation, atol=5e-6)
    np.testing.assert_allclose(shift, fit.ground.pose[3:], atol=5e-5)


def test_a_camera_straight_down_has_a_pose_too() -> None:
    turn = OPTICAL @ Rotation.from_euler("ZYX", [0.7, math.pi / 2, 0.0]).as_matrix().T
    pose = np.concatenate([Rotation.from_matrix(turn).as_rotvec(), turn @ [0.0, 0.0, -2.0]])
    camera = fixed_camera(
        "up", GroundCamera(Camera(640, 480, 500.0, 500.0, 319.5, 239.5), pose, 1e-8 * np.eye(6))
    )
    np.testing.assert_allclose(to_optical(camera)[0], turn, atol=5e-6)


def test_sigmas_of_a_camera_are_those_of_what_it_sees() -> None:
    """The largest standard deviation in the image, of many poses with the noise of the control points."""
    rng = np.random.default_rng(5)
    truth, settings = (
        over_floor(LENSES["barrel"], rng),
        AerialSettings(control_sigma_px=0.5, control_sigma=0.0),
    )
    points = floor_points(truth, rng, 8)
    told = fixed_camera("up", solve_pose(truth.camera, points, settings).ground, 0.1)
    pixels = np.array([[0.0, 0.0], [619.0, 0.0], [0.0, 479.0], [619.0, 479.0], [320.0, 240.0]])
    places, turns = [], []
    for _ in range(200):
        noise = 0.5 * rng.standard_normal(points.pixels.shape)
        noisy = type(points)(points.names, points.places, points.pixels + noise)
        ground = solve_pose(truth.camera, noisy, settings).ground
        here, there = ground.places(pixels, 0.1), ground.places(pixels + np.array([10.0, 0.0]), 0.1)
        places.append(here)
        turns.append(np.arctan2(*(there - here)[:, ::-1].T))
    spreads = [np.cov(np.array(places)[:, k].T) for k in range(len(pixels))]
    largest = math.sqrt(max(np.linalg.eigvalsh(one)[-1] for one in spreads))
    assert 0.85 < largest / told.position_sigma < 1.15
    assert 0.8 < np.std(np.unwrap(turns, axis=0), axis=0).max() / told.yaw_sigma < 1.2
