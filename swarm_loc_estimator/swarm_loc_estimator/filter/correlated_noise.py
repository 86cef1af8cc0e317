"""Correlated errors of repeated measurements by one pair of robots.

An infrared exchange errs by the elements' unknown gains much more than by noise, and those are the same the
next time. So of the variance c of a measurement a part s = b c comes again, and n alike exchanges of a pair
can tell no more than their mean does, of the variance V = s + w, w = (c - s) / n. Another exchange takes part
in this mean with the weight that is best for what does not come again, o = c - s; what comes again in both is
the same error, if not always as large:

    a = w / (w + o),   w' = w o / (w + o),   sqrt(s') = (1 - a) sqrt(s) + a sqrt(s of the exchange).

The filter, to which errors are independent, is to know what the mean z' tells, and nothing twice. It has been
told z before with the information L, and what the exchange adds to that is

    the information V'^-1 - L   of the value   z' + (V'^-1 - L)^-1 L (z' - z).

This holds whatever others tell of the two robots meanwhile; but it is linearised about a belief that errs
most at first, when pairs tell most. So the noise r is enlarged where a variance e was expected that is not
small beside it, by e^2 / (e + r): what is not told now, the next exchange tells. For the same reason a
measurement counts by two thirds when it locates a robot.

Where the robots have moved, which odometry knows but roughly, a new mean begins. What was told before grows
old, by as much as what is believed of their relative pose becomes less sure; and it does not count where they
have turned, for then they use other elements, whose gains are others. Range, bearing and heading grow old
apart. Errors of pairs that share a robot are taken as independent, though they share its elements: of ranges
measured by, or to, one robot they correlate by about .15.
"""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.common.se2_scalar import between, composed, wrap
from swarm_loc_estimator.common.small_matrix import assign, assign_matrix, cholesky3
from swarm_loc_estimator.filter.belief import BeliefArrays
from swarm_loc_estimator.filter.measurement_model import MeasurementArray, MeasurementColumns
from swarm_loc_estimator.odometry.look_up import OdometrySample

PAIR_ROWS = 10
"""Rows of three numbers that are remembered of a pair."""
_MEAN, _OBSERVER, _TARGET, _TOLD, _VARIANCE, _OWN, _LASTING, _NOISE = 0, 1, 2, 3, 6, 7, 8, 9
"""The mean z; where both robots were on their tracks; the rows of L; the variances of their relative pose
that were left in the belief; w; s; the variances that the two tracks had gathered, and nothing."""
_FORGOTTEN = 0.5
"""After a turn of so much, errors have a correlation of exp(-1/2) with those before [rad]."""
_AT_FIRST = 1.5
"""By so much the variances of a measurement are enlarged that locates a robot."""
_STILL = 1e-4
"""Robots stand whose tracks have gathered a smaller standard deviation [m, rad]."""
_NOTHING_NEW = 1e-8
"""The share of a measurement's information below which something does not count."""


def at_first(measurement: MeasurementArray) -> MeasurementArray:
    """A measurement (1,) as it counts when it locates a robot: by two thirds where errors come again."""
    if not (measurement["systematic_share"] > 0.0).any():
        return measurement
    wider: MeasurementArray = measurement.copy()
    wider["covariance"] *= _AT_FIRST
    return wider


@inlined_njit
def use_mean(
    measurements: MeasurementColumns,
    k: int,
    belief: BeliefArrays,
    expected: tuple[FloatArray, FloatArray, FloatArray],
    innovation: FloatArray,
    noise: FloatArray,
    pair: FloatArray,
) -> None:
    """Turn a measurement of a pair into what it adds to what the pair has told before.

    Args:
        measurements: (m,).
        k: Which.
        belief: With what pairs have told.
        expected: Poses (2, 3) of observer and target in `map`, the value (3,) predicted from them, and its
            variances (3,).
        innovation: (3,) measured minus predicted, changed.
        noise: (3, 3) covariance of the measurement, changed.
        pair: (PAIR_ROWS, 3) written: what to remember when it is used.
    """
    place = _place(measurements, k, belief)
    if place < 0:
        return
    observer, target = measurements.observer[k], measurements.target[k]
    poses, predicted, variances = expected
    _write_track(belief.transform[observer], poses[0], pair[_OBSERVER])
    _write_track(belief.transform[target], poses[1], pair[_TARGET])
    pair[_NOISE, 0] = _gathered(belief.preintegrated_covariance[observer])
    pair[_NOISE, 1] = _gathered(belief.preintegrated_covariance[target])
    for i in range(3):
        again = min(measurements.systematic_share[k, i], 1.0) * measurements.covariance[k, i, i]
        pair[_OWN, i], pair[_LASTING, i] = max(noise[i, i] - again, 0.0), again
        pair[_MEAN, i] = predicted[i] + innovation[i]
        pair[_VARIANCE, i] = max(variances[i], 0.0)  # a difference, which rounding may have made less
    if belief.pair_robot[observer, place] == target:
        _join(belief.pair_history[observer, place], predicted, innovation, noise, pair)
    else:
        _begin(noise, pair)
    for i in range(3):
        pair[_VARIANCE, i] *= noise[i, i] / (variances[i] + noise[i, i])


