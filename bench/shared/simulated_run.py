"""A simulated run through the estimator, and its errors, the same for all benchmarks."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bench.scenarios.bags import as_detections
from bench.scenarios.lived_run import LivedRun, SimulatedRun, in_order_of_arrival
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.offline.metrics import nees
from swarm_loc_estimator.offline.replay import ListedSchedule, Runner
from swarm_loc_estimator.sensors.camera import NO_DETECTIONS, DetectionRows
from swarm_loc_estimator.sensors.inputs import Batch
from swarm_loc_estimator.sensors.odometry import OdometryRows
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator
from swarm_loc_estimator.timeline.settings import Settings

_TICK_NS = 100_000_000
_COLUMNS = ("robot", "stamp_ns", "arrival_ns")


@dataclass(frozen=True)
class CoreResult:
    """Estimates of a run."""

    cpu_s: float  # [s]
    poses: FloatArray  # (K, N, 3) at every tick
    covariances: FloatArray  # (K, N, 3, 3)


def run_core(run: SimulatedRun, tick_ns: IntArray, settings: Settings) -> CoreResult:
    """Run the estimator over a run in order of arrival."""
    runner = Runner(Estimator(run.swarm, settings), ListedSchedule(tick_ns))
    parts = inputs_of(run, tick_ns)
    begun = time.process_time()
    for inputs in parts:
        runner.take(inputs)
    cpu_s = time.process_time() - begun
    result = runner.result("run", (run.start_ns, run.end_ns), {}, {})
    return CoreResult(cpu_s, result.poses, result.covariances)


def estimates_of(
    swarm: Swarm, inputs: Sequence[Batch], tick_ns: IntArray
) -> Iterator[tuple[Estimate, Estimator]]:
    """The estimate at each tick by the inputs before it, and the estimator at that moment."""
    estimator = Estimator(swarm)
    for now_ns, batch in zip(tick_ns.tolist(), inputs, strict=True):
        estimator.receive(batch)
        yield estimator.tick(now_ns), estimator


def inputs_of(run: LivedRun, tick_ns: IntArray, **others: Any) -> list[Batch]:
    """Odometry and detections of a run, and other readings by sensor or in place of these.

    They are cut as by `inputs_between`.
    """
    detections = detection_rows(run) if isinstance(run, SimulatedRun) else NO_DETECTIONS
    return inputs_between(tick_ns, **{"odometry": odometry_rows(run), "detections": detections, **others})


def inputs_between(tick_ns: IntArray, **rows: Any) -> list[Batch]:
    """The readings by sensor that arrived between the previous tick and each tick."""
    cuts = {
        name: [0, *np.searchsorted(one.arrival_ns, tick_ns, side="right").tolist()]
        for name, one in rows.items()
    }
    parts = []
    for k, now_ns in enumerate(tick_ns.tolist()):
        part = {name: select(one, slice(*cuts[name][k : k + 2])) for name, one in rows.items()}
        parts.append(Batch.of(now_ns, now_ns, **part))
    return parts


def odometry_rows(run: LivedRun) -> OdometryRows:
    """The odometry of a run; without twists in the run, they are not known."""
    rows = run.odometry
    has_twist = "twist" in (rows.dtype.names or ())
    twist = rows["twist"].copy() if has_twist else np.full(rows["pose"].shape, np.nan)
    robot, stamp_ns, arrival_ns = (rows[name].astype(np.int64) for name in _COLUMNS)
    return OdometryRows(robot, stamp_ns, rows["pose"].copy(), twist, arrival_ns)


def detection_rows(run: SimulatedRun) -> DetectionRows:
    """The sightings of a run as detections."""
    frames = run.frames
    robot, stamp_ns, arrival_ns = (
        np.repeat(frames[name].astype(np.int64), frames["count"]) for name in _COLUMNS
    )
    return DetectionRows(robot, stamp_ns, as_detections(run), arrival_ns)


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


def ticks(run: LivedRun) -> IntArray:
    """Stamps of outputs (K,), ten times a second."""
    return np.arange(run.start_ns + _TICK_NS, run.end_ns + 1, _TICK_NS)


def errors_of(poses: FloatArray, run: LivedRun, stamp_ns: IntArray) -> FloatArray:
    """Errors x, y, theta (K, N, 3) of poses at stamps (K,)."""
    errors: FloatArray = poses - run.truth.all_at(stamp_ns)
    errors[..., 2] = se2.wrap_angle(errors[..., 2])
    return errors


def fitted_errors(places: FloatArray, truth: FloatArray) -> FloatArray:
    """Errors (k, 2) of places (k, 2) after the rigid motion that fits the finite ones to the truth best."""
    known = np.isfinite(places).all(axis=1)
    return se2.transform_points(se2.rigid_fit(places[known], truth[known]), places) - truth


def position_rmse(errors: FloatArray) -> float:
    """Root mean square of the distance [m]."""
    return float(np.sqrt(np.mean(np.sum(errors[..., :2] ** 2, axis=-1))))


def mean_nees(errors: FloatArray, covariances: FloatArray) -> float:
    """Mean normalised error squared of errors (..., 3) with covariances (..., 3, 3); 3 is ideal."""
    return float(np.mean(nees(errors.reshape(-1, 3), covariances.reshape(-1, 3, 3))))
