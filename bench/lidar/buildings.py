"""Maps of real buildings by raw wheel odometry and scans, against the path that gmapping found.

    python -m bench.lidar.buildings freiburg-101 acapulco

That path is no independent truth, but its maps are consistent. Each building is mapped in a process of its
own, whose memory is measured.
"""

from __future__ import annotations

import json
import math
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bench.lidar.radish import BUILDINGS, NAME, reference, write_bag
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.se2 import between, rigid_fit, transform_points, wrap_angle
from swarm_loc_estimator.mapping.map_file import save_map
from swarm_loc_estimator.mapping.mapper import CooperativeMapper
from swarm_loc_estimator.mapping.mapper_feed import MapperFeed, MapperInput
from swarm_loc_estimator.mapping.sweep_map import LoopTie
from swarm_loc_estimator.offline.metrics import is_misleading
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.swarm.error_models import OdometryModel
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.estimate import Status

_BEGIN_S = 160.0  # Of freiburg-079, of which the odometry contradicts the scans, the begin is measured, too
_WRONG_M, _WRONG_TURN = 1.0, math.radians(15.0)
"""Difference of a tie from the reference from which it is wrong."""
_SAME_S = 0.01
_ODOMETRY = OdometryModel(
    wheel_separation=0.4,
    wheel_noise=2e-4,
    distance_noise=5e-3,
    turn_noise=0.01,
    distance_scale_sigma=0.03,
    turn_scale_sigma=0.03,
    timeout_s=4.0,
    turn_rate_change=0.2,
)
"""Of robots of half a metre, whose steps err by 4 to 10 cm a metre and come in bursts, with pauses of 3 s."""
_TICK_S, _AFTER_NS = 0.25, 1_000_000  # Time between poses, and from a scan to the one that is compared
_WARM = 10  # Scans before the first that count for the cost, while code is loaded


def figures(buildings: Sequence[str] = BUILDINGS) -> dict[str, dict[str, float]]:
    """Building -> path_rms_m, wrong_loops, cpu_ms_per_scan, last_over_first, memory_mb and others."""
    found = {}
    for building in buildings:
        command = [sys.executable, "-m", "bench.lidar.buildings", "--one", building]
        lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        found[building.replace("-", "")] = json.loads(lines)
    return found


def mapped(building: str, until_s: float = math.inf) -> tuple[CooperativeMapper, FloatArray]:
    """Map a building; returns the mapper and the CPU time of each scan (n,) [s]."""
    with TemporaryDirectory() as folder:
        bag = Path(folder, "bag")
        write_bag(building, bag, until_s)
        mapper = CooperativeMapper()
        feed = MapperFeed(load_swarm(bag / "swarm.yaml").robots, mapper, {})
        kinds = {f"{NAME}/{kind.topic}": kind for kind in (MapperInput.ODOMETRY, MapperInput.SCAN)}
        cpu, begin = [], time.process_time()
        with BagReader(bag) as reader:
            for topic, _, _, data in reader.messages(kinds):
                feed.add(0, kinds[topic], data)
                if kinds[topic] is MapperInput.SCAN:
                    now = time.process_time()
                    cpu.append(now - begin)
                    begin = now
    mapper.finish()
    return mapper, np.array(cpu)


def path_rms(mapper: CooperativeMapper, building: str) -> float:
    """RMS distance of the stops from the reference after a rigid fit [m]."""
    at, known = _at_stops(mapper, reference(building))
    path, truth = mapper.graph.poses[known, :2], reference(building)[at[known], 1:3]
    off = transform_points(rigid_fit(path, truth), path) - truth
    return float(np.sqrt(np.square(off).sum(axis=1).mean()))


def wrong_loops(mapper: CooperativeMapper, building: str) -> tuple[int, int]:
    """Numbers of ties of loops that the reference contradicts, and of those between stops that it has."""
    path = reference(building)
    at, known = _at_stops(mapper, path)
    ties = [tie for tie in mapper.sweeps.loops if known[tie.begin] and known[tie.end]]
    return sum(_contradict(path[at, 1:], tie) for tie in ties), len(ties)


