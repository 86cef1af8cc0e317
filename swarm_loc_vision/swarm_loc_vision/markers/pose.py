"""Poses of the markers in one image: each alone, and jointly for markers of one body.

IPPE gives two initial poses of a plane. Each is refined by weighted least squares on the corners, with an
upright prior if there is one. The covariance of the corners propagates to the pose.

Marker frame: x right and y up when facing it, z out of it. Camera frame: x right, y down, z
forward. Rotations are perturbed from the left, so covariances are about the camera's axes.

The pose of one face of a body seen head-on is ambiguous, that of two faces is not. Each of n faces gets the
common pose and n times its covariance, so an estimator that treats the faces as independent obtains the
covariance of the common pose. As for a single face, the covariance does not contain `position_sigma` of the
description, which the estimator adds to each face.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.parameters import number
from swarm_loc_estimator.swarm.swarm import CameraMount, FixedCamera, Robot
from swarm_loc_vision.common.camera import Camera

_ROUNDS = 12
_CONVERGED = 1e-6  # Threshold of the weighted squared step at convergence
_NOWHERE = 1e12
# About 0.001 px: OpenCV finds no pose of 1 % of the squares that are exactly aligned with the image.
_UNALIGNED = 1e-6 * np.array([[0.9, 0.1], [-0.3, 0.7], [0.2, -0.8], [-0.6, 0.4]])
_LYING = 1e-6  # Length of a z axis along the direction up
# Checked by the NEES of test_pose.py.
_TRUST = 6.0
"""Prior degrees of freedom of the corners' covariance. The pose covariance is inflated where residuals are
larger, as on a partly covered marker. A single marker has two degrees of freedom."""
_MISFIT = 100.0
"""Threshold of chi square, with two degrees of freedom, for a model error such as a wrong calibration or a
bent marker."""
_SAME = 1.0 + 2.0 * math.cos(0.05)
"""Solutions with less than 0.05 rad between their rotations are the same. The sum of the elementwise product
of two rotations is 1 + 2 cos of the angle between them."""


class Upright(NamedTuple):
    """Prior that a body stands upright."""

    up: FloatArray  # (3,) unit vector in the camera frame
    tilt_sigma: float  # Standard deviation of the tilt about either horizontal axis [rad]


class Poses(NamedTuple):
    """Two solutions for each of N markers or bodies, the better one first."""

    rotation: FloatArray  # (N, 2, 3, 3) to the camera frame
    position: FloatArray  # (N, 2, 3) in the camera frame [m]
    covariance: FloatArray  # (N, 2, 6, 6) of position and rotation [m^2, rad^2]
    chi2: FloatArray  # (N, 2) weighted squares of the corners' residuals; infinite: no solution


class _Sight(NamedTuple):
    """Measurements of one marker, or of a body with M markers."""

    points: FloatArray  # (4 M, 3) corners in the body's frame
    pixels: FloatArray  # (4 M, 2) their pixels
    weights: FloatArray  # (M, 8, 8) inverse covariance of the corners of each marker
    intrinsics: FloatArray  # fx, fy, cx, cy
    axis: FloatArray  # (3,) axis of the body that points up
    up: FloatArray  # (3,) in the camera frame
    tilt_weight: float  # Inverse variance of the tilt; 0: no prior


def square(length: float) -> FloatArray:
    """(4, 3) corners of a marker in its own frame, clockwise from the upper left [m]."""
    half = 0.5 * length
    return np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])


def marker_poses(
    corners: FloatArray,
    covariance: FloatArray,
    lengths: FloatArray,
    intrinsics: FloatArray,
    upright: Upright | None = None,
) -> tuple[Poses, NDArray[np.bool_]]:
    """Solve for the poses of markers with sides (N,) [m]; also returns which markers misfit.

    Corners (N, 4, 2) go clockwise from the marker's own upper left [ideal px], with a covariance (N, 8, 8);
    `upright` is given if the markers' y axes are known to point up. There is one solution where both initial
    poses converge to the same. For a misfit, the variance of the residuals of plain least squares is added to
    the covariance of the corners.
    """
    directions = (corners - intrinsics[2:]) / intrinsics[:2]
    points = np.stack([square(length) for length in lengths]) if len(lengths) else np.zeros((0, 4, 3))
    starts = _two_starts(points, directions, None if upright is None else upright.up)

    def refined(rows: NDArray[np.int64], covariance: FloatArray) -> Poses:
        count, poses = len(rows), (starts[0][rows], starts[1][rows])
        found = Poses(*poses, np.zeros((count, 2, 6, 6)), np.full((count, 2), np.inf))
        weights = np.asarray(np.linalg.inv(covariance), np.float64)
        _refine_markers(points[rows], corners[rows], weights, intrinsics, *_tilt(upright), found)
        return found

    poses = refined(np.arange(len(corners)), covariance)
    is_misfit = np.isfinite(poses.chi2.min(axis=1)) & (poses.chi2.min(axis=1) > _MISFIT)
    if is_misfit.any():
        rows = np.flatnonzero(is_misfit)
        left = refined(rows, np.tile(np.eye(8), (len(rows), 1, 1))).chi2.min(axis=1)
        unsure = covariance[rows] + 0.5 * left[:, None, None] * np.eye(8)
        for column, again in zip(poses, refined(rows, unsure), strict=True):
            column[rows] = again
    surplus = np.maximum(1.0, (_TRUST + poses.chi2.min(axis=1)) / (_TRUST + 2.0))
    solved = np.isfinite(surplus)
    poses.covariance[solved] *= surplus[solved, None, None, None]
    poses.chi2[solved] /= surplus[solved, None]
    worse = poses.chi2[:, 0] > poses.chi2[:, 1]
    for column in poses:
        column[worse] = column[worse, ::-1]
    turned = np.einsum("nij,nij->n", poses.rotation[:, 0], poses.rotation[:, 1])
    poses.chi2[turned >= _SAME, 1] = np.inf
    return poses, is_misfit


def _two_starts(
    points: FloatArray, directions: FloatArray, up: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Two initial rotations and positions of each square by IPPE; behind the camera: no pose.

    Collins and Bartoli, IJCV 2014: the perspective of a plane at its centre yields two rotations, mirrored
    about the line of sight. The y axes point `up` (3,), if that is given.
    """
    rotation = np.full((len(points), 2, 3, 3), np.nan)
    for n, (corners, seen) in enumerate(zip(points, directions + _UNALIGNED, strict=True)):
        turns = cv2.solvePnPGeneric(corners, seen, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE)[1]
        if len(turns) == 2:
            rotation[n] = [cv2.Rodrigues(turn)[0] for turn in turns]
    none = ~np.isfinite(rotation).all(axis=(1, 2, 3))
    rotation[none] = 0.0
    if up is not None:
        # turn the y axes up and make the z axes level
        out = rotation[..., 2] - (rotation[..., 2] @ up)[..., None] * up
        length = np.linalg.norm(out, axis=-1)
        turns = length > _LYING
        out = out[turns] / length[turns, None]
        rotation[turns] = np.stack([np.cross(up, out), np.broadcast_to(up, out.shape), out], axis=-1)
    position = _places(points, directions, rotation)
    position[none] = -1.0
    return rotation, position


