"""Poses from corners: exact, consistent with their covariance, and honest about the mirrored solution."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.vision.scenes import facing, project
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.markers.pose import Poses, Upright, _equations, _Sight, marker_poses, square

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
