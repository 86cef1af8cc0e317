"""Nodes of whole simulated graphs that are stopped by SIGSTOP for a while: drivers, and the mapper.

PushBots explore a corridor that the mapper maps; e-pucks drive an eight, with drivers that talk to them over
TCP as over WiFi. "Tracked" is the time from SIGCONT until all robots are TRACKED in one message, "measured"
that until the next measurement comes that locates the robot by itself: a fix of the mapper, an image.
"Recovery" is the difference; 0: other measurements had located it before.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped

from bench.graph.listener import Say
from bench.shared.common import DEMO_BAG as BAG
from bench.shared.common import OUT
from swarm_loc_drivers.sim.simulation import SimulationOptions, graph_of
from swarm_loc_estimator.common.launch import NodeSpec
from swarm_loc_estimator.common.messages.cdr import nanoseconds
from swarm_loc_estimator.common.messages.poses import yaw_of
from swarm_loc_estimator.common.trajectory import DEFAULT_GAP_NS, Trajectory, interpolate
from swarm_loc_estimator.offline.live_run import START_PATIENCE_S, LiveGraph
from swarm_loc_estimator.offline.metrics import is_misleading
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm, save_swarm
from swarm_loc_estimator.timeline.estimator import Status
from swarm_loc_estimator.watch.server import free_port
from swarm_loc_msgs.msg import MarkerDetectionArray

PAUSES_S = (1.0, 5.0, 30.0)
_BETWEEN_S = 8.0
_EPUCKS = 2
_SMALL_IMAGES = "epuck_world: {ros__parameters: {width: 640, height: 480}}\n"
STOPPED: Mapping[str, Mapping[str, str]] = {
    "pushbots": {"driver": "pushbot1/pushbot_driver", "mapper": "mapper"},
    "epucks_wifi": {"driver": "epuck1/epuck_driver"},
}
"""Simulation -> what is stopped, with the full name of its node."""
_MEASURED = {
    "pushbots": ("pushbot1/fix", PoseWithCovarianceStamped),
    "epucks_wifi": ("epuck1/detections", MarkerDetectionArray),
}
"""Simulation -> topic of the measurements that locate the robot whose driver is stopped."""


@contextmanager
def stopped(pid: int) -> Iterator[None]:
    """Stop a process for a while."""
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


def misleading_share(result: ReplayResult, truth: Mapping[str, Trajectory], begin_ns: int) -> float:
    """Share of the TRACKED poses since an instant that are misleading."""
    stamp_ns = np.array(result.stamp_ns)
    places = [interpolate(truth[one.name], stamp_ns, DEFAULT_GAP_NS)[0] for one in result.swarm.robots]
    error = result.poses - np.stack(places, axis=1)
    known = (result.status == Status.TRACKED) & np.isfinite(error).all(axis=2)
    known &= (stamp_ns >= begin_ns)[:, None]
    return float(is_misleading(error[known], result.covariances[known]).sum()) / max(int(known.sum()), 1)


def _options(kind: str, folder: Path, plan: str) -> tuple[SimulationOptions, Swarm]:
    """A simulation of two robots; PushBots stand where their hall has starts."""
    if kind == "pushbots":
        recorded = load_swarm(BAG.parent / "pushbots_two" / "swarm.yaml")
        swarm = replace(recorded, robots=tuple(replace(one, start=None) for one in recorded.robots))
        save_swarm(swarm, folder / "swarm.yaml")
        return SimulationOptions(str(folder / "swarm.yaml"), plan=plan), swarm
    whole = load_swarm(BAG.parent / "eight_five_robots" / "swarm.yaml")
    swarm = replace(whole, robots=whole.robots[:_EPUCKS])
    save_swarm(swarm, folder / "swarm.yaml")
    (folder / "parameters.yaml").write_text(_SMALL_IMAGES, encoding="utf-8")
    options = SimulationOptions(
        str(folder / "swarm.yaml"), world="w0", parameter_file=str(folder / "parameters.yaml")
    )
    return options, swarm


def over_tcp(nodes: Sequence[NodeSpec], links: Sequence[str], port: int, ahead: int = 0) -> list[NodeSpec]:
    """The nodes with TCP ports from `port` on in the place of the links to their robots.

    Drivers connect `ahead` of these, where something must pass the bytes on.
    """
    place = {link: f"tcp://localhost:{port + ahead + robot}" for robot, link in enumerate(links)}
    changed = []
    for node in nodes:
        parameters = {name: place.get(str(value), value) for name, value in node.parameters.items()}
        if "link_folder" in parameters:
            parameters |= {"link_folder": "", "first_port": port}
        changed.append(replace(node, parameters=parameters))
    return changed


@contextmanager
def simulated(
    kind: str, plan: str = "corridor", port: int = 0, ahead: int = 0
) -> Iterator[tuple[LiveGraph, Swarm, dict[str, list[tuple[int, list[float]]]]]]:
    """The graph of a simulation, its swarm, and the true poses as they come: stamps and poses by robot.

    With a port, drivers connect over TCP, see `over_tcp`.
    """
    with TemporaryDirectory() as folder:
        options, swarm = _options(kind, Path(folder), plan)
        nodes = graph_of(options, swarm, folder)
        if port:
            nodes = over_tcp(nodes, [f"{folder}/{one.name}" for one in swarm.robots], port, ahead)
        truth: dict[str, list[tuple[int, list[float]]]] = {one.name: [] for one in swarm.robots}
        with LiveGraph(nodes, OUT / "robustness" / f"{kind}.log") as graph:
            for name, one in truth.items():

                def take(message: PoseStamped, one: list[tuple[int, list[float]]] = one) -> None:
                    place, q = message.pose.position, message.pose.orientation
                    pose = [place.x, place.y, yaw_of(q.x, q.y, q.z, q.w)]
                    one.append((nanoseconds(message.header.stamp), pose))

                graph.recorder.create_subscription(PoseStamped, f"{name}/ground_truth", take, 1000)
            yield graph, swarm, truth


def _all_tracked(graph: LiveGraph, since_ns: int, measured: Sequence[bytes]) -> tuple[float, float]:
    """Wait until all robots are TRACKED later than an instant, and a measurement has come; both times [s]."""
    begin_s = time.monotonic()
    tracked_s = measured_s = 0.0

    def is_over() -> bool:
        nonlocal tracked_s, measured_s
        poses, now_s = graph.recorder.poses(), time.monotonic() - begin_s
        if poses and poses[-1].stamp_ns > since_ns and (poses[-1].status == Status.TRACKED).all():
            tracked_s = tracked_s or now_s
        measured_s = measured_s or (now_s if measured else 0.0)
        return bool(tracked_s and measured_s)

    graph.wait_for(is_over, "go on", START_PATIENCE_S)
    return tracked_s, measured_s


def go(graph: LiveGraph, seconds: float) -> None:
    """Let time pass."""
    end_s = time.monotonic() + seconds
    graph.wait_for(lambda: time.monotonic() > end_s, "go on", START_PATIENCE_S)


def trajectories(truth: Mapping[str, list[tuple[int, list[float]]]]) -> dict[str, Trajectory]:
    """The paths of robots by name."""
    return {
        name: Trajectory(np.array([at for at, _ in one]), np.array([pose for _, pose in one]))
        for name, one in truth.items()
    }


def measure(say: Say) -> dict[str, float]:
    """Figures of each pause, one after the other in one graph of each simulation."""
    figures: dict[str, float] = {}
    for kind, stops in STOPPED.items():
        port = free_port() if kind == "epucks_wifi" else 0
        with simulated(kind, port=port) as (graph, swarm, truth):
            measured: list[bytes] = []
            topic, message_type = _MEASURED[kind]
            graph.recorder.create_subscription(message_type, topic, measured.append, 1000, raw=True)
            _all_tracked(graph, 0, measured)
            go(graph, _BETWEEN_S)
            begin_ns = graph.recorder.poses()[-1].stamp_ns
            for what, node in stops.items():
                for pause_s in PAUSES_S:
                    say(f"{kind} {what} {pause_s:g} s")
                    with stopped(graph.process(node).pid):
                        go(graph, pause_s)
                    name = f"time.{kind}.{what}_stopped_{pause_s:g}_s"
                    measured.clear()
                    since_ns = graph.recorder.poses()[-1].stamp_ns
                    tracked_s, measured_s = _all_tracked(graph, since_ns, measured)
                    figures[f"{name}.tracked_s"], figures[f"{name}.measured_s"] = tracked_s, measured_s
                    figures[f"{name}.recovery_s"] = max(0.0, tracked_s - measured_s)
                    go(graph, _BETWEEN_S)
            paths = trajectories(truth)
            result = graph.recorder.result(kind, swarm, paths)
        figures[f"time.{kind}.misleading_share"] = misleading_share(result, paths, begin_ns)
    return figures
