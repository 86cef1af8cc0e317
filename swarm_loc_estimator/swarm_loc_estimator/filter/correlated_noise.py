"""Correlated errors of repeated measurements by one pair of robots, and of absolute fixes of one robot.

The error of an infrared exchange comes from the unknown gains of the elements much more than from noise, and
the gains are the same in the next exchange. So a part s = b c of the variance c of a measurement is
systematic, and n similar exchanges of a pair have only the information of their mean, of the variance V = s +
w with the random part w = (c - s) / n. A further exchange enters the mean with the weight that is optimal for
its random part o = c - s; the systematic parts of mean and exchange are the same error, though not always
equally large:

    a = w / (w + o),   w' = w o / (w + o),   sqrt(s') = (1 - a) sqrt(s) + a sqrt(s of the exchange).

The filter treats errors as independent. It must receive the information of the mean z' and nothing twice. It
has already fused z with the information L, so the exchange adds

    the information V'^-1 - L   of the value   z' + (V'^-1 - L)^-1 L (z' - z).

This holds whatever other measurements of the two robots are fused in between; but it is linearised about an
estimate that is worst at first, when pairs have most information. So the noise r is inflated where the
predicted variance e is not small compared with it, by e^2 / (e + r); the information held back enters with
the next exchange. For the same reason a measurement counts by two thirds when it initializes a robot.

A new mean starts where the robots have moved, because odometry is uncertain. The fused information of the old
mean decays as the predicted variance of their relative pose grows. It does not count after turns, which use
other elements with other gains. Range, bearing and heading decay separately. Errors of pairs that share a
robot are treated as independent, although they share its elements: ranges measured by, or to, one robot have
a correlation of about 0.15.

Fixes of a mapper are estimates that contain the robot's odometry and all earlier scans: what is wrong with
the map is wrong with all of them. With the variance c of a fix, s = b c and the predicted variance p, the
error s is in the prediction already, and the fix improves only the rest p - s, by its random part c - s:

    p' = s + (p - s) (c - s) / (p - s + c - s)   where p > s, else p.

The noise is inflated so that the update has this result, in the directions that diagonalise both covariances.
With b = 0 it stays as it is; with b = 1 the variance becomes c, however many fixes there are, and a fix that
is less sure than the prediction is ignored.

Reported uncertainty of errors that repeat. Those of sightings do while a robot looks from the same place, and
the noise of wheels is the less known the longer nothing has measured a robot. An update leaves the part A of
an error and adds noise: with P0 and P, the covariances before and after, and C, that with the estimated place
of the source, A = I - (P0 - P) (P0 - C)^-T, and the noise is A (P0 - P). So the covariance X beyond the
filter's becomes A X A^T + w A (P0 - P), where w tells how much of the noise repeats: with the share s of the
variance that does, the correlation r by motion, and the share a that updates since the last look have left of
its error, w = 2 s r a / (1 - r a). Poses and gates do not depend on X.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit, norefcount_njit
from swarm_loc_estimator.common.numerics import (
    assign,
    assign_matrix,
    between,
    cholesky3,
    composed,
    factor_numbers,
    wrap,
)
from swarm_loc_estimator.filter.measurements import Measurements
from swarm_loc_estimator.filter.models import ANY_HEADING, has_kernel
from swarm_loc_estimator.filter.sources import RANGE_VALUE, find_link, is_fix, new_link, robot_of, source_of
from swarm_loc_estimator.filter.state import PAIR_ROWS, BeliefArrays, Innovations, covariance_within
from swarm_loc_estimator.odometry.track_arrays import OdometrySample, TrackArrays, look_up_pose

_MEAN, _OBSERVER, _TARGET, _FUSED, _VARIANCE, _RANDOM, _SYSTEMATIC, _NOISE = 0, 1, 2, 3, 6, 7, 8, 9
"""The mean z; the poses of both robots on their tracks; the rows of L; the variances of their relative pose
after the update; w; s; the accumulated variances of the two tracks, and an unused number."""
_DECORRELATION_ANGLE = 0.5  # Turn after which errors have a correlation of exp(-1/2) with those before [rad]
_INITIAL_INFLATION = 1.5  # Factor on the variances of a measurement that initializes a robot
_STATIONARY_SIGMA = 1e-4  # Robots are stationary while their tracks accumulate less [m, rad]
_NEGLIGIBLE = 1e-8  # Share of the information of a measurement that is neglected


def at_initialization(one: Measurements) -> Measurements:
    """A row of measurements with the inflated noise for initialization; fixes are returned unchanged."""
    if one.observer < 0 or not (one.systematic_share > 0.0).any():
        return one
    return one._replace(covariance=one.covariance * _INITIAL_INFLATION)


@inlined_njit
def use_mean(
    measurements: Measurements,
    k: int,
    belief: BeliefArrays,
    poses: FloatArray,
    predicted: FloatArray,
    variances: FloatArray,
    innovation: FloatArray,
    noise: FloatArray,
    pair: FloatArray,
) -> None:
    """Replace measurement k of a pair by the information that it adds to the pair's fused information.

    From poses (2, 3) in `map` the value (3,) is predicted with variances (3,). Innovation (3,) and noise (3,
    3) are changed, and the memory of the pair (PAIR_ROWS, 3) if the measurement is used is written.
    """
    observer, target = measurements.observer[k], measurements.target[k]
    place = _place(belief, observer, target, measurements.systematic_share[k])
    if place < 0:
        return
    for side, row in enumerate((_OBSERVER, _TARGET)):  # the poses on the tracks, and their noise
        robot = observer if side == 0 else target
        t, pose = belief.transform[robot], poses[side]
        pair[row, 0], pair[row, 1], pair[row, 2] = between(t[0], t[1], t[2], pose[0], pose[1], pose[2])
        pair[_NOISE, side] = _gathered(belief.preintegrated_covariance[robot])
    for i in range(3):
        again = min(measurements.systematic_share[k, i], 1.0) * measurements.covariance[k, i, i]
        pair[_RANDOM, i], pair[_SYSTEMATIC, i] = max(noise[i, i] - again, 0.0), again
        pair[_MEAN, i] = predicted[i] + innovation[i]
        pair[_VARIANCE, i] = max(variances[i], 0.0)  # rounding may make the difference negative
        if i > 0:  # else an angle that was forgotten for long would be relearned over many turns
            pair[_VARIANCE, i] = min(pair[_VARIANCE, i], ANY_HEADING)
    if belief.pair_robot[observer, place] == target:
        _join(belief.pair_history[observer, place], predicted, innovation, noise, pair)
    else:
        _start_mean(noise, pair)
    for i in range(3):
        pair[_VARIANCE, i] *= noise[i, i] / (variances[i] + noise[i, i])


@cached_njit
def inflate_fix(shares: FloatArray, predicted_covariance: FloatArray, noise: FloatArray) -> None:
    """Inflate the noise (3, 3) of a fix so that it adds no more than what earlier ones with its errors lack.

    `shares` (3,) are the systematic shares of its variances.
    """
    root = cholesky3(noise)
    inverse = _inverse(root)
    ratio, axes = np.linalg.eigh(np.dot(inverse, np.dot(predicted_covariance, inverse.T)))
    basis = np.dot(root, np.ascontiguousarray(axes))
    scaled = np.empty((3, 3))
    for i in range(3):
        share = 0.0
        for j in range(3):
            share += shares[j] * axes[j, i] * axes[j, i]
        rest, new = ratio[i] - share, 0.0
        if rest > 0.0:
            after = share + rest * (1.0 - share) / (rest + 1.0 - share)
            new = 1.0 / after - 1.0 / ratio[i]
        for j in range(3):
            scaled[j, i] = basis[j, i] / max(new, _NEGLIGIBLE)
    assign_matrix(noise, np.dot(scaled, basis.T))


@cached_njit
def _start_mean(noise: FloatArray, pair: FloatArray) -> None:
    """Start a mean with the first measurement of a pair, of covariance `noise` (3, 3)."""
    _hold_back(noise, pair)
    assign_matrix(pair[_FUSED : _FUSED + 3], _inverse(noise))


@cached_njit
def _join(
    known: FloatArray, predicted: FloatArray, innovation: FloatArray, noise: FloatArray, pair: FloatArray
) -> None:
    """Let a measurement join the mean of its pair, see `use_mean`."""
    # Whether neither robot can have moved since: without odometry, the pose on the track is no evidence.
    gathered = max(abs(pair[_NOISE, 0] - known[_NOISE, 0]), abs(pair[_NOISE, 1] - known[_NOISE, 1]))
    stand = gathered < _STATIONARY_SIGMA * _STATIONARY_SIGMA
    # The mean before, carried here, and how much of its information is left.
    carried = _carried(known, pair)
    left, fused = _remaining(known, carried, pair[_VARIANCE]), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            fused[i, j] = known[_FUSED + i, j] * math.sqrt(left[i] * left[j])
    # The weight of the measurement in the mean of each component, w' and s'.
    before = _inverse(fused)
    step, weights = np.zeros(3), 0.0
    for i in range(3):
        systematic, own = known[_SYSTEMATIC, i], pair[_RANDOM, i]
        variance = (systematic + known[_RANDOM, i]) / left[i] if stand else before[i, i]
        rest = max(variance - systematic, 0.0)
        weight = rest / (rest + own) if rest > _NEGLIGIBLE * variance else 0.0
        root = (1.0 - weight) * math.sqrt(systematic) + weight * math.sqrt(pair[_SYSTEMATIC, i])
        pair[_RANDOM, i], pair[_SYSTEMATIC, i] = weight * own, root * root
        weights += weight
        if stand:
            step[i] = weight * _difference(i, pair[_MEAN, i], carried[i])
            pair[_MEAN, i] = carried[i] + step[i]
            innovation[i] = _difference(i, pair[_MEAN, i], predicted[i])
    # The noise whose information, added to what was fused, gives the covariance of the mean; what is fused
    # then.
    factor = cholesky3(_covariance(before, noise, weights / 3.0, pair))
    new, directions = np.linalg.eigh(np.eye(3) - np.dot(factor.T, np.dot(fused, factor)))
    spread = np.dot(factor, directions) / np.sqrt(np.maximum(new, _NEGLIGIBLE))
    assign_matrix(noise, np.dot(spread, spread.T))
    _hold_back(noise, pair)
    step = np.dot(noise, np.dot(fused, step))
    fused += _inverse(noise)
    for i in range(3):
        innovation[i] += step[i]
        for j in range(3):
            pair[_FUSED + i, j] = 0.5 * (fused[i, j] + fused[j, i])


@cached_njit
def _difference(i: int, value: float, other: float) -> float:
    """Difference of component i, a range or an angle."""
    return wrap(value - other) if i > 0 else value - other


@cached_njit
def _covariance(before: FloatArray, now: FloatArray, weight: float, pair: FloatArray) -> FloatArray:
    """Covariance (3, 3) of the mean of a pair: variances w + s, and the weighted mean of the correlations."""
    covariance = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            correlation = (1.0 - weight) * before[i, j] / math.sqrt(before[i, i] * before[j, j])
            correlation += weight * now[i, j] / math.sqrt(now[i, i] * now[j, j])
            variances = (pair[_RANDOM, i] + pair[_SYSTEMATIC, i]) * (pair[_RANDOM, j] + pair[_SYSTEMATIC, j])
            covariance[i, j] = correlation * math.sqrt(variances)
    return covariance


@cached_njit
def _hold_back(noise: FloatArray, pair: FloatArray) -> None:
    """Inflate the noise (3, 3) of a pair where the predicted variances are not small compared with it."""
    for i in range(3):
        expected = pair[_VARIANCE, i]
        noise[i, i] += expected * expected / (expected + noise[i, i])


@cached_njit
def _inverse(matrix: FloatArray) -> FloatArray:
    """Inverse (3, 3), contiguous."""
    inverse = np.empty((3, 3))
    inverse[:] = np.linalg.inv(matrix)
    return inverse


@cached_njit
def _carried(known: FloatArray, pair: FloatArray) -> FloatArray:
    """The mean of a pair (3,), predicted by odometry to the present poses of the two robots."""
    a, b, c, d = pair[_OBSERVER], known[_OBSERVER], known[_TARGET], pair[_TARGET]
    x, y, theta = between(a[0], a[1], a[2], b[0], b[1], b[2])
    distance, bearing = known[_MEAN, 0], known[_MEAN, 1]
    ahead, aside = distance * math.cos(bearing), distance * math.sin(bearing)
    x, y, theta = composed(x, y, theta, ahead, aside, known[_MEAN, 2])
    moved = between(c[0], c[1], c[2], d[0], d[1], d[2])
    x, y, theta = composed(x, y, theta, moved[0], moved[1], moved[2])
    carried = np.empty(3)
    carried[0], carried[1], carried[2] = math.hypot(x, y), math.atan2(y, x), wrap(theta)
    return carried


@cached_njit
def _remaining(known: FloatArray, carried: FloatArray, variances: FloatArray) -> FloatArray:
    """Shares (3,) of the fused information that still count, at the variances (3,) predicted now."""
    arrival = wrap(carried[1] - known[_MEAN, 1]) / _DECORRELATION_ANGLE
    departure = wrap(carried[1] - carried[2] - known[_MEAN, 1] + known[_MEAN, 2]) / _DECORRELATION_ANGLE
    sensors, emitters = math.exp(-0.5 * arrival * arrival), math.exp(-0.5 * departure * departure)
    left = np.full(3, 0.5 * (sensors + emitters))
    left[1] = sensors  # bearings depend on sensors only
    for i in range(3):
        if variances[i] > known[_VARIANCE, i]:  # never where both are zero
            left[i] *= known[_VARIANCE, i] / variances[i]
        left[i] = max(left[i], _NEGLIGIBLE)
    return left


@inlined_njit
def _gathered(covariance: FloatArray) -> float:
    """Accumulated variance of a track: the trace of its covariance (3, 3)."""
    return float(covariance[0, 0] + covariance[1, 1] + covariance[2, 2])


@norefcount_njit
def record_pair(measurements: Measurements, k: int, belief: BeliefArrays, pair: FloatArray) -> None:
    """Store the memory of a pair (PAIR_ROWS, 3) that `use_mean` has written, once its measurement is used."""
    observer, target = measurements.observer[k], measurements.target[k]
    place = _place(belief, observer, target, measurements.systematic_share[k])
    if place >= 0:
        _keep(belief, observer, target, measurements.stamp_ns[k], place, pair)


@cached_njit
def record_constraint(one: Measurements, belief: BeliefArrays, tracks: OdometrySample) -> None:
    """Store a row of measurements that may initialize a robot; `tracks` (2,) are of observer and target."""
    observer: int = one.observer  # type: ignore[assignment]  # of a row, these are scalars
    target: int = one.target  # type: ignore[assignment]
    place = _place(belief, observer, target, one.systematic_share)
    if place < 0:
        return
    pair, noise = np.zeros((PAIR_ROWS, 3)), one.covariance.copy()
    assign(pair[_MEAN], one.value)
    assign_matrix(pair[_OBSERVER : _TARGET + 1], tracks.pose)
    pair[_NOISE, 0], pair[_NOISE, 1] = _gathered(tracks.covariance[0]), _gathered(tracks.covariance[1])
    for i in range(3):
        again = min(one.systematic_share[i], 1.0) * noise[i, i]
        pair[_RANDOM, i], pair[_SYSTEMATIC, i] = noise[i, i] - again, again
        pair[_VARIANCE, i] = noise[i, i]
    _start_mean(noise, pair)
    for i in range(3):
        pair[_VARIANCE, i] = noise[i, i]
    _keep(belief, observer, target, one.stamp_ns, place, pair)  # type: ignore[arg-type]


@inlined_njit
def _place(belief: BeliefArrays, observer: int, target: int, share: FloatArray) -> int:
    """Slot of a pair, or of the oldest pair; -1: no pair, or no systematic errors."""
    places, best = belief.pair_robot.shape[1], 0
    if places == 0 or observer < 0 or target < 0:
        return -1
    if not max(share[0], share[1], share[2]) > 0.0:
        return -1
    robots, stamps_ns = belief.pair_robot[observer], belief.pair_stamp_ns[observer]
    for place in range(places):
        if robots[place] == target:
            return place
        if stamps_ns[place] < stamps_ns[best]:
            best = place
    return best


@inlined_njit
def _keep(
    belief: BeliefArrays, observer: int, target: int, stamp_ns: int, place: int, pair: FloatArray
) -> None:
    """Write the memory of a pair (PAIR_ROWS, 3)."""
    belief.pair_robot[observer, place] = target
    belief.pair_stamp_ns[observer, place] = stamp_ns
    assign_matrix(belief.pair_history[observer, place], pair)


def without_repeats(measurements: Measurements) -> list[slice]:
    """Split measurements (m,) into parts with at most one correlated measurement per pair or robot."""
    edges, seen = [0], set[tuple[int, int]]()
    comes_again: BoolArray = measurements.systematic_share.max(axis=1) > 0.0
    if comes_again.any():
        pairs = zip(measurements.observer.tolist(), measurements.target.tolist(), strict=True)
        for k, pair in itertools.compress(enumerate(pairs), comes_again):
            if pair in seen:
                edges.append(k)
                seen.clear()
            seen.add(pair)
    return [slice(begin, end) for begin, end in itertools.pairwise([*edges, measurements.size])]


# Systematic; tuned on MRCLAM set 1, where 80 % of the variances of sightings repeat.
REPEATED = 0.5  # Share of the variance of a sighting that repeats at the same place
_LEAST_OWN = 1e-3  # Least share of a standard deviation that the place of a source does not have, too
LENGTH_M = 0.03  # Motion of one end, as the other sees it, after which its correlation is 1/e


@cached_njit
def note_update(
    measurements: Measurements,
    k: int,
    belief: BeliefArrays,
    before: FloatArray,
    correction: FloatArray,
    work: Innovations,
) -> None:
    """Update the excess covariances of the robots of measurement k, which was used, as is row 0 of `work`.

    `before` (2, 3, 3) are the covariances of observer and target before the correction (n,). What an update
    by one number leaves follows from its gain, the correction over the innovation.
    """
    sides, innovation = (measurements.observer[k], measurements.target[k]), work.innovation[0, 0]
    left, added = np.zeros((2, 3, 3)), np.zeros((2, 3, 3))
    by_gain = not has_kernel(measurements, k)
    if by_gain and innovation == 0.0:
        return
    for i in range(2):
        if sides[i] >= 0 and by_gain:
            gain = correction[3 * sides[i] : 3 * sides[i] + 3] / innovation
            left[i] = np.eye(3) - np.outer(gain, work.jacobian[0, 0, 3 * i : 3 * i + 3])
            _count_learned(belief, sides[i], left[i])
        elif sides[i] >= 0:
            own = before[i].copy()
            _take_off_shared(measurements, k, belief, work.cross_covariance[0], 1.0, own)
            _learn(belief, sides[i], before[i], own, left[i], added[i])
    weight = _weight(measurements, k, belief, work.place[0], work.share[0])
    for i in range(2):
        if sides[i] >= 0:
            _carry_excess(belief.sources.excess[sides[i]], left[i], added[i], weight)


@cached_njit
def note_batch(
    measurements: Measurements, belief: BeliefArrays, before: FloatArray, work: Innovations
) -> None:
    """Do so for the accepted ones of measurements (m,) fused together; `before` (N, 3, 3) is of robots."""
    used, cross = work.accepted, work.cross_covariance
    total, count = np.zeros(before.shape[0]), np.zeros(before.shape[0])
    own, left, added = before.copy(), np.zeros(before.shape), np.zeros(before.shape)
    for k in range(used.size):
        for side in (measurements.observer[k], measurements.target[k]):
            if used[k] and side >= 0:
                count[side] += 1.0
    for k in range(used.size):
        for side in (measurements.observer[k], measurements.target[k]):
            if used[k] and side >= 0:
                _take_off_shared(measurements, k, belief, cross[k], 1.0 / count[side], own[side])
    for robot in range(count.size):
        if count[robot] > 0.0:
            _learn(belief, robot, before[robot], own[robot], left[robot], added[robot])
    for k in range(used.size):
        if used[k]:
            weight = _weight(measurements, k, belief, work.place[k], work.share[k])
            for side in (measurements.observer[k], measurements.target[k]):
                if side >= 0:
                    total[side] += weight
    for robot in range(count.size):
        if count[robot] > 0.0:
            weight = total[robot] / count[robot]
            _carry_excess(belief.sources.excess[robot], left[robot], added[robot], weight)


@inlined_njit
def _take_off_shared(
    measurements: Measurements, k: int, belief: BeliefArrays, cross: FloatArray, share: float, own: FloatArray
) -> None:
    """Take a share of a robot's covariance with the estimated place of what it measures off `own` (3, 3).

    Not with an anchor, whose errors are of another kind.
    """
    body, table = max(measurements.landmark[k], measurements.mount[k]), belief.table
    is_anchor = table.first_anchor <= body < table.first_camera
    if body >= 0 and not is_anchor and table.survey_column[body] >= 0:
        sees = measurements.observer[k] >= 0
        for i in range(3):
            for j in range(3):
                own[i, j] -= share * (cross[i, j] if sees else cross[j, i])


@cached_njit
def _learn(
    belief: BeliefArrays, robot: int, before: FloatArray, own: FloatArray, left: FloatArray, added: FloatArray
) -> None:
    """Write what an update leaves of errors (3, 3), A, and the noise that it adds (3, 3), A (P0 - P).

    A is I - K H, where K = (P0 - C) H^T S^-1 and K S K^T = P0 - P; without C, of a known place, P P0^-1.
    `before` (3, 3) is P0, `own` (3, 3) P0 - C.
    """
    difference = before.copy()
    for i in range(3):
        for j in range(3):
            difference[i, j] -= covariance_within(belief, 3 * robot, i, j)
    first, _, second, _, _, third = factor_numbers(0.5 * (own + own.T))
    one, _, two, _, _, three = factor_numbers(before)
    if not (first > _LEAST_OWN * one and second > _LEAST_OWN * two and third > _LEAST_OWN * three):
        own = before  # rounding errors, or NaN
    cofactors = np.empty((3, 3))
    determinant = _write_cofactors(own, cofactors)  # the inverse of own^T is their matrix over it
    for i in range(3):
        for j in range(3):
            left[i, j] = 1.0 if i == j else 0.0
            for r in range(3):
                left[i, j] -= difference[i, r] * cofactors[r, j] / determinant
    added[:] = np.dot(left, difference)
    _count_learned(belief, robot, left)


@cached_njit
def _count_learned(belief: BeliefArrays, robot: int, left: FloatArray) -> None:
    """Add the logarithm by which an update reduces a robot's errors to the part `left` (3, 3) of them."""
    cofactors = np.empty((3, 3))
    learned = -math.log(max(_write_cofactors(left, cofactors), 1e-300)) / 3.0
    if 0.0 < learned < math.inf:  # False for NaN
        belief.sources.learned[robot] += learned


