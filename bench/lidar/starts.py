"""Starts anywhere in known maps: three simulated halls, and the map of a real floor.

Robots drive from random places with random headings, with wheels that slip by 2 to 5 %. A start is found when
its robot is TRACKED; it is wrong if the robot is then more than 0.3 m or 15 degrees off.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import scipy

from bench.lidar.known_map import ODOMETRY, exact_map, inputs_of_sweeps
from bench.pushbot.exploration import PERIOD_S, PushBotNoise
from bench.pushbot.lidar import BEAMS, LIDAR, NAME, NEAREST, ODOMETRY_STEPS, SWEEP_STEPS, LidarBody
from bench.pushbot.mapping import LIDAR_SLIPS, PLANS
from bench.shared.common import ProgressLine
from swarm_loc_drivers.sim.pushbot.floor_plan import FloorPlan, floor_plan
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.filter.measurements import Verdict
from swarm_loc_estimator.filter.models import SCAN
from swarm_loc_estimator.mapping.grid import OccupancyMap
from swarm_loc_estimator.mapping.map_file import load_map, save_map
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.timeline.estimate import Status
from swarm_loc_estimator.timeline.estimator import Estimator

_UNTIL_S, _AFTER_S = 40.0, 3.0  # How long a robot drives unfound, and after it is found
_WRONG_M, _WRONG_TURN = 0.3, math.radians(15.0)
_CLEAR_M, _HOPS_M, _TRIES = 0.3, (0.6, 5.0), 400
_FAR_M = {"hall": 3.5, "floor": 12.0}


class Start(NamedTuple):
    """What became of a start."""

    is_found: bool
    is_wrong: bool
    is_ambiguous: bool  # Not found, and its scans are said to fit several places
    found_s: float
    cpu_s: float
    scan_cpu_s: float  # Most of it that one scan took


@cached_njit
def _ranges(
    occupied: BoolArray, corner: FloatArray, cell: float, poses: FloatArray, far: float
) -> FloatArray:
    """Distances (n,) ahead of poses (n, 3) to the first occupied cell [m]; infinite: none."""
    out = np.full(len(poses), math.inf)
    for k in range(len(poses)):
        cos, sin = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        for step in range(int(far / (0.25 * cell))):
            way = 0.25 * cell * step
            i = math.floor((poses[k, 0] + way * cos - corner[0]) / cell)
            j = math.floor((poses[k, 1] + way * sin - corner[1]) / cell)
            if not (0 <= i < occupied.shape[0] and 0 <= j < occupied.shape[1]):
                break
            if occupied[i, j]:
                out[k] = way
                break
    return out


@dataclass
class GridBody(LidarBody):
    """A robot on a drawn map."""

    grid: OccupancyMap = field(kw_only=True)
    clear: BoolArray = field(kw_only=True)  # (nx, ny) where it has room
    far_m: float = field(kw_only=True)

    def _next_target(self) -> FloatArray:
        """Of random places straight ahead, the one farthest from where it has been."""
        here, places = self.pose[:2], self.grid.centres(self.clear)
        been = np.array(self.trace[:: round(1.0 / PERIOD_S)])[:, :2]
        best, target = -1.0, here
        for place in places[self.rng.integers(len(places), size=_TRIES)]:
            away = math.dist(place, here)
            if not _HOPS_M[0] < away < _HOPS_M[1]:
                continue
            way = here + np.linspace(0.0, 1.0, int(away / 0.05))[:, None] * (place - here)
            if self.clear[tuple(self.grid.index(way).T)].mean() < 0.97:
                continue
            score = float(np.hypot(*(been - place).T).min())
            if score > best:
                best, target = score, place
        return target

    def ranges(self, begin: int) -> FloatArray:
        """Ranges (BEAMS,) of the sweep that began at a step [m]."""
        grid = self.grid
        true = _ranges(grid.occupied, np.asarray(grid.corner), grid.cell, self.beams(begin), self.far_m)
        noise = LIDAR.range_sigma + LIDAR.range_sigma_per_m * np.minimum(true, self.far_m)
        found = true + noise * self.rng.standard_normal(BEAMS)
        return np.where(found > self.far_m, math.inf, np.maximum(found, NEAREST))


def bodies(grid: OccupancyMap, far_m: float, seeds: range) -> Iterator[tuple[int, GridBody]]:
    """Robots at random places of a map."""
    away = scipy.ndimage.distance_transform_edt(~grid.occupied & grid.free) * grid.cell
    regions, _ = scipy.ndimage.label(away > _CLEAR_M)
    largest = 1 + int(np.bincount(regions.ravel())[1:].argmax())
    clear = regions == largest
    low, high = grid.centres(clear).min(axis=0), grid.centres(clear).max(axis=0)
    plan = FloorPlan("map", np.array([[*low, *high]]), low[None])
    for seed in seeds:
        rng = np.random.default_rng([seed, 44])
        places = grid.centres(clear)
        pose = np.array([*places[rng.integers(len(places))], rng.uniform(-math.pi, math.pi)])
        noise = PushBotNoise(slip=LIDAR_SLIPS[seed % len(LIDAR_SLIPS)])
        yield seed, GridBody(plan, pose, noise, rng, grid=grid, clear=clear, far_m=far_m)


def try_start(path: Path, body: GridBody) -> Start:
    """Drive a robot without a start until some time after it is found."""
    robot = Robot(NAME, lidar=replace(LIDAR, max_range=body.far_m), odometry=ODOMETRY)
    estimator, found_s, wrong = Estimator(Swarm((robot,), map=path)), math.inf, False
    cpu_s: list[float] = []
    odometry: list[tuple[int, int, FloatArray]] = []
    for step in range(round(_UNTIL_S / PERIOD_S) + 1):
        now_ns = round(step * PERIOD_S * 1e9)
        if step % ODOMETRY_STEPS == 0:
            odometry.append((0, now_ns, body.odometry))
        if step and step % SWEEP_STEPS == 0:
            batch = inputs_of_sweeps(now_ns, odometry, [body.ranges(step - SWEEP_STEPS)], body.far_m)
            odometry, begin_s = [], time.process_time()
            estimator.receive(batch)
            estimate = estimator.tick(now_ns)
            cpu_s.append((time.process_time() - begin_s) * (now_ns * 1e-9 <= found_s))
            if estimate.status[0] == Status.TRACKED:
                found_s = min(found_s, now_ns * 1e-9)
                off = estimate.poses[0] - body.pose
                wrong |= math.hypot(off[0], off[1]) > _WRONG_M or abs(float(wrap_angle(off[2]))) > _WRONG_TURN
            if now_ns * 1e-9 > found_s + _AFTER_S:
                break
        body.step()
    recent = estimator.recent()
    scans = recent.verdicts[recent.measurements.model == SCAN]
    ambiguous = math.isinf(found_s) and bool(scans.size) and scans[-1] == Verdict.SEVERAL_PLACES
    return Start(math.isfinite(found_s), wrong, ambiguous, found_s, sum(cpu_s), max(cpu_s))


def measure(count: int, real: Path | None, say: ProgressLine) -> dict[str, float]:
    """Figures of `count` starts in each hall, and in a real map."""
    figures: dict[str, float] = {}
    all_starts: list[Start] = []
    with TemporaryDirectory() as folder:
        maps = {name: save_map(exact_map(floor_plan(name)), Path(folder) / name)[0] for name in PLANS}
        for name, path in [*maps.items(), *([("real", real)] if real else [])]:
            far_m = _FAR_M["floor" if name == "real" else "hall"]
            starts = []
            for seed, body in bodies(load_map(path), far_m, range(count)):
                say(f"{name}, start {seed}")
                starts.append(try_start(path, body))
            figures |= _figures(f"global_start.{name}", starts)
            all_starts += starts
    return figures | _figures("global_start", all_starts)


def _figures(name: str, starts: list[Start]) -> dict[str, float]:
    figures: dict[str, Any] = {
        "found": np.mean([one.is_found for one in starts]),
        "found_or_ambiguous": np.mean([one.is_found or one.is_ambiguous for one in starts]),
        "wrong": sum(one.is_wrong for one in starts),
        "cpu_s": np.mean([one.cpu_s for one in starts]),
        "max_cpu_s": max(one.cpu_s for one in starts),
        "max_scan_cpu_s": max(one.scan_cpu_s for one in starts),
    }
    if any(one.is_found for one in starts):
        figures["found_s"] = np.median([one.found_s for one in starts if one.is_found])
    return {f"{name}.{key}": float(value) for key, value in figures.items()}
