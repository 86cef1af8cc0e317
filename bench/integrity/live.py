"""Faults of processes: a driver or the estimator is killed and starts again, or starts late.

In the live graph five emulated e-pucks drive the eight in a rendered world, with all nodes that `simulate`
starts. An estimator that starts late, while PushBots map, is replayed.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.graph.listener import Listener, Say, starting_swarm
from bench.integrity.scoring import Estimated, Score, scored
from bench.pushbot.bag import PushbotBagSettings, write_pushbot_bag
from bench.shared.bags import copy_part, first_log_ns
from swarm_loc_drivers.sim.simulation import SimulationOptions, graph_of
from swarm_loc_drivers.sim.worlds import W0
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.detections import decode_detections
from swarm_loc_estimator.common.messages.poses import decode_odometry
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.common.trajectory import DEFAULT_GAP_NS, interpolate
from swarm_loc_estimator.offline.live_run import LiveGraph, read_poses
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm, save_swarm
from swarm_loc_estimator.timeline.estimator import Status
from swarm_loc_vision.markers.detector import precompile

_BEFORE_S, _AFTER_S = 8.0, 10.0
_PATIENCE_S = 120.0
_ESTIMATOR = "estimator"


@dataclass(frozen=True)
class _Live:
    """A running graph and its listener."""

    graph: LiveGraph
    listener: Listener
    nodes: frozenset[str]

    def has_budget(self, duration_s: float, without: str = "") -> None:
        """Wait for simulated time; `without` names a node that is down."""
        until_ns = self.listener.now_ns + round(duration_s * 1e9)
        self.graph.wait_for(
            lambda: self.listener.now_ns >= until_ns, "go on driving", _PATIENCE_S, self.nodes - {without}
        )


Break = Callable[[_Live, float], float]
"""Causes a fault for some time [s], repairs it, and returns the time of the repair [s]."""


def _driver_restart(live: _Live, away_s: float) -> float:
    """Kill a driver; repaired with the first sighting of its robot after its odometry has returned."""
    robot, kept = live.listener.names[0], live.listener.kept
    driver, (_, odometry), (arrivals, images) = (
        f"{robot}/epuck_driver",
        kept[robot, "odom"],
        kept[robot, "detections"],
    )
    live.graph.kill(driver)
    live.has_budget(away_s, without=driver)
    driven, received = len(odometry), len(images)
    live.graph.restart(driver)
    live.graph.wait_for(lambda: len(odometry) > driven, "send odometry again", _PATIENCE_S)
    since_ns = decode_odometry(odometry[driven]).stamp_ns

    def seen_again() -> list[int]:
        found = {k: decode_detections(images[k]) for k in range(received, len(images))}
        return [k for k, one in found.items() if one.detections.size and one.stamp_ns >= since_ns]

    live.graph.wait_for(lambda: bool(seen_again()), "see something again", _PATIENCE_S)
    return arrivals[seen_again()[0]] * 1e-9


def _estimator_restart_moved(live: _Live, away_s: float) -> float:
    """Kill the estimator; then the robots are not at their starts. Repaired with its first poses."""
    raw = live.graph.recorder.raw
    live.graph.kill(_ESTIMATOR)
    live.has_budget(away_s, without=_ESTIMATOR)
    received = len(raw)
    live.graph.restart(_ESTIMATOR)
    live.graph.wait_for(lambda: len(raw) > received, "publish poses again", _PATIENCE_S)
    return read_poses(raw[received]).stamp_ns * 1e-9


LIVE_SCENARIOS: Mapping[str, Break] = {
    "driver_restart": _driver_restart,
    "estimator_restart_moved": _estimator_restart_moved,
}


def run_live(name: str, seed: int, folder: Path, say: Say) -> Score:
    """Run a scenario of `LIVE_SCENARIOS`.

    Args:
        name: Of the scenario.
        seed: Of the world and of the duration of the fault.
        folder: For description and log; created.
        say: Called with the progress.

    Raises:
        LiveError: A node has ended, or the graph has stopped.
    """
    precompile()  # once, not in every robot's detector at a time
    links, swarm = folder / "links", starting_swarm(W0)
    links.mkdir(parents=True, exist_ok=True)
    save_swarm(swarm, folder / "swarm.yaml")
    names = [robot.name for robot in swarm.robots]
    options = SimulationOptions(str(folder / "swarm.yaml"), world="w0", seed=seed)
    nodes = graph_of(options, swarm, str(links))
    away_s = float(np.random.default_rng([seed, 5]).uniform(1.2, 6.0))
    with LiveGraph(nodes, folder / "nodes.log") as graph:
        listener = Listener(graph, names)
        live = _Live(graph, listener, frozenset(node.full_name for node in nodes))
        begin_ns = listener.wait_until_they_drive(say)
        live.has_budget(_BEFORE_S)
        say(f"breaks for {away_s:.1f} s")
        repaired_s = LIVE_SCENARIOS[name](live, away_s)
        say("repaired")
        live.has_budget(_AFTER_S)
    return scored(_estimated(listener, swarm, begin_ns), repaired_s - begin_ns * 1e-9)


def _estimated(listener: Listener, swarm: Swarm, begin_ns: int) -> Estimated:
    """Poses and errors while the robots drove."""
    live = listener.graph.recorder.result("live", swarm, listener.truth(swarm))
    places = np.stack(
        [interpolate(live.truth[name], live.stamp_ns, DEFAULT_GAP_NS)[0] for name in listener.names], axis=1
    )
    known = (live.stamp_ns >= begin_ns) & np.isfinite(places).all(axis=(1, 2))
    error = (live.poses - places)[known]
    error[..., 2] = se2.wrap_angle(error[..., 2])
    time_s: FloatArray = (live.stamp_ns[known] - begin_ns).astype(np.float64) * 1e-9
    return Estimated(time_s, error, live.covariances[known], live.status[known] == Status.TRACKED)


LATE_START = "late_start_mapping"
_PLANS, _SLIPS = ("corridor", "office", "ring"), (0.01, 0.02, 0.04)
_DURATION_S, _LATE_S = 160.0, (10.0, 90.0)
_RIGHT_M = 0.3  # Distance from the truth that a mapper's first map may be off
_MAX_GAP_NS = 1_000_000_000


def run_late_start(seed: int, folder: Path) -> Score:
    """Write a run of two PushBots to a folder, and start the estimator late, by seed.

    The recovery is counted from the fix by which all robots have one.
    """
    whole, late = folder / "whole", folder / "late"
    plan, slip = _PLANS[seed % len(_PLANS)], _SLIPS[seed % len(_SLIPS)]
    write_pushbot_bag(PushbotBagSettings(seed, _DURATION_S, 2, plan, slip), whole, "")
    late_s = float(np.random.default_rng([seed, 5]).uniform(*_LATE_S))
    copy_part(whole, late, _DURATION_S, late_s)
    swarm = load_swarm(whole / "swarm.yaml")
    result = replay(late, swarm)
    truth, known = zip(
        *(interpolate(result.truth[one.name], result.stamp_ns, _MAX_GAP_NS) for one in swarm.robots),
        strict=True,
    )
    inside = np.all(known, axis=0)
    error = result.poses[inside] - np.stack(truth, axis=1)[inside]
    error[..., 2] = wrap_angle(error[..., 2])
    time_s = 1e-9 * (result.stamp_ns[inside] - result.stamp_ns[0])
    first_ns = max(first_log_ns(late, f"{one.name}/fix") for one in swarm.robots)
    tracked = result.status[inside] == Status.TRACKED
    estimated = Estimated(time_s, error, result.covariances[inside], tracked)
    return scored(estimated, 1e-9 * (first_ns - result.stamp_ns[0]), right_m=_RIGHT_M)
