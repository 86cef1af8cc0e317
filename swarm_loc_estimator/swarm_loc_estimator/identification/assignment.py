"""Global assignment of anonymous detections to robots that know where they are.

All robots together are assigned so that the whole is most likely: a detection where one is expected, or
none. A robot whose detection might as well be another one's, or which might as well have another one, gets
none.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.identification.picture import Picture

UNSEEN = -1
"""Of a robot: no detection is near enough; of a detection: no robot is."""
AMBIGUOUS = -2
"""Of a robot or a detection: there is one, or are several, but it is not clear which."""
_FORBIDDEN = 1e9


class Assignment(NamedTuple):
    """Who is what.

    Attributes:
        place: (r,) the detection of each robot, or UNSEEN or AMBIGUOUS.
        robot: (n,) the robot of each detection, as an index below r, or UNSEEN or AMBIGUOUS.
        probability: (r,) that the assignment of a robot is right, beside the best one without it.
    """

    place: IntArray
    robot: IntArray
    probability: FloatArray


def log_ratios(
    poses: FloatArray, covariances: FloatArray, picture: Picture, log_density: float, gate: float
) -> FloatArray:
    """Log likelihoods (r, n) of detections as robots', over those as any others'; -inf beyond the gate.

    Args:
        poses: (r, 3) where robots are believed to be at the stamp of the picture.
        covariances: (r, 3, 3).
        picture: (n,) detections.
        log_density: Of detections that are others' [1/m^2].
        gate: Largest squared Mahalanobis distance of a position.
    """
    away = picture.pose[None, :, :2] - poses[:, None, :2]
    s = covariances[:, None, :2, :2] + picture.covariance[None, :, :2, :2]
    a, b, d = s[..., 0, 0], s[..., 0, 1], s[..., 1, 1]
    x, y = away[..., 0], away[..., 1]
    determinant = a * d - b * b
    squared = (d * x * x - 2.0 * b * x * y + a * y * y) / determinant
    ratio = -0.5 * squared - 0.5 * np.log(determinant) - np.log(2.0 * np.pi) - log_density
    return np.asarray(np.where(squared <= gate, ratio, -np.inf))


def assign(ratios: FloatArray, detection_probability: float, least_probability: float) -> Assignment:
    """Assign detections to robots.

    Args:
        ratios: (r, n) as of `log_ratios`.
        detection_probability: Of a robot in the picture.
        least_probability: Of an assignment that others contest; less is ambiguous.
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
    """The detection (r,) of each robot, UNSEEN for none, at the least cost together; none costs nothing."""
    r, n = costs.shape
    whole = np.full((r, n + r), _FORBIDDEN)
    whole[:, :n] = np.where(np.isfinite(costs), costs, _FORBIDDEN)
    whole[np.arange(r), n + np.arange(r)] = 0.0
    rows, columns = linear_sum_assignment(whole)
    place = np.full(r, UNSEEN)
    place[rows] = np.where(columns < n, columns, UNSEEN)
    return place, float(whole[rows, columns].sum())
