"""Cameras of a described swarm in the world as it truly is: those of the robots, and one above them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.sim.render import scene as scenery
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.render.raster import Patches
from swarm_loc_drivers.sim.render.renderer import Renderer, RobotCamera, Scene
from swarm_loc_drivers.sim.run import Trajectories
from swarm_loc_drivers.sim.worlds import HiddenGeometry
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.parameters import number
from swarm_loc_estimator.swarm.swarm import CameraMount, Face, Landmark, Swarm
from swarm_loc_vision.aerial.ground_control import FloorMarker
from swarm_loc_vision.markers.families import Family


@dataclass(frozen=True)
class Arena:
    """Arena around the robots."""

    size: tuple[float, float]  # Size along x and y, around map's origin [m]
    family: Family  # Kind of the markers


class CameraRig:
    """The cameras of all robots, of one model as calibrated; for use by one thread.

    In the swarm as described, every robot has a camera, and every marker shows a heading; the truth is where
    these truly are. The seed draws the look of walls and floor.
    """

    def __init__(
        self, swarm: Swarm, truth: HiddenGeometry, arena: Arena, model: CameraModel, seed: int
    ) -> None:
        self.faces = _faces(swarm, truth, arena.family)  # Of each robot the markers on it, in its base_link
        self.ids = truth.ids  # (M,) of all landmarks, and then of the faces of robot after robot
        # What there is to be seen
        self.scene = _scene(swarm, truth, arena, self.faces, np.random.default_rng(seed))
        self._renderer = Renderer(self.scene, model)
        self.cameras = [
            RobotCamera(
                index,
                model,
                replace(robot.camera or CameraMount(), x=mount[0], y=mount[1], yaw=mount[2]),
                focal_scale=1.0 / scale,
            )
            for index, (robot, mount, scale) in enumerate(
                zip(swarm.robots, truth.mounts.tolist(), truth.scales.tolist(), strict=True)
            )
        ]

    def take(
        self, robot: int, middle_ns: int, track: Trajectories, rng: np.random.Generator
    ) -> NDArray[np.uint8]:
        """The image (height, width) of a robot's camera, exposed around `middle_ns`.

        The track is of true paths, from half an exposure before to half an exposure after; `rng` is the
        source of the sensor's noise.
        """
        return self._renderer.take(self.cameras[robot], middle_ns, track.all_at, rng)


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
    swarm: Swarm, truth: HiddenGeometry, arena: Arena, faces: list[list[Patches]], rng: np.random.Generator
) -> Scene:
    boards = [
        _board(pose, mark, arena.family)
        for pose, mark in zip(truth.landmarks.tolist(), swarm.landmarks, strict=True)
    ]
    robots = [[scenery.body(), scenery.tower(), *own] for own in faces]
    return Scene(scenery.arena(arena.size, rng), boards, robots)


def _board(pose: list[float], mark: Face | Landmark, family: Family) -> Patches:
    """A marker on its sheet."""
    return scenery.marker(pose, mark.z, family.pattern(mark.id) != 0, family.whole_size(mark.size))


@dataclass(frozen=True)
class OverheadSettings:
    """An overhead camera over an arena, and the light there."""

    aerial_rate: float = number(0.0, "1/s", 0.0, 60.0, "images of an overhead camera; 0: there is none")
    aerial_width: int = number(1280, "px", 16, 8192, "columns of its image")
    aerial_height: int = number(960, "px", 16, 8192, "rows")
    aerial_field_of_view: float = number(math.radians(75.0), "rad", 0.05, 2.6, "across, without distortion")
    aerial_k1: float = number(-0.1, "1", -1.0, 1.0, "radial distortion, as OpenCV defines it")
    aerial_x: float = number(0.0, "m", -100.0, 100.0, "where the camera hangs in map")
    aerial_y: float = number(-0.35, "m", -100.0, 100.0, "where the camera hangs in map")
    aerial_z: float = number(2.1, "m", 0.2, 100.0, "height above the floor")
    aerial_tilt: float = number(math.radians(10.0), "rad", 0.0, 1.2, "away from straight down")
    aerial_yaw: float = number(0.5 * math.pi, "rad", -6.3, 6.3, "direction to which it is tilted")
    aerial_exposure_s: float = number(0.01, "s", 1e-5, 0.133, "how long the shutter is open")
    aerial_light: float = number(0.5, "1", 0.05, 1.0, "light at the image's right rim over that at the left")
    aerial_shadow: float = number(0.4, "1", 0.0, 1.0, "share of the light that robots' shadows take")
    aerial_shadow_yaw: float = number(0.8, "rad", -6.3, 6.3, "direction in which shadows fall in map")
    aerial_shadow_slope: float = number(0.5, "1", 0.0, 5.0, "length of shadows per height")

    @property
    def is_there(self) -> bool:
        """Whether the overhead camera exists."""
        return self.aerial_rate > 0.0


@dataclass(frozen=True)
class OverheadModel(CameraModel):
    """A camera with uneven light in its image."""

    light: float = 1.0  # At the right rim over that at the left

    def electrons(self) -> NDArray[np.float32]:
        """What white leaves in each pixel (height, width) during the exposure."""
        across = np.linspace(1.0, self.light, self.width, dtype=np.float32)
        return np.asarray(super().electrons() * across, np.float32)


def overhead_model(settings: OverheadSettings) -> OverheadModel:
    """The camera as calibrated."""
    return OverheadModel(
        width=settings.aerial_width,
        height=settings.aerial_height,
        field_of_view=settings.aerial_field_of_view,
        k1=settings.aerial_k1,
        exposure_s=settings.aerial_exposure_s,
        light=settings.aerial_light,
    )


def lying(marks: Sequence[FloorMarker | Face], family: Family) -> list[Patches]:
    """Markers that lie flat, on the floor or on a robot; faces without a yaw have 0."""
    return [
        scenery.lying_marker(
            (one.x, one.y, one.yaw or 0.0), one.z, family.pattern(one.id) != 0, family.whole_size(one.size)
        )
        for one in marks
    ]


class OverheadRig:
    """The overhead camera of one world; for use by one thread.

    It sees what the robots' own cameras see, and fiducials of a family on the floor, for ground control.
    """

    def __init__(
        self, scene: Scene, settings: OverheadSettings, markers: Sequence[FloorMarker], family: Family
    ) -> None:
        model = overhead_model(settings)
        count = len(scene.robots)
        shadow = scenery.shadow(
            settings.aerial_shadow, settings.aerial_shadow_yaw, settings.aerial_shadow_slope
        )
        shadows: list[Sequence[Patches]] = [[shadow] if settings.aerial_shadow else [] for _ in range(count)]
        robots = [[*parts, scenery.top_pattern()] for parts in scene.robots]
        self._renderer = Renderer(
            replace(scene, robots=[lying(markers, family), *shadows, *robots, []], flat=1 + count), model
        )
        # the mast stands still at the last place, has no body, and carries the camera as a robot does
        mount = CameraMount(
            z=settings.aerial_z, yaw=settings.aerial_yaw, pitch=0.5 * math.pi - settings.aerial_tilt
        )
        self._camera = RobotCamera(2 * count + 1, model, mount)
        self._foot = np.array([settings.aerial_x, settings.aerial_y, 0.0])

    def take(self, middle_ns: int, track: Trajectories, rng: np.random.Generator) -> NDArray[np.uint8]:
        """The image (height, width), exposed around `middle_ns`; see `CameraRig.take`."""

        def poses_at(times: IntArray) -> FloatArray:
            robots = track.all_at(times)
            still = np.zeros((len(times), 1, 3))
            shadows = robots * [1.0, 1.0, 0.0]
            return np.concatenate([still, shadows, robots, still + self._foot], axis=1)

        return self._renderer.take(self._camera, middle_ns, poses_at, rng)
