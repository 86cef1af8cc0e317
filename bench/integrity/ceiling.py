"""Five e-pucks with lying tags under two ceiling cameras whose views overlap: detections without images."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from bench.inputs.overhead_world import TOP
from bench.integrity.fault import CLEAN, settings_of
from swarm_loc_drivers.sim.run import CAMERA_LATENESS, LivedRun, arrival_ns, survivors
from swarm_loc_drivers.sim.scenarios.eight import drive_eight
from swarm_loc_drivers.sim.sightings import schedule_exposures
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.sensors.camera import CameraSensor, DetectionRows
from swarm_loc_estimator.sensors.sensor import in_order_of_arrival
from swarm_loc_estimator.swarm.swarm import FixedCamera, Swarm

_CAMERAS = tuple(
    FixedCamera(f"ceiling{k + 1}", x, 0.0, 2.0, yaw=0.5 * math.pi, position_sigma=0.002, yaw_sigma=0.001)
    for k, x in enumerate((-0.45, 0.45))
)
_HALF_VIEW = (0.5, 0.65)  # Of the plane of the tags, upwards and sideways in the image [m]
_RATE_HZ, _LOSS = 10.0, 0.02
_NOISE = np.array([0.001, 0.001, 0.005, 0.05, 0.05, 0.01])
"""Standard deviations of a tag's pose along and about the axes of the optical frame [m, rad]."""
_LEVEL = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Rotation from the optical frame of a camera that looks straight down to forward, left, up."""


@lru_cache(maxsize=2)  # scenarios of one seed share it
def drive_under_ceiling(seed: int, duration_s: float) -> LivedRun:
    """Drive the eight; no robot has a camera, and no start is known."""
    settings = replace(settings_of(seed, CLEAN, duration_s), start_known=False)
    described, truth, odometry = drive_eight(np.random.default_rng(seed), settings)
    robots = tuple(
        replace(robot, camera=None, faces=(replace(TOP, id=k + 1),))
        for k, robot in enumerate(described.robots)
    )
    return LivedRun(Swarm(robots, (), _CAMERAS), truth, odometry)


def hung(swarm: Swarm, rng: np.random.Generator) -> Swarm:
    """The swarm with the cameras where they truly hang."""
    cameras = []
    for camera in swarm.cameras:
        dx, dy = (camera.position_sigma * rng.standard_normal(2)).tolist()
        turn = camera.yaw_sigma * float(rng.standard_normal())
        cameras.append(replace(camera, x=camera.x + dx, y=camera.y + dy, yaw=camera.yaw + turn))
    return replace(swarm, cameras=tuple(cameras))


def observe_tags(run: LivedRun, seen: Swarm, seed: int) -> DetectionRows:
    """Detections of the tags by all cameras, in order of arrival.

    Args:
        run: The run.
        seen: The swarm as it is; cameras look straight down.
        seed: Of exposures, noise and losses, which do not depend on `seen`.
    """
    # images, and the errors of all tags in each of them
    rng, robots = np.random.default_rng([seed, 20]), len(seen.robots)
    camera, stamp_ns = schedule_exposures(rng, len(seen.cameras), _RATE_HZ, run.start_ns, run.end_ns)
    arrives_ns, arrived = arrival_ns(rng, stamp_ns, CAMERA_LATENESS), survivors(rng, camera.size, _LOSS)
    noise = _NOISE * rng.standard_normal((camera.size, robots, 6))
    # tags in the level frames of the cameras
    mounts = np.array([(one.x, one.y, one.yaw) for one in seen.cameras])
    tops = [robot.faces[0] for robot in seen.robots]
    on_robots = np.array([(face.x, face.y, face.yaw) for face in tops], dtype=float)
    tags = se2.between(mounts[camera][:, None], se2.compose(run.truth.all_at(stamp_ns), on_robots))
    heights = np.array([[face.z - one.z for face in tops] for one in seen.cameras])[camera]
    image, robot = np.nonzero((np.abs(tags[..., :2]) < _HALF_VIEW).all(axis=-1) & arrived[:, None])
    tag, error, height = tags[image, robot], noise[image, robot], heights[image, robot]
    # their poses in the optical frames
    upright = Rotation.from_matrix(_LEVEL.T) * Rotation.from_euler("z", tag[:, 2:])
    rows = CameraSensor.rows(
        {
            "robot": robots + camera[image],
            "stamp_ns": stamp_ns[image],
            "arrival_ns": arrives_ns[image],
            "id": np.array([face.id for face in tops])[robot],
            "position": np.column_stack([tag[:, :2], height]) @ _LEVEL + error[:, :3],
            "orientation": (Rotation.from_rotvec(error[:, 3:]) * upright).as_quat(),
            "covariance": np.tile(np.diag(_NOISE**2), (image.size, 1, 1)),
        }
    )
    return in_order_of_arrival([rows])