def _places(points: FloatArray, directions: FloatArray, rotation: FloatArray) -> FloatArray:
    """Positions (N, 2, 3) for given rotations (N, 2, 3, 3), by linear least squares."""
    turned = np.einsum("nsij,nkj->nski", rotation, points)
    along = directions[:, None]
    shift = along * turned[..., 2:] - turned[..., :2]  # = t_xy - along t_z
    mean, mean_shift = along.mean(axis=2), shift.mean(axis=2)
    spread = np.square(along - mean[:, :, None]).sum(axis=(2, 3))
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -((along - mean[:, :, None]) * shift).sum(axis=(2, 3)) / spread
    return np.concatenate([mean_shift + mean * depth[..., None], depth[..., None]], axis=2)


def body_pose(
    points: FloatArray,
    pixels: FloatArray,
    covariance: FloatArray,
    intrinsics: FloatArray,
    rotations: FloatArray,
    positions: FloatArray,
    upright: Upright | None = None,
) -> Poses:
    """The pose of a body from several of its markers: the best solution, and the best different one, if any.

    Points (M, 4, 3) are the corners in the body's frame, whose z axis points up [m]; pixels (M, 4, 2) have a
    covariance (M, 8, 8) [px^2]. Rotations (S, 3, 3) and positions (S, 3) are the initial ones; `upright` is
    given if the body is known to stand upright.
    """
    weights = np.asarray(np.linalg.inv(covariance), np.float64)
    axis, flat = np.array([0.0, 0.0, 1.0]), (points.reshape(-1, 3), pixels.reshape(-1, 2))
    sight = _Sight(*flat, weights, intrinsics, axis, *_tilt(upright))
    rotations, positions = rotations.copy(), positions.copy()
    covariances = np.zeros((len(rotations), 6, 6))
    chi2 = np.full(len(rotations), np.inf)
    for i in range(len(rotations)):
        chi2[i] = _refine(sight, rotations[i], positions[i], covariances[i])
    order = np.argsort(chi2, kind="stable")
    best = order[0]
    turned = np.einsum("ij,sij->s", rotations[best], rotations)
    others = [i for i in order if turned[i] < _SAME]
    chosen = [best, others[0] if others else best]
    found = Poses(*(column[chosen][None] for column in (rotations, positions, covariances, chi2)))
    if not others:
        found.chi2[0, 1] = np.inf
    return found


