"""The estimator over a recording in memory, as often as a fit needs it."""

from __future__ import annotations

import time

import numpy as np

from swarm_loc_estimator.calibration.recording import Recording
from swarm_loc_estimator.core.estimator import SwarmEstimate, SwarmEstimator
from swarm_loc_estimator.core.settings import EstimatorSettings
from swarm_loc_estimator.core.swarm import Swarm
from swarm_loc_estimator.replay_result import ReplayResult


def rerun(
    recording: Recording, swarm: Swarm, tick_s: float, settings: EstimatorSettings | None = None
) -> ReplayResult:
    """Poses at every whole multiple of `tick_s`, each from what had arrived by then, as in `replay`."""
    began = time.perf_counter()
    estimator = SwarmEstimator(swarm, settings)
    period_ns = round(tick_s * 1e9)
    first_ns, last_ns = recording.range_ns
    stamps_ns = np.arange(first_ns // period_ns + 1, last_ns // period_ns + 2) * period_ns
    arrivals = estimator.screen(recording.messages)
    estimates: list[SwarmEstimate] = []
    for now_ns, part in zip(stamps_ns.tolist(), arrivals.until_each(stamps_ns), strict=False):
        estimator.add(part)
        estimates.append(estimator.tick(now_ns))
    robots = len(swarm.robots)
    return ReplayResult(
        title=recording.name,
        swarm=swarm,
        stamp_ns=stamps_ns,
        pose=np.array([e.poses for e in estimates]).reshape(-1, robots, 3),
        covariance=np.array([e.covariances for e in estimates]).reshape(-1, robots, 3, 3),
        truth=recording.truth,
        counters={**estimator.counters, **estimator.drops},
        data_s=(last_ns - first_ns) * 1e-9,
        wall_s=time.perf_counter() - began,
    )
