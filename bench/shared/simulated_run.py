"""A simulated run through the estimator, and its errors, the same for all benchmarks."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from swarm_loc_drivers.sim.run import in_order_of_arrival
from swarm_loc_drivers.sim.scenarios.bags import as_detections
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.offline.metrics import nees
from swarm_loc_estimator.offline.replay import ListedSchedule, Runner
from swarm_loc_estimator.sensors.camera import DetectionRows
from swarm_loc_estimator.sensors.odometry import OdometryRows
from swarm_loc_estimator.sensors.registry import Batch
from swarm_loc_estimator.sensors.sensor import chosen
from swarm_loc_estimator.timeline.estimator import Estimator

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from swarm_loc_drivers.sim.run import SimulatedRun
    from swarm_loc_estimator.common.arrays import FloatArray
    from swarm_loc_estimator.timeline.settings import Settings


_TICK_NS = 100_000_000


@dataclass(frozen=True)
class CoreResult:
    """Estimates of a run.

    Attributes:
        cpu_s: [s].
        poses: (K, N, 3) at every tick.
        covariances: (K, N, 3, 3).
    """

    cpu_s: float
    poses: FloatArray
    covariances: FloatArray


def run_core(run: SimulatedRun, tick_ns: NDArray[np.int64], settings: Settings) -> CoreResult:
    """Run the estimator over a run in order of arrival."""
    runner = Runner(Estimator(run.swarm, settings), ListedSchedule(tick_ns))
    parts = inputs_between(run, tick_ns)
    begun = time.process_time()
    for inputs in parts:
        runner.take(inputs)
    cpu_s = time.process_time() - begun
    result = runner.result("run", (run.start_ns, run.end_ns), {}, {})
    return CoreResult(cpu_s, result.poses, result.covariances)


def inputs_between(run: SimulatedRun, tick_ns: NDArray[np.int64]) -> list[Batch]:
    """The inputs that arrived between the previous tick and each tick."""
    rows, frames = run.odometry, run.frames
    names = ("robot", "stamp_ns", "arrival_ns")
    robot, stamp_ns, arrival_ns = (rows[name].astype(np.int64) for name in names)
    pose = rows["pose"].copy()
    twist = rows["twist"].copy() if "twist" in (rows.dtype.names or ()) else np.full(pose.shape, np.nan)
    odometry = OdometryRows(robot, stamp_ns, pose, twist, arrival_ns)
    robot, stamp_ns, arrival_ns = (
        np.repeat(frames[name].astype(np.int64), frames["count"]) for name in names
    )
    seen = DetectionRows(robot, stamp_ns, as_detections(run), arrival_ns)
    parts, begin = [], [0, 0]
    for now_ns in tick_ns.tolist():
        ends = [int(np.searchsorted(p.arrival_ns, now_ns, side="right")) for p in (odometry, seen)]
        first, second = (slice(a, b) for a, b in zip(begin, ends, strict=True))
        part = {"odometry": chosen(odometry, first), "detections": chosen(seen, second)}
        parts.append(Batch(now_ns, now_ns, part))
        begin = ends
    return parts


def without_delay(run: SimulatedRun) -> SimulatedRun:
    """The run with arrivals at the stamps."""
    odometry, frames = run.odometry.copy(), run.frames.copy()
    odometry["arrival_ns"], frames["arrival_ns"] = odometry["stamp_ns"], frames["stamp_ns"]
    of_sighting = np.repeat(frames["arrival_ns"], frames["count"])
    image_of = np.repeat(np.arange(len(frames)), frames["count"])
    sightings = run.sightings[np.lexsort((image_of, of_sighting))]
    frames = in_order_of_arrival(frames, run.end_ns)
    frames["first"] = np.cumsum(frames["count"]) - frames["count"]
    odometry = in_order_of_arrival(odometry, run.end_ns)
    return replace(run, odometry=odometry, frames=frames, sightings=sightings)


def ticks(run: SimulatedRun) -> NDArray[np.int64]:
    """Stamps of outputs (K,), ten times a second."""
    return np.arange(run.start_ns + _TICK_NS, run.end_ns + 1, _TICK_NS)


def errors_of(poses: FloatArray, run: SimulatedRun, stamp_ns: NDArray[np.int64]) -> FloatArray:
    """Errors x, y, theta (K, N, 3) of poses at stamps (K,)."""
    errors: FloatArray = poses - run.truth.all_at(stamp_ns)
    errors[..., 2] = se2.wrap_angle(errors[..., 2])
    return errors


def position_rmse(errors: FloatArray) -> float:
    """Root mean square of the distance [m]."""
    return float(np.sqrt(np.mean(np.sum(errors[..., :2] ** 2, axis=-1))))


def mean_nees(errors: FloatArray, covariances: FloatArray) -> float:
    """Mean normalised error squared of errors (..., 3) with covariances (..., 3, 3); 3 is ideal."""
    return float(np.mean(nees(errors.reshape(-1, 3), covariances.reshape(-1, 3, 3))))
