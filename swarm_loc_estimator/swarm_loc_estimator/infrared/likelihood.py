"""Maximum likelihood estimate of the relative pose of two robots, from all readings of all powers.

`search` starts at the poses of `start_table` to find the global minimum. The covariance is the inverse
information, inflated where residuals exceed the platform's noise. Unknown gains are estimated together with
the pose, so the covariance includes their uncertainty.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit, norefcount_njit
from swarm_loc_estimator.common.numerics import assign, assign_matrix, wrap
from swarm_loc_estimator.infrared.brightness import (
    StartTable,
    add_spread,
    blurred,
    compress,
    find_starts,
    start_table,
)
from swarm_loc_estimator.infrared.cost import DARK, MEASURED, Pair, with_stray_light, write_costs
from swarm_loc_estimator.infrared.search import (
    TABLE_STARTS,
    IrOutcome,
    IrSolutions,
    Workspace,
    checked,
    classify,
    compress_readings,
    new_workspace,
    no_solutions,
    pose_covariance,
    search,
)
from swarm_loc_estimator.swarm.ir_board import IrModel, IrPlatform, PairGains

# The constants of the likelihood are checked by `make bench-droplet` and test_ir_likelihood.py.
_WORSE = 2.0  # Maximum misfit of a start relative to that of the best start
_LOOSE, _STILL = 0.1, 1e-4  # Minimum predicted decrease of the cost per step, of the blurred and exact model
_SAME = 0.02  # Maximum difference in cost of two searches that reached the same minimum
_SUSPICIOUS = 1.3  # Threshold of the misfit above which a minimum may be wrong
_FEWEST = 9  # Minimum number of measured readings
_FAINTEST = 6.0  # Minimum excess of the readings' sum of squares over noise [sigma]
_FAINTEST_OF_OUTLIERS = 3.0
"""The same for platforms with bright outliers, where the posterior over all poses also rejects noise."""
_EXPLAINED = 0.5  # Minimum share of the readings' sum of squares that a pose must explain
_EXPLAINED_OF_OUTLIERS = 0.2  # The same where readings may be blocked or too bright
_WIDEST = 1.0  # Maximum standard deviation of bearing and heading around the best minimum [rad]
_WIDEST_OF_ALL = 0.9  # The same for the posterior over all poses
_APART = 0.1  # Minimum distance of two distinct minima in bearing, heading [rad] or relative range
_AROUND = [(b, h) for b in (-0.2, 0.0, 0.2) for h in (-0.2, 0.0, 0.2) if b or h]
_ASIDE = np.array([(0.0, 0.1, 0.3), (0.0, -0.1, -0.3), *((0.0, b, h) for b, h in _AROUND)])
"""Offsets (range [m], bearing, heading [rad]) of additional starts: two from the best minimum, near which the
second-best often is, the others from the table's best start."""
_OF_SECOND = 2  # Number of these offsets that start from the best minimum
_MIN_ODDS = 1e-4  # Minimum odds of a second pose that is reported
_WORTH_WEIGHING = 8.0  # Maximum difference in cost of two minima compared by the probability around them
_NO_MINIMUM = np.full(4, math.inf)
_EXACT = 1e-4  # Standard deviation of each log-gain where only the common log-gain is uncertain
_FOUND, _TOO_WEAK, _TOO_FEW, _UNDETERMINED, _MISFIT = (int(outcome) for outcome in IrOutcome)


class MaximumLikelihood:
    """Maximum likelihood poses of robots that have one platform."""

    def __init__(self, platform: IrPlatform) -> None:
        self._platform = platform
        self._models = Models(platform.model, blurred(platform), start_table(platform))

    def solve(
        self, readings: ArrayLike, gains: PairGains | None = None, saturation: ArrayLike | None = None
    ) -> IrSolutions:
        """Relative poses of k pairs.

        Args:
            readings: (k, modes, n, n) [count], [mode, sensor, emitter], NaN where not measured.
            gains: Of the k pairs; None: never calibrated.
            saturation: (k, modes) minimum of saturated readings, which are only lower bounds [count];
                None: the platform's.

        Raises:
            ReadingsError: They have another shape.
        """
        values, known, limits = checked(self._platform, readings, gains, saturation)
        flat = values.reshape(len(values), math.prod(values.shape[1:]))
        return _solve_all(self._models, flat, known, limits)


class Models(NamedTuple):
    """The models of a platform."""

    exact: IrModel  # The platform's model
    blurred: IrModel  # The model with smoothed curves, which has fewer local minima
    table: StartTable  # Expected readings at coarse poses


