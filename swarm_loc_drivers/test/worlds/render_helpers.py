"""A small scene, and what an image of it must show, worked out by casting rays: slow and independent."""

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.scenarios.eight_run import faces, wall_markers
from swarm_loc_drivers.sim.render import scene as scenery
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.render.raster import Patches
from swarm_loc_drivers.sim.render.renderer import RobotCamera, Scene
from swarm_loc_drivers.sim.scenarios.eight import ARENA
from swarm_loc_estimator.common.arrays import FloatArray

LANDMARK_SIZE = wall_markers()[0].size


def random_cells(seed: int) -> NDArray[np.bool_]:
    """The cells of some marker: a black border around six by six of either colour."""
    cells = np.zeros((8, 8), bool)
    cells[1:7, 1:7] = np.random.default_rng(seed).random((6, 6)) < 0.5
    return cells


def small_arena(robots: int = 3) -> Scene:
    """The arena of the eight with markers of random cells."""
    boards = [
        scenery.marker((m.x, m.y, m.yaw or 0.0), m.z, random_cells(m.id), m.size) for m in wall_markers()
    ]
    parts = [
        [
            scenery.body(),
            scenery.tower(),
            *(
                scenery.marker((f.x, f.y, f.yaw or 0.0), f.z, random_cells(f.id), f.size)
                for f in faces(10 * (robot + 1))
            ),
        ]
        for robot in range(robots)
    ]
    return Scene(scenery.arena(ARENA, np.random.default_rng(5)), boards, parts)


def pose_matrix(pose: Sequence[float] | FloatArray) -> FloatArray:
    """A planar pose as (4, 4)."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return np.array([[cos, -sin, 0, pose[0]], [sin, cos, 0, pose[1]], [0, 0, 1, 0], [0, 0, 0, 1]], float)


def camera_matrix(camera: RobotCamera, pose: Sequence[float] | FloatArray) -> FloatArray:
    """From the optical frame to map (4, 4), by the definition of the camera's mount."""
    mount = camera.mount
    turn = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    for angle, axis in ((mount.roll, (1, 0, 0)), (mount.pitch, (0, 1, 0)), (mount.yaw, (0, 0, 1))):
        turn = np.asarray(cv2.Rodrigues(np.multiply(angle, axis))[0], float) @ turn
    matrix = np.block(
        [[turn, np.array([[mount.x], [mount.y], [mount.z]])], [np.array([[0.0, 0.0, 0.0, 1.0]])]]
    )
    to_map: FloatArray = pose_matrix(pose) @ matrix
    return to_map


def pixels_of(camera: RobotCamera, model: CameraModel, pose: FloatArray, points: FloatArray) -> FloatArray:
    """Where OpenCV projects points (n, 3) of map (n, 2)."""
    to_optical = np.linalg.inv(camera_matrix(camera, pose))
    turn, shift = cv2.Rodrigues(to_optical[:3, :3])[0], to_optical[:3, 3]
    pixels = cv2.projectPoints(points, turn, shift, model.camera.matrix, np.array(model.camera.distortion))[0]
    return np.asarray(pixels, float)[:, 0]


class RayCaster:
    """What single rays meet.

    Args:
        scene: The scene.
        own: Robot whose parts are not there.
        poses: (N, 3) of the robots in map.
    """

    def __init__(self, scene: Scene, own: int, poses: FloatArray) -> None:
        parts: list[tuple[Patches, FloatArray]] = [(scene.backdrop, np.eye(4))]
        parts += [(board, np.eye(4)) for board in scene.boards]
        for robot, pose in enumerate(poses):
            parts += [(part, pose_matrix(pose)) for part in scene.robots[robot] if robot != own]
        self._surfaces = [
            (part.corners[a:b] @ to_map[:3, :3].T + to_map[:3, 3], part.change[a:b], number > 0)
            for number, (part, to_map) in enumerate(parts)
            for a, b in zip(part.first[:-1], part.first[1:], strict=True)
        ]

    def brightness(self, origin: FloatArray, rays: FloatArray) -> FloatArray:
        """Of what rays (n, 3) from a point meet first (n,)."""
        nearest = np.full(len(rays), np.inf)
        value = np.full(len(rays), scenery.ROOM)
        for corners, change, covers in self._surfaces:
            normal = np.cross(corners[0, 3] - corners[0, 0], corners[0, 1] - corners[0, 0])
            centre = corners.mean(axis=(0, 1))
            reach = np.linalg.norm(corners - centre, axis=-1).max() + 1e-9
            height = float((corners[0, 0] - origin) @ normal)
            facing = rays @ normal
            # one that runs along the surface, or away from its front, meets it nowhere
            distance = np.divide(height, facing, out=np.full(len(rays), -1.0), where=facing < -1e-12)
            near = np.linalg.norm(origin + distance[:, None] * rays - centre, axis=1) <= reach
            which = np.flatnonzero((distance > 0.0) & (distance < nearest + 1e-5) & near)
            hit = origin + distance[which, None] * rays[which]
            inside = _within(corners, hit, normal)
            total = (inside * change[:, None]).sum(axis=0) + (0.0 if covers else scenery.ROOM)
            met = which[inside.any(axis=0)]
            nearest[met], value[met] = distance[met], total[inside.any(axis=0)]
        return value


def _within(quads: FloatArray, points: FloatArray, normal: FloatArray) -> NDArray[np.bool_]:
    """Which points (n, 3) lie inside quadrangles (Q, 4, 3) that are clockwise from the front (Q, n)."""
    outwards = np.cross(normal, np.roll(quads, -1, axis=1) - quads)
    beyond = outwards @ points.T - np.sum(outwards * quads, axis=-1, keepdims=True)
    return np.asarray((beyond <= 0.0).all(axis=1))