@inlined_njit
def _write_cofactors(matrix: FloatArray, out: FloatArray) -> float:
    """Write the cofactors (3, 3) of a matrix (3, 3), return its determinant; faster than LAPACK."""
    for i in range(3):
        p, q = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            r, s = (j + 1) % 3, (j + 2) % 3
            out[i, j] = matrix[p, r] * matrix[q, s] - matrix[p, s] * matrix[q, r]
    determinant: float = matrix[0, 0] * out[0, 0] + matrix[0, 1] * out[0, 1] + matrix[0, 2] * out[0, 2]
    return determinant


@norefcount_njit
def _weight(
    measurements: Measurements, k: int, belief: BeliefArrays, seen: FloatArray, share: float
) -> float:
    """Twice the correlation of the error of measurement k with those of its link before, as they are left.

    Times the share by which it counted, since its noise was divided by that. Ranges have it in their noise.
    """
    place, state, robot = find_link(measurements, k, belief), belief.sources, robot_of(measurements, k)
    if place < 0 or not has_kernel(measurements, k):
        return 0.0
    last = state.last_look[robot, place]
    moved, since = math.hypot(seen[0] - last[0], seen[1] - last[1]), last[2] - state.learned[robot]
    last[0], last[1], last[2] = seen[0], seen[1], state.learned[robot]
    alone = is_fix(measurements, k) or measurements.systematic_share[k, 0] > 0.0
    if alone or not moved >= 0.0:
        return 0.0
    left = math.exp(since - moved / LENGTH_M)
    return 2.0 * share * REPEATED * left / max(1.0 - left, 1e-3)


