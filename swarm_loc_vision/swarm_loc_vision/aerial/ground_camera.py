"""A camera over the floor: pixels to places on a level plane and back, with covariances."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.common.camera import Camera

POSE_SIZE = 6
_GRID = 48  # Samples along a side of the image for the reach of the lens
_PLACE_STEP = 1e-4
_POSE_STEPS = np.array([1e-6] * 3 + [1e-6] * 3)
_MIN_DEPTH = 1e-3  # Least depth of a projected place [m]


@dataclass(frozen=True)
class GroundCamera:
    """A camera with a known pose in map; the plane z = 0 of map is the floor."""

    camera: Camera  # Its intrinsics
    # (6,) from map to the optical frame (x right, y down, z forward): rotation vector, shift [m]
    pose: FloatArray
    covariance: FloatArray  # (6, 6) covariance of the pose

    def pixels(self, places: FloatArray) -> FloatArray:
        """(..., 2) raw pixels of places (..., 3) in map; NaN behind the camera and beyond its lens."""
        return projected(self.camera, self.pose, places, self.reach)

    @cached_property
    def reach(self) -> float:
        """Largest radius at distance 1 that the image shows."""
        camera = self.camera
        u, v = np.meshgrid(np.linspace(0, camera.width - 1, _GRID), np.linspace(0, camera.height - 1, _GRID))
        ideal = camera.to_ideal(np.stack([u, v], axis=-1))
        radius = np.linalg.norm((ideal - camera.intrinsics[2:]) / camera.intrinsics[:2], axis=-1)
        return float(np.nanmax(radius)) * 1.01

    @cached_property
    def rotation(self) -> FloatArray:
        """(3, 3) from map to the optical frame."""
        return rotation_of(self.pose)

    @cached_property
    def centre(self) -> FloatArray:
        """(3,) position of the camera in map [m]."""
        return np.asarray(-self.rotation.T @ self.pose[3:])

    def places(self, pixels: FloatArray, height: float) -> FloatArray:
        """(..., 2) x, y [m] on the plane z = `height` of raw pixels (..., 2); NaN where it is not seen."""
        camera = self.camera
        ideal = (camera.to_ideal(pixels) - camera.intrinsics[2:]) / camera.intrinsics[:2]
        rays = np.concatenate([ideal, np.ones((*ideal.shape[:-1], 1))], axis=-1) @ self.rotation
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (height - self.centre[2]) / rays[..., 2]
            places = self.centre[:2] + depth[..., None] * rays[..., :2]
        places[~(depth > _MIN_DEPTH)] = np.nan
        return np.asarray(places)

    def scale(self, places: FloatArray) -> FloatArray:
        """(...) pixels per metre at places (..., 3) on a level plane: the root of the scale of areas."""
        return np.asarray(np.sqrt(np.abs(np.linalg.det(self._slopes(places)[..., :2]))))

    def covariances(
        self, places: FloatArray, pixel_covariance: FloatArray, height_sigma: float
    ) -> FloatArray:
        """(N, 2, 2) covariance of places on a level plane from those of pixels, pose and height.

        With z the pixel, p the place, c the camera's pose and h the height, z = f(p, h, c) gives
        dp = (df/dp)^-1 (dz - df/dc dc - df/dh dh).

        Args:
            places: (N, 3) in map.
            pixel_covariance: (N, 2, 2) of their raw pixels [px^2].
            height_sigma: Standard deviation of the height [m].
        """
        slopes = self._slopes(places)
        inverse = np.linalg.inv(slopes[..., :2])
        of_pose = pose_slopes(self.camera, self.pose, places)
        spread = pixel_covariance + of_pose @ self.covariance @ np.swapaxes(of_pose, -1, -2)
        of_height = slopes[..., 2:] * height_sigma
        spread = spread + of_height @ np.swapaxes(of_height, -1, -2)
        return np.asarray(inverse @ spread @ np.swapaxes(inverse, -1, -2))

    def pixel_covariances(self, places: FloatArray, covariance: FloatArray) -> FloatArray:
        """(N, 2, 2) covariance of raw pixels [px^2] from that of places (N, 3) on a level plane [m^2]."""
        slopes = self._slopes(places)[..., :2]
        return np.asarray(slopes @ covariance @ np.swapaxes(slopes, -1, -2))

    def _slopes(self, places: FloatArray) -> FloatArray:
        """(..., 2, 3) derivatives of pixels by places."""
        steps = _PLACE_STEP * np.eye(3)
        ahead, behind = (self.pixels(places[..., None, :] + s * steps) for s in (0.5, -0.5))
        return np.asarray(np.swapaxes(ahead - behind, -1, -2) / _PLACE_STEP)


def rotation_of(pose: FloatArray) -> FloatArray:
    """(3, 3) rotation of a pose (6,)."""
    return np.asarray(cv2.Rodrigues(pose[:3])[0], np.float64)


def projected(camera: Camera, pose: FloatArray, places: FloatArray, reach: float = np.inf) -> FloatArray:
    """(..., 2) raw pixels of places (..., 3) for a pose (6,); see `GroundCamera.pixels`."""
    seen = places @ rotation_of(pose).T + pose[3:POSE_SIZE]
    with np.errstate(divide="ignore", invalid="ignore"):
        tangents = seen[..., :2] / seen[..., 2:]
    outside: NDArray[np.bool_] = ~(seen[..., 2] > _MIN_DEPTH) | ~(np.linalg.norm(tangents, axis=-1) <= reach)
    tangents[outside] = 0.0
    pixels = camera.to_raw(tangents * camera.intrinsics[:2] + camera.intrinsics[2:])
    pixels[outside] = np.nan
    return pixels


def pose_slopes(camera: Camera, pose: FloatArray, places: FloatArray) -> FloatArray:
    """(..., 2, 6) derivatives of the pixels of places (..., 3) by a pose (6,)."""
    columns = [
        (projected(camera, pose + step, places) - projected(camera, pose - step, places)) / (2.0 * step.max())
        for step in np.diag(_POSE_STEPS)
    ]
    return np.stack(columns, axis=-1)
