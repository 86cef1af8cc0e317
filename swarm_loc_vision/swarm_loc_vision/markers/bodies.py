"""Poses of the markers in one image: each alone, and jointly for markers of one body.

The pose of one face of a body seen head-on is ambiguous, that of two faces is not. Each of n faces gets the
common pose and n times its covariance, so an estimator that treats the faces as independent obtains the
covariance of the common pose. As for a single face, the covariance does not contain `position_sigma` of the
description, which the estimator adds to each face.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.parameters import number
from swarm_loc_estimator.swarm.swarm import CameraMount, Face, FixedCamera, Robot
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.markers.pose import Poses, Upright, body_pose, marker_poses, square

SHIFT = 0.15**2 * np.tile(np.eye(2), (4, 4))  # Of corners, by what a calibration leaves of a lens [px^2]
# Checked by the NEES of test_bodies.py.
_MIN_SIGMA = 0.0005  # Minimum of `position_sigma` [m]
_MAX_CHI2 = 25.0
"""Maximum chi square per degree of freedom; above it the faces contradict the description and stay single."""

_MAX_LEFT_OUT = 0.99  # Maximum share of a position's variance that is subtracted


@dataclass(frozen=True)
class Placement:
    """Pose of a marker on a body."""

    rotation: FloatArray  # (3, 3) from the marker's frame to the body's
    position: FloatArray  # (3,) in the body's frame [m]
    sigma: float  # Standard deviation of the position along each axis [m]


Body = Mapping[int, Placement]  # Marker id -> its pose on the body


def robot_body(robot: Robot) -> Body:
    """The faces of a robot with a known yaw, in base_link."""
    return {face.id: _placement(face, face.yaw) for face in robot.faces if face.yaw is not None}


def _placement(face: Face, yaw: float) -> Placement:
    """The pose of an upright face whose normal points along its yaw, or of a lying one whose x axis does."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    rotation = np.array([[-sin, 0.0, cos], [cos, 0.0, sin], [0.0, 1.0, 0.0]])
    if face.lies:
        rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return Placement(rotation, np.array([face.x, face.y, face.z]), max(face.position_sigma, _MIN_SIGMA))


def up_of(mount: CameraMount | FixedCamera) -> FloatArray:
    """(3,) up in the optical frame of a camera on a level robot, or of a fixed one."""
    cos = math.cos(mount.pitch)
    return np.array([-math.sin(mount.roll) * cos, -math.cos(mount.roll) * cos, -math.sin(mount.pitch)])


@dataclass(frozen=True)
class Seen:
    """Markers in an image, one row each."""

    id: IntArray  # (N,)
    corners: FloatArray  # (N, 4, 2) [ideal px]
    covariance: FloatArray  # (N, 8, 8) of the corners [px^2]
    lengths: FloatArray  # (N,) sides [m]
    poses: Poses  # Pose of each marker alone; those on bodies are replaced


