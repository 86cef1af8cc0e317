"""Maximum likelihood estimate of the relative pose of two robots, from all readings of all powers.

The search of `search` starts at the poses of `start_table`, so that no wrong minimum is found. The inverse
information is the covariance, grown where readings fit worse than the platform's noise allows. Elements'
unknown gains are sought along, so that the covariance contains them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarm_loc_estimator.core.infrared.board import IrModel, IrPlatform, PairGains
from swarm_loc_estimator.core.infrared.solution import IrSolutions, Outcome, checked
from swarm_loc_estimator.core.infrared.solvers.coarse_posterior import add_spread
from swarm_loc_estimator.core.infrared.solvers.cost import (
    DARK,
    MEASURED,
    Pair,
    Scratch,
    new_scratch,
    with_stray_light,
)
from swarm_loc_estimator.core.infrared.solvers.readings import classify, compress_readings
from swarm_loc_estimator.core.infrared.solvers.search import pose_covariance, search
from swarm_loc_estimator.core.infrared.solvers.start_table import (
    Float32Array,
    StartRoom,
    StartTable,
    blurred,
    compress,
    find_starts,
    new_start_room,
    start_table,
)
from swarm_loc_estimator.numerics.arrays import FloatArray
from swarm_loc_estimator.numerics.jit import compiled
from swarm_loc_estimator.numerics.se2_scalar import wrap
from swarm_loc_estimator.numerics.small_matrix import assign, assign_matrix

_TABLE_STARTS = 3
_WORSE = 2.0
"""A start that fits worse than the best one by more than this factor is not tried."""
_LOOSE, _STILL = 0.1, 1e-4
"""A step that promises to lower the cost by less ends a search, of the soft and of the exact model."""
_SAME = 0.02
"""Two minima whose costs differ by less are one."""
_SUSPICIOUS = 1.3
"""A misfit that is seldom so large by chance."""
_FEWEST = 9
_FAINTEST = 6.0
"""Readings must be brighter than noise by so many sigmas of the sum of their squares."""
_FAINTEST_OF_OUTLIERS = 3.0
"""Likewise where the probability of all poses is known besides; noise alone then gives none."""
_EXPLAINED = 0.5
"""The share of what is read, in squares, that a pose must explain."""
_EXPLAINED_OF_OUTLIERS = 0.2
"""Likewise where readings may be blocked or too bright."""
_WIDEST = 1.0
"""A bearing or heading less sure than this, by the best minimum alone, is open [rad]."""
_WIDEST_OF_ALL = 0.9
"""Likewise by the probability of all poses."""
_APART = 0.1
"""Two minima farther apart than this, in bearing, heading [rad] or relative in range, are two poses."""
_AROUND = [(b, h) for b in (-0.2, 0.0, 0.2) for h in (-0.2, 0.0, 0.2) if b or h]
_ASIDE = np.array([(0.0, 0.1, 0.3), (0.0, -0.1, -0.3), *((0.0, b, h) for b, h in _AROUND)])
"""Where to look besides: two from the best minimum, where the second-best often is, and others from the
table's best start; range, bearing, heading [m, rad]."""
_OF_SECOND = 2
"""How many of these are of the second-best minimum."""
_MIN_ODDS = 1e-4
_WORTH_WEIGHING = 8.0
"""Minima whose costs differ by more are not weighed by what is around them."""
_NO_MINIMUM = np.full(4, math.inf)
_EXACT = 1e-4
"""The own sigma of gains of which only the common part is unsure."""
_FOUND, _TOO_WEAK, _TOO_FEW, _UNDETERMINED, _MISFIT = (int(outcome) for outcome in Outcome)


class MaximumLikelihood:
    """Most likely poses for one platform.

    Args:
        platform: The board of both robots.
    """

    def __init__(self, platform: IrPlatform) -> None:
        self._platform = platform
        self._models = Models(platform.model, blurred(platform), start_table(platform))

    def solve(
        self, readings: ArrayLike, gains: PairGains | None = None, saturation: ArrayLike | None = None
    ) -> IrSolutions:
        """Relative poses of k pairs, see `solution.IrEstimator`."""
        values, known, limits = checked(self._platform, readings, gains, saturation)
        solutions = IrSolutions.none(len(values))
        _solve_all(self._models, values, known, limits, solutions)
        return solutions


