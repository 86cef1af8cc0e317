"""The estimator over a recording in memory, as often as a fit needs it."""

from __future__ import annotations

import time
from typing import Any

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
    estimator = SwarmEstimator(swarm, settings)
    period_ns = round(tick_s * 1e9)
    estimates: list[SwarmEstimate] = []
    first_ns, last_ns = recording.range_ns
    next_ns = (first_ns // period_ns + 1) * period_ns
    began = time.perf_counter()
    message: Any
    for arrival_ns, is_odometry, robot, stamp_ns, message in recording.messages():
        while next_ns <= arrival_ns:
            estimates.append(estimator.tick(next_ns))
            next_ns += period_ns
        if is_odometry:
            estimator.add_odometry(robot, stamp_ns, message, arrival_ns)
        else:
            estimator.add_detections(robot, stamp_ns, message, arrival_ns)
    estimates.append(estimator.tick(next_ns))
    robots = len(swarm.robots)
    return ReplayResult(
        title=recording.name,
        swarm=swarm,
        stamp_ns=np.array([e.stamp_ns for e in estimates], dtype=np.int64),
        pose=np.array([e.poses for e in estimates]).reshape(-1, robots, 3),
        covariance=np.array([e.covariances for e in estimates]).reshape(-1, robots, 3, 3),
        truth=recording.truth,
        counters={"measurements used": estimator.used, **estimator.drops},
        data_s=(last_ns - first_ns) * 1e-9,
        wall_s=time.perf_counter() - began,
    )