def _contradict(truth: FloatArray, tie: LoopTie) -> bool:
    """Whether poses (k, 3) of the stops contradict a tie."""
    x, y, turn = between(between(truth[tie.begin], truth[tie.end]), tie.pose)
    return bool(math.hypot(x, y) > _WRONG_M or abs(turn) > _WRONG_TURN)


def localized(mapper: CooperativeMapper, building: str) -> dict[str, float]:
    """Figures of a replay of the same log in the finished map, compared with the stops of the mapper.

    Poses are those right after the scans of the stops. Between two ticks a scan moves them, so that a pose in
    between would have the error of one tick and the covariance of the other.
    """
    stops = np.array([mapper.begin_ns[stop] for stop in range(mapper.graph.count)]) + _AFTER_NS
    tick_ns = round(1e9 * _TICK_S)
    ticks = np.arange(stops.min() // tick_ns + 1, stops.max() // tick_ns) * tick_ns
    with TemporaryDirectory() as folder:
        bag = Path(folder, "bag")
        write_bag(building, bag)
        path, _ = save_map(mapper.occupancy(), Path(folder, "map"))
        swarm = load_swarm(bag / "swarm.yaml")
        robot = replace(swarm.robots[0], start=(0.0, 0.0, 0.0), odometry=_ODOMETRY)
        result = replay(bag, replace(swarm, robots=(robot,), map=path), stamp_ns=np.union1d(ticks, stops))
    tracked = result.status[:, 0] == Status.TRACKED
    at = np.searchsorted(result.stamp_ns, stops)
    known = tracked[at]
    error = result.poses[at[known], 0] - mapper.graph.poses[known]
    error[:, 2] = wrap_angle(error[:, 2])
    misleading = is_misleading(error, result.covariances[at[known], 0])
    return {
        "localized_tracked_share": float(tracked[np.isin(result.stamp_ns, ticks)].mean()),
        "localized_misleading_share": float(misleading.sum() / len(stops)),
        "localized_rms_m": float(np.sqrt(np.square(error[:, :2]).sum(axis=1).mean())),
    }


def _at_stops(mapper: CooperativeMapper, path: FloatArray) -> tuple[IntArray, BoolArray]:
    """Rows (k,) of a path at the stops, and whether there are such rows."""
    stamp_s = np.array([mapper.begin_ns[stop] for stop in range(mapper.graph.count)]) * 1e-9
    after = np.clip(np.searchsorted(path[:, 0], stamp_s), 1, len(path) - 1)
    at = np.where(stamp_s - path[after - 1, 0] < path[after, 0] - stamp_s, after - 1, after)
    return at, np.abs(path[at, 0] - stamp_s) < _SAME_S


def _figures_of(building: str) -> dict[str, float]:
    mapper, cpu = mapped(building)
    tenth, (wrong, compared) = len(cpu) // 10, wrong_loops(mapper, building)
    found = {
        "path_rms_m": path_rms(mapper, building),
        "wrong_loops": float(wrong),
        "compared_loops": float(compared),
        "loops": float(mapper.counters["loops_closed"]),
        "doubts": float(len(mapper.sweeps.doubts())),
        "contradicted": float(mapper.counters["odometry_contradicted"]),
        "cpu_ms_per_scan": 1e3 * float(cpu[_WARM:].mean()),
        "last_over_first": float(cpu[-tenth:].mean() / cpu[_WARM : _WARM + tenth].mean()),
        "map_cells": float(mapper.occupancy().log_odds.size),
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
    }
    found |= localized(mapper, building)
    if building == "freiburg-079":
        found["begin_rms_m"] = path_rms(mapped(building, _BEGIN_S)[0], building)
    return found


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        print(json.dumps(_figures_of(sys.argv[2])))
    else:
        for name, row in figures(sys.argv[1:] or BUILDINGS).items():
            print(name, {key: round(value, 3) for key, value in row.items()})