@cached_njit
def _begin(noise: FloatArray, pair: FloatArray) -> None:
    """A pair's first measurement, of covariance `noise` (3, 3), is all that the pair has told."""
    _postpone(noise, pair)
    assign_matrix(pair[_TOLD : _TOLD + 3], _inverse(noise))


@cached_njit
def _join(
    known: FloatArray, predicted: FloatArray, innovation: FloatArray, noise: FloatArray, pair: FloatArray
) -> None:
    """Let a measurement join the mean that is known of its pair, see `use_mean`."""
    carried, stand = _carried(known, pair), _stand(known, pair)
    left, told = _left(known, carried, pair[_VARIANCE]), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            told[i, j] = known[_TOLD + i, j] * math.sqrt(left[i] * left[j])
    before = _inverse(told)
    step, weights = np.zeros(3), 0.0
    for i in range(3):
        variance = (known[_LASTING, i] + known[_OWN, i]) / left[i] if stand else before[i, i]
        weight = _take_part(known, pair, i, variance)
        weights += weight
        if stand:
            step[i] = weight * _difference(i, pair[_MEAN, i], carried[i])
            pair[_MEAN, i] = carried[i] + step[i]
            innovation[i] = _difference(i, pair[_MEAN, i], predicted[i])
    assign_matrix(noise, _noise_beside(told, _covariance(before, noise, weights / 3.0, pair)))
    _postpone(noise, pair)
    step = np.dot(noise, np.dot(told, step))
    told += _inverse(noise)
    for i in range(3):
        innovation[i] += step[i]
        for j in range(3):
            pair[_TOLD + i, j] = 0.5 * (told[i, j] + told[j, i])


@cached_njit
def _take_part(known: FloatArray, pair: FloatArray, i: int, variance: float) -> float:
    """The weight of a measurement in the mean of component i, of such variance; write w' and s'."""
    lasting, own = known[_LASTING, i], pair[_OWN, i]
    rest = max(variance - lasting, 0.0)
    weight = rest / (rest + own) if rest > _NOTHING_NEW * variance else 0.0
    root = (1.0 - weight) * math.sqrt(lasting) + weight * math.sqrt(pair[_LASTING, i])
    pair[_OWN, i], pair[_LASTING, i] = weight * own, root * root
    return weight


@cached_njit
def _difference(i: int, value: float, other: float) -> float:
    """By what component i, a range or an angle, differs from another one."""
    return wrap(value - other) if i > 0 else value - other


@cached_njit
def _covariance(before: FloatArray, now: FloatArray, weight: float, pair: FloatArray) -> FloatArray:
    """The covariance (3, 3) of a pair's mean: its variances w + s, and the mean of the correlations.

    Args:
        before: (3, 3) covariance of the mean before.
        now: (3, 3) covariance of the measurement that joined it.
        weight: Of the measurement.
        pair: (PAIR_ROWS, 3) with w and s.
    """
    covariance = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            correlation = (1.0 - weight) * before[i, j] / math.sqrt(before[i, i] * before[j, j])
            correlation += weight * now[i, j] / math.sqrt(now[i, i] * now[j, j])
            variances = (pair[_OWN, i] + pair[_LASTING, i]) * (pair[_OWN, j] + pair[_LASTING, j])
            covariance[i, j] = correlation * math.sqrt(variances)
    return covariance


@cached_njit
def _postpone(noise: FloatArray, pair: FloatArray) -> None:
    """Enlarge the noise (3, 3) of what a pair tells where the variances expected are not small beside it."""
    for i in range(3):
        expected = pair[_VARIANCE, i]
        noise[i, i] += expected * expected / (expected + noise[i, i])


@cached_njit
def _noise_beside(told: FloatArray, covariance: FloatArray) -> FloatArray:
    """The noise (3, 3) of what adds to an information (3, 3) until all has a covariance (3, 3)."""
    factor = cholesky3(covariance)
    new, directions = np.linalg.eigh(np.eye(3) - np.dot(factor.T, np.dot(told, factor)))
    root = np.dot(factor, directions) / np.sqrt(np.maximum(new, _NOTHING_NEW))
    noise: FloatArray = np.dot(root, root.T)
    return noise


@cached_njit
def _inverse(matrix: FloatArray) -> FloatArray:
    """The inverse of a matrix (3, 3)."""
    inverse = np.empty((3, 3))
    inverse[:] = np.linalg.inv(matrix)
    return inverse


