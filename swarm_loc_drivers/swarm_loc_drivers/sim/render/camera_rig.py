"""Cameras of all robots of a described swarm, in the world as it truly is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.sim.common.hidden_geometry import HiddenGeometry
from swarm_loc_drivers.sim.common.trajectories import Trajectories
from swarm_loc_drivers.sim.render import scene as scenery
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.render.raster import Patches
from swarm_loc_drivers.sim.render.renderer import Renderer, RobotCamera, Scene
from swarm_loc_drivers.sim.render.views import Views, views_of
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.swarm import CameraMount, Face, Landmark, Swarm
from swarm_loc_vision.markers.families import Family


@dataclass(frozen=True)
class Arena:
    """What is built around the robots.

    Attributes:
        size: Size along x and y, around map's origin [m].
        family: Kind of the markers.
    """

    size: tuple[float, float]
    family: Family


class CameraRig:
    """The cameras of all robots; for use by one thread.

    Args:
        swarm: As described; every robot has a camera, and every marker shows a heading.
        truth: Where cameras and markers truly are.
        arena: What is around.
        model: Of all cameras, as calibrated.
        seed: Draws what the walls and the floor look like.
    """

    def __init__(
        self, swarm: Swarm, truth: HiddenGeometry, arena: Arena, model: CameraModel, seed: int
    ) -> None:
        self._faces, self._ids = _faces(swarm, truth, arena.family), truth.ids
        self._scene = _scene(swarm, truth, arena, self._faces, np.random.default_rng(seed))
        self._renderer = Renderer(self._scene, model)
        self._cameras = [
            RobotCamera(index, model, _true_mount(robot.camera, mount), focal_scale=1.0 / scale)
            for index, (robot, mount, scale) in enumerate(
                zip(swarm.robots, truth.mounts.tolist(), truth.scales.tolist(), strict=True)
            )
        ]

    def take(
        self, robot: int, middle_ns: int, track: Trajectories, rng: np.random.Generator
    ) -> NDArray[np.uint8]:
        """The image (height, width) of a robot's camera, exposed around `middle_ns`.

        Args:
            robot: Its index.
            middle_ns: Middle of the exposure.
            track: True paths, from half an exposure before to half an exposure behind.
            rng: Source of the sensor's noise.
        """
        return self._renderer.take(self._cameras[robot], middle_ns, track.all_at, rng)

    @property
    def scene(self) -> Scene:
        """What there is to be seen."""
        return self._scene

    def views(self, robot: int, poses: FloatArray) -> Views:
        """Where markers lie in an image of a robot's camera when all robots stand at `poses` (N, 3)."""
        return views_of(self._scene, self._faces, self._ids, self._cameras[robot], poses)


def _true_mount(camera: CameraMount | None, true: list[float]) -> CameraMount:
    """A described mount with its true place and yaw."""
    return replace(camera or CameraMount(), x=true[0], y=true[1], yaw=true[2])


def _faces(swarm: Swarm, truth: HiddenGeometry, family: Family) -> list[list[Patches]]:
    """Of each robot the markers on it."""
    faces = [
        _board(pose, face, family)
        for pose, face in zip(
            truth.faces.tolist(), [face for robot in swarm.robots for face in robot.faces], strict=True
        )
    ]
    return [
        [faces[k] for k in np.flatnonzero(truth.face_owner == robot)] for robot in range(len(swarm.robots))
    ]


def _scene(
    swarm: Swarm,
    truth: HiddenGeometry,
    arena: Arena,
    faces: list[list[Patches]],
    rng: np.random.Generator,
) -> Scene:
    """Arena, landmarks and robots."""
    boards = [
        _board(pose, mark, arena.family)
        for pose, mark in zip(truth.landmarks.tolist(), swarm.landmarks, strict=True)
    ]
    robots = [[scenery.body(), scenery.tower(), *own] for own in faces]
    return Scene(scenery.arena(arena.size, rng), boards, robots)


def _board(pose: list[float], mark: Face | Landmark, family: Family) -> Patches:
    """A marker on its sheet."""
    return scenery.marker(pose, mark.z, family.pattern(mark.id) != 0, mark.size)
