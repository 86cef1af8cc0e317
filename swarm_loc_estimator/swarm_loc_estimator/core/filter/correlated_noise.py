"""Correlated errors of repeated measurements by one pair of robots.

An infrared exchange errs by the elements' unknown gains much more than by noise, and those are the same the
next time. So of the variance c of a measurement a part s = b c comes again, and n alike exchanges of a pair
can tell no more than a mean of the variance V = s + w, w = (c - s) / n. Another exchange takes part in this
mean with the weight that is best for what does not come again, o = c - s; what comes again in both is the
same error, if not always as large:

    a = w / (w + o),   w' = w o / (w + o),   sqrt(s') = (1 - a) sqrt(s) + a sqrt(s of the exchange).

As information adds up, the filter, to which errors are independent, comes to V' = s' + w' with the noise
r = 1 / (1 / V' - 1 / V). This holds whatever others tell of the two robots meanwhile. What was told grows old
where the robots move, by as much as what is believed of their relative pose becomes less sure; and it does
not count where they have turned, for then they use other elements, whose gains are others. Range, bearing and
heading are reckoned with apart. A pair's first measurement has r = c.

The filter's own weight of an exchange is 1 - V' / V, less than a where much comes again: the first exchange
of many keeps most of the weight. So its estimate errs by up to 1.32 times the variance V' that it tells, for
300 alike exchanges of which a fifth comes again. Errors of pairs that share a robot are taken as independent,
though they share its elements: of ranges measured by, or to, one robot they correlate by about .15.
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
_NOTHING_NEW = 1e-8
"""The share of a measurement's information below which something does not count."""
_DIRECTIONS, _TOLD, _VARIANCE, _LASTING = 0, 1, 2, 3
"""Rows of what is remembered of a pair: directions of light, 1 / V, variances that were predicted, s."""


@inlined
def inflate_noise(
    measurements: MeasurementColumns,
    k: int,
    belief: BeliefArrays,
    pose: FloatArray,
    predicted: FloatArray,
    noise: FloatArray,
) -> None:
    """Enlarge the noise (3, 3) of a measurement that tells again what its pair has told before.

    Args:
        measurements: (m,).
        k: Which.
        belief: With what pairs have told.
        pose: (2, 3) of observer and target in `map`, as believed.
        predicted: (3,) variances of the prediction, in the value's coordinates.
        noise: (3, 3) covariance of the measurement, changed.
    """
    place = _place(measurements, k, belief)
    if place < 0 or belief.pair_robot[measurements.observer[k], place] != measurements.target[k]:
        return
    told = _told(belief, (measurements.observer[k], place), pose, predicted)
    known = belief.pair_history[measurements.observer[k], place]
    scale = (
        _scale(measurements, k, 0, told[0], known),
        _scale(measurements, k, 1, told[1], known),
        _scale(measurements, k, 2, told[2], known),
    )
    for i in range(3):
        for j in range(3):
            noise[i, j] *= scale[i] * scale[j]


@inlined
def _scale(measurements: MeasurementColumns, k: int, i: int, told: float, known: FloatArray) -> float:
    """By what factor the standard deviation to use component i with exceeds that of the measurement."""
    c = measurements.covariance[k, i, i]
    if told * c < _NOTHING_NEW:
        return 1.0
    lasting, rest = _mean(measurements, k, i, told, known)
    return 1.0 / math.sqrt(max(c / (lasting + rest) - c * told, _NOTHING_NEW))


@inlined
def _mean(
    measurements: MeasurementColumns, k: int, i: int, told: float, known: FloatArray
) -> tuple[float, float]:
    """The variances s' and w' of component i in the mean of what was told and measurement k."""
    c = measurements.covariance[k, i, i]
    again = min(measurements.systematic_share[k, i], 1.0) * c
    own = c - again
    if told * c < _NOTHING_NEW:
        return again, own
    rest = max(1.0 / told - known[_LASTING, i], 0.0)
    weight = rest / (rest + own) if rest > 0.0 else 0.0
    root = (1.0 - weight) * math.sqrt(known[_LASTING, i]) + weight * math.sqrt(again)
    return root * root, weight * own


