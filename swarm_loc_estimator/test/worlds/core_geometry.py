"""Frames, poses and their errors for the tests of the core, written independently of the code under test."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.swarm import CameraMount


def homogeneous(
    x: float, y: float, z: float, yaw: float, pitch: float = 0.0, roll: float = 0.0
) -> FloatArray:
    """The matrix (4, 4) of a frame at x, y, z turned by Rz(yaw) Ry(pitch) Rx(roll)."""
    cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch, roll) for f in (math.cos, math.sin))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, y],
            [-sp, cp * sr, cp * cr, z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def marker_frame(x: float, y: float, z: float, yaw: float) -> FloatArray:
    """The matrix (4, 4) of a marker: z out of its face towards yaw, y down."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([[sin, 0.0, cos, x], [-cos, 0.0, sin, y], [0.0, -1.0, 0.0, z], [0.0, 0.0, 0.0, 1.0]])


def optical_frame(mount: CameraMount) -> FloatArray:
    """The matrix (4, 4) from base_link to the camera's optical frame: x right, y down, z forward."""
    to_optical = np.eye(4)
    to_optical[:3, :3] = np.column_stack([(0, -1, 0), (0, 0, -1), (1, 0, 0)])
    return homogeneous(mount.x, mount.y, mount.z, mount.yaw, mount.pitch, mount.roll) @ to_optical


def seen(base: ArrayLike, mount: CameraMount, marker_in_map: FloatArray) -> FloatArray:
    """Markers (..., 4, 4) in the optical frame of a camera on a robot at `base` (3,)."""
    x, y, theta = np.asarray(base, dtype=float)
    camera = homogeneous(x, y, 0.0, theta) @ optical_frame(mount)
    relative: FloatArray = np.linalg.inv(camera) @ marker_in_map
    return relative


def planar(pose: FloatArray) -> FloatArray:
    """The homogeneous matrix (3, 3) of a pose (3,) in the plane."""
    x, y, theta = pose
    cos, sin = math.cos(theta), math.sin(theta)
    return np.array([[cos, -sin, x], [sin, cos, y], [0.0, 0.0, 1.0]])


def pose_of(matrix: FloatArray) -> FloatArray:
    """The pose (3,) of a homogeneous matrix (3, 3)."""
    return np.array([matrix[0, 2], matrix[1, 2], math.atan2(matrix[1, 0], matrix[0, 0])])


def slopes_of(function: Callable[[FloatArray], ArrayLike], size: int, step: ArrayLike = 1e-6) -> FloatArray:
    """Central differences (..., size) of a function of changes (size,), by one step or one of each."""
    steps = np.broadcast_to(np.asarray(step, dtype=float), (size,))
    sides = [(function(change), function(-change)) for change in np.diag(steps)]
    differences = [np.subtract(*ends) / (2.0 * one) for ends, one in zip(sides, steps, strict=True)]
    slopes: FloatArray = np.stack(differences, axis=-1)
    return slopes


def wrapped(error: FloatArray) -> FloatArray:
    """Errors (..., 3) with their headings in [-pi, pi]."""
    result: FloatArray = error.copy()
    result[..., 2] = np.arctan2(np.sin(error[..., 2]), np.cos(error[..., 2]))
    return result


def nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Normalised squared errors (...) of errors (..., 3), headings wrapped."""
    normal = wrapped(error)
    weighted = np.linalg.solve(covariance, normal[..., None])[..., 0]
    squared: FloatArray = np.einsum("...i,...i->...", normal, weighted)
    return squared
