"""Planar rigid transforms, vectorised over any leading shape.

A pose is an array (..., 3) = x [m], y [m], theta [rad]; ``a`` composed with ``b`` is the pose of
``b`` when ``b`` is given in the frame ``a``. A twist is (..., 3) = rho_x [m], rho_y [m], phi [rad].
Errors are right-invariant: X = exp(xi) X_hat, so ``xi`` lives in the fixed frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from swarm_loc_estimator.common.arrays import FloatArray

_SMALL_ANGLE = 1e-4


def wrap_angle(angle: ArrayLike) -> FloatArray:
    """Angles [rad] wrapped into [-pi, pi); e-puck paper eq. (2), which needs the floor modulo."""
    return np.mod(np.asarray(angle, dtype=float) + np.pi, 2.0 * np.pi) - np.pi


def compose(a: ArrayLike, b: ArrayLike) -> FloatArray:
    """The pose (..., 3) of ``b``, given in frame ``a``, in the frame that ``a`` is given in."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + cos * b[..., 0] - sin * b[..., 1]
    y = a[..., 1] + sin * b[..., 0] + cos * b[..., 1]
    return np.stack([x, y, wrap_angle(a[..., 2] + b[..., 2])], axis=-1)


def inverse(pose: ArrayLike) -> FloatArray:
    """The inverse transform (..., 3)."""
    pose = np.asarray(pose, dtype=float)
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x = -cos * pose[..., 0] - sin * pose[..., 1]
    y = sin * pose[..., 0] - cos * pose[..., 1]
    return np.stack([x, y, wrap_angle(-pose[..., 2])], axis=-1)


def between(a: ArrayLike, b: ArrayLike) -> FloatArray:
    """The pose (..., 3) of ``b`` seen from ``a``, both given in one frame: inverse(a) composed with b."""
    return compose(inverse(a), b)


def transform_points(pose: ArrayLike, points: ArrayLike) -> FloatArray:
    """Points (..., 2) [m] given in the frame ``pose``, expressed in the frame ``pose`` is given in."""
    pose, points = np.asarray(pose, dtype=float), np.asarray(points, dtype=float)
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x = pose[..., 0] + cos * points[..., 0] - sin * points[..., 1]
    y = pose[..., 1] + sin * points[..., 0] + cos * points[..., 1]
    return np.stack([x, y], axis=-1)


def rigid_fit(points: ArrayLike, to: ArrayLike) -> FloatArray:
    """The pose (3,) of the frame of points (k, 2) [m] that brings them closest to others (k, 2) [m]."""
    points, to = np.asarray(points, dtype=float), np.asarray(to, dtype=float)
    middle, goal = points.mean(axis=0), to.mean(axis=0)
    spread = (points - middle).T @ (to - goal)
    turn = np.arctan2(spread[0, 1] - spread[1, 0], spread[0, 0] + spread[1, 1])
    return np.array([*(goal - transform_points([0.0, 0.0, turn], middle)), turn])


def exp(twist: ArrayLike) -> FloatArray:
    """The pose (..., 3) reached by following ``twist`` (..., 3) for unit time."""
    twist = np.asarray(twist, dtype=float)
    a, b = _arc_coefficients(twist[..., 2])
    x = a * twist[..., 0] - b * twist[..., 1]
    y = b * twist[..., 0] + a * twist[..., 1]
    return np.stack([x, y, wrap_angle(twist[..., 2])], axis=-1)


def log(pose: ArrayLike) -> FloatArray:
    """The twist (..., 3) with phi in [-pi, pi) whose ``exp`` is ``pose``."""
    pose = np.asarray(pose, dtype=float)
    phi = wrap_angle(pose[..., 2])
    a, b = _arc_coefficients(phi)
    scale = 1.0 / (a * a + b * b)
    x = scale * (a * pose[..., 0] + b * pose[..., 1])
    y = scale * (-b * pose[..., 0] + a * pose[..., 1])
    return np.stack([x, y, phi], axis=-1)


def adjoint(pose: ArrayLike) -> FloatArray:
    """The matrices (..., 3, 3) with X exp(u) = exp(adjoint(X) u) X, twists ordered x, y, phi."""
    pose = np.asarray(pose, dtype=float)
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    matrix = np.zeros((*pose.shape[:-1], 3, 3))
    matrix[..., 0, 0] = cos
    matrix[..., 0, 1] = -sin
    matrix[..., 1, 0] = sin
    matrix[..., 1, 1] = cos
    matrix[..., 0, 2] = pose[..., 1]
    matrix[..., 1, 2] = -pose[..., 0]
    matrix[..., 2, 2] = 1.0
    return matrix


def error_to_pose_jacobian(pose: ArrayLike) -> FloatArray:
    """The matrices (..., 3, 3) that map a right-invariant error of ``pose`` to errors of x, y, theta."""
    pose = np.asarray(pose, dtype=float)
    matrix = np.zeros((*pose.shape[:-1], 3, 3))
    matrix[..., [0, 1, 2], [0, 1, 2]] = 1.0
    matrix[..., 0, 2] = -pose[..., 1]
    matrix[..., 1, 2] = pose[..., 0]
    return matrix


def pose_covariance(pose: ArrayLike, error_covariance: ArrayLike) -> FloatArray:
    """Covariances (..., 3, 3) of x, y, theta from those of the right-invariant error."""
    jacobian = error_to_pose_jacobian(pose)
    return np.asarray(jacobian @ np.asarray(error_covariance, dtype=float) @ np.swapaxes(jacobian, -1, -2))


def error_covariance(pose: ArrayLike, covariance: ArrayLike) -> FloatArray:
    """Covariances (..., 3, 3) of the right-invariant error from those of x, y, theta."""
    jacobian = error_to_pose_jacobian(pose)
    jacobian[..., :2, 2] *= -1.0  # the inverse: a shear with the opposite sign
    return np.asarray(jacobian @ np.asarray(covariance, dtype=float) @ np.swapaxes(jacobian, -1, -2))


def _arc_coefficients(phi: FloatArray) -> tuple[FloatArray, FloatArray]:
    """sin(phi)/phi and (1 - cos(phi))/phi, by their series near zero."""
    small = np.abs(phi) < _SMALL_ANGLE
    safe = np.where(small, 1.0, phi)
    a = np.where(small, 1.0 - phi * phi / 6.0, np.sin(safe) / safe)
    b = np.where(small, 0.5 * phi, (1.0 - np.cos(safe)) / safe)
    return a, b
