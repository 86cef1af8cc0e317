"""Errors that last: of measurements by one link, and of wheels while nothing measures.

The batch takes errors as independent. What the filter knows of repeated ones, see `filter/sources.py`,
`filter/correlated_noise.py` and `filter/prediction.py`, enlarges their noise here. Where it does so for its
poses, so does the batch; where only for covariances, the solution gets these from a problem with more noise:
n measurements by one link, of whose variance a share s repeats, have together the variance (1 - s) / n + s.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.filter.correlated_noise import LENGTH_M, RADIO_LENGTH_M, REPEATED
from swarm_loc_estimator.filter.measurements import Measurements
from swarm_loc_estimator.filter.models import POLAR, is_compiled, predict_any
from swarm_loc_estimator.filter.prediction import GROWTH
from swarm_loc_estimator.filter.sources import CORRELATION_NS, LEAST_SHARE
from swarm_loc_estimator.offline.batch.problem import BatchProblem, Knots


def counted_once(problem: BatchProblem) -> BatchProblem:
    """The problem in which measurements of a link within their correlation time count as one.

    Wheels are the less sure the longer nothing has measured their robot, lest the batch contradicts what does
    so at last.
    """
    sightings = problem.sightings
    order, same = _links(sightings)
    share = np.empty(sightings.size)
    share[order] = _shares(sightings, order, same)
    covariance = sightings.covariance / share[:, None, None]
    return replace(problem, sightings=sightings._replace(covariance=covariance), knots=_unmeasured(problem))


def with_lasting_errors(problem: BatchProblem, knot: FloatArray, place: FloatArray) -> BatchProblem:
    """The problem with the noise of errors that last, about knots (k, 3) and places (S, 3)."""
    some, rows = problem.sightings, np.arange(problem.sightings.size)
    # how far each end of a link has moved, as the other sees it
    poses = problem.poses(rows, knot, place, problem.tracks)
    predicted, *_ = predict_any(some, poses[0], poses[1], np.zeros((some.size, 3)))
    seen, polar = predicted[:, :2].copy(), some.model == POLAR
    cos, sin = np.cos(predicted[polar, 1]), np.sin(predicted[polar, 1])
    seen[polar] = predicted[polar, :1] * np.column_stack([cos, sin])
    order, same = _links(some)
    a, b = order[:-1], order[1:]
    moved = np.hypot(*(seen[b] - seen[a]).T) / np.where(is_compiled(some.model[b]), LENGTH_M, RADIO_LENGTH_M)
    same &= ((some.observer[b] >= 0) | (some.mount[b] >= 0)) & np.isfinite(moved)  # no fixes
    kept = np.where(same, np.exp(-np.where(same, moved, 0.0)), 0.0).tolist()
    # sums of all that have the same error, before and after
    own = _shares(some, order, same)
    before, after = own.copy(), own.copy()
    for k, left in enumerate(kept):
        before[k + 1] += left * before[k]
    for k in range(len(kept) - 1, -1, -1):
        after[k] += kept[k] * after[k + 1]
    factor = np.empty(some.size)
    factor[order] = 1.0 + REPEATED * (before + after - own - 1.0).clip(min=0.0)
    covariance = some.covariance * factor[:, None, None]
    return replace(problem, sightings=some._replace(covariance=covariance))


def _links(some: Measurements) -> tuple[IntArray, BoolArray]:
    """Order (m,) of measurements, link by link, and whether each (m - 1,) but the first continues a link."""
    columns = (some.received_from, some.observer, some.target, some.landmark, some.mount, some.model)
    _, link = np.unique(np.stack([*columns, some.reading]), axis=1, return_inverse=True)
    order = np.lexsort((some.stamp_ns, link.ravel()))
    return order, np.asarray(np.diff(link.ravel()[order]) == 0)


def _shares(some: Measurements, order: IntArray, same: BoolArray) -> FloatArray:
    """By how much measurements (m,) in their order count, see `share_of` of `filter/sources.py`."""
    a, b = order[:-1], order[1:]
    since_ns = some.stamp_ns[b] - some.stamp_ns[a]
    is_fix = (some.observer[b] < 0) & (some.mount[b] < 0)
    share = np.clip(since_ns / CORRELATION_NS, LEAST_SHARE, 1.0)
    share[(since_ns == 0) & ~is_fix] = 1.0
    share[~is_compiled(some.model[b]) & (some.value[a, 0] == some.value[b, 0])] = LEAST_SHARE
    return np.concatenate([np.ones(min(1, order.size)), np.where(same, share, 1.0)])


def _unmeasured(problem: BatchProblem) -> Knots:
    """Knots with noise of wheels that grows with the time to the nearest measurement of the robot."""
    knots = problem.knots
    covariance = knots.sample.covariance.copy()
    for robot in np.unique(knots.robot).tolist():
        own = np.flatnonzero(knots.robot == robot)
        some, at_ns = problem.sightings, knots.stamp_ns[own]
        if own.size < 2 or problem.swarm.robots[robot].stands:
            continue
        seen = np.sort(some.stamp_ns[(some.observer == robot) | (some.target == robot)])
        middle_ns = at_ns[:-1] + np.diff(at_ns) // 2
        place = np.searchsorted(seen, middle_ns)
        far = np.append(np.append(-np.inf, seen.astype(float)), np.inf)
        apart_s = 1e-9 * np.minimum(middle_ns - far[place], far[place + 1] - middle_ns)
        growth = 1.0 + GROWTH * np.where(np.isfinite(apart_s), apart_s, 0.0)
        steps = np.diff(covariance[own], axis=0) * growth[:, None, None]
        covariance[own[1:]] = covariance[own[0]] + np.cumsum(steps, axis=0)
    return replace(knots, sample=knots.sample._replace(covariance=covariance))
