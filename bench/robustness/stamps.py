"""Odometry with wrong stamps: how often is a pose reported as TRACKED misleading, at ticks of 10 ms?"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from bench.integrity.faults import CLEAN, settings_of
from bench.scenarios.eight_run import simulate_eight
from bench.scenarios.lived_run import SimulatedRun
from bench.shared.common import ProgressLine
from bench.shared.simulated_run import errors_of, estimates_of, inputs_of
from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.offline.metrics import is_misleading
from swarm_loc_estimator.timeline.estimator import Status

_DURATION_S, _TICK_NS = 15.0, 10_000_000
_EVERY = 20  # Of so many stamps one is wrong
JITTERS = (0.05, 0.3, 0.6, 0.9)  # Of the period

Change = Callable[[IntArray, int, np.random.Generator], IntArray]
"""Stamps in order (n,) of a robot and their period [ns] -> wrong stamps."""


def _jitter(share: float) -> Change:
    def change(stamps: IntArray, period: int, rng: np.random.Generator) -> IntArray:
        return stamps + np.rint(share * period * rng.uniform(-0.5, 0.5, stamps.size)).astype(np.int64)

    return change


def _single(share: float) -> Change:
    def change(stamps: IntArray, period: int, _: np.random.Generator) -> IntArray:
        return stamps + np.where(np.arange(stamps.size) % _EVERY == 0, round(share * period), 0)

    return change


def _twice(stamps: IntArray, _period: int, _rng: np.random.Generator) -> IntArray:
    return np.where(np.arange(stamps.size) % _EVERY == 1, np.roll(stamps, 1), stamps)


CHANGES: Mapping[str, Change] = {
    **{f"jitter_{round(100 * share)}": _jitter(share) for share in JITTERS},
    "early": _single(-0.9),
    "late": _single(0.9),
    "twice": _twice,
}
"""Ways in which stamps are wrong."""


def with_stamps(run: SimulatedRun, change: Change, rng: np.random.Generator) -> SimulatedRun:
    """The run with wrong stamps of all robots; poses and arrivals stay."""
    odometry = run.odometry.copy()
    for robot in range(len(run.swarm.robots)):
        rows = np.flatnonzero(odometry["robot"] == robot)
        rows = rows[np.argsort(odometry["stamp_ns"][rows], kind="stable")]
        stamps = odometry["stamp_ns"][rows].astype(np.int64)
        odometry["stamp_ns"][rows] = change(stamps, int(np.median(np.diff(stamps))), rng)
    return replace(run, odometry=odometry)


def misleading_share(run: SimulatedRun) -> tuple[float, float]:
    """Share of misleading poses of TRACKED robots, and largest error of these robots [m], after a second."""
    tick_ns = np.arange(run.start_ns + 10**9, run.end_ns, _TICK_NS)
    estimates = [one for one, _ in estimates_of(run.swarm, inputs_of(run, tick_ns), tick_ns)]
    error = errors_of(np.array([one.poses for one in estimates]), run, tick_ns)
    tracked = np.array([one.status for one in estimates]) == Status.TRACKED
    covariance = np.array([one.covariances for one in estimates])[tracked]
    wrong = is_misleading(error[tracked], covariance)
    return float(wrong.mean()), float(np.hypot(*error[tracked][:, :2].T).max())


def measure(seeds: int, say: ProgressLine) -> dict[str, float]:
    """Figures of so many runs with each kind of wrong stamps."""
    figures: dict[str, float] = {}
    shares: list[float] = []
    for name, change in CHANGES.items():
        found = []
        for seed in range(1, seeds + 1):
            say(f"{name}, seed {seed}")
            run = simulate_eight(settings_of(seed, CLEAN, _DURATION_S))
            found.append(misleading_share(with_stamps(run, change, np.random.default_rng([seed, 7]))))
        shares += [share for share, _ in found]
        figures[f"stamps.{name}.misleading_share"] = float(np.mean([share for share, _ in found]))
        figures[f"stamps.{name}.worst_m"] = max(worst for _, worst in found)
    return {"stamps.misleading_share": max(shares)} | figures
