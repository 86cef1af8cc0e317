"""Poses of markers: upright and lying."""

import math
from dataclasses import replace

import numpy as np
import pytest
from aerial_scenes import LENSES, floor_points, over_floor
from scipy.spatial.transform import Rotation

from bench.vision.scenes import CAMERA, facing, project
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
from swarm_loc_vision.markers.pose import (
    Poses,
    Seen,
    Upright,
    _equations,
    _Sight,
    marker_poses,
    robot_body,
    solve_bodies,
    square,
)

INTRINSICS = np.array([1000.0, 1000.0, 639.5, 479.5])
LENGTH, SIGMA_PX = 0.05, 0.05
UP = np.array([0.0, -1.0, 0.0])


def random_markers(count: int, seed: int, min_incidence: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """Rotations (N, 3, 3) and positions (N, 3) before the camera."""
    rng = np.random.default_rng(seed)
    position = rng.uniform(0.4, 1.2, (count, 1)) * np.column_stack(
        [rng.uniform(-0.5, 0.5, (count, 2)), np.ones(count)]
    )
    azimuth, roll = rng.uniform(-3.0, 3.0, (2, count))
    incidence = rng.uniform(min_incidence, 1.1, count)
    rotation = [facing(a, i, r, at) for a, i, r, at in zip(azimuth, incidence, roll, position, strict=True)]
    return np.stack(rotation), position


def upright_markers(count: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """As `random_markers`, with their y axes up in the camera frame."""
    rng = np.random.default_rng(seed)
    yaw = rng.uniform(-1.0, 1.0, count)
    out = np.column_stack([np.sin(yaw), np.zeros(count), -np.cos(yaw)])
    right = np.cross(UP, out)
    position = np.column_stack(
        [rng.uniform(-0.3, 0.3, count), rng.uniform(-0.05, 0.05, count), rng.uniform(0.5, 1.5, count)]
    )
    return np.stack([right, np.tile(UP, (count, 1)), out], axis=2), position


def corners_of(rotation: FloatArray, position: FloatArray, noise_px: float = 0.0) -> FloatArray:
    exact = np.stack([project(r, p, square(LENGTH)) for r, p in zip(rotation, position, strict=True)])
    return np.asarray(exact + noise_px * np.random.default_rng(9).normal(size=exact.shape))


def solve(corners: FloatArray, upright: Upright | None = None) -> Poses:
    count = len(corners)
    covariance = np.tile(SIGMA_PX**2 * np.eye(8), (count, 1, 1))
    return marker_poses(corners, covariance, np.full(count, LENGTH), INTRINSICS, upright)[0]


def turn_errors(found: FloatArray, true: FloatArray) -> FloatArray:
    return np.asarray(Rotation.from_matrix(found @ true.transpose(0, 2, 1)).as_rotvec())


def test_exact_corners_give_the_exact_pose() -> None:
    rotation, position = random_markers(200, 0)
    poses = solve(corners_of(rotation, position))
    assert poses.position[:, 0] == pytest.approx(position, abs=1e-7)
    assert np.abs(turn_errors(poses.rotation[:, 0], rotation)).max() < 1e-5
    assert np.linalg.det(poses.rotation[:, 1]) == pytest.approx(np.ones(200))


def test_an_axis_aligned_rectangle_has_a_pose() -> None:
    corners = np.array([[[600.0, 400.0], [680.0, 400.0], [680.0, 480.0], [600.0, 480.0]]])
    poses = solve(corners)
    assert np.isfinite(poses.chi2[0, 0])
    assert poses.position[0, 0, 2] == pytest.approx(1000.0 * LENGTH / 80.0, rel=1e-3)


def test_errors_are_as_large_as_the_covariance_says() -> None:
    rotation, position = random_markers(600, 1, min_incidence=0.5)
    poses = solve(corners_of(rotation, position, SIGMA_PX))
    error = np.hstack([poses.position[:, 0] - position, turn_errors(poses.rotation[:, 0], rotation)])
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(poses.covariance[:, 0]), error)
    assert np.median(nees) == pytest.approx(5.35, rel=0.15)  # of chi square with 6 degrees of freedom
    assert poses.chi2[:, 0].mean() == pytest.approx(2.0, rel=0.2)


def test_the_other_solution_is_there_where_the_plane_is_ambiguous() -> None:
    rotation, position = random_markers(400, 2)
    poses = solve(corners_of(rotation, position, 6 * SIGMA_PX))
    angle = np.linalg.norm(turn_errors(poses.rotation[:, 0], rotation), axis=1)
    other = np.linalg.norm(turn_errors(poses.rotation[:, 1], rotation), axis=1)
    flipped = other < 0.5 * angle
    assert flipped.sum() > 5
    close = poses.chi2[:, 1] - poses.chi2[:, 0] < 36.0 * 16.0  # the noise is six times the given one
    assert close[flipped].all()
    assert (poses.chi2[:, 0] <= poses.chi2[:, 1]).all()


def test_where_both_starts_lead_to_one_solution_there_is_no_other() -> None:
    poses = solve(corners_of(*upright_markers(400, 3), SIGMA_PX))
    apart = np.linalg.norm(turn_errors(poses.rotation[:, 0], poses.rotation[:, 1]), axis=1)
    assert (apart < 0.01).sum() > 10
    assert np.isinf(poses.chi2[apart < 0.0499, 1]).all()
    assert np.isfinite(poses.chi2[apart > 0.0501, 1]).sum() > 200


def test_knowing_that_markers_stand_upright_makes_them_surer() -> None:
    rotation, position = upright_markers(400, 3)
    corners = corners_of(rotation, position, 4 * SIGMA_PX)
    tilts, turns = [], []
    for upright in (None, Upright(UP, math.radians(0.2))):
        poses = solve(corners, upright)
        error = turn_errors(poses.rotation[:, 0], rotation)
        tilts.append(math.sqrt(np.mean(error[:, [0, 2]] ** 2)))
        turns.append(math.sqrt(np.mean(error[:, 1] ** 2)))
    assert tilts[1] < 0.2 * tilts[0]
    assert turns[1] <= turns[0]


def test_corners_that_fit_no_square_are_told_and_solved_as_if_all_were_as_unsure() -> None:
    count, lengths = 300, np.full(300, LENGTH)
    rotation, position = random_markers(count, 5, min_incidence=0.5)
    corners = corners_of(rotation, position, 20.0 * SIGMA_PX)
    claimed = np.tile(np.diag([1.0, 0.01] * 4) * SIGMA_PX**2, (count, 1, 1))
    poses, is_misfit = marker_poses(corners, claimed, lengths, INTRINSICS)
    plain = solve(corners)
    assert is_misfit.mean() > 0.95
    error, plain_error = (p.position[is_misfit, 0] - position[is_misfit] for p in (poses, plain))
    assert np.linalg.norm(error) < 1.1 * np.linalg.norm(plain_error)
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(poses.covariance[is_misfit, 0, :3, :3]), error)
    assert np.median(nees) < 2.5 * 2.37  # of chi square with 3 degrees of freedom
    assert not marker_poses(corners_of(rotation, position), claimed, lengths, INTRINSICS)[1].any()


