"""Score the integrity of an estimate: misleading robot-seconds, and the time to recover from a fault."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from bench.integrity.faults import seconds
from bench.integrity.scenarios import Fault
from bench.shared.common import rms
from bench.shared.simulated_run import errors_of, estimates_of, inputs_of, ticks
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.offline.metrics import is_misleading, nees
from swarm_loc_estimator.timeline.estimate import Contradicted
from swarm_loc_estimator.timeline.estimator import Status

_RIGHT_M = 0.05
_SETTLED_S = 1.0
_STEADY_S = 3.0


class Estimated(NamedTuple):
    """Estimates and their errors."""

    time_s: FloatArray  # (T,) since the run began [s]
    error: FloatArray  # (T, N, 3) estimate minus truth; NaN where not located
    covariance: FloatArray  # (T, N, 3, 3)
    tracked: BoolArray  # (T, N) whether the status is TRACKED


@dataclass(frozen=True)
class Score:
    """One run of a scenario."""

    misleading_share: float  # Share of robot-seconds TRACKED with an error beyond 5 sigma and 2 cm
    tracked_share: float  # Of robot-seconds after the first second
    position_m: float  # RMSE while tracked, after the first second
    nees: float  # Mean normalised error squared of the same, 3 is ideal
    # From the fault's end until each robot is right and tracked for 3 s; NaN: it has no end
    recovery_s: float
    time_s: FloatArray  # (T,) of the ticks
    error_m: FloatArray  # (T, N) distance from the truth; NaN where not located
    misleading: BoolArray  # (T, N) whether misleading
    reported: frozenset[tuple[str, Contradicted]] = frozenset()  # Reported contradictions by name and kind


def score(fault: Fault) -> Score:
    """Run the estimator over a scenario, ticking ten times a second."""
    run = fault.run
    tick_ns, estimates = ticks(run), []
    reported: set[tuple[str, Contradicted]] = set()
    for estimate, estimator in estimates_of(run.swarm, inputs_of(run, tick_ns), tick_ns):
        estimates.append(estimate)
        reported |= {(one.about, one.kind) for one in estimator.contradictions(estimate.stamp_ns)}
    error = errors_of(np.array([one.poses for one in estimates]), run, tick_ns)
    covariance = np.array([one.covariances for one in estimates])
    tracked = np.array([one.status for one in estimates]) == Status.TRACKED
    estimated = Estimated(seconds(run, tick_ns), error, covariance, tracked)
    found = scored(estimated, fault.ends_s, fault.hidden_s)
    return replace(found, reported=frozenset(reported))


def scored(
    estimated: Estimated,
    ends_s: float | None = None,
    hidden_s: tuple[float, float] | None = None,
    right_m: float = _RIGHT_M,
) -> Score:
    """Score estimates; see `Fault` for the times. A pose within `right_m` is right."""
    time_s, error, covariance, tracked = estimated
    distance: FloatArray = np.hypot(error[..., 0], error[..., 1])
    misleading = tracked & np.isfinite(distance)
    misleading[misleading] = is_misleading(error[misleading], covariance[misleading])
    knowable = np.ones(time_s.size, dtype=bool)
    if hidden_s is not None:
        knowable = (time_s < hidden_s[0]) | (time_s >= hidden_s[1])
    used = tracked & (time_s > _SETTLED_S)[:, None] & knowable[:, None]
    return Score(
        misleading_share=float(misleading[knowable].mean()),
        tracked_share=float(tracked[time_s > _SETTLED_S].mean()),
        position_m=rms(distance[used]),
        nees=float(np.mean(nees(error[used], covariance[used]))),
        recovery_s=_recovery_s(time_s, tracked & (distance < right_m), ends_s),
        time_s=time_s,
        error_m=distance,
        misleading=misleading,
    )


def _recovery_s(time_s: FloatArray, right: BoolArray, ends_s: float | None) -> float:
    """Time until the last robot stays right [s]; NaN if the fault does not end."""
    if ends_s is None:
        return float("nan")
    begin = int(np.searchsorted(time_s, ends_s))
    needed = round(_STEADY_S / float(np.median(np.diff(time_s))))
    steady = [np.convolve(one[begin:], np.ones(needed), "valid") >= needed for one in right.T]
    since_s = time_s[begin:] - ends_s
    return max(float(since_s[np.argmax(one)]) if one.any() else float(time_s[-1]) for one in steady)
