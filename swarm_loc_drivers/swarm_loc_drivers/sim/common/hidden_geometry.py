"""True poses of cameras and markers, which the swarm description only approximates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray

if TYPE_CHECKING:
    from swarm_loc_drivers.sim.common.error_model import ErrorModel
    from swarm_loc_estimator.swarm.swarm import Swarm


@dataclass(frozen=True)
class HiddenGeometry:
    """Where cameras and markers truly are.

    Attributes:
        mounts: (N, 3) camera poses in base_link.
        scales: (N,) reported distance per true distance.
        landmarks: (L, 3) in map.
        faces: (K, 3) in their robot's base_link.
        face_owner: (K,) robot index.
        ids: (L + K,) marker ids.
    """

    mounts: FloatArray
    scales: FloatArray
    landmarks: FloatArray
    faces: FloatArray
    face_owner: NDArray[np.int64]
    ids: NDArray[np.uint32]


def hidden_geometry(rng: np.random.Generator, swarm: Swarm, errors: ErrorModel) -> HiddenGeometry:
    """Draw a world's systematic errors; every robot of the swarm must have a camera."""
    mounts = np.array([[r.camera.x, r.camera.y, r.camera.yaw] for r in swarm.robots if r.camera is not None])
    mounts[:, 2] += errors.camera_yaw_sigma * rng.standard_normal(len(mounts))
    scales = 1.0 + errors.scale_sigma * rng.standard_normal(len(mounts))
    landmarks = np.array([[m.x, m.y, m.yaw] for m in swarm.landmarks], dtype=float)
    spread = np.array([errors.map_position_sigma, errors.map_position_sigma, errors.map_heading_sigma])
    landmarks += spread * rng.standard_normal(landmarks.shape)
    all_faces = [(index, face) for index, robot in enumerate(swarm.robots) for face in robot.faces]
    faces = np.array([[face.x, face.y, face.yaw] for _, face in all_faces], dtype=float)
    faces[:, :2] += errors.face_position_sigma * rng.standard_normal((len(faces), 2))
    owner = np.array([index for index, _ in all_faces], dtype=np.int64)
    ids = [mark.id for mark in swarm.landmarks] + [face.id for _, face in all_faces]
    return HiddenGeometry(mounts, scales, landmarks, faces, owner, np.array(ids, dtype=np.uint32))