@cached_njit
def _carry_excess(excess: FloatArray, left: FloatArray, added: FloatArray, weight: float) -> None:
    """X <- A X A^T + w A (P0 - P)."""
    new = np.dot(np.dot(left, excess), left.T) + weight * added
    if math.isfinite(np.sum(new)):
        excess[:] = 0.5 * (new + new.T)


# Of ranges to twelve real anchors (LIAS-CUHKSZ, libRSF) 30 to 60 % of the variance repeat while the range
# changes by 0.15 m, and 1/e of that at 0.3 m, which takes half a metre of driving in any direction.
RADIO_LENGTH_M = 0.5  # Motion of an antenna after which the correlation of errors is 1/e
_LEAST_REPEATED, _MOST_REPEATED, _LEARNING, _LARGEST = 0.3, 0.9, 1.0 / 64.0, 9.0
"""Least and largest share of their variance that repeats, and weight and limit of a squared difference."""
_STILL_M, _NEAR_M = 0.03, 0.15  # Antennas that have moved less stand, or see almost the same errors [m]
_LEAST_NEWS = 1e-6  # Least part of the information of a range that is new
_SPENT, _PLACES, _WHITE, _INNOVATION, _VARIANCE = 1, 2, 7, 8, 9
"""What else `last_look` has of two radios, see `SourceArrays`."""


