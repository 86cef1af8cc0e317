"""Joint pose of a rigid body from several of its markers.

One face seen head-on cannot be told from its mirror image, two faces together can. The answer is given face
by face: each with the common pose, and with its covariance times the number of faces. So whoever takes the
faces for independent gets the common pose with its true covariance. As of a face alone, that covariance
leaves out how exactly faces sit; who knows it from the description adds it to each.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.swarm.swarm import CameraMount, Face, Robot
from swarm_loc_vision.markers.pose import Poses, Upright, body_pose, square

_MIN_SIGMA = 0.0005
"""No face is glued on truer [m]."""
_MAX_CHI2 = 25.0
"""Per degree of freedom; where faces fit worse, they do not sit as described, and each stays on its own."""

_MAX_LEFT_OUT = 0.99
"""Of a position's variance."""


@dataclass(frozen=True)
class Placement:
    """Where a marker sits on a body.

    Attributes:
        rotation: (3, 3) from the marker's frame to the body's.
        position: (3,) in the body's frame [m].
        sigma: How unsure its position is, each way [m].
    """

    rotation: FloatArray
    position: FloatArray
    sigma: float


Body = Mapping[int, Placement]
"""Marker id -> where it sits."""


def robot_body(robot: Robot) -> Body:
    """The faces of a robot that show a heading, in base_link."""
    return {face.id: _placement(face, face.yaw) for face in robot.faces if face.yaw is not None}


def _placement(face: Face, yaw: float) -> Placement:
    """A face stands upright and looks along its yaw."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    rotation = np.array([[-sin, 0.0, cos], [cos, 0.0, sin], [0.0, 1.0, 0.0]])
    return Placement(rotation, np.array([face.x, face.y, face.z]), max(face.position_sigma, _MIN_SIGMA))


def up_of(mount: CameraMount) -> FloatArray:
    """(3,) up in the optical frame of a camera on a level robot."""
    cos = math.cos(mount.pitch)
    return np.array([-math.sin(mount.roll) * cos, -math.cos(mount.roll) * cos, -math.sin(mount.pitch)])


@dataclass(frozen=True)
class Seen:
    """Markers in an image, one row each.

    Attributes:
        id: (N,).
        corners: (N, 4, 2) [ideal px].
        covariance: (N, 8, 8) of the corners [px^2].
        lengths: (N,) sides [m].
        poses: Of each on its own; those of bodies are replaced.
    """

    id: IntArray
    corners: FloatArray
    covariance: FloatArray
    lengths: FloatArray
    poses: Poses


def solve_bodies(seen: Seen, bodies: Iterable[Body], intrinsics: FloatArray, upright: Upright | None) -> None:
    """Replace the poses of markers that sit on one body by what they say together.

    Args:
        seen: The markers; changed.
        bodies: What carries several.
        intrinsics: (4,) fx, fy, cx, cy [px].
        upright: Given when the bodies are known to stand upright.
    """
    solved = np.isfinite(seen.poses.chi2[:, 0])
    for body in bodies:
        rows = [int(i) for i in np.flatnonzero(solved) if int(seen.id[i]) in body]
        distinct = {int(seen.id[i]) for i in rows}
        if len(rows) < 2 or len(distinct) < len(rows):
            continue
        _solve(seen, rows, [body[int(seen.id[i])] for i in rows], intrinsics, upright)


def _solve(
    seen: Seen,
    rows: Sequence[int],
    places: Sequence[Placement],
    intrinsics: FloatArray,
    upright: Upright | None,
) -> None:
    """One body, seen in some rows."""
    points = np.stack(
        [square(seen.lengths[i]) @ at.rotation.T + at.position for i, at in zip(rows, places, strict=True)]
    )
    starts = _starts(seen, rows, places)
    own = [square(seen.lengths[i]) @ seen.poses.rotation[i, 0].T + seen.poses.position[i, 0] for i in rows]
    for _ in range(2):  # what a shift does depends on how faces lie, which each alone tells badly
        shifts = [_shift_covariance(at.sigma, c, intrinsics) for at, c in zip(places, own, strict=True)]
        covariance = seen.covariance[rows] + np.stack(shifts)
        found = body_pose(points, seen.corners[rows], covariance, intrinsics, *starts, upright)
        if not np.isfinite(found.chi2[0, 0]):
            return
        own = list(points @ found.rotation[0, 0].T + found.position[0, 0])
    freedom = 8.0 * len(rows) - 6.0
    if not found.chi2[0, 0] < _MAX_CHI2 * freedom:
        return
    surplus = max(1.0, found.chi2[0, 0] / freedom)
    told = max(min(at.sigma for at in places) ** 2 - _MIN_SIGMA**2, 0.0)
    for i, at in zip(rows, places, strict=True):
        for s in range(2):
            rotation, position = found.rotation[0, s], found.position[0, s]
            lever = rotation @ at.position
            seen.poses.rotation[i, s] = rotation @ at.rotation
            seen.poses.position[i, s] = position + lever
            of_one = len(rows) * surplus * _moved(found.covariance[0, s], lever)
            if np.isfinite(found.chi2[0, s]):
                _leave_out(told, of_one)
            seen.poses.covariance[i, s] = of_one
            seen.poses.chi2[i, s] = found.chi2[0, s] / surplus


def _starts(seen: Seen, rows: Sequence[int], places: Sequence[Placement]) -> tuple[FloatArray, FloatArray]:
    """The poses of the body by each solution of each marker alone."""
    rotations, positions = [], []
    for i, at in zip(rows, places, strict=True):
        for s in range(2):
            if np.isfinite(seen.poses.chi2[i, s]):
                rotation = seen.poses.rotation[i, s] @ at.rotation.T
                rotations.append(rotation)
                positions.append(seen.poses.position[i, s] - rotation @ at.position)
    return np.stack(rotations), np.stack(positions)


def _shift_covariance(sigma: float, corners: FloatArray, intrinsics: FloatArray) -> FloatArray:
    """(8, 8) in the image of corners (4, 3) in the camera frame that are shifted together [px^2]."""
    fx, fy = intrinsics[:2]
    x, y, z = corners.T
    by_shift = np.zeros((8, 3))
    by_shift[0::2, 0], by_shift[0::2, 2] = fx / z, -fx * x / z**2
    by_shift[1::2, 1], by_shift[1::2, 2] = fy / z, -fy * y / z**2
    return np.asarray(sigma**2 * by_shift @ by_shift.T)


def _leave_out(variance: float, covariance: FloatArray) -> None:
    """Take a variance of the position, each way, from a pose's covariance (6, 6), which stays positive.

    Faces shifted on their own are all shifted by one part, which moves the body, and by others, which tell of
    themselves. So that of one part is in there whole, but for what a pose not quite right makes of it.
    """
    of_position = np.linalg.inv(np.linalg.inv(covariance)[:3, :3])  # were the rotation known
    most = _MAX_LEFT_OUT * np.linalg.eigvalsh(of_position)[0]
    covariance[:3, :3] -= min(variance, most) * np.eye(3)


def _moved(covariance: FloatArray, lever: FloatArray) -> FloatArray:
    """The covariance (6, 6) of a pose a lever (3,) away, given in the camera frame."""
    x, y, z = lever
    move = np.eye(6)
    move[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]  # d(position) = dt + omega x lever
    return np.asarray(move @ covariance @ move.T)