def solve_bodies(seen: Seen, bodies: Iterable[Body], intrinsics: FloatArray, upright: Upright | None) -> None:
    """Replace the poses of markers that sit on one body by their common pose.

    Args:
        seen: The markers; modified.
        bodies: Bodies with several markers.
        intrinsics: (4,) fx, fy, cx, cy [px].
        upright: Given when bodies are known to stand upright.
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
    """Solve for the pose of one body from its rows."""
    points = np.stack(
        [square(seen.lengths[i]) @ at.rotation.T + at.position for i, at in zip(rows, places, strict=True)]
    )
    starts = _starts(seen, rows, places)
    own = [square(seen.lengths[i]) @ seen.poses.rotation[i, 0].T + seen.poses.position[i, 0] for i in rows]
    for _ in range(2):  # the effect of a shift depends on the faces' orientation, poor for a face alone
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
    added = max(min(at.sigma for at in places) ** 2 - _MIN_SIGMA**2, 0.0)
    for i, at in zip(rows, places, strict=True):
        for s in range(2):
            rotation, position = found.rotation[0, s], found.position[0, s]
            lever = rotation @ at.position
            seen.poses.rotation[i, s] = rotation @ at.rotation
            seen.poses.position[i, s] = position + lever
            of_one = len(rows) * surplus * _moved(found.covariance[0, s], lever)
            if np.isfinite(found.chi2[0, s]):
                _leave_out(added, of_one)
            seen.poses.covariance[i, s] = of_one
            seen.poses.chi2[i, s] = found.chi2[0, s] / surplus


def _starts(seen: Seen, rows: Sequence[int], places: Sequence[Placement]) -> tuple[FloatArray, FloatArray]:
    """Rotations and positions of the body by each solution of each marker."""
    rotations, positions = [], []
    for i, at in zip(rows, places, strict=True):
        for s in range(2):
            if np.isfinite(seen.poses.chi2[i, s]):
                rotation = seen.poses.rotation[i, s] @ at.rotation.T
                rotations.append(rotation)
                positions.append(seen.poses.position[i, s] - rotation @ at.position)
    return np.stack(rotations), np.stack(positions)


def _shift_covariance(sigma: float, corners: FloatArray, intrinsics: FloatArray) -> FloatArray:
    """(8, 8) image covariance of a common shift of corners (4, 3) in the camera frame [px^2]."""
    fx, fy = intrinsics[:2]
    x, y, z = corners.T
    by_shift = np.zeros((8, 3))
    by_shift[0::2, 0], by_shift[0::2, 2] = fx / z, -fx * x / z**2
    by_shift[1::2, 1], by_shift[1::2, 2] = fy / z, -fy * y / z**2
    return np.asarray(sigma**2 * by_shift @ by_shift.T)


def _leave_out(variance: float, covariance: FloatArray) -> None:
    """Subtract a variance of the position from the covariance (6, 6) of a pose, which stays positive.

    The shifts of the faces have a common part, which moves the body, and individual parts, which show up as
    residuals. So the covariance contains the variance of the common part, up to errors of the pose.
    """
    of_position = np.linalg.inv(np.linalg.inv(covariance)[:3, :3])  # for a known rotation
    most = _MAX_LEFT_OUT * np.linalg.eigvalsh(of_position)[0]
    covariance[:3, :3] -= min(variance, most) * np.eye(3)


def _moved(covariance: FloatArray, lever: FloatArray) -> FloatArray:
    """The covariance (6, 6) of a pose at an offset (3,) in the camera frame."""
    x, y, z = lever
    move = np.eye(6)
    move[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]  # d(position) = dt + omega x lever
    return np.asarray(move @ covariance @ move.T)


@dataclass(frozen=True)
class PoseSettings:
    """Settings of poses."""

    marker_length: float = number(
        0.05, "m", 0.001, 10.0, "side of markers without a length of their own, black border included"
    )
    tilt_sigma: float = number(
        0.0, "rad", 0.0, 1.0, "standard deviation of markers from upright; 0: any orientation"
    )
    ambiguity: float = number(
        16.0, "1", 0.0, 1e4, "the mirrored pose is published if its chi square is higher by at most this"
    )


class PoseSolver:
    """Solves for the poses of markers.

    Args:
        settings: Settings of poses.
        camera: The camera.
        lengths: Sides of markers that differ from `settings.marker_length`, by id [m].
        up: (3,) direction up in the camera frame, for `settings.tilt_sigma`.
        lying: Ids of markers that lie flat, to which `settings.tilt_sigma` does not apply.
        bodies: Bodies that carry several markers.
    """

    def __init__(
        self,
        settings: PoseSettings,
        camera: Camera,
        lengths: Mapping[int, float],
        up: FloatArray | None,
        lying: Sequence[int],
        bodies: Sequence[Body],
    ) -> None:
        self._intrinsics = camera.intrinsics
        self._length, self._lengths = settings.marker_length, lengths
        self._lying: IntArray = np.array(lying, dtype=np.int64)
        self._bodies = bodies
        self._upright = None if up is None or not settings.tilt_sigma else Upright(up, settings.tilt_sigma)

    def solve(self, ids: IntArray, corners: FloatArray, covariance: FloatArray) -> tuple[Poses, int]:
        """The poses of markers (N,) and the number of misfits.

        Args:
            ids: (N,).
            corners: (N, 4, 2) clockwise from the marker's own upper left [ideal px].
            covariance: (N, 8, 8) of the corners [px^2].
        """
        lengths = np.array([self._lengths.get(int(i), self._length) for i in ids], dtype=float)
        poses, is_misfit = marker_poses(corners, covariance, lengths, self._intrinsics, self._upright)
        lies = np.isin(ids, self._lying)
        if self._upright is not None and lies.any():
            again, is_misfit[lies] = marker_poses(
                corners[lies], covariance[lies], lengths[lies], self._intrinsics
            )
            for column, new in zip(poses, again, strict=True):
                column[lies] = new
        if self._bodies:
            seen = Seen(ids, corners, covariance, lengths, poses)
            solve_bodies(seen, self._bodies, self._intrinsics, self._upright)
        return poses, int(is_misfit.sum())
