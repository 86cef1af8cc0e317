"""Error models of simulated worlds, hidden systematic errors, and checks of swarms."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.parameters import UserError, number, text
from swarm_loc_estimator.swarm.error_models import SensorModel
from swarm_loc_estimator.swarm.swarm import Pose2, Robot, Swarm

PRINTED_SENSOR = SensorModel(forward_sigma=0.026, left_sigma=0.029, heading_sigma=0.508)
"""The sigmas that the e-puck paper prints below its figure 5."""


@dataclass(frozen=True)
class ErrorModel:
    """Imperfections of one simulated world; all sigmas are one standard deviation."""

    forward_sigma: float  # White noise along the optical axis [m]
    left_sigma: float  # White noise across it [m]
    heading_sigma: float  # White noise of a marker's heading [rad]
    # Share of sightings whose heading is the mirror solution of the planar pose problem
    flip_probability: float = 0.0
    gross_probability: float = 0.0  # Share of sightings that are outliers
    camera_yaw_sigma: float = 0.0  # Unknown turn of each camera on its robot [rad]
    scale_sigma: float = 0.0  # Unknown scale of each camera's distances [1]
    map_position_sigma: float = 0.0  # Error of every landmark's surveyed position, per axis [m]
    map_heading_sigma: float = 0.0  # Error of its surveyed direction [rad]
    face_position_sigma: float = 0.0  # Error of every on-robot marker's position, per axis [m]
    exposure_early_s: float = 0.0  # Images are taken up to this long before their stamp, uniformly [s]
    turn_slip: float = 0.0  # Share of every commanded turn that is lost
    wheel_noise: float = 2e-5  # Variance of a wheel's path per metre rolled [m]
    frame_loss: float = 0.05  # Share of images that never arrive
    described: SensorModel = PRINTED_SENSOR  # The sensor model that the swarm description gives


W0 = ErrorModel(PRINTED_SENSOR.forward_sigma, PRINTED_SENSOR.left_sigma, PRINTED_SENSOR.heading_sigma)
"""The printed sigmas as white noise and nothing else."""

W2 = ErrorModel(
    forward_sigma=0.008,
    left_sigma=0.006,
    heading_sigma=0.10,
    flip_probability=0.12,
    gross_probability=0.005,
    camera_yaw_sigma=math.radians(1.8),
    scale_sigma=0.024,
    map_position_sigma=0.016,
    map_heading_sigma=0.03,
    face_position_sigma=0.003,
    exposure_early_s=0.133,
    turn_slip=0.05,
)
"""Small white noise and systematic errors that together look like the paper's experiment."""

W2_FAST = replace(W2, turn_slip=0.20)  # At 0.08 m/s the wheels slip more in the curves

WORLDS = {"w0": W0, "w2": W2, "w2fast": W2_FAST}


@dataclass(frozen=True)
class HiddenGeometry:
    """Where cameras and markers truly are."""

    mounts: FloatArray  # (N, 3) camera poses in base_link
    scales: FloatArray  # (N,) reported distance per true distance
    landmarks: FloatArray  # (L, 3) in map
    faces: FloatArray  # (K, 3) in their robot's base_link
    face_owner: IntArray  # (K,) robot index
    ids: NDArray[np.uint32]  # (L + K,) marker ids


def hidden_geometry(rng: np.random.Generator, swarm: Swarm, errors: ErrorModel) -> HiddenGeometry:
    """Draw a world's systematic errors; every robot of the swarm must have a camera."""
    mounts = np.array([[r.camera.x, r.camera.y, r.camera.yaw] for r in swarm.robots if r.camera is not None])
    mounts[:, 2] += errors.camera_yaw_sigma * rng.standard_normal(len(mounts))
    scales = 1.0 + errors.scale_sigma * rng.standard_normal(len(mounts))
    landmarks = np.array([[m.x, m.y, m.yaw] for m in swarm.landmarks], dtype=float).reshape(-1, 3)
    spread = np.array([errors.map_position_sigma, errors.map_position_sigma, errors.map_heading_sigma])
    landmarks += spread * rng.standard_normal(landmarks.shape)
    all_faces = [(index, face) for index, robot in enumerate(swarm.robots) for face in robot.faces]
    faces = np.array([[face.x, face.y, face.yaw] for _, face in all_faces], dtype=float).reshape(-1, 3)
    faces[:, :2] += errors.face_position_sigma * rng.standard_normal((len(faces), 2))
    owner = np.array([index for index, _ in all_faces], dtype=np.int64)
    ids = [mark.id for mark in swarm.landmarks] + [face.id for _, face in all_faces]
    return HiddenGeometry(mounts, scales, landmarks, faces, owner, np.array(ids, dtype=np.uint32))


class WorldError(UserError):
    """A swarm that cannot be simulated."""


@dataclass(frozen=True)
class WorldParameters:
    """Parameters of the nodes of all worlds."""

    swarm_file: str = text("", "path of the swarm description; every robot needs a start", required=True)
    seed: int = number(1, "1", 0, 2**31 - 1, "fixes the errors")
    rate: float = number(
        1.0, "1", 0.01, 100.0, "simulated seconds per second, as far as the machine keeps up"
    )
    truth_rate: float = number(20.0, "1/s", 0.1, 200.0, "published true poses of each robot")


@dataclass(frozen=True)
class LinkedWorldParameters(WorldParameters):
    """Parameters of worlds whose robots answer their drivers."""

    link_folder: str = text("", "where each robot's serial port appears under its name; empty: TCP")


def start_of(robot: Robot) -> Pose2:
    """The start pose of a robot; raises WorldError if the swarm description has none."""
    if robot.start is None:
        raise WorldError(f"robot '{robot.name}' has no start pose, and a simulated robot needs one.")
    return robot.start