@compiled
def record_pair(
    measurements: MeasurementColumns,
    k: int,
    belief: BeliefArrays,
    pose: FloatArray,
    predicted: FloatArray,
    noise: FloatArray,
) -> None:
    """Record that a measurement was used with this noise; arguments as `inflate_noise` left them."""
    place = _place(measurements, k, belief)
    if place < 0:
        return
    observer, told, lasting = measurements.observer[k], np.zeros(3), np.empty(3)
    known = belief.pair_history[observer, place]
    if belief.pair_robot[observer, place] == measurements.target[k]:
        told[0], told[1], told[2] = _told(belief, (observer, place), pose, predicted)
    for i in range(3):
        lasting[i] = _mean(measurements, k, i, told[i], known)[0]
        told[i] += 1.0 / noise[i, i]
        predicted[i] *= noise[i, i] / (predicted[i] + noise[i, i])
    arrival, departure = _directions(pose)
    _keep(measurements, k, belief, place, (arrival, departure), (told, predicted, lasting))


@compiled
def record_constraint(measurements: MeasurementColumns, k: int, belief: BeliefArrays) -> None:
    """Record that a measurement may locate a robot, which then errs as the measurement does."""
    place = _place(measurements, k, belief)
    if place >= 0:
        told, variance, lasting = np.empty(3), np.empty(3), np.empty(3)
        for i in range(3):
            variance[i] = measurements.covariance[k, i, i]
            told[i] = 1.0 / variance[i]
            lasting[i] = measurements.systematic_share[k, i] * variance[i]
        bearing, heading = measurements.value[k, 1], measurements.value[k, 2]
        _keep(
            measurements, k, belief, place, (bearing, bearing - heading + math.pi), (told, variance, lasting)
        )


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
def _directions(pose: FloatArray) -> tuple[float, float]:
    """From where light arrives at the observer, and where it departs to from the target, in their frames.

    Both as believed (2, 3): what is measured scatters, and has now and then the wrong one of two solutions.
    """
    dx, dy = pose[1, 0] - pose[0, 0], pose[1, 1] - pose[0, 1]
    return math.atan2(dy, dx) - pose[0, 2], math.atan2(-dy, -dx) - pose[1, 2]


@inlined
def _told(
    belief: BeliefArrays, pair: tuple[int, int], pose: FloatArray, predicted: FloatArray
) -> tuple[float, float, float]:
    """What a pair has told of range, bearing and heading with the same elements, and is not old."""
    known = belief.pair_history[pair[0], pair[1]]
    arrival, departure = _directions(pose)
    arrival = wrap(arrival - known[_DIRECTIONS, 0]) / _FORGOTTEN
    departure = wrap(departure - known[_DIRECTIONS, 1]) / _FORGOTTEN
    sensors, emitters = math.exp(-0.5 * arrival * arrival), math.exp(-0.5 * departure * departure)
    both = 0.5 * (sensors + emitters)
    return (
        known[_TOLD, 0] * both * min(known[_VARIANCE, 0] / predicted[0], 1.0),
        known[_TOLD, 1] * sensors * min(known[_VARIANCE, 1] / predicted[1], 1.0),  # of the sensors alone
        known[_TOLD, 2] * both * min(known[_VARIANCE, 2] / predicted[2], 1.0),
    )


@compiled
def _keep(
    measurements: MeasurementColumns,
    k: int,
    belief: BeliefArrays,
    place: int,
    directions: tuple[float, float],
    content: tuple[FloatArray, FloatArray, FloatArray],
) -> None:
    """Write what is remembered of a pair: directions, and the rows that follow them."""
    observer = measurements.observer[k]
    belief.pair_robot[observer, place] = measurements.target[k]
    belief.pair_stamp_ns[observer, place] = measurements.stamp_ns[k]
    known = belief.pair_history[observer, place]
    known[_DIRECTIONS, 0], known[_DIRECTIONS, 1] = directions
    for i in range(3):
        known[_TOLD, i], known[_VARIANCE, i], known[_LASTING, i] = content[0][i], content[1][i], content[2][i]
