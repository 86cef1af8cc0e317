"""Gating: the Mahalanobis distance of an innovation, and a heading that is robust to flips."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import inlined_njit
from swarm_loc_estimator.common.small_matrix import factor_numbers

_STUDENT_DOF = 4.0
_MISREAD = 0.25 * np.pi  # Minimum error of the heading of a misread fiducial [rad]
NO_HEADING = 1e4  # Variance of a heading that is not used [rad^2]


def gate_threshold(probability: ArrayLike, degrees_of_freedom: int = 2) -> FloatArray:
    """Chi-square quantile: gate threshold of the squared distance for an acceptance probability."""
    threshold: FloatArray = np.vectorize(_quantile, otypes=[float])(probability, degrees_of_freedom)
    return threshold


@cache
def _quantile(probability: float, degrees_of_freedom: int) -> float:
    """Where `_exceeding` falls to the rest of a probability; SciPy has this, but takes long to import."""
    low, high = 0.0, 1.0
    while _exceeding(high, degrees_of_freedom) > 1.0 - probability:
        low, high = high, 2.0 * high
    while low < (middle := 0.5 * (low + high)) < high:
        is_below = _exceeding(middle, degrees_of_freedom) > 1.0 - probability
        low, high = (middle, high) if is_below else (low, middle)
    return high


def _exceeding(squared: float, degrees_of_freedom: int) -> float:
    """Probability of a larger chi-square: the upper incomplete gamma function, by its recursion."""
    half, order = 0.5 * squared, 1.0 - 0.5 * (degrees_of_freedom % 2)
    probability = math.exp(-half) if order == 1.0 else math.erfc(math.sqrt(half))
    while 2.0 * order < degrees_of_freedom:
        probability += half**order * math.exp(-half) / math.gamma(order + 1.0)
        order += 1.0
    return probability


POSE_GATE = float(gate_threshold(0.9999, 3))
"""Threshold of the squared distance of a pose whose heading is gated, too: fixes with systematic errors."""


@inlined_njit
def squared_distance(innovation: FloatArray, covariance: FloatArray) -> float:
    """Normalized innovation squared of an innovation (3,) with covariance (3, 3)."""
    aa, ba, bb, ca, cb, cc = factor_numbers(covariance)
    a = innovation[0] / aa
    b = (innovation[1] - ba * a) / bb
    c = (innovation[2] - ca * a - cb * b) / cc
    c = c / cc
    b = (b - cb * c) / bb
    a = (a - ba * b - ca * c) / aa
    distance: float = innovation[0] * a + innovation[1] * b + innovation[2] * c
    return distance


@inlined_njit
def position_distance(
    innovation: FloatArray, covariance: FloatArray, more: tuple[float, float] = (0.0, 0.0)
) -> float:
    """Squared Mahalanobis distance of the first two components, the only ones that are gated.

    The heading is not gated: the planar ambiguity of a square marker flips it in otherwise good sightings.

    Args:
        innovation: (3,).
        covariance: (3, 3) of the innovation.
        more: Variances added to both components.
    """
    a, b, d = covariance[0, 0] + more[0], covariance[0, 1], covariance[1, 1] + more[1]
    x, y = innovation[0], innovation[1]
    distance: float = (d * x * x - 2.0 * b * x * y + a * y * y) / (a * d - b * b)
    return distance


@inlined_njit
def is_misread(innovation: float, variance: float, gate: float) -> bool:
    """Whether a fix has the heading of a fiducial that was misread, turned by a quarter or a half.

    Such errors last for seconds, so down-weighting each of them does not suffice.
    """
    misread: bool = abs(innovation) > _MISREAD and innovation * innovation > gate * variance
    return misread


@inlined_njit
def soften_heading(innovation: FloatArray, covariance: FloatArray, noise: FloatArray) -> None:
    """Inflate the heading variance in `noise` (3, 3) if its innovation is large, to down-weight flips.

    Weight of Student's t with 4 degrees of freedom; `covariance` (3, 3) is that of the innovation.
    """
    normalised = innovation[2] * innovation[2] / covariance[2, 2]
    factor = (_STUDENT_DOF + normalised) / (_STUDENT_DOF + 1.0)
    if factor > 1.0:
        scale = np.sqrt(factor)
        noise[0, 2] *= scale
        noise[1, 2] *= scale
        noise[2, 0] *= scale
        noise[2, 1] *= scale
        noise[2, 2] *= factor
