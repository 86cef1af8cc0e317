"""Poses of the markers in one image: each alone, and jointly for markers of one body."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.parameters import number
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.markers.bodies import Body, Seen, solve_bodies
from swarm_loc_vision.markers.pose import Poses, Upright, marker_poses


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
