"""Render images of an arena with robots: projection, motion blur, defocus, sensor."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from swarm_loc_drivers.sim.render.lens import CameraModel, expose
from swarm_loc_drivers.sim.render.raster import (
    REACH,
    Layer,
    Motion,
    Patches,
    draw,
    empty_box,
    fill,
    lay_over,
    project,
)
from swarm_loc_drivers.sim.render.scene import ROOM
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.swarm.swarm import CameraMount
from swarm_loc_vision.common.camera import CX, CY, FX

STEP_PX = 1.0  # Maximum motion between the instants of an exposure at which an image is drawn
MAX_INSTANTS = 256

_OPTICAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""From x forward, y left, z up to x right, y down, z forward."""
_CLOSEST = 0.03
_ONE_WAY = ((0.0, 1.0),)
_NARROW_WAYS = ((-0.5, 0.25), (0.0, 0.5), (0.5, 0.25))
"""Shift to the right and down [px], and share of the light, for a blur that is narrow against pixels."""
_NARROW_VARIANCE, _WIDE_VARIANCE = 0.125, 0.64  # Of these ways, and from which pixels are fine enough [px^2]
_NOISE_LENGTH = 1 << 20


PosesAt = Callable[[IntArray], FloatArray]  # True poses (K, N, 3) of all robots in map at times (K,) [ns]


@dataclass(frozen=True)
class Scene:
    """Everything that cameras see."""

    backdrop: Patches  # Behind everything, in map
    boards: Sequence[Patches]  # Free-standing boards, in map
    # Of each robot its parts in its base_link, such that no part hides a later one
    robots: Sequence[Sequence[Patches]]
    flat: int = 0  # Number of first robots that are flat on the floor, as shadows are, and hide nothing


@dataclass
class RobotCamera:
    """One robot's camera as it truly is."""

    robot: int  # Index of its robot, whose own body is not seen
    model: CameraModel  # As calibrated
    mount: CameraMount  # In base_link
    focal_scale: float = 1.0  # True focal length per calibrated one
    lens: FloatArray = field(init=False)  # Constants of `raster.project`

    def __post_init__(self) -> None:
        self.lens = self.model.lens(self.focal_scale)
        mount = self.mount
        turned = Rotation.from_euler("ZYX", [mount.yaw, mount.pitch, mount.roll]).as_matrix()
        self._turn: FloatArray = _OPTICAL @ turned.T
        self._shift: FloatArray = -self._turn @ np.array([mount.x, mount.y, mount.z])

    def view(self, poses: FloatArray) -> Motion:
        """Where frames at planar `poses` (K, ..., 3) lie, given in this robot's base_link."""
        cos, sin, zero = np.cos(poses[..., 2]), np.sin(poses[..., 2]), np.zeros(poses.shape[:-1])
        rows = [[cos, -sin, zero], [sin, cos, zero], [zero, zero, zero + 1.0]]
        turns = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
        places = np.stack([poses[..., 0], poses[..., 1], zero], axis=-1)
        return self._turn @ turns, places @ self._turn.T + self._shift