@cached_njit
def _solve_all(models: Models, readings: FloatArray, gains: PairGains, saturation: FloatArray) -> IrSolutions:
    """Solve all pairs: first those with known gains, then the others, each group with its own workspace."""
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
    costs, ranges = (readings[k], work.cut, work.stable, work.kinds, work.exact), models.table.ranges
    pair = Pair(*costs, gains.sensor[k], gains.emitter[k], work.prior, ranges[0], 2.0 * ranges[-1])
    for side in range(2):  # the information of the prior on the log-gains of sensors, and of emitters
        own, common = max(gains.sigma[k, 2 * side], _EXACT) ** 2, gains.sigma[k, 2 * side + 1] ** 2
        work.prior[side, 0], work.prior[side, 1] = 1.0 / own, common / (own + pair.sensor.size * common)
    exact = with_stray_light(models.exact, pair.readings)
    soft = with_stray_light(models.blurred, pair.readings)
    out.outcomes[k] = _solve_one(Models(exact, soft, models.table), saturation[k], pair, work, out, k)


@norefcount_njit
def _solve_one(
    models: Models, saturation: FloatArray, pair: Pair, work: Workspace, out: IrSolutions, k: int
) -> int:
    """Solve one pair; returns the outcome."""
    # enough readings, and brighter than noise
    measured, saturated, bright = classify(models.exact, saturation, pair)
    if measured < _FEWEST:
        return _UNDETERMINED if saturated > 0 else _TOO_FEW
    two_sided = models.exact.errors.bright < math.inf
    faintest = _FAINTEST_OF_OUTLIERS if two_sided else _FAINTEST
    if bright < measured + faintest * math.sqrt(2.0 * measured):
        return _TOO_WEAK
    # the best two minima of the negative log likelihood
    write_costs(models.exact.errors, pair)
    _find_minima(models, pair, work, measured)
    if two_sided:
        _weigh_minima(models.exact, pair, work)
    best, other = work.minima[0], work.minima[1]
    # the covariance at the best one, and whether it explains the readings
    covariance, odds = work.covariance, math.exp(best[3] - other[3])
    determined = pose_covariance(models.exact, pair, work.best, work.full, covariance)
    misfit = work.full.tally[0] / max(work.full.tally[1], 1.0)
    if _unexplained(models.exact, pair, work, bright / (measured + saturated)):
        return _MISFIT
    if not determined:
        return _UNDETERMINED
    # larger where the fit is bad, or where the pose may be the other minimum, or any other one
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
    # write the solution
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
    """Rank the two minima by the probability mass around them instead of its density; the better one first.

    A pose that explains most readings as outliers can fit the rest, but only in a tiny region.
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
    """Whether the pose fails to explain most of the readings, whose mean square is `bright`."""
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
    """Search from all promising starts; writes the best minimum and the best distinct one."""
    work.minima[:, 3] = math.inf
    reached = 0
    for s in range(_list_starts(models, pair, work)):
        reached = _search_from(models, pair, work, work.starts[s], reached)
    first, start = work.first, work.starts[0]
    assign(first, work.starts[1])
    for aside in range(_ASIDE.shape[0]):
        of_second = aside < _OF_SECOND
        if _in_doubt(work, reached, measured) or (of_second and work.full.at.size > 3):  # gains are estimated
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
    """Whether the best minimum may not be global: it was reached only once, or it fits badly."""
    return reached < 2 or 2.0 * work.minima[0, 3] > _SUSPICIOUS * (measured - 3)


@norefcount_njit
def _search_from(models: Models, pair: Pair, work: Workspace, start: FloatArray, reached: int) -> int:
    """Search from a start and keep its minimum; returns how often the best minimum has been reached."""
    at, best = work.full.at, work.minima[0, 3]
    cost = search(models.exact, pair, start, _STILL, work.full, work.minima[0])
    if _keep(work.minima, at[at.size - 3 :], cost):
        assign(work.best, at)
    if abs(cost - best) < _SAME:
        return reached + 1
    return 1 if cost < best else reached


@norefcount_njit
def _list_starts(models: Models, pair: Pair, work: Workspace) -> int:
    """Write the start poses; returns their number.

    The first is the minimum of the blurred model, the others are the best poses of the table. `_find_minima`
    adds starts by `_ASIDE` and starts that assume blocked readings.
    """
    compress_readings(models.exact, pair, work.pattern, work.present)
    starts, found = work.starts, work.starts[1 : 1 + TABLE_STARTS]
    outliers = math.inf if models.exact.errors.bright < math.inf else -math.inf
    count = 1 + find_starts(models.table, work.pattern, work.present, outliers, work.start, found)
    soft = Pair(*pair[:4], work.soft, *pair[5:])  # type: ignore[arg-type] # mypy loses the order
    write_costs(models.blurred.errors, soft)
    search(models.blurred, soft, found[0], _LOOSE, work.plain, work.minima[0])
    for c in range(3):
        starts[0, c] = work.plain.at[c]
    while starts[count - 1, 3] > _WORSE * starts[1, 3]:
        count -= 1
    return count


@norefcount_njit
def _keep(minima: FloatArray, pose: FloatArray, cost: float) -> bool:
    """Insert a minimum into the best two distinct ones (2, 4); returns whether it is the best."""
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
