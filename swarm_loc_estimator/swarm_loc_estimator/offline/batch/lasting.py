"""Errors that last, as noise of a batch: of sightings from one place, and of wheels while nothing measures.

The batch takes errors as independent. So what the filter knows of repeated errors, see `filter/sources.py`,
`filter/correlated_noise.py` and `filter/prediction.py`, enlarges their noise here: n measurements by one
link, of whose variance a share s repeats, have together the variance (1 - s) / n + s.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.filter.correlated_noise import LENGTH_M, RADIO_LENGTH_M, REPEATED
from swarm_loc_estimator.filter.models import POLAR, is_compiled, predict_any
from swarm_loc_estimator.filter.prediction import GROWTH
from swarm_loc_estimator.filter.sources import CORRELATION_NS, LEAST_SHARE
from swarm_loc_estimator.offline.batch.problem import BatchProblem, Knots


def with_lasting_errors(problem: BatchProblem, knot: FloatArray, place: FloatArray) -> BatchProblem:
    """The problem with the noise of errors that last, about knots (k, 3) and places (S, 3)."""
    factor = _repeated(problem, knot, place)
    sightings = problem.sightings
    covariance = sightings.covariance * factor[:, None, None]
    return replace(problem, sightings=sightings._replace(covariance=covariance), knots=_unmeasured(problem))


def _repeated(problem: BatchProblem, knot: FloatArray, place: FloatArray) -> FloatArray:
    """By how much more noise (m,) counts since measurements of a link share their errors."""
    some, rows = problem.sightings, np.arange(problem.sightings.size)
    poses = problem.poses(rows, knot, place, problem.tracks)
    predicted, *_ = predict_any(some, poses[0], poses[1], np.zeros((some.size, 3)))
    seen, by_sight = predicted[:, :2].copy(), is_compiled(some.model)
    polar = some.model == POLAR
    cos, sin = np.cos(predicted[polar, 1]), np.sin(predicted[polar, 1])
    seen[polar] = predicted[polar, :1] * np.column_stack([cos, sin])
    # measurements of one link after the other, and what each shares with the one before
    columns = (some.received_from, some.observer, some.target, some.landmark, some.mount, some.model)
    _, link = np.unique(np.stack([*columns, some.reading]), axis=1, return_inverse=True)
    order = np.lexsort((some.stamp_ns, link.ravel()))
    same = np.diff(link.ravel()[order]) == 0
    a, b = order[:-1], order[1:]
    is_fix = (some.observer[b] < 0) & (some.mount[b] < 0)
    share = np.clip((some.stamp_ns[b] - some.stamp_ns[a]) / CORRELATION_NS, LEAST_SHARE, 1.0)
    share[~by_sight[b] & (some.value[a, 0] == some.value[b, 0])] = LEAST_SHARE
    moved = np.hypot(*(seen[b] - seen[a]).T) / np.where(by_sight[b], LENGTH_M, RADIO_LENGTH_M)
    kept = np.where(
        same & ~is_fix & np.isfinite(moved), np.exp(-np.where(np.isfinite(moved), moved, 0.0)), 0.0
    )
    own = np.append(1.0, np.where(same, share, 1.0))
    # sums of all that have the same error, before and after
    before, after = own.copy(), own.copy()
    for k, left in enumerate(kept.tolist()):
        before[k + 1] += left * before[k]
    for k, left in zip(range(kept.size - 1, -1, -1), kept[::-1].tolist(), strict=True):
        after[k] += left * after[k + 1]
    found = np.empty(some.size)
    found[order] = (1.0 + REPEATED * (before + after - own - 1.0).clip(min=0.0)) / own
    return found


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