class Renderer:
    """Draws images of one scene; all cameras, of one model, share its buffers, so use it from one thread."""

    def __init__(self, scene: Scene, model: CameraModel) -> None:
        self._scene, self._model = scene, model
        self._board_centres = np.array([board.centre[0] for board in scene.boards]).reshape(-1, 3)
        self._image = np.zeros((model.height, model.width), np.float32)
        changes = np.zeros((model.height, model.width + 2), np.float32)
        self._layer = Layer(changes, np.zeros_like(changes), empty_box())
        self._electrons = model.electrons()
        self._noise = np.random.default_rng(0).standard_normal(_NOISE_LENGTH, dtype=np.float32)

    def light(self, camera: RobotCamera, poses: FloatArray) -> NDArray[np.float32]:
        """The brightness of every pixel (height, width), without noise; overwritten by the next call.

        What covers something else while it moves is averaged over the exposure before it is laid over what it
        covers: exact but for the image's blurred rims in front of other blurred rims. Poses (K, N, 3) of all
        robots in map are those at the middles of K equal parts of the exposure.
        """
        seen_from = poses[:, camera.robot]
        of_map = camera.view(se2.inverse(seen_from))
        of_robots = camera.view(se2.between(seen_from[:, None], poses))
        fill(self._image, self._drawn(self._scene.backdrop, camera, of_map).changes, ROOM)
        for part, motion in self._far_to_near(camera.robot, poses, of_map, of_robots):
            lay_over(self._image, self._drawn(part, camera, motion))
        self._defocus()
        return self._image

    def _drawn(self, patches: Patches, camera: RobotCamera, motion: Motion) -> Layer:
        """The boundaries of patches, noted; with a narrow blur by light that comes three ways."""
        layer = self._layer._replace(box=empty_box())
        ways = _NARROW_WAYS if self._blur_is_narrow else _ONE_WAY
        for shift_px, weight in ways:
            lens = camera.lens.copy()
            lens[[CX, CY]] += shift_px
            draw(layer, patches, lens, motion, weight)
        return layer

    @property
    def _blur_is_narrow(self) -> bool:
        return _NARROW_VARIANCE < self._model.focus_sigma_px**2 < _WIDE_VARIANCE

    def _defocus(self) -> None:
        """Blur the image as the optics do.

        Light is blurred before it falls into pixels. A blur that is wide against them comes out the same when
        pixels are blurred afterwards; with a narrow one edges would seem to lie up to 0.03 px aside, one way
        or the other as they lie in the pixels. So part of it is there before, half a pixel apart.
        """
        sigma = self._model.focus_sigma_px
        if self._blur_is_narrow:
            side = 0.5 * (sigma**2 - _NARROW_VARIANCE)
            kernel = np.array([side, 1.0 - 2.0 * side, side])
            cv2.sepFilter2D(self._image, -1, kernel, kernel, dst=self._image)
        elif sigma > 0.0:
            cv2.GaussianBlur(self._image, (0, 0), sigma, dst=self._image)

    def frame(self, camera: RobotCamera, poses: FloatArray, rng: np.random.Generator) -> NDArray[np.uint8]:
        """The image (height, width) that the sensor reports; arguments as for `light`."""
        light = self.light(camera, poses)
        model = self._model
        frame = np.empty(light.shape, np.uint8)
        offset = rng.integers(0, _NOISE_LENGTH - model.width, model.height)
        expose(light, frame, self._electrons, model.read_noise, model.gain, self._noise, offset)
        return frame

    def take(
        self, camera: RobotCamera, middle_ns: int, poses_at: PosesAt, rng: np.random.Generator
    ) -> NDArray[np.uint8]:
        """The image (height, width) that a camera takes, exposed around `middle_ns`."""
        half_ns = round(0.5e9 * camera.model.exposure_s)
        begin, end = poses_at(np.array([middle_ns - half_ns, middle_ns + half_ns]))
        instants = self.instants(camera, begin, end)
        shares = (2 * np.arange(instants) + 1 - instants) / instants
        poses = poses_at(middle_ns + np.rint(shares * half_ns).astype(np.int64))
        return self.frame(camera, poses, rng)

    def instants(self, camera: RobotCamera, begin: FloatArray, end: FloatArray) -> int:
        """At how many instants of an exposure `light` needs the poses.

        Poses (N, 3) of all robots in map are those when the shutter opens and when it closes.
        """
        poses = np.stack([begin, end])
        seen_from = poses[:, camera.robot]
        rotation, shift = camera.view(se2.inverse(seen_from))
        boards = self._board_centres @ np.swapaxes(rotation, 1, 2) + shift[:, None]
        robots = camera.view(se2.between(seen_from[:, None], poses))[1]
        moved = float(camera.lens[FX] * np.abs(se2.wrap_angle(end[camera.robot, 2] - begin[camera.robot, 2])))
        things = np.concatenate([boards, robots], axis=1)
        in_view = (things[..., 2] > _CLOSEST) & (np.abs(things[..., 0]) < camera.lens[REACH] * things[..., 2])
        for before, after in things[:, in_view.all(axis=0)].swapaxes(0, 1).tolist():
            moved = max(moved, math.dist(_pixel(camera.lens, before), _pixel(camera.lens, after)))
        return max(1, min(math.ceil(moved / STEP_PX), MAX_INSTANTS))

    def _far_to_near(
        self, own: int, poses: FloatArray, of_map: Motion, of_robots: Motion
    ) -> Iterator[tuple[Patches, Motion]]:
        """All parts in front of the backdrop with their motions, far ones first, at the exposure's middle."""
        middle = poses[len(poses) // 2]
        places = np.concatenate([self._board_centres[:, :2], middle[:, :2]])
        boards = len(self._board_centres)
        distance = np.linalg.norm(places - middle[own, :2], axis=1)
        distance[boards : boards + self._scene.flat] = np.inf
        for thing in np.argsort(-distance, kind="stable").tolist():
            if thing < boards:
                yield self._scene.boards[thing], of_map
            elif thing - boards != own:
                robot = thing - boards
                motion = (
                    np.ascontiguousarray(of_robots[0][:, robot]),
                    np.ascontiguousarray(of_robots[1][:, robot]),
                )
                for part in self._scene.robots[robot]:
                    yield part, motion


def _pixel(lens: FloatArray, place: Sequence[float]) -> tuple[float, float]:
    """Pixel of a place in the optical frame."""
    return project(lens, place[0] / place[2], place[1] / place[2])
