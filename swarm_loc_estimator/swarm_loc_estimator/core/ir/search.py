"""The most likely pose from a start: damped Gauss-Newton on all readings of one pair of robots.

What is sought is the pose and, where elements differ by an unknown amount, every sensor's and emitter's
log-gain, which has a prior. A measured reading is its expectation plus Gaussian noise. A saturated one says
only that expectation plus noise is at saturation or above, which has the probability of a normal tail. At a
kink of the curves the slope is one-sided, which the damping bears.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.core.compiled import compiled, wrap
from swarm_loc_estimator.core.ir.brightness import predict_brightness
from swarm_loc_estimator.core.ir.platform import IrModel
from swarm_loc_estimator.core.se2 import FloatArray

MISSING, MEASURED, SATURATED = 0, 1, 2

_ROUNDS = 40
_FIRST_DAMPING = 1e-3
_MOST_DAMPING = 1e8
_LONGEST_TURN = 0.4
"""Of one step [rad]."""
_LONGEST_SHARE = 0.4
"""Of one step in range, relative."""
_BESIDE = 0.03
"""A search that has come so near a known minimum [rad, relative in range], at its cost, would end there."""
_TAIL = -6.0
"""Below, the normal distribution is asymptotic [sigma]."""
_AWAY = 2.5
"""How far around a minimum its covariance looks [sigma]."""
_CORNER = 3.0**-0.5
_AROUND = (
    (_CORNER, _CORNER, _CORNER),
    (_CORNER, -_CORNER, -_CORNER),
    (-_CORNER, _CORNER, -_CORNER),
    (-_CORNER, -_CORNER, _CORNER),
)
"""Where to: the corners of a tetrahedron."""


class Pair(NamedTuple):
    """The readings of one pair of robots.

    Attributes:
        readings: (modes, n, n) [count].
        kinds: (modes, n, n) MISSING, MEASURED or SATURATED.
        sensor: (n,) gains of the receiver's sensors.
        emitter: (n,) gains of the transmitter's emitters.
        prior: (2, 2) of sensors and emitters: what weighs every log-gain's square, and the share of their
            common part that this weight leaves free; weights of zero: gains are exact.
        nearest: The least range to seek [m].
        farthest: The largest.
    """

    readings: FloatArray
    kinds: NDArray[np.int8]
    sensor: FloatArray
    emitter: FloatArray
    prior: FloatArray
    nearest: float
    farthest: float


class Scratch(NamedTuple):
    """Room to work in; P unknowns are the log-gains of n sensors and n emitters, if sought, and the pose.

    The pose comes last, so that the last rows of the Hessian's factor are those of the pose alone.

    Attributes:
        expected: (modes, n, n).
        slopes: (3, modes, n, n).
        at: (P,) the best so far.
        trial: (P,).
        factors: (2, n) sensors' and emitters' gains.
        gradients: (2, P) of the cost at the best so far, or at the trial.
        hessians: (2, P, P) likewise, by Gauss-Newton; lower triangles.
        factor: (P, P) lower triangle.
        step: (P,).
        root: (3, 3) inverse of the pose's part of the factor, lower triangle.
    """

    expected: FloatArray
    slopes: FloatArray
    at: FloatArray
    trial: FloatArray
    factors: FloatArray
    gradients: FloatArray
    hessians: FloatArray
    factor: FloatArray
    step: FloatArray
    root: FloatArray


@compiled
def new_scratch(modes: int, n: int, gains: bool) -> Scratch:
    """Room for a platform, with or without gains to seek."""
    size = 3 + 2 * n if gains else 3
    return Scratch(
        np.empty((modes, n, n)),
        np.empty((3, modes, n, n)),
        np.zeros(size),
        np.zeros(size),
        np.empty((2, n)),
        np.empty((2, size)),
        np.empty((2, size, size)),
        np.empty((size, size)),
        np.empty(size),
        np.zeros((3, 3)),
    )


@compiled
def search(
    model: IrModel, pair: Pair, start: FloatArray, still: float, room: Scratch, known: FloatArray
) -> float:
    """Go down from a start (range, bearing, heading, ...) to a minimum; returns its cost.

    It ends when a step promises to lower the cost by less than `still`, or in the basin of a minimum that is
    known (4,), range, bearing, heading, and the cost that is returned then; infinite: none is.

    The cost is half the weighed sum of squares, of readings and priors, and minus the logarithms of the
    probabilities of saturated readings. `room.at` has the minimum.
    """
    at, size, gradients, hessians = room.at, room.at.size, room.gradients, room.hessians
    for p in range(size - 3):
        at[p] = 0.0
    for p in range(3):
        at[size - 3 + p] = start[p]
    best, damping, growth = 0, _FIRST_DAMPING, 2.0
    cost = _cost(model, pair, at, room, gradients[best], hessians[best])
    for _ in range(_ROUNDS):
        promise = _step(pair, room, gradients[best], hessians[best], damping)
        if promise < still:
            break
        now = _cost(model, pair, room.trial, room, gradients[1 - best], hessians[1 - best])
        gain = (cost - now) / promise
        if gain > 1e-3:
            best, cost = 1 - best, now
            for p in range(size):
                at[p] = room.trial[p]
            if known[3] < math.inf and now < known[3] + 1.0 and _beside(known, at):
                return float(min(now, known[3]))
            damping, growth = damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), 2.0
        else:
            damping, growth = damping * growth, growth * 2.0
            if damping > _MOST_DAMPING:
                break
    return cost


@compiled
def _beside(known: FloatArray, at: FloatArray) -> bool:
    """Whether a search has come to a known minimum."""
    x = at.size - 3
    turned = max(abs(wrap(at[x + 1] - known[1])), abs(wrap(at[x + 2] - known[2])))
    return bool(max(turned, abs(at[x] / known[0] - 1.0)) < _BESIDE)


@compiled
def _step(pair: Pair, room: Scratch, gradient: FloatArray, hessian: FloatArray, damping: float) -> float:
    """Write the next trial; returns by how much the quadratic model lowers the cost there."""
    step, size = room.step, room.step.size
    distance = room.at[size - 3]
    # where the range is at its limit and would go beyond, it stays
    held = (distance <= pair.nearest and gradient[size - 3] > 0.0) or (
        distance >= pair.farthest and gradient[size - 3] < 0.0
    )
    while not _factorize(hessian, damping, room.factor, held):
        damping = max(10.0 * damping, _FIRST_DAMPING)
        if damping > _MOST_DAMPING:
            return 0.0
    for p in range(size):
        step[p] = -gradient[p]
    if held:
        step[size - 3] = 0.0
    _solve(room.factor, step)
    shorter = 1.0
    for p in (size - 2, size - 1):
        shorter = min(shorter, _LONGEST_TURN / max(abs(step[p]), 1e-12))
    shorter = min(shorter, _LONGEST_SHARE * distance / max(abs(step[size - 3]), 1e-12))
    slope, bend = 0.0, 0.0
    for p in range(size):
        step[p] *= shorter
        slope += gradient[p] * step[p]
        bend += 0.5 * hessian[p, p] * step[p] * step[p]
        for q in range(p):
            bend += hessian[p, q] * step[p] * step[q]
        room.trial[p] = room.at[p] + step[p]
    room.trial[size - 3] = min(max(room.trial[size - 3], pair.nearest), pair.farthest)
    return -slope - bend


@compiled
def _cost(
    model: IrModel, pair: Pair, at: FloatArray, room: Scratch, gradient: FloatArray, hessian: FloatArray
) -> float:
    """The cost at some place; writes its gradient and Hessian there."""
    size, modes, n = at.size, pair.readings.shape[0], pair.readings.shape[1]
    predict_brightness(model, at[size - 3], at[size - 2], at[size - 1], room.expected, room.slopes)
    sought = size > 3
    for i in range(n):
        room.factors[0, i] = pair.sensor[i] * (math.exp(at[i]) if sought else 1.0)
        room.factors[1, i] = pair.emitter[i] * (math.exp(at[n + i]) if sought else 1.0)
    for p in range(size):
        gradient[p] = 0.0
        for q in range(p + 1):
            hessian[p, q] = 0.0
    cost = _add_prior(pair, at, gradient, hessian) if sought else 0.0
    x = size - 3
    for m in range(modes):
        for i in range(n):
            for j in range(n):
                kind = pair.kinds[m, i, j]
                if kind == MISSING:
                    continue
                factor = room.factors[0, i] * room.factors[1, j]
                expected = factor * room.expected[m, i, j]
                one, pull, weight = _of_reading(model, pair.readings[m, i, j], kind, expected)
                cost += one
                if weight == 0.0:
                    continue
                a = factor * room.slopes[0, m, i, j]
                b = factor * room.slopes[1, m, i, j]
                c = factor * room.slopes[2, m, i, j]
                gradient[x] += pull * a
                gradient[x + 1] += pull * b
                gradient[x + 2] += pull * c
                hessian[x, x] += weight * a * a
                hessian[x + 1, x] += weight * a * b
                hessian[x + 1, x + 1] += weight * b * b
                hessian[x + 2, x] += weight * a * c
                hessian[x + 2, x + 1] += weight * b * c
                hessian[x + 2, x + 2] += weight * c * c
                if sought:
                    gradient[i] += pull * expected
                    gradient[n + j] += pull * expected
                    both = weight * expected * expected
                    hessian[i, i] += both
                    hessian[n + j, n + j] += both
                    hessian[n + j, i] += both
                    for slope, row in ((a, x), (b, x + 1), (c, x + 2)):
                        mixed = weight * expected * slope
                        hessian[row, i] += mixed
                        hessian[row, n + j] += mixed
    return cost


@compiled
def _add_prior(pair: Pair, at: FloatArray, gradient: FloatArray, hessian: FloatArray) -> float:
    """Add the priors of log-gains: independent errors, and one common to all of a side."""
    n, cost = pair.sensor.size, 0.0
    for side in range(2):
        weight, common = pair.prior[side, 0], pair.prior[side, 1]
        first, total = side * n, 0.0
        for p in range(first, first + n):
            total += at[p]
        for p in range(first, first + n):
            pull = weight * (at[p] - common * total)
            cost += 0.5 * pull * at[p]
            gradient[p] += pull
            hessian[p, p] += weight * (1.0 - common)
            for q in range(first, p):
                hessian[p, q] -= weight * common
    return cost


@compiled
def _of_reading(model: IrModel, reading: float, kind: int, expected: float) -> tuple[float, float, float]:
    """What a reading adds to the cost, and its first and second derivative by the expectation."""
    level = reading if kind == MEASURED else model.saturation
    relative = model.relative_noise * level
    weight = 1.0 / (model.noise * model.noise + relative * relative)
    if kind == MEASURED:
        pull = weight * (expected - reading)
        return 0.5 * pull * (expected - reading), pull, weight
    per_sigma = math.sqrt(weight)
    z = (expected - level) * per_sigma
    if z > -_TAIL:
        return 0.0, 0.0, 0.0
    if z > _TAIL:
        share = 0.5 * math.erfc(-z / math.sqrt(2.0))
        hazard = math.exp(-0.5 * z * z) / (math.sqrt(2.0 * math.pi) * share)
        cost = -math.log(share)
    else:
        series = 1.0 - 1.0 / (z * z) + 3.0 / (z * z * z * z)
        hazard = -z / series
        cost = 0.5 * z * z + math.log(-z * math.sqrt(2.0 * math.pi) / series)
    return cost, -hazard * per_sigma, max(hazard * (hazard + z), 0.0) * weight


@compiled
def _factorize(matrix: FloatArray, damping: float, factor: FloatArray, held: bool) -> bool:
    """Cholesky of the lower triangle with its diagonal grown by a share; whether it is positive definite.

    Args:
        matrix: (P, P).
        damping: The share.
        factor: (P, P) written.
        held: Leave the third last row and column out, which is the range.
    """
    size = matrix.shape[0]
    for p in range(size):
        for q in range(p + 1):
            value = matrix[p, q] * (1.0 + damping if p == q else 1.0)
            if held and size - 3 in (p, q):
                value = 1.0 if p == q else 0.0
            for k in range(q):
                value -= factor[p, k] * factor[q, k]
            if p == q:
                if not value > 1e-12 * matrix[p, p]:
                    return False
                factor[p, p] = math.sqrt(value)
            else:
                factor[p, q] = value / factor[q, q]
    return True


@compiled
def _solve(factor: FloatArray, vector: FloatArray) -> None:
    """Solve factor factor^T x = vector in place."""
    size = vector.size
    for p in range(size):
        for k in range(p):
            vector[p] -= factor[p, k] * vector[k]
        vector[p] /= factor[p, p]
    for p in range(size - 1, -1, -1):
        for k in range(p + 1, size):
            vector[p] -= factor[k, p] * vector[k]
        vector[p] /= factor[p, p]


@compiled
def pose_covariance(
    model: IrModel, pair: Pair, at: FloatArray, room: Scratch, covariance: FloatArray
) -> bool:
    """Write the pose's covariance (3, 3) at a minimum (P,); whether the readings determine the pose.

    It is the mean of the inverse information there and around: beyond a kink of the curves, readings may tell
    much less of the pose.
    """
    hessian = room.hessians[0]
    _cost(model, pair, at, room, room.gradients[0], hessian)
    if not _invert(hessian, room):
        return False
    _add_square(room.root, covariance, 1.0 / (1.0 + len(_AROUND)), 0.0)
    root, x = room.root.copy(), at.size - 3
    for direction in _AROUND:
        for p in range(at.size):
            room.trial[p] = at[p]
        for p in range(3):
            for q in range(p, 3):
                room.trial[x + p] += _AWAY * root[q, p] * direction[q]
        room.trial[x] = max(room.trial[x], pair.nearest)
        _cost(model, pair, room.trial, room, room.gradients[0], hessian)
        if not _invert(hessian, room):
            return False
        _add_square(room.root, covariance, 1.0 / (1.0 + len(_AROUND)), 1.0)
    return True


@compiled
def _invert(information: FloatArray, room: Scratch) -> bool:
    """Write the inverse of the pose's part of the information's factor; whether there is one."""
    if not _factorize(information, 0.0, room.factor, False):
        return False
    factor, root, x = room.factor, room.root, information.shape[0] - 3
    for p in range(3):
        root[p, p] = 1.0 / factor[x + p, x + p]
    root[1, 0] = -factor[x + 1, x] * root[0, 0] * root[1, 1]
    root[2, 1] = -factor[x + 2, x + 1] * root[1, 1] * root[2, 2]
    root[2, 0] = -(factor[x + 2, x] * root[0, 0] + factor[x + 2, x + 1] * root[1, 0]) * root[2, 2]
    return True


@compiled
def _add_square(root: FloatArray, matrix: FloatArray, weight: float, keep: float) -> None:
    """Matrix becomes keep * matrix + weight * root^T root, all (3, 3)."""
    for p in range(3):
        for q in range(3):
            value = 0.0
            for k in range(max(p, q), 3):
                value += root[k, p] * root[k, q]
            matrix[p, q] = (keep * matrix[p, q] if keep else 0.0) + weight * value
