"""A fixed camera of a swarm description, from the pose that ground control points determine."""

from __future__ import annotations

import warnings

import numpy as np
from scipy.spatial.transform import Rotation

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.swarm.swarm import FixedCamera
from swarm_loc_vision.aerial.ground_camera import POSE_SIZE, GroundCamera

_FROM_OPTICAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Columns: forward, left and up of a camera in its optical frame."""
_GRID = (9, 7)
_BESIDE_PX, _STEP = 20.0, 1e-5


class LocateError(UserError):
    """A camera that cannot be located; the message is one sentence."""


def fixed_camera(name: str, ground: GroundCamera, height: float = 0.0) -> FixedCamera:
    """The description of a camera over the floor.

    Its sigmas are the largest in its image, by the covariance of the pose.

    Args:
        name: Namespace of its topics.
        ground: The camera with its pose.
        height: Of the markers on the robots above the floor [m].

    Raises:
        LocateError: The camera does not see markers that lie at this height.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # straight down, yaw and roll are one angle
        turn = Rotation.from_matrix(ground.rotation.T @ _FROM_OPTICAL)
        yaw, pitch, roll = (round(float(angle), 6) for angle in turn.as_euler("ZYX"))
    x, y, z = (round(float(value), 5) for value in ground.centre)
    position, heading = floor_sigmas(ground, height)
    return FixedCamera(name, x, y, z, yaw, pitch, roll, max(position, 1e-5), max(heading, 1e-6))


def floor_sigmas(ground: GroundCamera, height: float) -> tuple[float, float]:
    """Largest standard deviations in the image, by the pose: of a coordinate [m] and of a direction [rad].

    Raises:
        LocateError: The camera does not see the plane from above.
    """
    camera = ground.camera
    u, v = np.meshgrid(
        np.linspace(0.0, camera.width - 1.0 - _BESIDE_PX, _GRID[0]),
        np.linspace(0.0, camera.height - 1.0, _GRID[1]),
    )
    here = np.stack([u.ravel(), v.ravel()], axis=-1)
    pixels = np.stack([here, here + np.array([_BESIDE_PX, 0.0])])

    def seen(step: FloatArray) -> FloatArray:
        moved = GroundCamera(camera, ground.pose + step, ground.covariance)
        place, beside = moved.places(pixels, height)
        along = beside - place
        return np.column_stack([place, np.arctan2(along[:, 1], along[:, 0])])

    changes = np.stack([seen(step) - seen(-step) for step in _STEP * np.eye(POSE_SIZE)], axis=-1)
    changes[:, 2] = se2.wrap_angle(changes[:, 2])
    slopes = changes / (2.0 * _STEP)
    slopes = slopes[np.isfinite(slopes).all(axis=(1, 2))]
    if height >= ground.centre[2] or not len(slopes):
        raise LocateError(
            f"A camera {ground.centre[2]:.3g} m above the floor does not see markers lying at {height:g} m."
        )
    spread = slopes @ ground.covariance @ np.swapaxes(slopes, -1, -2)
    position = np.sqrt(np.linalg.eigvalsh(spread[:, :2, :2]).max())
    return float(position), float(np.sqrt(spread[:, 2, 2].max()))
