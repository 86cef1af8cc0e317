"""Detections of an aerial image, and points of a robot's odometry track."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray


class Picture(NamedTuple):
    """Anonymous detections (n,) of one aerial image, in `map`."""

    pose: FloatArray  # (n, 3) x [m], y [m], heading [rad], which is zero where it was not measured
    covariance: FloatArray  # (n, 3, 3) of it
    has_heading: BoolArray  # (n,) whether the heading was measured

    @property
    def variance(self) -> FloatArray:
        """(n,) mean variance of x and y [m^2]."""
        return np.asarray(0.5 * (self.covariance[:, 0, 0] + self.covariance[:, 1, 1]))


class TrackPoint(NamedTuple):
    """A robot's own track at the instant of an image."""

    pose: FloatArray  # (3,) on the track, in the track's frame; the heading is not wrapped
    covariance: FloatArray  # (3, 3) of the right-invariant error accumulated since the start of the track


def gathered_between(before: TrackPoint, after: TrackPoint) -> FloatArray:
    """Covariance (3, 3) accumulated between two points of a track, at the later one.

    Of x and y along the axes of the track's frame, and of the heading.
    """
    x, y = after.pose[0], after.pose[1]
    shear = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
    gathered: FloatArray = shear @ (after.covariance - before.covariance) @ shear.T
    return gathered