@cached_njit
def noise_of_range(
    measurements: Measurements,
    k: int,
    belief: BeliefArrays,
    tracks: TrackArrays,
    variance: float,
    innovation: float,
    accepted: bool,
) -> float:
    """The variance with which range k has just the information that its link does not have yet.

    The errors of two radios depend on where they are. Differences of ranges that follow each other show the
    noise of each; what the description allows beyond it repeats. With the share s of the variance that does,
    n looks from the same places have the information n / (1 + (n - 1) s) of one. It is spent until the
    antennas move, as odometry alone tells: of errors whose correlation is 1/e at a length, two lengths are
    one look. What the noise of odometry has made of it since then does not count. `variance` is that of the
    predicted range [m^2].
    """
    robot, source = robot_of(measurements, k), source_of(measurements, k, belief)
    described: float = measurements.covariance[k, 0, 0]
    if robot < 0 or source < 0:
        return described
    place = find_link(measurements, k, belief)
    if place < 0:
        place = new_link(belief.sources, robot, source)
    last = belief.sources.last_look[robot, place]
    # How far have the antennas moved since what is known of them?
    places, pose, moved = np.zeros(4), np.zeros(3), 0.0
    for side in range(2):
        end = measurements.observer[k] if side == 0 else measurements.target[k]
        antenna = measurements.sensor[k] if side == 0 else measurements.marker[k]
        pose.fill(0.0)
        if end >= 0:
            look_up_pose(tracks, end, measurements.stamp_ns[k], pose)
        x, y, _ = composed(pose[0], pose[1], pose[2], antenna[0], antenna[1], 0.0)
        places[2 * side], places[2 * side + 1] = x, y
        moved += math.hypot(x - last[_PLACES + 2 * side], y - last[_PLACES + 2 * side + 1])
    if not moved >= 0.0:
        last[_SPENT], last[_WHITE] = 0.0, 0.5 * described
    if not moved < _STILL_M:
        last[_SPENT] *= math.exp(-moved / (2.0 * RADIO_LENGTH_M)) if moved >= 0.0 else 0.0
        last[_PLACES : _PLACES + 4] = places
    # Noise, and what repeats beside it.
    if accepted and moved < _NEAR_M and measurements.value[k, 0] != last[RANGE_VALUE]:
        square = 0.5 * (innovation - last[_INNOVATION]) ** 2
        last[_WHITE] += _LEARNING * (min(square, _LARGEST * described) - last[_WHITE])
    repeated = min(max(1.0 - last[_WHITE] / described, _LEAST_REPEATED), _MOST_REPEATED)
    # One look more.
    if variance > last[_VARIANCE]:  # False for a new link
        last[_SPENT] *= last[_VARIANCE] / variance
    spent, news = last[_SPENT], 0.0
    if repeated * spent < 1.0:
        looks = spent * (1.0 - repeated) / (1.0 - repeated * spent)
        news = (looks + 1.0) / (1.0 + looks * repeated) - spent
    noise = described / max(news, _LEAST_NEWS)
    if accepted:
        last[RANGE_VALUE], last[_INNOVATION] = measurements.value[k, 0], innovation
        last[_SPENT], last[_VARIANCE] = spent + news, variance * noise / (variance + noise)
    return noise