def _tilt(upright: Upright | None) -> tuple[FloatArray, float]:
    """Direction up, and the weight of the tilt; 0 without a prior."""
    known = upright or Upright(np.zeros(3), np.inf)
    return np.ascontiguousarray(known.up, float), 1.0 / known.tilt_sigma**2


@cached_njit
def _refine_markers(
    points: FloatArray,
    corners: FloatArray,
    weights: FloatArray,
    intrinsics: FloatArray,
    up: FloatArray,
    tilt_weight: float,
    poses: Poses,
) -> None:
    """Refine both initial poses of each marker."""
    rotation, position, covariance, chi2 = poses
    axis = np.array([0.0, 1.0, 0.0])
    for n in range(len(corners)):
        sight = _Sight(points[n], corners[n], weights[n : n + 1], intrinsics, axis, up, tilt_weight)
        for s in range(2):
            if position[n, s, 2] > 0.0:
                chi2[n, s] = _refine(sight, rotation[n, s], position[n, s], covariance[n, s])


@cached_njit
def _refine(sight: _Sight, rotation: FloatArray, position: FloatArray, covariance: FloatArray) -> float:
    """Minimize the weighted squares of corners and tilt by Levenberg-Marquardt; infinite: no solution.

    Rotation and position are the initial values, and the result; the covariance (6, 6) is filled.
    """
    normal, trial_normal = np.empty((6, 6)), np.empty((6, 6))
    slope, trial_slope, step = np.empty(6), np.empty(6), np.empty(6)
    trial_rotation, trial_position = np.empty((3, 3)), np.empty(3)
    factor = np.empty((6, 6))
    cost = _equations(sight, rotation, position, normal, slope)
    damping = 1e-4
    for _ in range(_ROUNDS):
        # a damped Gauss-Newton step (Levenberg-Marquardt)
        if not cost < _NOWHERE:
            return np.inf
        if not _factorized(normal, damping, factor):
            return np.inf
        _solved(factor, slope, step)
        gain = 0.0
        for i in range(6):
            gain += step[i] * slope[i]
            if i < 3:
                trial_position[i] = position[i] + step[i]
        _rotated(rotation, step, trial_rotation)
        trial = _equations(sight, trial_rotation, trial_position, trial_normal, trial_slope)
        # keep it if the cost falls, else damp more
        if trial <= cost:
            rotation[:], position[:] = trial_rotation, trial_position
            normal[:], slope[:] = trial_normal, trial_slope
            cost = trial
            damping *= 0.1
            if gain < _CONVERGED:
                break
        else:
            damping *= 10.0
    # the covariance is the inverse of the normal matrix
    if not _factorized(normal, 0.0, factor):
        return np.inf
    unit = np.zeros(6)
    for i in range(6):
        unit[:] = 0.0
        unit[i] = 1.0
        _solved(factor, unit, step)
        covariance[i] = step
    return cost