def test_the_gradient_is_that_of_the_cost() -> None:
    rotation, position = random_markers(1, 4, min_incidence=0.4)
    points, pixels = square(LENGTH), corners_of(rotation, position, 1.0)[0]
    covariance = SIGMA_PX**2 * (np.eye(8) + 0.3 * np.ones((8, 8)))
    weights = np.asarray(np.linalg.inv(covariance)[None], np.float64)
    sight = _Sight(points, pixels, weights, INTRINSICS, np.array([0.0, 1.0, 0.0]), UP, 50.0)
    normal, slope = np.empty((6, 6)), np.empty(6)

    def cost(step: FloatArray) -> float:
        turned = Rotation.from_rotvec(step[3:]).as_matrix() @ rotation[0]
        return float(_equations(sight, turned, position[0] + step[:3], normal, slope))

    numeric = [(cost(1e-6 * unit) - cost(-1e-6 * unit)) / 2e-6 for unit in np.eye(6)]
    cost(np.zeros(6))
    assert -2.0 * slope == pytest.approx(numeric, rel=1e-4, abs=1e-2)


INTRINSICS_LYING_MARKERS = np.array([CAMERA[0, 0], CAMERA[1, 1], CAMERA[0, 2], CAMERA[1, 2]])
SIZE, SIGMA_PX_LYING_MARKERS = 0.05, 0.1
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
        corners.append(seen + SIGMA_PX_LYING_MARKERS * rng.normal(size=(4, 2)))
    covariance, lengths = np.tile(SIGMA_PX_LYING_MARKERS**2 * np.eye(8), (faces, 1, 1)), np.full(faces, SIZE)
    poses, _ = marker_poses(np.stack(corners), covariance, lengths, INTRINSICS_LYING_MARKERS)
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
        solve_bodies(seen, [BODY], INTRINSICS_LYING_MARKERS, None)
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
            solve_bodies(seen, [BODY], INTRINSICS_LYING_MARKERS, None)
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