class Models(NamedTuple):
    """What is known of a platform.

    Attributes:
        exact: The platform.
        blurred: Its soft version, whose minimum is near the right one.
        table: What is read all around.
    """

    exact: IrModel
    blurred: IrModel
    table: StartTable


class _Room(NamedTuple):
    """Room to work in.

    Attributes:
        plain: To search the pose only.
        full: To search gains besides where they are not known, else the same.
        start: To look for starts.
        starts: (S, 4) range, bearing, heading, misfit.
        pattern: (modes * n * n,) compressed readings.
        present: (modes * n * n,) 1 where there is a reading, else 0.
        kinds: (modes, n, n) of the readings.
        stable: (modes, n, n) the readings by `stabilized`.
        minima: (2, 4) range, bearing, heading and cost of the best two minima that lie apart.
        best: (P,) the best with its gains.
        covariance: (3, 3) of its pose.
    """

    plain: Scratch
    full: Scratch
    start: StartRoom
    starts: FloatArray
    pattern: Float32Array
    present: Float32Array
    kinds: NDArray[np.int8]
    stable: FloatArray
    minima: FloatArray
    best: FloatArray
    covariance: FloatArray


@compiled
def _new_room(table: StartTable, modes: int, n: int, known: bool) -> _Room:
    """Room for one platform, with gains known or not."""
    plain = new_scratch(modes, n, False)
    full = plain if known else new_scratch(modes, n, True)
    return _Room(
        plain,
        full,
        new_start_room(table),
        np.empty((1 + _TABLE_STARTS, 4)),
        np.empty(modes * n * n, np.float32),
        np.empty(modes * n * n, np.float32),
        np.empty((modes, n, n), np.int8),
        np.empty((modes, n, n)),
        np.empty((2, 4)),
        np.empty(full.at.size),
        np.empty((3, 3)),
    )


@compiled
def _solve_all(
    models: Models, readings: FloatArray, gains: PairGains, saturation: FloatArray, out: IrSolutions
) -> None:
    """All pairs, one after the other."""
    modes, n = readings.shape[1], readings.shape[2]
    rooms = [_new_room(models.table, modes, n, known > 0) for known in range(2)]
    nearest, farthest = models.table.ranges[0], 2.0 * models.table.ranges[-1]
    prior = np.empty((2, 2))
    for k in range(readings.shape[0]):
        room = rooms[1 if _write_prior(gains.sigma[k], n, prior) else 0]
        sensor, emitter = gains.sensor[k], gains.emitter[k]
        pair = Pair(
            readings[k], room.stable, saturation[k], room.kinds, sensor, emitter, prior, nearest, farthest
        )
        exact = with_stray_light(models.exact, readings[k])
        soft = with_stray_light(models.blurred, readings[k])
        out.outcomes[k] = _solve_one(Models(exact, soft, models.table), pair, room, out, k)


@compiled
def _write_prior(sigma: FloatArray, n: int, prior: FloatArray) -> bool:
    """Write `Pair.prior` for the sigmas (4,) of `PairGains`; whether the gains are known, all sigmas zero."""
    for side in range(2):
        own, common = max(sigma[2 * side], _EXACT) ** 2, sigma[2 * side + 1] ** 2
        prior[side, 0], prior[side, 1] = 1.0 / own, common / (own + n * common)
    return bool(max(sigma[0], sigma[1], sigma[2], sigma[3]) == 0.0)


