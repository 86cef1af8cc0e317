"""Score the integrity of an estimate: misleading robot-seconds, and the time to recover from a fault."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.integrity.faults import Fault, seconds
from bench.scenarios.lived_run import LivedRun
from bench.shared.common import new_plot, rms, save_plot
from bench.shared.simulated_run import errors_of, estimates_of, inputs_of, ticks
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.offline.metrics import is_misleading, nees
from swarm_loc_estimator.timeline.estimate import Contradicted
from swarm_loc_estimator.timeline.estimator import Status

_RIGHT_M = 0.05
_SETTLED_S = 1.0
_STEADY_S = 3.0
_AFTER_S = 30.0  # Time after a fault in which other robots' errors are compared


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
    blame: Blame | None = None  # Of a fault that says who is guilty


@dataclass(frozen=True)
class Blame:
    """Who is named for a fault, and what it does to robots that it does not concern."""

    # From the fault's begin until a guilty source is named [s]; the length of the run: never
    named_s: float
    accused: int  # Number of innocent sources named
    # RMSE of the other robots during the fault, over that of the run without it; NaN: it concerns all robots
    others_ratio: float = math.nan
    others_after_ratio: float = math.nan  # The same after the fault; NaN, too, if it does not end


class Named(NamedTuple):
    """A reported contradiction."""

    time_s: float  # Since the run began [s]
    about: str  # Name of the source
    kind: Contradicted  # What is contradicted


def score(fault: Fault) -> Score:
    """Run the estimator over a scenario, ticking ten times a second."""
    estimated, named = _estimated(fault.run, fault.readings)
    found = scored(estimated, fault.ends_s, fault.hidden_s)
    found = replace(found, reported=frozenset((one.about, one.kind) for one in named))
    if not fault.guilty:
        return found
    blame = blame_of(fault, named)
    if fault.concerned:
        during, after = _others_ratios(fault, estimated)
        blame = replace(blame, others_ratio=during, others_after_ratio=after)
    return replace(found, blame=blame)


def _estimated(run: LivedRun, readings: Mapping[str, Any]) -> tuple[Estimated, list[Named]]:
    """Estimates of a run with further readings, and what is contradicted at each tick."""
    tick_ns, estimates, named = ticks(run), [], []
    time_s = seconds(run, tick_ns)
    inputs = inputs_of(run, tick_ns, **readings)
    for now_s, (estimate, estimator) in zip(
        time_s.tolist(), estimates_of(run.swarm, inputs, tick_ns), strict=True
    ):
        estimates.append(estimate)
        named += [Named(now_s, one.about, one.kind) for one in estimator.contradictions(estimate.stamp_ns)]
    error = errors_of(np.array([one.poses for one in estimates]), run, tick_ns)
    covariance = np.array([one.covariances for one in estimates])
    tracked = np.array([one.status for one in estimates]) == Status.TRACKED
    return Estimated(time_s, error, covariance, tracked), named


def blame_of(fault: Fault, named: Sequence[Named]) -> Blame:
    """Who is named for a fault; a contradicted pose is a symptom and names no source."""
    sources = [one for one in named if one.kind != Contradicted.POSE]
    since_s = [one.time_s - fault.begins_s for one in sources if one.about in fault.guilty]
    named_s = min((one for one in since_s if one >= 0.0), default=fault.run.duration_s)
    return Blame(named_s, len({one.about for one in sources} - fault.guilty))


def _others_ratios(fault: Fault, estimated: Estimated) -> tuple[float, float]:
    """Errors of robots that a fault does not concern, by those without it: while it lasts, and afterwards."""
    others = [k for k in range(len(fault.run.swarm.robots)) if k not in fault.concerned]
    healthy, _ = _estimated(fault.run, fault.healthy)
    end_s = fault.run.duration_s if fault.ends_s is None else fault.ends_s
    spans = [(fault.begins_s, end_s), (end_s, end_s + _AFTER_S)]
    during, after = (_rmse_m(estimated, others, one) / _rmse_m(healthy, others, one) for one in spans)
    return during, math.nan if fault.ends_s is None else after


def _rmse_m(estimated: Estimated, robots: list[int], span_s: tuple[float, float]) -> float:
    """RMSE of the positions of some robots within a time, where located; NaN without any [m]."""
    inside = (estimated.time_s >= span_s[0]) & (estimated.time_s < span_s[1])
    error = estimated.error[inside][:, robots, :2]
    known = error[np.isfinite(error).all(axis=-1)]
    return rms(np.hypot(*known.T)) if known.size else math.nan


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


def plot_errors(scores: Mapping[str, Sequence[Score]], file: str) -> Path:
    """Plot errors of all robots over time as out/FILE.png, a plot per name, with misleading ones marked."""
    figure, axes = new_plot(len(scores), width=3.6)
    for axis, (name, runs) in zip(axes, scores.items(), strict=True):
        for one in runs:
            axis.semilogy(one.time_s, 100.0 * one.error_m, color="0.6", linewidth=0.5)
            ticks, robots = np.nonzero(one.misleading)
            axis.semilogy(one.time_s[ticks], 100.0 * one.error_m[ticks, robots], "r.", markersize=3)
        axis.set(title=name, xlabel="time [s]", ylabel="error [cm]", ylim=(0.01, 300.0))
    return save_plot(figure, file)
