"""Correlated errors of repeated measurements by one pair of robots.

An infrared exchange errs by the elements' unknown gains much more than by noise, and those are the same the
next time. So the error u of a measurement, of variance c, has a part b c that comes again. What is believed
of the pair's relative pose has an error e, of variance p, in which that part has a weight a: E[e u] = a b c.
The best that the measurement can make of p then is

    p - (p - a b c)^2 / (p - 2 a b c + c),

and r = p (p - (a b c)^2 / c) c / (p - a b c)^2 is the noise with which the filter, to which errors are
independent, comes to the same variance; p <= a b c tells nothing new. So n exchanges of robots that stand
leave c (b + (1 - b) / n). Range, bearing and heading are reckoned with apart. The first measurement of a pair
has a = 0 and r = c. What is used raises the weight; what others tell lowers it, as much as they lower p.
Robots that have turned use other elements, whose gains are others.
"""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_estimator.core.filter.belief import BeliefArrays
from swarm_loc_estimator.core.filter.measurement_model import MeasurementColumns
from swarm_loc_estimator.numerics.arrays import FloatArray
from swarm_loc_estimator.numerics.jit import compiled, inlined
from swarm_loc_estimator.numerics.se2_scalar import wrap

_FORGOTTEN = 0.5
"""After a turn of so much, errors have a correlation of exp(-1/2) with those before [rad]."""
_NOTHING_NEW = 1e-4
"""The share of an uncertainty below which something new does not count."""
_VALUE, _WEIGHT, _VARIANCE = 0, 1, 2
"""Rows of what is remembered of a pair: value measured, weights a, variances p."""


@inlined
def inflate_noise(
    measurements: MeasurementColumns,
    k: int,
    belief: BeliefArrays,
    predicted: FloatArray,
    noise: FloatArray,
) -> None:
    """Enlarge the noise (3, 3) of a measurement that tells again what its pair has told before.

    Args:
        measurements: (m,).
        k: Which.
        belief: With what pairs have told.
        predicted: (3,) variances of the prediction, in the value's coordinates.
        noise: (3, 3) covariance of the measurement, changed.
    """
    place = _place(measurements, k, belief)
    if place < 0 or belief.pair_robot[measurements.observer[k], place] != measurements.target[k]:
        return
    weight = _weights(measurements, k, belief, place, predicted)
    scale = (
        _scale(measurements, k, 0, predicted, weight),
        _scale(measurements, k, 1, predicted, weight),
        _scale(measurements, k, 2, predicted, weight),
    )
    for i in range(3):
        for j in range(3):
            noise[i, j] *= scale[i] * scale[j]


@inlined
def _scale(
    measurements: MeasurementColumns,
    k: int,
    i: int,
    predicted: FloatArray,
    weight: tuple[float, float, float],
) -> float:
    """By what factor the standard deviation r of component i exceeds that of the measurement."""
    p, c = predicted[i], measurements.covariance[k, i, i]
    again = weight[i] * measurements.systematic_share[k, i] * c
    new = p - again
    return math.sqrt(p * (p - again * again / c)) / new if new > _NOTHING_NEW * p else 1.0 / _NOTHING_NEW


@compiled
def record_pair(
    measurements: MeasurementColumns,
    k: int,
    belief: BeliefArrays,
    predicted: FloatArray,
    noise: FloatArray,
) -> None:
    """Record that a measurement was used with this noise; arguments as `inflate_noise` left them."""
    place = _place(measurements, k, belief)
    if place < 0:
        return
    observer, weight = measurements.observer[k], np.zeros(3)
    if belief.pair_robot[observer, place] == measurements.target[k]:
        weight[0], weight[1], weight[2] = _weights(measurements, k, belief, place, predicted)
    for i in range(3):
        gain = predicted[i] / (predicted[i] + noise[i, i])
        weight[i] += gain * (1.0 - weight[i])
        predicted[i] *= 1.0 - gain
    _keep(measurements, k, belief, place, weight, predicted)


@compiled
def record_constraint(measurements: MeasurementColumns, k: int, belief: BeliefArrays) -> None:
    """Record that a measurement may locate a robot, which then errs as the measurement does."""
    place = _place(measurements, k, belief)
    if place >= 0:
        variance = np.empty(3)
        for i in range(3):
            variance[i] = measurements.covariance[k, i, i]
        _keep(measurements, k, belief, place, np.ones(3), variance)


@inlined
def _place(measurements: MeasurementColumns, k: int, belief: BeliefArrays) -> int:
    """Where the pair of measurement k is remembered or is to be, in place of the oldest; -1: needs not."""
    places, best = belief.pair_robot.shape[1], 0
    if places == 0 or measurements.observer[k] < 0 or measurements.target[k] < 0:
        return -1
    if (
        not max(
            measurements.systematic_share[k, 0],
            measurements.systematic_share[k, 1],
            measurements.systematic_share[k, 2],
        )
        > 0.0
    ):
        return -1
    robots, stamps_ns = (
        belief.pair_robot[measurements.observer[k]],
        belief.pair_stamp_ns[measurements.observer[k]],
    )
    for place in range(places):
        if robots[place] == measurements.target[k]:
            return place
        if stamps_ns[place] < stamps_ns[best]:
            best = place
    return best


@inlined
def _weights(
    measurements: MeasurementColumns, k: int, belief: BeliefArrays, place: int, predicted: FloatArray
) -> tuple[float, float, float]:
    """With what weights errors that come again are in what is believed of range, bearing and heading."""
    known = belief.pair_history[measurements.observer[k], place]
    value = measurements.value[k]
    arrival = wrap(value[1] - known[_VALUE, 1]) / _FORGOTTEN
    departure = wrap(value[1] - value[2] - known[_VALUE, 1] + known[_VALUE, 2]) / _FORGOTTEN
    sensors, emitters = math.exp(-0.5 * arrival * arrival), math.exp(-0.5 * departure * departure)
    both = 0.5 * (sensors + emitters)
    return (
        known[_WEIGHT, 0] * both * min(predicted[0] / known[_VARIANCE, 0], 1.0),
        known[_WEIGHT, 1] * sensors * min(predicted[1] / known[_VARIANCE, 1], 1.0),  # of the sensors alone
        known[_WEIGHT, 2] * both * min(predicted[2] / known[_VARIANCE, 2], 1.0),
    )


@compiled
def _keep(
    measurements: MeasurementColumns,
    k: int,
    belief: BeliefArrays,
    place: int,
    weight: FloatArray,
    variance: FloatArray,
) -> None:
    """Write what is remembered of a pair."""
    observer = measurements.observer[k]
    belief.pair_robot[observer, place] = measurements.target[k]
    belief.pair_stamp_ns[observer, place] = measurements.stamp_ns[k]
    for i in range(3):
        belief.pair_history[observer, place, _VALUE, i] = measurements.value[k, i]
        belief.pair_history[observer, place, _WEIGHT, i] = weight[i]
        belief.pair_history[observer, place, _VARIANCE, i] = variance[i]