@compiled
def _solve_one(models: Models, pair: Pair, room: _Room, out: IrSolutions, k: int) -> int:
    """One pair; returns the outcome."""
    measured, saturated, bright = classify(models.exact, pair)
    if measured < _FEWEST:
        return _UNDETERMINED if saturated > 0 else _TOO_FEW
    two_sided = models.exact.errors.bright < math.inf
    faintest = _FAINTEST_OF_OUTLIERS if two_sided else _FAINTEST
    if bright < measured + faintest * math.sqrt(2.0 * measured):
        return _TOO_WEAK
    _find_minima(models, pair, room, measured)
    if two_sided:
        _weigh_minima(models.exact, pair, room)
    best, other = room.minima[0], room.minima[1]
    covariance, odds = room.covariance, math.exp(best[3] - other[3])
    determined = pose_covariance(models.exact, pair, room.best, room.full, covariance)
    misfit = room.full.tally[0] / max(room.full.tally[1], 1.0)
    if _unexplained(models.exact, pair, room, bright / (measured + saturated)):
        return _MISFIT
    if not determined:
        return _UNDETERMINED
    share = 0.0 if two_sided else odds / (1.0 + odds)
    for p in range(3):
        for q in range(3):
            apart = _apart(best, other, p) * _apart(best, other, q) if share > 0.0 else 0.0
            covariance[p, q] = models.exact.scale * max(misfit, 1.0) * covariance[p, q] + share * apart
    if two_sided:
        if add_spread(models.table, room.start, best, covariance) > _WIDEST_OF_ALL**2:
            return _UNDETERMINED
    elif max(covariance[1, 1], covariance[2, 2]) > models.exact.scale * _WIDEST * _WIDEST:
        return _UNDETERMINED
    out.misfits[k], out.odds[k] = misfit, odds
    assign(out.systematic_share[k], room.full.of_gains)
    assign_matrix(out.covariances[k], covariance)
    for p in range(3):
        out.poses[k, p] = best[p]
        if odds > _MIN_ODDS:
            out.alternatives[k, p] = other[p]
    return _FOUND


@compiled
def _weigh_minima(model: IrModel, pair: Pair, room: _Room) -> None:
    """Judge the two minima by the probability around them, not its density; writes the better one first.

    A pose that takes most readings for outliers can fit the few others in a tiny region only.
    """
    best, other, at = room.minima[0], room.minima[1], room.full.at
    if not other[3] - best[3] < _WORTH_WEIGHING or not pose_covariance(
        model, pair, room.best, room.full, room.covariance
    ):
        return
    best[3] -= _log_volume(room.covariance)
    cost = search(model, pair, other, _STILL, room.full, _NO_MINIMUM)
    found = at.copy()
    if not pose_covariance(model, pair, found, room.full, room.covariance):
        return
    for p in range(3):
        other[p] = wrap(found[at.size - 3 + p]) if p > 0 else found[at.size - 3]
    other[3] = cost - _log_volume(room.covariance)
    if other[3] < best[3]:
        for p in range(4):
            best[p], other[p] = other[p], best[p]
        assign(room.best, found)


@compiled
def _log_volume(covariance: FloatArray) -> float:
    """Half the logarithm of the determinant of a covariance (3, 3)."""
    c = covariance
    size = c[0, 0] * (c[1, 1] * c[2, 2] - c[1, 2] * c[2, 1])
    size -= c[0, 1] * (c[1, 0] * c[2, 2] - c[1, 2] * c[2, 0])
    size += c[0, 2] * (c[1, 0] * c[2, 1] - c[1, 1] * c[2, 0])
    return 0.5 * math.log(max(size, 1e-30))


@compiled
def _unexplained(model: IrModel, pair: Pair, room: _Room, bright: float) -> bool:
    """Whether a pose leaves most of what was read, mean square `bright`, unexplained."""
    tally = room.full.tally
    if model.errors.bright == math.inf:
        misfit = tally[0] / max(tally[1], 1.0)
        return bool(misfit - 1.0 > (1.0 - _EXPLAINED) * max(bright - 1.0, 0.0))
    total, count = 0.0, 0
    for kind, stable in zip(pair.kinds.flat, pair.stable.flat):  # noqa: B905 (not compiled)
        if kind == MEASURED:
            total += stable**2
            count += 1
    return bool(tally[2] - count > (1.0 - _EXPLAINED_OF_OUTLIERS) * max(total - count, 0.0))


