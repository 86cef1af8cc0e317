"""A recording as the estimator reads it, all at once, and the filter run over it as if nothing came late.

A fit needs poses a hundred times; without buffering they come several times as fast as by `rerun`, and differ
from those only by what the newest odometry adds.
"""

from __future__ import annotations

import time

import numpy as np

from swarm_loc_estimator.calibration.recording import IntArray, Recording
from swarm_loc_estimator.core.fusion import Fusion
from swarm_loc_estimator.core.measurements import MeasurementArray
from swarm_loc_estimator.core.odometry import OdometryTracks
from swarm_loc_estimator.core.readout import read_out
from swarm_loc_estimator.core.screening import Screening
from swarm_loc_estimator.core.settings import EstimatorSettings
from swarm_loc_estimator.core.swarm import Swarm
from swarm_loc_estimator.replay_result import ReplayResult


def tracks_and_measurements(recording: Recording, swarm: Swarm) -> tuple[OdometryTracks, MeasurementArray]:
    """All odometry, calibrated, and all sightings of known markers in the order of their stamps."""
    arrivals = Screening(swarm, EstimatorSettings()).screen(recording.messages)
    odometry, measured = arrivals.odometry, arrivals.measurements
    tracks = OdometryTracks(swarm.robots)
    tracks.extend(odometry.robot, odometry.stamp_ns, odometry.pose)
    return tracks, measured[np.lexsort([measured[name] for name in ("marker_id", "observer", "stamp_ns")])]


def run_in_order(recording: Recording, swarm: Swarm, tick_s: float) -> ReplayResult:
    """Poses at every whole multiple of `tick_s`, each from all that was true by then."""
    began = time.perf_counter()
    tracks, measured = tracks_and_measurements(recording, swarm)
    fusion = Fusion(swarm, EstimatorSettings(), tracks)
    state = fusion.new_state()
    timeout_s = np.array([robot.odometry.timeout_s for robot in swarm.robots])
    verdicts, nis = np.zeros(measured.size, dtype=np.uint8), np.empty(measured.size)
    stamps_ns, ends = _ticks(recording, measured["stamp_ns"], round(tick_s * 1e9))
    estimates, begin = [], 0
    for stamp_ns, end in zip(stamps_ns.tolist(), ends.tolist(), strict=True):
        rows = slice(begin, end)
        if end > begin:
            fusion.step(state, measured[rows], verdicts[rows], nis[rows])
        begin = end
        state_then = fusion.with_starts(state, stamp_ns)
        estimates.append(read_out(state_then, tracks.arrays, timeout_s, stamp_ns))
    first_ns, last_ns = recording.range_ns
    return ReplayResult(
        title=recording.name,
        swarm=swarm,
        stamp_ns=stamps_ns,
        pose=np.array([e.poses for e in estimates]).reshape(-1, len(swarm.robots), 3),
        covariance=np.array([e.covariances for e in estimates]).reshape(-1, len(swarm.robots), 3, 3),
        truth=recording.truth,
        data_s=(last_ns - first_ns) * 1e-9,
        wall_s=time.perf_counter() - began,
    )


def _ticks(recording: Recording, measured_ns: IntArray, period_ns: int) -> tuple[IntArray, IntArray]:
    """Stamps (T,) of the poses, and (T,) how many measurements were true by then."""
    first_ns, last_ns = recording.range_ns
    stamps_ns = np.arange(first_ns // period_ns + 1, last_ns // period_ns + 2) * period_ns
    return stamps_ns, np.searchsorted(measured_ns, stamps_ns, side="right")