@cached_njit
def _equations(
    sight: _Sight, rotation: FloatArray, position: FloatArray, normal: FloatArray, slope: FloatArray
) -> float:
    """Fill the normal equations at a pose; returns its cost, infinite where a corner is behind the camera."""
    normal[:] = 0.0
    slope[:] = 0.0
    cost = 0.0
    jacobian, weighed = np.zeros((8, 6)), np.empty(6)
    rest = np.empty(8)
    points, pixels, weights, intrinsics = sight.points, sight.pixels, sight.weights, sight.intrinsics
    fx, fy = intrinsics[0], intrinsics[1]
    for m in range(len(weights)):
        # residuals and Jacobian of the four corners
        for k in range(4):
            x, y, z = 0.0, 0.0, 0.0
            for i in range(3):
                x += rotation[0, i] * points[4 * m + k, i]
                y += rotation[1, i] * points[4 * m + k, i]
                z += rotation[2, i] * points[4 * m + k, i]
            depth = z + position[2]
            if not depth > 1e-6:
                return np.inf
            u, v = (x + position[0]) / depth, (y + position[1]) / depth
            rest[2 * k] = pixels[4 * m + k, 0] - intrinsics[2] - fx * u
            rest[2 * k + 1] = pixels[4 * m + k, 1] - intrinsics[3] - fy * v
            # d(point) = dt + omega x (R p)
            a, b = fx / depth, fy / depth
            jacobian[2 * k, 0], jacobian[2 * k, 2] = a, -a * u
            jacobian[2 * k, 3], jacobian[2 * k, 4], jacobian[2 * k, 5] = -a * u * y, a * (z + u * x), -a * y
            jacobian[2 * k + 1, 1], jacobian[2 * k + 1, 2] = b, -b * v
            jacobian[2 * k + 1, 3], jacobian[2 * k + 1, 4] = -b * (z + v * y), b * v * x
            jacobian[2 * k + 1, 5] = b * x
        # sums weighted by the inverse covariance of the corners
        for i in range(8):
            weighed[:] = 0.0
            weighed_rest = 0.0
            for j in range(8):
                weight = weights[m, i, j]
                weighed_rest += weight * rest[j]
                for c in range(6):
                    weighed[c] += weight * jacobian[j, c]
            cost += rest[i] * weighed_rest
            for c in range(6):
                slope[c] += jacobian[i, c] * weighed_rest
                for d in range(6):
                    normal[c, d] += jacobian[i, c] * weighed[d]
    if sight.tilt_weight > 0.0:
        cost += _add_tilt(sight, rotation, normal, slope)
    return cost


@cached_njit
def _add_tilt(sight: _Sight, rotation: FloatArray, normal: FloatArray, slope: FloatArray) -> float:
    """Add the upright prior: the cross product of the body's axis and up is the tilt."""
    axis, up, tilt_weight = sight.axis, sight.up, sight.tilt_weight
    top = np.empty(3)
    for i in range(3):
        top[i] = rotation[i, 0] * axis[0] + rotation[i, 1] * axis[1] + rotation[i, 2] * axis[2]
    aligned = top[0] * up[0] + top[1] * up[1] + top[2] * up[2]
    cost = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        rest = top[j] * up[k] - top[k] * up[j]  # the rotation to upright
        cost += tilt_weight * rest * rest
        # d(rest) = -(up . top) omega + (omega . up) top: minus that is the Jacobian of the model
        for c in range(3):
            by_c = (aligned if c == i else 0.0) - up[c] * top[i]
            slope[3 + c] += tilt_weight * by_c * rest
            for d in range(3):
                by_d = (aligned if d == i else 0.0) - up[d] * top[i]
                normal[3 + c, 3 + d] += tilt_weight * by_c * by_d
    return cost