@compiled
def _apart(a: FloatArray, b: FloatArray, p: int) -> float:
    """The difference of two poses in range, bearing or heading."""
    return wrap(a[p] - b[p]) if p > 0 else a[p] - b[p]


@compiled
def _find_minima(models: Models, pair: Pair, room: _Room, measured: int) -> None:
    """Search from all starts that are worth it; writes the best minimum of all and another one."""
    room.minima[:, 3] = math.inf
    reached = 0
    for s in range(_list_starts(models, pair, room)):
        reached = _search_from(models, pair, room, room.starts[s], reached)
    first, start = room.starts[1].copy(), room.starts[0]
    for aside in range(_ASIDE.shape[0]):
        of_second = aside < _OF_SECOND
        if _in_doubt(room, reached, measured) or (of_second and room.full.at.size > 3):  # gains are sought
            origin = room.minima[0] if of_second else first
            for p in range(3):
                start[p] = origin[p] + _ASIDE[aside, p]
            reached = _search_from(models, pair, room, start, reached)
    if _in_doubt(room, reached, measured) and models.exact.errors.blocked < math.inf:
        dark = compress(models.exact, DARK * models.exact.noise)
        blocked = find_starts(models.table, room.pattern, room.present, dark, room.start, room.starts)
        for s in range(min(blocked, _TABLE_STARTS)):
            reached = _search_from(models, pair, room, room.starts[s], reached)


@compiled
def _in_doubt(room: _Room, reached: int, measured: int) -> bool:
    """Whether the best minimum may not be the best of all: reached but once, or it fits badly."""
    return reached < 2 or 2.0 * room.minima[0, 3] > _SUSPICIOUS * (measured - 3)


@compiled
def _search_from(models: Models, pair: Pair, room: _Room, start: FloatArray, reached: int) -> int:
    """Search from a start, keep where it ends; how often the best minimum was reached, before and now."""
    at, best = room.full.at, room.minima[0, 3]
    cost = search(models.exact, pair, start, _STILL, room.full, room.minima[0])
    if _keep(room.minima, at[at.size - 3 :], cost):
        assign(room.best, at)
    if abs(cost - best) < _SAME:
        return reached + 1
    return 1 if cost < best else reached


@compiled
def _list_starts(models: Models, pair: Pair, room: _Room) -> int:
    """Write poses to begin at; returns how many.

    First where the soft model's search ends, then the best of the table, then others that fit there nearly as
    well. More are in `_ASIDE`, and at last those for readings of which some are blocked.
    """
    compress_readings(models.exact, pair, room.pattern, room.present)
    starts, found = room.starts, room.starts[1 : 1 + _TABLE_STARTS]
    outliers = math.inf if models.exact.errors.bright < math.inf else -math.inf
    count = 1 + find_starts(models.table, room.pattern, room.present, outliers, room.start, found)
    search(models.blurred, pair, found[0], _LOOSE, room.plain, room.minima[0])
    for p in range(3):
        starts[0, p] = room.plain.at[p]
    while starts[count - 1, 3] > _WORSE * starts[1, 3]:
        count -= 1
    return count


@compiled
def _keep(minima: FloatArray, pose: FloatArray, cost: float) -> bool:
    """Sort a minimum into the best two that lie apart (2, 4); whether it is the best."""
    best, other = minima[0], minima[1]
    better = cost < best[3]
    turned = max(abs(wrap(pose[1] - best[1])), abs(wrap(pose[2] - best[2])))
    apart = max(turned, abs(pose[0] / best[0] - 1.0)) > _APART
    if better and apart:
        assign(other, best)
    if better or (apart and cost < other[3]):
        place = best if better else other
        place[0], place[1], place[2], place[3] = pose[0], wrap(pose[1]), wrap(pose[2]), cost
    return bool(better)
