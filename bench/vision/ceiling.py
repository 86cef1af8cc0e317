"""Fixed cameras over an arena whose robots carry markers that lie flat."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.sim.render import scene as scenery
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.render.renderer import Renderer, RobotCamera, Scene
from swarm_loc_drivers.sim.render.rigs import Arena, lying
from swarm_loc_drivers.sim.run import Trajectories
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.swarm import CameraMount, FixedCamera, Robot
from swarm_loc_vision.aerial.ground_control import FloorMarker


class CeilingRig:
    """The fixed cameras of one world; for use by one thread.

    Args:
        robots: As described, with faces that lie and have a yaw.
        cameras: Where they truly hang.
        arena: Arena around the robots, and family of all markers.
        model: Of all cameras.
        markers: Fiducials on the floor, for ground control, where they truly lie.
        seed: Draws the look of walls and floor.
    """

    def __init__(
        self,
        robots: Sequence[Robot],
        cameras: Sequence[FixedCamera],
        arena: Arena,
        model: CameraModel,
        markers: Sequence[FloorMarker],
        seed: int,
    ) -> None:
        backdrop = scenery.arena(arena.size, np.random.default_rng(seed))
        bodies = [[scenery.body(), scenery.tower(), *lying(robot.faces, arena.family)] for robot in robots]
        # a camera has a place of its own, without a body, after the floor's markers and the robots
        scene = Scene(backdrop, [], [lying(markers, arena.family), *bodies, *([] for _ in cameras)], flat=1)
        self._renderer = Renderer(scene, model)
        self._feet = np.array([[camera.x, camera.y, 0.0] for camera in cameras])
        self._cameras = [
            RobotCamera(
                1 + len(robots) + k,
                model,
                CameraMount(0.0, 0.0, one.z, one.yaw, pitch=one.pitch, roll=one.roll),
            )
            for k, one in enumerate(cameras)
        ]

    def take(
        self, camera: int, middle_ns: int, track: Trajectories, rng: np.random.Generator
    ) -> NDArray[np.uint8]:
        """The image (height, width) of a camera, exposed around `middle_ns`; see `rigs.CameraRig.take`."""

        def poses_at(times: NDArray[np.int64]) -> FloatArray:
            still = np.zeros((len(times), 1, 3))
            feet = np.broadcast_to(self._feet, (len(times), *self._feet.shape))
            return np.concatenate([still, track.all_at(times), feet], axis=1)

        return self._renderer.take(self._cameras[camera], middle_ns, poses_at, rng)
