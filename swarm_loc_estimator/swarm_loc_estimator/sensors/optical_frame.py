"""Vectors and orientations in the optical frame of a camera, for compiled code."""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit


@cached_njit
def is_rotation(quaternion: FloatArray) -> bool:
    """Whether a quaternion (4,) is finite and not zero."""
    norm = 0.0
    for i in range(4):
        norm += quaternion[i] * quaternion[i]
    return math.isfinite(norm) and norm > 1e-12


@cached_njit
def to_level_frame(level: FloatArray, optical: FloatArray, out: FloatArray) -> None:
    """Rotate a vector (3,) from the optical frame to the camera's level axes forward, left, up."""
    for i in range(3):
        out[i] = level[i, 0] * optical[0] + level[i, 1] * optical[1] + level[i, 2] * optical[2]


@cached_njit
def scale(vector: FloatArray, factor: float) -> None:
    """Multiply a vector (3,), in place."""
    for i in range(3):
        vector[i] *= factor


@cached_njit
def write_rotation(quaternion: FloatArray, out: FloatArray) -> None:
    """Write the rotation matrix (3, 3) of a quaternion xyzw (4,) of any length."""
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    out[0, 0], out[1, 1], out[2, 2] = (
        w * w + x * x - y * y - z * z,
        w * w - x * x + y * y - z * z,
        w * w - x * x - y * y + z * z,
    )
    out[0, 1], out[0, 2], out[1, 2] = 2.0 * (x * y - w * z), 2.0 * (x * z + w * y), 2.0 * (y * z - w * x)
    out[1, 0], out[2, 0], out[2, 1] = 2.0 * (x * y + w * z), 2.0 * (x * z - w * y), 2.0 * (y * z + w * x)
    out /= x * x + y * y + z * z + w * w


@cached_njit
def face_heading(level: FloatArray, quaternion: FloatArray) -> float:
    """Heading in the sensor plane of the z axis of an orientation xyzw (4,), the normal of a face."""
    rotation, axes = np.empty((3, 3)), np.empty(3)
    write_rotation(quaternion, rotation)
    to_level_frame(level, rotation[:, 2], axes)
    return math.atan2(axes[1], axes[0])
