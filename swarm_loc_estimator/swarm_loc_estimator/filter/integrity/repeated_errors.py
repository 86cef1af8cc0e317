"""Reported uncertainty of errors that repeat: a robot that looks again from the same place learns little new.

The filter treats errors of sightings as independent. But the next picture from the same place shows a marker
at the same pixels, with the same error: on MRCLAM set 1, 79 % of the variance of ranges and 80 % of that of
bearings repeat. With gain K and Jacobian H the error of the poses becomes e <- A e - K v, A = I - K H, where
v is the error of the sighting. Let b be its part that repeats, s R its variance, and C = cov(e, b). Then the
covariance of e exceeds that of the filter by

    X <- A X A^T - A C K^T - K C^T A^T,    C <- A C - s K R,

and C of the pair fades with the distance by which one end has moved as the other sees it. X is added to the
reported covariance of each robot; estimates and gates do not depend on it. It never makes a covariance
smaller, and it is zero for an observer that moves on between its sightings. X of two robots is taken as
uncorrelated. Measurements that are fused in batches, and infrared, whose repeated errors
`correlated_noise.py` averages, are left out.
"""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.small_matrix import (
    add_scaled,
    assign_matrix,
    factor_numbers,
)
from swarm_loc_estimator.filter.belief import BeliefArrays, IntegrityArrays
from swarm_loc_estimator.filter.integrity.pairs import find_pair
from swarm_loc_estimator.filter.measurement_model import POLAR, MeasurementColumns

_SHARE = 0.5  # Share s of the variance of a sighting that repeats at the same place
_LENGTH_M = 0.03  # Distance over which the repeated part fades to 1/e
_ROUNDING = 1e-12


@cached_njit
def count_repeated(
    measurements: MeasurementColumns,
    k: int,
    belief: BeliefArrays,
    predicted: FloatArray,
    gain: FloatArray,
    jacobian: FloatArray,
    noise: FloatArray,
) -> None:
    """Update the excess covariances of both robots of measurement k.

    Args:
        measurements: (m,).
        k: Which one.
        belief: Its integrity is changed.
        predicted: (3,) value.
        gain: (3, 6) of the poses of both sides; not used for a side that is missing.
        jacobian: (3, DEPENDS_ON) of the innovation.
        noise: (3, 3) of the measurement.
    """
    place = find_pair(measurements, k, belief)
    if place < 0 or measurements.systematic_share[k, 0] > 0.0:
        return
    robots, sides = (
        (measurements.observer[k], measurements.target[k]),
        2 if measurements.target[k] >= 0 else 1,
    )
    state, after, wider = belief.integrity, np.zeros((2, 3, 3)), np.empty((2, 3, 3))
    kept = _kept(state, robots[0], place, measurements.kind[k], predicted)
    for i in range(sides):
        own_gain = gain[:, 3 * i : 3 * i + 3].T
        left, own = _left(own_gain, jacobian, i, i), state.repeated[robots[i]]
        for other in range(own.shape[0]):
            if state.source[robots[i], other] >= 0:
                _multiply(left, own[other, 0])
        pair = state.repeated[robots[0], place, i]
        if i == 1:
            _multiply(left, pair)
        for j in range(sides):
            left = _left(own_gain, jacobian, i, j)
            add_scaled(after[i], _times(_times(left, state.excess[robots[j]]), left.T), 1.0)
        cross, new = _times(pair, own_gain.T), _times(own_gain, noise)
        for a in range(3):
            for b in range(3):
                wider[i, a, b] = after[i, a, b] - kept * (cross[a, b] + cross[b, a])
                pair[a, b] = kept * pair[a, b] - _SHARE * new[a, b]
    for i in range(sides):
        assign_matrix(state.excess[robots[i]], wider[i] if _is_positive(wider[i]) else after[i])


@cached_njit
def _is_positive(matrix: FloatArray) -> bool:
    """Whether a matrix (3, 3) is positive semidefinite up to rounding."""
    shifted = matrix.copy()
    for i in range(3):
        shifted[i, i] += _ROUNDING
    first, _, second, _, _, third = factor_numbers(shifted)
    return math.isfinite(first + second + third)


@cached_njit
def _times(left: FloatArray, right: FloatArray) -> FloatArray:
    """Product of two matrices (3, 3)."""
    product = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for r in range(3):
                product[i, j] += left[i, r] * right[r, j]
    return product


@cached_njit
def _multiply(left: FloatArray, matrix: FloatArray) -> None:
    """Multiply a matrix (3, 3) by another one from the left, in place."""
    for j in range(3):
        x, y, z = matrix[0, j], matrix[1, j], matrix[2, j]
        for i in range(3):
            matrix[i, j] = left[i, 0] * x + left[i, 1] * y + left[i, 2] * z


@cached_njit
def _left(gain: FloatArray, jacobian: FloatArray, i: int, j: int) -> FloatArray:
    """What the update leaves of the error of side j in that of side i (3, 3): a block of I - K H."""
    left = _times(gain, jacobian[:, 3 * j : 3 * j + 3])
    for a in range(3):
        for b in range(3):
            left[a, b] = (1.0 if i == j and a == b else 0.0) - left[a, b]
    return left


@cached_njit
def _kept(state: IntegrityArrays, observer: int, place: int, kind: int, predicted: FloatArray) -> float:
    """Share of the repeated error that is left after the motion since the last sighting of the pair."""
    x, y, last = predicted[0], predicted[1], state.repeated_at[observer, place]
    if kind == POLAR:
        x, y = predicted[0] * math.cos(predicted[1]), predicted[0] * math.sin(predicted[1])
    moved = math.hypot(x - last[0], y - last[1])
    last[0], last[1] = x, y
    return math.exp(-moved / _LENGTH_M)
