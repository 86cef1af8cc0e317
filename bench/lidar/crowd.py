"""Twenty robots with lidars that see each other all the time in one hall.

Each drives about in a square of its own, with wheels that slip by 2 to 5 %, from a known start. With the map,
poses are compared with those of robots that do not see each other. Without it, lidar sightings are compared
with odometry alone.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from bench.lidar.known_map import ODOMETRY, exact_map, inputs_of_sweeps, sweep
from bench.pushbot.exploration import PERIOD_S, PushBotNoise
from bench.pushbot.lidar import BEAMS, LIDAR, NEAREST, ODOMETRY_STEPS, SWEEP_S, SWEEP_STEPS, LidarBody
from bench.pushbot.mapping import LIDAR_SLIPS
from bench.shared.common import ProgressLine
from swarm_loc_drivers.sim.pushbot.floor_plan import FloorPlan, outline, wall_distance
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.common.messages.cdr import LASER_SCAN, encode
from swarm_loc_estimator.common.messages.poses import encode_odometry
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.mapping.map_file import save_map
from swarm_loc_estimator.mapping.mapper import CooperativeMapper
from swarm_loc_estimator.mapping.mapper_feed import MapperFeed, MapperInput
from swarm_loc_estimator.offline.map_replay import map_figures
from swarm_loc_estimator.offline.metrics import is_misleading
from swarm_loc_estimator.swarm.swarm import Pose2, Robot, StartSigma, Swarm
from swarm_loc_estimator.timeline.estimate import Status
from swarm_loc_estimator.timeline.estimator import Estimator

_START = StartSigma(0.02, 0.02, math.radians(1.0))
_COLUMNS, _ROWS, _SQUARE_M, _FREE_M = 5, 4, 1.6, 0.35
_RADIUS, _FAR_M, _RUN_S, _SETTLED_S, _MAPPED_S = 0.15, 12.0, 60.0, 5.0, 20.0


@dataclass
class CrowdBody(LidarBody):
    """A robot that stays in its square."""

    square: FloatArray = field(kw_only=True)  # (4,) x0, y0, x1, y1 [m]

    def _next_target(self) -> FloatArray:
        return self.rng.uniform(self.square[:2], self.square[2:])


def _hall() -> FloorPlan:
    """A hall with a niche and two pillars, around the squares."""
    size = np.array([_COLUMNS, _ROWS]) * _SQUARE_M
    free = [(0.0, 0.0, size[0], size[1]), (1.0, size[1], 2.7, size[1] + 0.8)]
    x, y = 2 * _SQUARE_M, _SQUARE_M
    solid = [(x - 0.1, y - 0.1, x + 0.1, y + 0.1), (2 * x - 0.15, 2 * y - 0.1, 2 * x + 0.1, 2 * y + 0.1)]
    return FloorPlan("crowd", outline(free, solid), np.array([[0.5 * _SQUARE_M, 0.5 * _SQUARE_M]]))


def _bodies(seed: int) -> list[CrowdBody]:
    plan, bodies = _hall(), []
    for k in range(_COLUMNS * _ROWS):
        rng = np.random.default_rng([seed, k, 45])
        low = np.array([k % _COLUMNS, k // _COLUMNS]) * _SQUARE_M
        square = np.concatenate([low + _FREE_M, low + _SQUARE_M - _FREE_M])
        pose = np.array([*rng.uniform(square[:2], square[2:]), rng.uniform(-math.pi, math.pi)])
        noise = PushBotNoise(slip=LIDAR_SLIPS[k % len(LIDAR_SLIPS)])
        bodies.append(CrowdBody(plan, pose, noise, rng, square=square))
    return bodies


def _to_others(beams: FloatArray, bodies: list[CrowdBody], own: int, begin: int) -> FloatArray:
    """Distances (BEAMS,) ahead of beams (BEAMS, 3) to the bodies of others, where they were then [m]."""
    share = np.arange(BEAMS) / BEAMS * SWEEP_STEPS
    out = np.full(BEAMS, math.inf)
    for body in bodies[:own] + bodies[own + 1 :]:
        poses = np.array([*body.trace[begin : begin + SWEEP_STEPS], body.pose])
        centre = np.stack([np.interp(share, np.arange(len(poses)), poses[:, a]) for a in (0, 1)], axis=-1)
        x, y = (centre - beams[:, :2]).T
        along = x * np.cos(beams[:, 2]) + y * np.sin(beams[:, 2])
        across = y * np.cos(beams[:, 2]) - x * np.sin(beams[:, 2])
        depth = _RADIUS**2 - across**2
        hits = (depth > 0.0) & (along > 0.0)
        out[hits] = np.minimum(out[hits], along[hits] - np.sqrt(depth[hits]))
    return out


def _ranges(bodies: list[CrowdBody], own: int, begin: int, *, sees: bool) -> FloatArray:
    """Ranges (BEAMS,) of the sweep that began at a step [m]."""
    body, beams = bodies[own], bodies[own].beams(begin)
    true = np.array([wall_distance(body.plan.walls, *beam) for beam in beams])
    true = np.minimum(true, _to_others(beams, bodies, own, begin)) if sees else true
    noise = LIDAR.range_sigma + LIDAR.range_sigma_per_m * true
    return np.maximum(true + noise * body.rng.standard_normal(BEAMS), NEAREST)


@dataclass(frozen=True)
class _Run:
    error_m: FloatArray  # (n,) of the positions of all robots that are TRACKED
    tracked: float  # Share of poses
    misleading: float  # Share of poses
    cpu_ms: float  # Per scan, all of the estimator


def _run(seed: int, path: Path | None, *, scans: bool, sees: bool, radius: float) -> _Run:
    """Drive, and compare poses with the truth at each sweep."""
    bodies = _bodies(seed)
    lidar = replace(LIDAR, max_range=_FAR_M, robot_radius=radius)
    robots = [
        Robot(f"r{k}", lidar=lidar, odometry=ODOMETRY, start=_start(body), start_sigma=_START)
        for k, body in enumerate(bodies)
    ]
    estimator, cpu_s, count = Estimator(Swarm(tuple(robots), map=path)), 0.0, 0
    waiting: list[tuple[int, int, FloatArray]] = []
    errors, misled, all_poses = [], 0, 0
    for step in range(round(_RUN_S / PERIOD_S) + 1):
        now_ns = round(step * PERIOD_S * 1e9)
        if step % ODOMETRY_STEPS == 0:
            waiting += [(k, now_ns, body.odometry.copy()) for k, body in enumerate(bodies)]
        if step and step % SWEEP_STEPS == 0:
            begin = step - SWEEP_STEPS
            ranges = [_ranges(bodies, k, begin, sees=sees) for k in range(len(bodies))] if scans else []
            batch = inputs_of_sweeps(now_ns, waiting, ranges, _FAR_M)
            waiting, begin_s = [], time.process_time()
            estimator.receive(batch)
            estimate = estimator.tick(now_ns)
            cpu_s, count = cpu_s + time.process_time() - begin_s, count + len(bodies)
            if now_ns * 1e-9 > _SETTLED_S:
                error = estimate.poses - np.array([body.pose for body in bodies])
                error[:, 2] = wrap_angle(error[:, 2])
                # robots without map or landmark are never confirmed
                is_local = path is None
                tracked: BoolArray = estimate.status == (Status.UNCONFIRMED if is_local else Status.TRACKED)
                errors.append(np.hypot(*error[tracked, :2].T))
                misled += int(is_misleading(error[tracked], estimate.covariances[tracked]).sum())
                all_poses += len(bodies)
        for body in bodies:
            body.step()
    found = np.concatenate(errors)
    return _Run(found, found.size / all_poses, misled / all_poses, 1e3 * cpu_s / count)


def _start(body: CrowdBody) -> Pose2:
    """Where it is believed to start."""
    x, y, theta = body.pose + body.rng.standard_normal(3) * [_START.x, _START.y, _START.theta]
    return float(x), float(y), float(theta)


def _mapped(seed: int, *, sees: bool, radius: float) -> tuple[float, float]:
    """Map the hall by all robots; RMS error of stops, and mean distance of walls from their places [m]."""
    bodies, mapper = _bodies(seed), CooperativeMapper()
    lidar = replace(LIDAR, max_range=_FAR_M, robot_radius=radius)
    robots = [
        Robot(f"r{k}", lidar=lidar, start=_start(body), start_sigma=_START) for k, body in enumerate(bodies)
    ]
    feed, truth = MapperFeed(robots, mapper, {}), {}
    for step in range(round(_MAPPED_S / PERIOD_S) + 1):
        now_ns = round(step * PERIOD_S * 1e9)
        for k, body in enumerate(bodies):
            truth[k, now_ns] = body.pose.copy()
            if step % ODOMETRY_STEPS == 0:
                frames, stamp = (f"r{k}/odom", f"r{k}/base_link"), np.array([now_ns])
                data = encode_odometry(*frames, stamp, body.odometry[None], np.zeros((1, 3)))[0]
                feed.add(k, MapperInput.ODOMETRY, data)
        for k in range(len(bodies)) if step and step % SWEEP_STEPS == 0 else ():
            begin_ns = now_ns - round(SWEEP_S * 1e9)
            fields = sweep(begin_ns, _ranges(bodies, k, step - SWEEP_STEPS, sees=sees), _FAR_M)._asdict()
            del fields["lidar"]
            header = {"stamp": fields.pop("stamp_ns"), "frame_id": fields.pop("frame_id")}
            fields |= {"header": header, "ranges": fields["ranges"].astype(np.float32)}
            feed.add(k, MapperInput.SCAN, encode(fields, LASER_SCAN))
        for body in bodies:
            body.step()
    mapper.finish()
    robot = {feed.number(k): k for k in range(len(bodies))}
    errors = [
        mapper.graph.poses[stop, :2] - truth[robot[int(mapper.graph.robot[stop])], at_ns][:2]
        for stop, at_ns in mapper.begin_ns.items()
        if (robot[int(mapper.graph.robot[stop])], at_ns) in truth
    ]
    tracks: dict[int, Trajectory] = {}
    walls = map_figures(mapper, tracks, bodies[0].plan.walls).wall_m
    return float(np.sqrt(np.square(errors).sum(axis=1).mean())), walls


def measure(seeds: int, say: ProgressLine) -> dict[str, float]:
    """Figures of drives."""
    figures: dict[str, float] = {}
    with TemporaryDirectory() as folder:
        path, _ = save_map(exact_map(_hall()), Path(folder) / "hall")
        kinds: dict[str, Any] = {
            "in_map.alone": {"path": path, "scans": True, "sees": False, "radius": 0.0},
            "in_map.crowd": {"path": path, "scans": True, "sees": True, "radius": _RADIUS},
            "in_map.crowd_as_walls": {"path": path, "scans": True, "sees": True, "radius": 0.0},
            "no_map.odometry": {"path": None, "scans": False, "sees": True, "radius": 0.0},
            "no_map.sightings": {"path": None, "scans": True, "sees": True, "radius": _RADIUS},
        }
        for name, kind in kinds.items():
            runs = []
            for seed in range(seeds):
                say(f"{name}, seed {seed}")
                runs.append(_run(seed, **kind))
            errors = np.concatenate([one.error_m for one in runs])
            figures[f"crowd.{name}.rmse_m"] = float(np.sqrt(np.mean(errors**2)))
            for key in ("tracked", "misleading", "cpu_ms"):
                figures[f"crowd.{name}.{key}"] = float(np.mean([getattr(one, key) for one in runs]))
    kinds_of_map = {"alone": (False, 0.0), "crowd": (True, _RADIUS), "crowd_as_walls": (True, 0.0)}
    for name, (sees, radius) in kinds_of_map.items():
        found = []
        for seed in range(seeds):
            say(f"map, {name}, seed {seed}")
            found.append(_mapped(seed, sees=sees, radius=radius))
        figures[f"crowd.map.{name}.rmse_m"], figures[f"crowd.map.{name}.wall_m"] = map(
            float, np.mean(found, axis=0)
        )
    for key in ("rmse_m", "wall_m"):
        figures[f"crowd.map.{key}_over_alone"] = (
            figures[f"crowd.map.crowd.{key}"] / figures[f"crowd.map.alone.{key}"]
        )
    rmse = {name: figures[f"crowd.{name}.rmse_m"] for name in kinds}
    figures["crowd.over_alone"] = rmse["in_map.crowd"] / rmse["in_map.alone"]
    figures["crowd.gain"] = rmse["no_map.odometry"] / rmse["no_map.sightings"]
    return figures
