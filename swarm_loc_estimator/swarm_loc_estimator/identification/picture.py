"""Detections of an aerial image, points of a robot's track, and the assignment of both to each other.

All robots are assigned jointly, each to one detection or to none, so that the total likelihood is largest. A
robot gets none where two assignments are about equally likely.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray

UNSEEN = -1  #: No detection passes the gate of a robot, or no robot that of a detection
AMBIGUOUS = -2  # Candidates pass the gate, but none is clearly the right one
_FORBIDDEN = 1e9


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


def squared_distances(
    means: FloatArray, covariances: FloatArray, picture: Picture, spread: float
) -> tuple[FloatArray, FloatArray]:
    """Squared Mahalanobis distances (r, n) of positions, and determinants of their covariances.

    Of means (r, k) and covariances (r, k, k) only x and y count; `spread` is a standard deviation of both
    [m].
    """
    away = picture.pose[None, :, :2] - means[:, None, :2]
    s = covariances[:, None, :2, :2] + picture.covariance[None, :, :2, :2] + spread**2 * np.eye(2)
    a, b, d = s[..., 0, 0], s[..., 0, 1], s[..., 1, 1]
    x, y = away[..., 0], away[..., 1]
    determinant = a * d - b * b
    return (d * x * x - 2.0 * b * x * y + a * y * y) / determinant, determinant


class Assignment(NamedTuple):
    """Assignment of robots and detections."""

    place: IntArray  # (r,) the detection of each robot, or UNSEEN or AMBIGUOUS
    robot: IntArray  # (n,) the robot of each detection, as an index below r, or UNSEEN or AMBIGUOUS
    # (r,) that the assignment of a robot is right, compared with the best one without it
    probability: FloatArray


def log_ratios(
    poses: FloatArray, covariances: FloatArray, picture: Picture, log_density: float, gate: float
) -> FloatArray:
    """Log likelihood ratios (r, n), of this robot over another one; -inf beyond the gate.

    Robots have estimated poses (r, 3) with covariances (r, 3, 3) at the stamp of the picture (n,), detections
    of others a log density [1/m^2]. The gate is the largest squared Mahalanobis distance of a position.
    """
    squared, determinant = squared_distances(poses, covariances, picture, 0.0)
    ratio = -0.5 * squared - 0.5 * np.log(determinant) - np.log(2.0 * np.pi) - log_density
    return np.asarray(np.where(squared <= gate, ratio, -np.inf))


def assign(ratios: FloatArray, detection_probability: float, least_probability: float) -> Assignment:
    """Assign detections to robots by ratios (r, n) as of `log_ratios`, and the probability to be detected.

    A robot whose assignment is contested and has less than `least_probability` is AMBIGUOUS.
    """
    costs = -(ratios + np.log(detection_probability) - np.log1p(-detection_probability))
    near = np.isfinite(ratios)
    place, best = _solved(costs)
    probability = np.zeros(len(ratios))
    contested = near & ((near.sum(axis=1) > 1)[:, None] | (near.sum(axis=0) > 1)[None, :])
    for i in np.flatnonzero(place >= 0):
        j, other = place[i], 0.0
        margin = -costs[i, j]
        if contested[i, j]:
            without = costs.copy()
            without[i, j] = np.inf
            _, other = _solved(without)
            margin = other - best
        probability[i] = 1.0 / (1.0 + np.exp(-margin))
    unclear = (place >= 0) & (probability < least_probability)
    unclear &= contested[np.arange(len(place)), place]
    robot = np.where(near.any(axis=0), AMBIGUOUS, UNSEEN)
    place = np.where(unclear | ((place < 0) & near.any(axis=1)), AMBIGUOUS, place)
    clear = np.flatnonzero(place >= 0)
    robot[place[clear]] = clear
    return Assignment(place, robot, probability)


def _solved(costs: FloatArray) -> tuple[IntArray, float]:
    """The detection (r,) of each robot, or UNSEEN at zero cost, with the least total cost."""
    r, n = costs.shape
    whole = np.full((r, n + r), _FORBIDDEN)
    whole[:, :n] = np.where(np.isfinite(costs), costs, _FORBIDDEN)
    whole[np.arange(r), n + np.arange(r)] = 0.0
    rows, columns = scipy.optimize.linear_sum_assignment(whole)
    place = np.full(r, UNSEEN)
    place[rows] = np.where(columns < n, columns, UNSEEN)
    return place, float(whole[rows, columns].sum())
