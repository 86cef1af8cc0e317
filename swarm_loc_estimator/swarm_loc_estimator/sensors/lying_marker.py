"""Pose in the plane of a marker that lies flat, by casting its corners onto the plane of its height.

The tilt and the distance of a small marker in an image are uncertain, and the error of one is that of the
other. But a marker that lies flat has neither: its corners, projected by its measured pose into the image and
from there onto the plane in which it lies, tell its position and the direction of its x axis. These depend on
the pixels only, whichever of the two mirrored poses was measured.
"""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.filter.gating import gate_threshold

CAST, FACE_DOWN, NOT_FLAT = range(3)
"""Results of `cast`: a pose in the plane; a marker that shows the floor; one that lies not as described."""
_GATE = float(gate_threshold(1.0 - 1e-6, 3))
_TILT_SIGMA = 0.05  # Standard deviation of the tilt of what lies, besides its measurement [rad]
_HEIGHT_SHARE, _HEIGHT_SIGMA = 0.02, 0.005
"""Standard deviation of a distance by the size of a marker: share of it, and [m]."""


@cached_njit
def cast(
    level: FloatArray,
    position: FloatArray,
    rotation: FloatArray,
    spread: FloatArray,
    size: float,
    height: float,
    value: FloatArray,
    noise: FloatArray,
) -> int:
    """Write the pose of a lying marker in the level frame of a camera.

    Args:
        level: (3, 3) from the optical frame to the level frame: forward, left, up.
        position: (3,) of the marker in the optical frame [m].
        rotation: (3, 3) from the marker's frame to the optical frame.
        spread: (6, 6) covariance of position and rotation about the axes of the optical frame.
        size: Side of the marker [m].
        height: Of the marker above the camera, negative below it [m].
        value: (3,) written: forward, left [m], direction of the marker's x axis [rad].
        noise: (3, 3) written: covariance of `value`.

    Returns:
        CAST; or FACE_DOWN or NOT_FLAT, and nothing is written.
    """
    middle, axes = np.dot(level, position), np.dot(level, rotation)
    if not axes[2, 2] > 0.0:
        return FACE_DOWN
    if not _lies(level, middle, axes, spread, height):
        return NOT_FLAT
    ahead, aside, slopes = 0.0, 0.0, np.zeros((3, 6))
    along, across = np.zeros(6), np.zeros(6)
    value[0], value[1] = 0.0, 0.0
    for corner in range(4):
        a = 0.5 * size if corner in (1, 2) else -0.5 * size
        b = 0.5 * size if corner < 2 else -0.5 * size
        arm = rotation[:, 0] * a + rotation[:, 1] * b
        place = middle + axes[:, 0] * a + axes[:, 1] * b
        stretch = height / place[2]
        if not stretch > 0.0:
            return NOT_FLAT
        x, y = stretch * place[0], stretch * place[1]
        value[0] += 0.25 * x
        value[1] += 0.25 * y
        ahead += a * x + b * y
        aside += a * y - b * x
        for j in range(6):
            moved = level[:, j] if j < 3 else _turned(level, arm, j - 3)
            dx = stretch * moved[0] - x / place[2] * moved[2]
            dy = stretch * moved[1] - y / place[2] * moved[2]
            slopes[0, j] += 0.25 * dx
            slopes[1, j] += 0.25 * dy
            along[j] += a * dx + b * dy
            across[j] += a * dy - b * dx
    value[2] = math.atan2(aside, ahead)
    slopes[2] = (ahead * across - aside * along) / (ahead * ahead + aside * aside)
    noise[:] = np.dot(slopes, np.dot(spread, slopes.T))
    return CAST


@cached_njit
def _lies(level: FloatArray, middle: FloatArray, axes: FloatArray, spread: FloatArray, height: float) -> bool:
    """Whether a measured pose agrees with a level marker at a height, by its tilt and its distance."""
    slopes, rest, noise = np.zeros((3, 6)), np.empty(3), np.zeros((3, 3))
    slopes[0, 3:], slopes[1, 3:], slopes[2, :3] = level[1], -level[0], level[2]
    rest[0], rest[1], rest[2] = axes[0, 2], axes[1, 2], middle[2] - height
    noise[0, 0] = noise[1, 1] = _TILT_SIGMA * _TILT_SIGMA
    noise[2, 2] = (_HEIGHT_SHARE * height) ** 2 + _HEIGHT_SIGMA**2
    noise += np.dot(slopes, np.dot(spread, slopes.T))
    for i in range(3):
        if not noise[i, i] > 0.0:
            return False
    distance: float = np.dot(rest, np.linalg.solve(noise, rest))
    return 0.0 <= distance <= _GATE


@cached_njit
def _turned(level: FloatArray, arm: FloatArray, axis: int) -> FloatArray:
    """Motion (3,) in the level frame of the end of an arm (3,) turned about an axis of the optical frame."""
    j, k = (axis + 1) % 3, (axis + 2) % 3
    moved: FloatArray = level[:, k] * arm[j] - level[:, j] * arm[k]
    return moved
