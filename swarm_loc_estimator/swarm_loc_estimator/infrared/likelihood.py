"""Maximum likelihood estimate of the relative pose of two robots, from all readings of all powers.

`search` starts at the poses of `start_table`, so that no wrong minimum is found. The inverse
information is the covariance, inflated where readings fit worse than the platform's noise allows. Unknown
gains are estimated together with the pose, so that the covariance contains them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit, norefcount_njit
from swarm_loc_estimator.common.se2_scalar import wrap
from swarm_loc_estimator.common.small_matrix import assign, assign_matrix
from swarm_loc_estimator.infrared.cost import Pair, with_stray_light, write_costs
from swarm_loc_estimator.infrared.reading_cost import DARK, MEASURED
from swarm_loc_estimator.infrared.search import (
    TABLE_STARTS,
    Workspace,
    classify,
    compress_readings,
    new_workspace,
    pose_covariance,
    search,
)
from swarm_loc_estimator.infrared.solution import IrOutcome, IrSolutions, checked, no_solutions
from swarm_loc_estimator.infrared.start_table import (
    StartTable,
    add_spread,
    blurred,
    compress,
    find_starts,
    start_table,
)
from swarm_loc_estimator.swarm.ir_board import IrModel, IrPlatform, PairGains

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
"""That limit where the probability of all poses is computed as well, so that noise alone gives no pose."""
_EXPLAINED = 0.5
"""The share of what is read, in squares, that a pose must explain."""
_EXPLAINED_OF_OUTLIERS = 0.2
"""That share where readings may be blocked or too bright."""
_WIDEST = 1.0
"""A bearing or heading less sure than this, by the best minimum alone, is open [rad]."""
_WIDEST_OF_ALL = 0.9
"""That limit by the probability of all poses."""
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
_FOUND, _TOO_WEAK, _TOO_FEW, _UNDETERMINED, _MISFIT = (int(outcome) for outcome in IrOutcome)


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
        flat = values.reshape(len(values), math.prod(values.shape[1:]))
        return _solve_all(self._models, flat, known, limits)


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


@cached_njit
def _solve_all(models: Models, readings: FloatArray, gains: PairGains, saturation: FloatArray) -> IrSolutions:
    """All pairs, first those of known gains, then the others, each kind with a workspace of its own."""
    out = no_solutions(len(readings))
    for known in (True, False):
        some = [k for k in range(len(readings)) if known == (gains.sigma[k].max() == 0.0)]
        if len(some) > 0:
            work = new_workspace(models.table, saturation.shape[1], gains.sensor.shape[1], known)
            for k in some:
                _solve_at(models, readings, gains, saturation, work, out, k)
    return out


@cached_njit
def _solve_at(
    models: Models,
    readings: FloatArray,
    gains: PairGains,
    saturation: FloatArray,
    work: Workspace,
    out: IrSolutions,
    k: int,
) -> None:
    """One pair."""
    pair = Pair(
        readings[k],
        work.cut,
        work.stable,
        work.kinds,
        work.exact,
        gains.sensor[k],
        gains.emitter[k],
        work.prior,
        models.table.ranges[0],
        2.0 * models.table.ranges[-1],
    )
    _write_prior(gains.sigma[k], pair.sensor.size, work.prior)
    exact = with_stray_light(models.exact, pair.readings)
    soft = with_stray_light(models.blurred, pair.readings)
    out.outcomes[k] = _solve_one(Models(exact, soft, models.table), saturation[k], pair, work, out, k)


@norefcount_njit
def _write_prior(sigma: FloatArray, n: int, prior: FloatArray) -> None:
    """Write `Pair.prior` for the sigmas (4,) of `PairGains`."""
    for side in range(2):
        own, common = max(sigma[2 * side], _EXACT) ** 2, sigma[2 * side + 1] ** 2
        prior[side, 0], prior[side, 1] = 1.0 / own, common / (own + n * common)


@norefcount_njit
def _solve_one(
    models: Models, saturation: FloatArray, pair: Pair, work: Workspace, out: IrSolutions, k: int
) -> int:
    """One pair; returns the outcome."""
    measured, saturated, bright = classify(models.exact, saturation, pair)
    if measured < _FEWEST:
        return _UNDETERMINED if saturated > 0 else _TOO_FEW
    two_sided = models.exact.errors.bright < math.inf
    faintest = _FAINTEST_OF_OUTLIERS if two_sided else _FAINTEST
    if bright < measured + faintest * math.sqrt(2.0 * measured):
        return _TOO_WEAK
    write_costs(models.exact.errors, pair)
    _find_minima(models, pair, work, measured)
    if two_sided:
        _weigh_minima(models.exact, pair, work)
    best, other = work.minima[0], work.minima[1]
    covariance, odds = work.covariance, math.exp(best[3] - other[3])
    determined = pose_covariance(models.exact, pair, work.best, work.full, covariance)
    misfit = work.full.tally[0] / max(work.full.tally[1], 1.0)
    if _unexplained(models.exact, pair, work, bright / (measured + saturated)):
        return _MISFIT
    if not determined:
        return _UNDETERMINED
    share = 0.0 if two_sided else odds / (1.0 + odds)
    for p in range(3):
        for q in range(3):
            apart = _apart(best, other, p) * _apart(best, other, q) if share > 0.0 else 0.0
            covariance[p, q] = models.exact.scale * max(misfit, 1.0) * covariance[p, q] + share * apart
    if two_sided:
        if add_spread(models.table, work.start, best, covariance) > _WIDEST_OF_ALL**2:
            return _UNDETERMINED
    elif max(covariance[1, 1], covariance[2, 2]) > models.exact.scale * _WIDEST * _WIDEST:
        return _UNDETERMINED
    out.misfits[k], out.odds[k] = misfit, odds
    assign(out.systematic_share[k], work.full.of_gains)
    assign_matrix(out.covariances[k], covariance)
    for p in range(3):
        out.poses[k, p] = best[p]
        if odds > _MIN_ODDS:
            out.alternatives[k, p] = other[p]
    return _FOUND


@norefcount_njit
def _weigh_minima(model: IrModel, pair: Pair, work: Workspace) -> None:
    """Judge the two minima by the probability around them, not its density; writes the better one first.

    A pose that takes most readings for outliers can fit the few others in a tiny region only.
    """
    best, other, at = work.minima[0], work.minima[1], work.full.at
    if not other[3] - best[3] < _WORTH_WEIGHING or not pose_covariance(
        model, pair, work.best, work.full, work.covariance
    ):
        return
    best[3] -= _log_volume(work.covariance)
    cost = search(model, pair, other, _STILL, work.full, _NO_MINIMUM)
    found = work.found
    assign(found, at)
    if not pose_covariance(model, pair, found, work.full, work.covariance):
        return
    for p in range(3):
        other[p] = wrap(found[at.size - 3 + p]) if p > 0 else found[at.size - 3]
    other[3] = cost - _log_volume(work.covariance)
    if other[3] < best[3]:
        for p in range(4):
            best[p], other[p] = other[p], best[p]
        assign(work.best, found)


@norefcount_njit
def _log_volume(covariance: FloatArray) -> float:
    """Half the logarithm of the determinant of a covariance (3, 3)."""
    c = covariance
    size = c[0, 0] * (c[1, 1] * c[2, 2] - c[1, 2] * c[2, 1])
    size -= c[0, 1] * (c[1, 0] * c[2, 2] - c[1, 2] * c[2, 0])
    size += c[0, 2] * (c[1, 0] * c[2, 1] - c[1, 1] * c[2, 0])
    return 0.5 * math.log(max(size, 1e-30))


@norefcount_njit
def _unexplained(model: IrModel, pair: Pair, work: Workspace, bright: float) -> bool:
    """Whether a pose leaves most of what was read, mean square `bright`, unexplained."""
    tally = work.full.tally
    if model.errors.bright == math.inf:
        misfit = tally[0] / max(tally[1], 1.0)
        return bool(misfit - 1.0 > (1.0 - _EXPLAINED) * max(bright - 1.0, 0.0))
    total, count = 0.0, 0
    for f in range(pair.kinds.size):
        if pair.kinds[f] == MEASURED:
            total += pair.stable[f] ** 2
            count += 1
    return bool(tally[2] - count > (1.0 - _EXPLAINED_OF_OUTLIERS) * max(total - count, 0.0))


@norefcount_njit
def _apart(a: FloatArray, b: FloatArray, p: int) -> float:
    """The difference of two poses in range, bearing or heading."""
    return wrap(a[p] - b[p]) if p > 0 else a[p] - b[p]


@norefcount_njit
def _find_minima(models: Models, pair: Pair, work: Workspace, measured: int) -> None:
    """Search from all starts that are worth it; writes the best minimum of all and another one."""
    work.minima[:, 3] = math.inf
    reached = 0
    for s in range(_list_starts(models, pair, work)):
        reached = _search_from(models, pair, work, work.starts[s], reached)
    first, start = work.first, work.starts[0]
    assign(first, work.starts[1])
    for aside in range(_ASIDE.shape[0]):
        of_second = aside < _OF_SECOND
        if _in_doubt(work, reached, measured) or (of_second and work.full.at.size > 3):  # gains are sought
            origin = work.minima[0] if of_second else first
            for p in range(3):
                start[p] = origin[p] + _ASIDE[aside, p]
            reached = _search_from(models, pair, work, start, reached)
    if _in_doubt(work, reached, measured) and models.exact.errors.blocked < math.inf:
        dark = compress(models.exact, DARK * models.exact.noise)
        blocked = find_starts(models.table, work.pattern, work.present, dark, work.start, work.starts)
        for s in range(min(blocked, TABLE_STARTS)):
            reached = _search_from(models, pair, work, work.starts[s], reached)


@norefcount_njit
def _in_doubt(work: Workspace, reached: int, measured: int) -> bool:
    """Whether the best minimum may not be the best of all: reached but once, or it fits badly."""
    return reached < 2 or 2.0 * work.minima[0, 3] > _SUSPICIOUS * (measured - 3)


@norefcount_njit
def _search_from(models: Models, pair: Pair, work: Workspace, start: FloatArray, reached: int) -> int:
    """Search from a start, keep where it ends; how often the best minimum was reached, before and now."""
    at, best = work.full.at, work.minima[0, 3]
    cost = search(models.exact, pair, start, _STILL, work.full, work.minima[0])
    if _keep(work.minima, at[at.size - 3 :], cost):
        assign(work.best, at)
    if abs(cost - best) < _SAME:
        return reached + 1
    return 1 if cost < best else reached


@norefcount_njit
def _list_starts(models: Models, pair: Pair, work: Workspace) -> int:
    """Write poses to begin at; returns how many.

    First where the soft model's search ends, then the best of the table, then others that fit there nearly as
    well. More are in `_ASIDE`, and at last those for readings of which some are blocked.
    """
    compress_readings(models.exact, pair, work.pattern, work.present)
    starts, found = work.starts, work.starts[1 : 1 + TABLE_STARTS]
    outliers = math.inf if models.exact.errors.bright < math.inf else -math.inf
    count = 1 + find_starts(models.table, work.pattern, work.present, outliers, work.start, found)
    _search_blurred(models.blurred, pair, work, found[0])
    while starts[count - 1, 3] > _WORSE * starts[1, 3]:
        count -= 1
    return count


@norefcount_njit
def _search_blurred(model: IrModel, pair: Pair, work: Workspace, start: FloatArray) -> None:
    """Write where the soft model's search ends as the first start."""
    p = pair
    soft = Pair(
        p.readings,
        p.cut,
        p.stable,
        p.kinds,
        work.soft,
        p.sensor,
        p.emitter,
        p.prior,
        p.nearest,
        p.farthest,
    )
    write_costs(model.errors, soft)
    search(model, soft, start, _LOOSE, work.plain, work.minima[0])
    for c in range(3):
        work.starts[0, c] = work.plain.at[c]


@norefcount_njit
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