@cached_njit
def _factorized(normal: FloatArray, damping: float, factor: FloatArray) -> bool:
    """Lower Cholesky factor (6, 6) of a matrix with a damped diagonal; False: not positive definite."""
    for i in range(6):
        for j in range(i + 1):
            total = normal[i, j] * (1.0 + damping) if i == j else normal[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                factor[i, i] = math.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
    return True


@cached_njit
def _solved(factor: FloatArray, right: FloatArray, x: FloatArray) -> None:
    """Solve with a Cholesky factor (6, 6)."""
    for i in range(6):
        x[i] = right[i]
        for k in range(i):
            x[i] -= factor[i, k] * x[k]
        x[i] /= factor[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            x[i] -= factor[k, i] * x[k]
        x[i] /= factor[i, i]


@cached_njit
def _rotated(rotation: FloatArray, step: FloatArray, result: FloatArray) -> None:
    """Exp of the last three elements of a step, times a rotation (Rodrigues)."""
    x, y, z = step[3], step[4], step[5]
    angle2 = x * x + y * y + z * z
    angle = math.sqrt(angle2)
    a = math.sin(angle) / angle if angle > 1e-6 else 1.0 - angle2 / 6.0
    b = (1.0 - math.cos(angle)) / angle2 if angle > 1e-6 else 0.5 - angle2 / 24.0
    for c in range(3):
        p, q, r = rotation[0, c], rotation[1, c], rotation[2, c]
        dot = x * p + y * q + z * r
        cos = 1.0 - b * angle2
        result[0, c] = cos * p + a * (y * r - z * q) + b * dot * x
        result[1, c] = cos * q + a * (z * p - x * r) + b * dot * y
        result[2, c] = cos * r + a * (x * q - y * p) + b * dot * z


SHIFT = 0.15**2 * np.tile(np.eye(2), (4, 4))  # Of corners, by what a calibration leaves of a lens [px^2]
# Checked by the NEES of test_bodies.py.
_MIN_SIGMA = 0.0005  # Minimum of `position_sigma` [m]
_MAX_CHI2 = 25.0
"""Maximum chi square per degree of freedom; above it the faces contradict the description and stay single."""

_MAX_LEFT_OUT = 0.99  # Maximum share of a position's variance that is subtracted


@dataclass(frozen=True)
class Placement:
    """Pose of a marker on a body."""

    rotation: FloatArray  # (3, 3) from the marker's frame to the body's
    position: FloatArray  # (3,) in the body's frame [m]
    sigma: float  # Standard deviation of the position along each axis [m]


Body = Mapping[int, Placement]  # Marker id -> its pose on the body


def robot_body(robot: Robot) -> Body:
    """The faces of a robot with a known yaw, in base_link."""
    body = {}
    for face in robot.faces:
        if face.yaw is not None:
            # the normal of an upright face points along its yaw, the x axis of a lying one
            cos, sin = math.cos(face.yaw), math.sin(face.yaw)
            rotation = np.array([[-sin, 0.0, cos], [cos, 0.0, sin], [0.0, 1.0, 0.0]])
            if face.lies:
                rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
            place, sigma = np.array([face.x, face.y, face.z]), max(face.position_sigma, _MIN_SIGMA)
            body[face.id] = Placement(rotation, place, sigma)
    return body


def up_of(mount: CameraMount | FixedCamera) -> FloatArray:
    """(3,) up in the optical frame of a camera on a level robot, or of a fixed one."""
    cos = math.cos(mount.pitch)
    return np.array([-math.sin(mount.roll) * cos, -math.cos(mount.roll) * cos, -math.sin(mount.pitch)])


@dataclass(frozen=True)
class Seen:
    """Markers in an image, one row each."""

    id: IntArray  # (N,)
    corners: FloatArray  # (N, 4, 2) [ideal px]
    covariance: FloatArray  # (N, 8, 8) of the corners [px^2]
    lengths: FloatArray  # (N,) sides [m]
    poses: Poses  # Pose of each marker alone; those on bodies are replaced


def solve_bodies(seen: Seen, bodies: Iterable[Body], intrinsics: FloatArray, upright: Upright | None) -> None:
    """Replace the poses of seen markers that sit on one body by their common pose.

    `intrinsics` are fx, fy, cx, cy [px]; `upright` is given when bodies are known to stand upright.
    """
    solved = np.isfinite(seen.poses.chi2[:, 0])
    for body in bodies:
        rows = [int(i) for i in np.flatnonzero(solved) if int(seen.id[i]) in body]
        distinct = {int(seen.id[i]) for i in rows}
        if len(rows) < 2 or len(distinct) < len(rows):
            continue
        _solve(seen, rows, [body[int(seen.id[i])] for i in rows], intrinsics, upright)


def _solve(
    seen: Seen,
    rows: Sequence[int],
    places: Sequence[Placement],
    intrinsics: FloatArray,
    upright: Upright | None,
) -> None:
    """Solve for the pose of one body from its rows."""
    points = np.stack(
        [square(seen.lengths[i]) @ at.rotation.T + at.position for i, at in zip(rows, places, strict=True)]
    )
    # the body by each solution of each marker
    rotations, positions = [], []
    for i, at in zip(rows, places, strict=True):
        for s in np.flatnonzero(np.isfinite(seen.poses.chi2[i])).tolist():
            rotations.append(seen.poses.rotation[i, s] @ at.rotation.T)
            positions.append(seen.poses.position[i, s] - rotations[-1] @ at.position)
    starts = np.stack(rotations), np.stack(positions)
    own = [square(seen.lengths[i]) @ seen.poses.rotation[i, 0].T + seen.poses.position[i, 0] for i in rows]
    for _ in range(2):  # the effect of a shift depends on the faces' orientation, poor for a face alone
        shifts = [_shift_covariance(at.sigma, c, intrinsics) for at, c in zip(places, own, strict=True)]
        covariance = seen.covariance[rows] + np.stack(shifts)
        found = body_pose(points, seen.corners[rows], covariance, intrinsics, *starts, upright)
        if not np.isfinite(found.chi2[0, 0]):
            return
        own = list(points @ found.rotation[0, 0].T + found.position[0, 0])
    freedom = 8.0 * len(rows) - 6.0
    if not found.chi2[0, 0] < _MAX_CHI2 * freedom:
        return
    surplus = max(1.0, found.chi2[0, 0] / freedom)
    added = max(min(at.sigma for at in places) ** 2 - _MIN_SIGMA**2, 0.0)
    for i, at in zip(rows, places, strict=True):
        for s in range(2):
            rotation, position = found.rotation[0, s], found.position[0, s]
            lever = rotation @ at.position
            seen.poses.rotation[i, s] = rotation @ at.rotation
            seen.poses.position[i, s] = position + lever
            x, y, z = lever
            move = np.eye(6)
            move[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]  # d(position) = dt + omega x lever
            of_one = len(rows) * surplus * (move @ found.covariance[0, s] @ move.T)
            # the shifts of the faces have a common part, which moves the body, and individual parts, which
            # show up as residuals; so the common part is left out, and what remains is positive
            if np.isfinite(found.chi2[0, s]):
                of_position = np.linalg.inv(np.linalg.inv(of_one)[:3, :3])  # for a known rotation
                most = _MAX_LEFT_OUT * np.linalg.eigvalsh(of_position)[0]
                of_one[:3, :3] -= min(added, most) * np.eye(3)
            seen.poses.covariance[i, s] = of_one
            seen.poses.chi2[i, s] = found.chi2[0, s] / surplus


def _shift_covariance(sigma: float, corners: FloatArray, intrinsics: FloatArray) -> FloatArray:
    """(8, 8) image covariance of a common shift of corners (4, 3) in the camera frame [px^2]."""
    fx, fy = intrinsics[:2]
    x, y, z = corners.T
    by_shift = np.zeros((8, 3))
    by_shift[0::2, 0], by_shift[0::2, 2] = fx / z, -fx * x / z**2
    by_shift[1::2, 1], by_shift[1::2, 2] = fy / z, -fy * y / z**2
    return np.asarray(sigma**2 * by_shift @ by_shift.T)


@dataclass(frozen=True)
class PoseSettings:
    """Settings of poses."""

    marker_length: float = number(
        0.05, "m", 0.001, 10.0, "side of markers without a length of their own, black border included"
    )
    tilt_sigma: float = number(
        0.0, "rad", 0.0, 1.0, "standard deviation of markers from upright; 0: any orientation"
    )
    ambiguity: float = number(
        16.0, "1", 0.0, 1e4, "the mirrored pose is published if its chi square is higher by at most this"
    )


class PoseSolver:
    """Solves for the poses of markers."""

    def __init__(
        self,
        settings: PoseSettings,
        camera: Camera,
        lengths: Mapping[int, float],  # Sides of markers that differ from `marker_length`, by id [m]
        up: FloatArray | None,  # (3,) up in the camera frame, for `tilt_sigma`
        lying: Sequence[int],  # Ids of markers that lie flat, to which `tilt_sigma` does not apply
        bodies: Sequence[Body],  # Bodies that carry several markers
    ) -> None:
        self._intrinsics = camera.intrinsics
        self._length, self._lengths = settings.marker_length, lengths
        self._lying: IntArray = np.array(lying, dtype=np.int64)
        self._bodies = bodies
        self._upright = None if up is None or not settings.tilt_sigma else Upright(up, settings.tilt_sigma)

    def solve(self, ids: IntArray, corners: FloatArray, covariance: FloatArray) -> tuple[Poses, int]:
        """The poses of markers (N,) and the number of misfits.

        Corners (N, 4, 2) go clockwise from the marker's own upper left [ideal px]; their covariance is
        (N, 8, 8) [px^2].
        """
        lengths = np.array([self._lengths.get(int(i), self._length) for i in ids], dtype=float)
        poses, is_misfit = marker_poses(corners, covariance, lengths, self._intrinsics, self._upright)
        lies = np.isin(ids, self._lying)
        if self._upright is not None and lies.any():
            columns = corners[lies], covariance[lies], lengths[lies]
            again, is_misfit[lies] = marker_poses(*columns, self._intrinsics)
            for column, new in zip(poses, again, strict=True):
                column[lies] = new
        if self._bodies:
            seen = Seen(ids, corners, covariance, lengths, poses)
            solve_bodies(seen, self._bodies, self._intrinsics, self._upright)
        return poses, int(is_misfit.sum())
