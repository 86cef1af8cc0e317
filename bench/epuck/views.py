"""Ground truth of detections: where markers lie in an image, and which are occluded."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.sim.render.raster import Motion, Patches, project
from swarm_loc_drivers.sim.render.renderer import RobotCamera
from swarm_loc_drivers.sim.render.rigs import CameraRig
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray

_CLOSEST = 0.01  # What is nearer to the camera's plane is not projected [m]
_SHEET, _SQUARE = 0, 1  # Places of a marker's white sheet and of its black square among its patches


class Views(NamedTuple):
    """The markers whose front looks at a camera, one row each."""

    id: NDArray[np.uint32]  # (M,) of the marker
    corners: FloatArray  # (M, 4, 2) of the black square, clockwise from the marker's own upper left [px]
    margin: FloatArray  # (M,) how far inside the image its sheet lies, negative where it is cut off [px]
    incidence: FloatArray  # (M,) angle between its normal and the line of sight [rad]
    hidden: NDArray[np.bool_]  # (M,) whether a robot stands before a part of its sheet

    @property
    def side_px(self) -> FloatArray:
        """(M,) square roots of the squares' areas in the image [px]."""
        x, y = np.moveaxis(self.corners, -1, 0)
        area = 0.5 * np.sum(x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1), axis=1)
        side: FloatArray = np.sqrt(np.abs(area))
        return side


class _Seen(NamedTuple):
    """Markers in the optical frame: id, owner (-1: nobody), corners (M, 2, 4, 3) of sheet and square."""

    id: NDArray[np.uint32]
    owner: NDArray[np.int64]
    corners: FloatArray


def views_of(rig: CameraRig, robot: int, poses: FloatArray) -> Views:
    """The markers that look at a robot's camera, of whatever size, in view or outside.

    Args:
        rig: Cameras and scene, whose boards are markers.
        robot: Index of the robot.
        poses: (N, 3) of all robots in map.
    """
    # all markers in the optical frame
    scene, camera = rig.scene, rig.cameras[robot]
    own = poses[camera.robot]
    of_robots = [camera.view(se2.between(own, pose)) for pose in poses]
    markers = _in_optical_frame(
        scene.boards, rig.faces, rig.ids, [camera.view(se2.inverse(own)), *of_robots], camera.robot
    )
    # those that face the camera, in front of it
    centre = markers.corners[:, _SQUARE].mean(axis=1)
    right, down = (markers.corners[:, _SQUARE, k] - markers.corners[:, _SQUARE, 0] for k in (1, 3))
    normal = np.cross(down, right)
    cosine = -np.sum(centre * normal, axis=1)
    cosine /= np.linalg.norm(centre, axis=1) * np.linalg.norm(normal, axis=1)
    kept = (cosine > 0.0) & (markers.corners[..., 2].min(axis=(1, 2)) > _CLOSEST)
    markers = _Seen(*(column[kept] for column in markers))
    # hidden by a robot that is nearer
    pixels = _pixels(camera, markers.corners)
    outlines = {
        robot: _outline(camera, scene.robots[robot], of_robots[robot])
        for robot in range(len(poses))
        if robot != camera.robot
    }
    distance = [float(motion[1][2]) for motion in of_robots]
    hidden = [
        any(
            distance[robot] < depth and _overlap(outline, sheet)
            for robot, outline in outlines.items()
            if robot != owner
        )
        for owner, depth, sheet in zip(markers.owner, centre[kept][:, 2], pixels[:, _SHEET], strict=True)
    ]
    # distance from the border of the image
    size = np.array([camera.model.width, camera.model.height])
    sheet = pixels[:, _SHEET]
    margin = np.minimum(sheet + 0.5, size - 0.5 - sheet).min(axis=(1, 2))
    return Views(
        markers.id, pixels[:, _SQUARE], margin, np.arccos(cosine[kept]), np.array(hidden, dtype=bool)
    )


def _in_optical_frame(
    boards: Sequence[Patches],
    faces: Sequence[Sequence[Patches]],
    ids: NDArray[np.uint32],
    motions: Sequence[Motion],
    own: int,
) -> _Seen:
    """All markers but those on the camera's own robot; `motions` are of map and of robot after robot."""
    owner = np.repeat(np.arange(-1, len(faces)), [len(boards), *map(len, faces)])
    corners = [
        patches.corners[:2] @ motions[1 + robot][0].T + motions[1 + robot][1]
        for robot, patches in zip(owner, [*boards, *(face for one in faces for face in one)], strict=True)
    ]
    others = owner != own
    return _Seen(ids[others], owner[others], np.reshape(corners, (-1, 2, 4, 3))[others])


def _pixels(camera: RobotCamera, points: FloatArray) -> FloatArray:
    """(..., 2) of points (..., 3) before the camera, as they are drawn."""
    pixels = [project(camera.lens, x / z, y / z) for x, y, z in points.reshape(-1, 3).tolist()]
    return np.reshape(np.array(pixels, float), (*points.shape[:-1], 2))


def _outline(camera: RobotCamera, robot: Sequence[Patches], motion: Motion) -> FloatArray:
    """Convex hull (H, 2) of a robot in the image [px]; empty behind the camera."""
    corners = np.concatenate([part.corners.reshape(-1, 3) for part in robot]) @ motion[0].T + motion[1]
    before = corners[corners[:, 2] > _CLOSEST]
    if len(before) < len(corners):
        return np.zeros((0, 2))
    return np.asarray(cv2.convexHull(_pixels(camera, before).astype(np.float32))[:, 0], float)


def _overlap(outline: FloatArray, sheet: FloatArray) -> bool:
    """Whether two convex outlines share an area."""
    if not len(outline):
        return False
    area, _ = cv2.intersectConvexConvex(outline.astype(np.float32), sheet.astype(np.float32))
    return bool(area > 0.0)
