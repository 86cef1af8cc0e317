"""A robot with a 2-D lidar that localizes in a known map, in the halls of `bench.pushbot`.

The robot is that of `bench.pushbot.lidar`: its wheels lose 2 to 5 % of every path and turn. Its start is
known to 5 cm and 3 degrees. Maps are the exact one, with cells of 5 cm, and one that the mapper drew on
another drive of five minutes, with cells of 2 cm and a `map_sigma` of 5 cm. With "blocked", a quarter of the
beams ends at people who are not in the map and walk around. "wrong_start" is off by 1 m. Errors are against
the truth, so they contain those of the map.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import scipy

from bench.pushbot.exploration import PERIOD_S, PushBotNoise
from bench.pushbot.lidar import (
    BEAMS,
    LIDAR,
    NAME,
    NEAREST,
    ODOMETRY_STEPS,
    SWEEP_S,
    SWEEP_STEPS,
    LidarBody,
    LidarDrive,
    scan_message,
)
from bench.pushbot.mapping import LIDAR_SLIPS, PLANS
from bench.scenarios.lived_run import ODOMETRY_DTYPE, LivedRun
from bench.shared.common import ProgressLine
from bench.shared.simulated_run import errors_of, inputs_between, odometry_rows
from swarm_loc_drivers.sim.pushbot.floor_plan import FloorPlan, floor_plan
from swarm_loc_drivers.sim.run import Trajectories
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.mapping.grid import LOG_ODDS_CAP, OccupancyMap
from swarm_loc_estimator.mapping.map_file import save_map
from swarm_loc_estimator.mapping.mapper import CooperativeMapper
from swarm_loc_estimator.mapping.messages import ScanMessage, decode_scan
from swarm_loc_estimator.offline.metrics import is_misleading, nees
from swarm_loc_estimator.sensors.inputs import Batch
from swarm_loc_estimator.sensors.lidar import ScanRows
from swarm_loc_estimator.sensors.odometry import OdometryRows
from swarm_loc_estimator.swarm.error_models import OdometryModel
from swarm_loc_estimator.swarm.swarm import Pose2, Robot, StartSigma, Swarm
from swarm_loc_estimator.timeline.estimate import Status
from swarm_loc_estimator.timeline.estimator import Estimator

CELL = 0.05
MAP_SIGMAS = {"exact": 0.02, "drawn": 0.05}
BLOCKED = 0.25
ODOMETRY = OdometryModel(wheel_separation=0.16, distance_scale_sigma=0.05, turn_scale_sigma=0.05)
_START = StartSigma(0.05, 0.05, math.radians(3.0))
_PEOPLE, _NEAR_M, _FAR_M = 3, 0.4, 1.5
_EVALUATE_FROM_S, _RUN_S, _MAP_MINUTES = 2.0, 60.0, 5.0
_WRONG_STARTS = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


@dataclass(frozen=True)
class LidarRun:
    """Errors of one drive, at each sweep."""

    error: FloatArray  # (n, 3) estimated minus true x [m], y [m], theta [rad]
    covariance: FloatArray  # (n, 3, 3)
    tracked: BoolArray  # (n,) whether the robot was TRACKED
    cpu_ms: float  # Per scan, all of the estimator
    drops: dict[str, int]  # Unused data by reason


def _figures(runs: Sequence[LidarRun]) -> dict[str, float]:
    """Figures of runs: RMSE, NEES (of 3) and misleading share where TRACKED."""
    error, covariance, tracked = (
        np.concatenate([getattr(one, name) for one in runs]) for name in ("error", "covariance", "tracked")
    )
    found = {"tracked": float(tracked.mean())}
    if tracked.any():
        error, covariance = error[tracked], covariance[tracked]
        found["cm"] = 100.0 * math.sqrt(float(np.mean(np.sum(error[:, :2] ** 2, axis=1))))
        found["deg"] = math.degrees(math.sqrt(float(np.mean(error[:, 2] ** 2))))
        found["nees"] = float(nees(error, covariance).mean())
    found["misleading"] = float(is_misleading(error, covariance).mean()) if tracked.any() else 0.0
    return found


def measure(seeds: Sequence[int], say: ProgressLine) -> dict[str, float]:
    """Figures of all halls with both maps, and of wrong starts."""
    figures: dict[str, float] = {}
    cpu_ms: list[float] = []
    with TemporaryDirectory() as folder:
        for name in PLANS:
            plan = floor_plan(name)
            maps = {"exact": exact_map(plan), "drawn": drawn_map(plan, _MAP_MINUTES, 1)}
            for kind, drawn in maps.items():
                path, _ = save_map(drawn, Path(folder) / f"{name}_{kind}")
                for case, blocked in (("", 0.0), (".blocked", BLOCKED)):
                    say(f"{name}, {kind} map{case}")
                    runs = [
                        drive(plan, path, seed, _RUN_S, map_sigma=MAP_SIGMAS[kind], blocked=blocked)
                        for seed in seeds
                    ]
                    cpu_ms += [one.cpu_ms for one in runs]
                    found = _figures(runs)
                    figures |= {f"lidar_map.{kind}.{name}{case}.{key}": found[key] for key in found}
            wrong = [
                drive(plan, Path(folder) / f"{name}_exact.yaml", seed, 20.0, start_shift=shift)
                for seed in seeds
                for shift in _WRONG_STARTS
            ]
            found = _figures(wrong)
            figures |= {
                f"lidar_map.wrong_start.{name}.{key}": found[key] for key in ("tracked", "misleading")
            }
    return figures | {"lidar_map.cpu_ms": float(np.median(cpu_ms))}


def exact_map(plan: FloorPlan, cell: float = CELL) -> OccupancyMap:
    """The map of a hall: cells that walls touch are occupied, those where the robot can be are free."""
    low, high = (getattr(plan.walls.reshape(-1, 2), name)(axis=0) for name in ("min", "max"))
    corner = low - 0.37  # no wall on the edge of a cell
    occupied = np.zeros(np.ceil((high - corner + 0.3) / cell).astype(int), dtype=bool)
    for x0, y0, x1, y1 in plan.walls:
        count = 1 + math.ceil(math.hypot(x1 - x0, y1 - y0) / (0.2 * cell))
        points = np.linspace((x0, y0), (x1, y1), count)
        occupied[tuple(np.floor((points - corner) / cell).astype(int).T)] = True
    regions, _ = scipy.ndimage.label(~occupied)
    free = regions == regions[tuple(np.floor((plan.starts[0] - corner) / cell).astype(int))]
    return OccupancyMap(corner, cell, LOG_ODDS_CAP * (occupied.astype(float) - free))


def drawn_map(plan: FloorPlan, minutes: float, seed: int) -> OccupancyMap:
    """The map that the mapper draws on a drive."""
    rng = np.random.default_rng([seed, 77])
    drive = LidarDrive.starting(plan, CooperativeMapper(), LIDAR_SLIPS[seed % len(LIDAR_SLIPS)], rng)
    drive.run(60.0 * minutes)
    drive.mapper.finish()
    return drive.mapper.occupancy()


def sweep(begin_ns: int, ranges: FloatArray, far_m: float) -> ScanMessage:
    """The scan of a sweep that began at a time, with ranges (BEAMS,) up to `far_m` [m]."""
    turn = 2.0 * math.pi / BEAMS
    return ScanMessage(begin_ns, 0.0, 2.0 * math.pi, turn, SWEEP_S / BEAMS, NEAREST, far_m, ranges)


def inputs_of_sweeps(
    now_ns: int, odometry: Sequence[tuple[int, int, FloatArray]], ranges: Sequence[FloatArray], far_m: float
) -> Batch:
    """Odometry (robot, stamp, pose) since the last sweeps, and these sweeps, one of each robot or none."""
    robots, stamps = (np.array([one[k] for one in odometry]) for k in (0, 1))
    poses = np.array([pose for _, _, pose in odometry])
    rows: dict[str, Any] = {
        "odometry": OdometryRows(robots, stamps, poses, np.full_like(poses, np.nan), stamps)
    }
    begin_ns = now_ns - round(SWEEP_S * 1e9)
    if ranges:
        scans = np.empty(len(ranges), dtype=object)
        scans[:] = [sweep(begin_ns, one, far_m) for one in ranges]
        at_ns, end_ns = np.full((2, len(ranges)), [[begin_ns], [now_ns]])
        rows["scans"] = ScanRows(np.arange(len(ranges)), at_ns, scans, end_ns)
    return Batch.of(begin_ns, now_ns, **rows)


def block(ranges: FloatArray, share: float, rng: np.random.Generator, time_s: float) -> FloatArray:
    """Ranges (BEAMS,) with a share of them at people around the robot, who walk."""
    width = round(share * BEAMS / _PEOPLE)
    out = ranges.copy()
    for person in range(_PEOPLE):
        begin = int(BEAMS * (person / _PEOPLE + 0.03 * time_s * (1 + person)))
        beams = np.arange(begin, begin + width) % BEAMS
        near = 0.5 * (_NEAR_M + _FAR_M) + 0.5 * (_FAR_M - _NEAR_M) * math.sin(0.3 * time_s + person)
        before = (out[beams] > near) | (out[beams] == 0.0)
        out[beams[before]] = near + 0.02 * rng.standard_normal(int(before.sum()))
    return np.where(np.isfinite(out) & (out < NEAREST), 0.0, out)


def record(
    plan: FloorPlan,
    swarm_map: Path,
    seed: int,
    until_s: float,
    *,
    map_sigma: float = MAP_SIGMAS["exact"],
    blocked: float = 0.0,
    start_shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[LivedRun, ScanRows]:
    """Drive through a hall: the run from second 0, and its scans, which arrive with their last beam.

    Args:
        plan: The hall.
        swarm_map: The map's .yaml file.
        seed: Of all noise.
        until_s: How long [s].
        map_sigma: Standard deviation of its walls in the description [m].
        blocked: Share of the beams that meet what is not in the map.
        start_shift: Added to the start in the description.
    """
    # a robot whose start is known about
    rng = np.random.default_rng(seed)
    pose = np.array([*plan.starts[0], rng.uniform(-math.pi, math.pi)])
    body = LidarBody(plan, pose.copy(), PushBotNoise(slip=LIDAR_SLIPS[seed % len(LIDAR_SLIPS)]), rng)
    said = pose + rng.standard_normal(3) * [_START.x, _START.y, _START.theta] + start_shift
    start: Pose2 = (float(said[0]), float(said[1]), float(said[2]))
    lidar = replace(LIDAR, map_sigma=map_sigma)
    robot = Robot(NAME, start=start, start_sigma=_START, lidar=lidar, odometry=ODOMETRY)
    # its odometry, and a scan at the end of each sweep
    odometry, scans, arrivals_ns = [], [], []
    steps = round(until_s / PERIOD_S)
    for step in range(steps + 1):
        now_ns = round(step * PERIOD_S * 1e9)
        if step % ODOMETRY_STEPS == 0:
            odometry.append((0, now_ns, now_ns, body.odometry))
        if step and step % SWEEP_STEPS == 0:
            ranges = body.ranges(step - SWEEP_STEPS)
            if blocked:
                ranges = block(ranges, blocked, rng, now_ns * 1e-9)
            scans.append(decode_scan(scan_message(round((step - SWEEP_STEPS) * PERIOD_S * 1e9), ranges)))
            arrivals_ns.append(now_ns)
        body.step()
    truth = Trajectories(round(PERIOD_S * 1e9) * np.arange(steps + 1), np.array(body.trace)[:, None])
    run = LivedRun(Swarm((robot,), map=swarm_map), truth, np.array(odometry, ODOMETRY_DTYPE))
    column = np.empty(len(scans), dtype=object)
    column[:] = scans
    stamps_ns = np.array([one.stamp_ns for one in scans])
    return run, ScanRows(np.zeros_like(stamps_ns), stamps_ns, column, np.array(arrivals_ns))


def drive(plan: FloorPlan, swarm_map: Path, seed: int, until_s: float, **others: Any) -> LidarRun:
    """Drive through a hall and localize in a map; arguments are those of `record`."""
    run, scans = record(plan, swarm_map, seed, until_s, **others)
    estimator = Estimator(run.swarm)
    inputs = inputs_between(scans.arrival_ns, odometry=odometry_rows(run), scans=scans)
    estimates, cpu_s = [], 0.0
    for now_ns, batch in zip(scans.arrival_ns.tolist(), inputs, strict=True):
        begin_s = time.process_time()
        estimator.receive(batch)
        estimate = estimator.tick(now_ns)
        cpu_s += time.process_time() - begin_s
        if now_ns > 1e9 * _EVALUATE_FROM_S:
            estimates.append(estimate)
    error = errors_of(
        np.array([one.poses for one in estimates]), run, np.array([one.stamp_ns for one in estimates])
    )
    return LidarRun(
        error[:, 0],
        np.array([one.covariances[0] for one in estimates]),
        np.array([one.status[0] == Status.TRACKED for one in estimates]),
        1e3 * cpu_s / len(inputs),
        estimator.drops,
    )
