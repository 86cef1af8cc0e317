"""Faults of processes in the live graph: a driver or the estimator is killed, and starts again.

Five emulated e-pucks drive the eight in a rendered world, with all nodes that `simulate` starts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.graph.listener import Listener, Say, starting_swarm
from bench.integrity.scoring import Estimated, Score, scored
from swarm_loc_drivers.sim.simulation import SimulationOptions, graph_of
from swarm_loc_drivers.sim.worlds import W0
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.detections import decode_detections
from swarm_loc_estimator.common.messages.poses import decode_odometry
from swarm_loc_estimator.common.trajectory import DEFAULT_GAP_NS, interpolate
from swarm_loc_estimator.offline.live_run import LiveGraph, read_poses
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import save_swarm
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