@cached_njit
def _carried(known: FloatArray, pair: FloatArray) -> FloatArray:
    """The mean known of a pair (3,), carried on by odometry to where the two robots are now."""
    distance, bearing, heading = known[_MEAN, 0], known[_MEAN, 1], known[_MEAN, 2]
    o, t = _motion(pair[_OBSERVER], known[_OBSERVER]), _motion(known[_TARGET], pair[_TARGET])
    x, y, theta = composed(
        o[0], o[1], o[2], distance * math.cos(bearing), distance * math.sin(bearing), heading
    )
    x, y, theta = composed(x, y, theta, t[0], t[1], t[2])
    carried = np.empty(3)
    carried[0], carried[1], carried[2] = math.hypot(x, y), math.atan2(y, x), wrap(theta)
    return carried


@cached_njit
def _stand(known: FloatArray, pair: FloatArray) -> bool:
    """Whether neither robot may have moved since the pair was last recorded.

    Where a robot is on its track does not tell: without odometry it may be anywhere.
    """
    gathered = 0.0
    for i in range(2):
        gathered = max(gathered, abs(pair[_NOISE, i] - known[_NOISE, i]))
    return gathered < _STILL * _STILL


@cached_njit
def _motion(start: FloatArray, end: FloatArray) -> tuple[float, float, float]:
    """The pose `end` (3,) seen from the pose `start` (3,)."""
    return between(start[0], start[1], start[2], end[0], end[1], end[2])


@cached_njit
def _left(known: FloatArray, carried: FloatArray, variances: FloatArray) -> FloatArray:
    """What share of what a pair has told is not old (3,), at the variances (3,) that are now expected."""
    arrival = wrap(carried[1] - known[_MEAN, 1]) / _FORGOTTEN
    departure = wrap(carried[1] - carried[2] - known[_MEAN, 1] + known[_MEAN, 2]) / _FORGOTTEN
    sensors, emitters = math.exp(-0.5 * arrival * arrival), math.exp(-0.5 * departure * departure)
    left = np.full(3, 0.5 * (sensors + emitters))
    left[1] = sensors  # a bearing errs by them alone
    for i in range(3):
        if variances[i] > known[_VARIANCE, i]:  # never where both are zero
            left[i] *= known[_VARIANCE, i] / variances[i]
        left[i] = max(left[i], _NOTHING_NEW)
    return left


@cached_njit
def _write_track(transform: FloatArray, pose: FloatArray, out: FloatArray) -> None:
    """Write where on its track (3,) a robot is whose pose (3,) in `map` is given."""
    out[0], out[1], out[2] = between(transform[0], transform[1], transform[2], pose[0], pose[1], pose[2])


@inlined_njit
def _gathered(covariance: FloatArray) -> float:
    """The variance that a track has gathered: the trace of its covariance (3, 3)."""
    return float(covariance[0, 0] + covariance[1, 1] + covariance[2, 2])


@cached_njit
def record_pair(measurements: MeasurementColumns, k: int, belief: BeliefArrays, pair: FloatArray) -> None:
    """Record that a measurement was used, with what `use_mean` has written of its pair (PAIR_ROWS, 3)."""
    place = _place(measurements, k, belief)
    if place >= 0:
        _keep(measurements, k, belief, place, pair)


@cached_njit
def record_constraint(
    measurements: MeasurementColumns, k: int, belief: BeliefArrays, tracks: OdometrySample
) -> None:
    """Record that a measurement may locate a robot, which then errs as the measurement does.

    Args:
        measurements: (m,).
        k: Which.
        belief: Its memory of pairs is changed.
        tracks: (2,) of observer and target.
    """
    place = _place(measurements, k, belief)
    if place < 0:
        return
    pair, noise = np.zeros((PAIR_ROWS, 3)), measurements.covariance[k].copy()
    assign(pair[_MEAN], measurements.value[k])
    assign_matrix(pair[_OBSERVER : _TARGET + 1], tracks.pose)
    pair[_NOISE, 0], pair[_NOISE, 1] = _gathered(tracks.covariance[0]), _gathered(tracks.covariance[1])
    for i in range(3):
        again = min(measurements.systematic_share[k, i], 1.0) * noise[i, i]
        pair[_OWN, i], pair[_LASTING, i] = noise[i, i] - again, again
        pair[_VARIANCE, i] = noise[i, i]
    _begin(noise, pair)
    for i in range(3):
        pair[_VARIANCE, i] = noise[i, i]
    _keep(measurements, k, belief, place, pair)


@inlined_njit
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


@inlined_njit
def _keep(
    measurements: MeasurementColumns, k: int, belief: BeliefArrays, place: int, pair: FloatArray
) -> None:
    """Write what is remembered of the pair of measurement k (PAIR_ROWS, 3)."""
    observer = measurements.observer[k]
    belief.pair_robot[observer, place] = measurements.target[k]
    belief.pair_stamp_ns[observer, place] = measurements.stamp_ns[k]
    assign_matrix(belief.pair_history[observer, place], pair)
