"""Run a driver process per robot on one machine: time to discover all, lost messages, load of the estimator.

    make bench-drivers
    make bench-drivers ARGS="--robots 50 --discovery multicast"

Each driver polls an emulated e-puck on a serial port of its own and publishes its odometry; the robots stand.
It is measured with multicast, as ROS comes, and with a Fast DDS discovery server. To count losses, the robots
pause until the counts of drivers and estimator no longer change, answer for a while, and pause again.
"Discovery" is the time from the last driver's first answer to the first message of the last robot.
"""

import os
import re
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray

from bench.shared.common import OUT, Cell, flat, options_of, plot_by_size, table, write_figures
from swarm_loc_drivers.epuck.hardware import EPUCK2
from swarm_loc_drivers.sim.epuck.serial_firmware import SerialFirmware
from swarm_loc_drivers.sim.epuck.world import EpuckWorldParameters, SimulatedEpuck, make_world
from swarm_loc_drivers.sim.link_host import FirmwareHost
from swarm_loc_estimator.common.launch import NodeSpec, ParameterValue
from swarm_loc_estimator.offline.live_run import LiveGraph, Recorder, cpu_seconds
from swarm_loc_estimator.swarm.swarm import Face, Landmark, Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import save_swarm

SIZES = (50, 100, 200)
MULTICAST, SERVER = "multicast", "server"
RATE_HZ = 10.0
DURATION_S = 30.0
_PATIENCE_S = 900.0
_SETTLED_REPORTS = 3  # Reports of each driver without another reading, until counts are said to have settled
_SPACING_M = 0.5
_CYCLE_S = 0.01
_CONNECTED = re.compile(r"\[(\d+\.\d+)\] \[\w+\.epuck_driver\]: connected to")
_UNITS = {
    "start_up_s": "start-up [s]",
    "discovery_s": "discovery [s]",
    "sent_messages": "messages",
    "lost_messages": "lost",
    "estimator_core": "estimator [core]",
    "driver_core": "a driver [core]",
}


class Counts:
    """Messages that drivers have published and the estimator has received, from /diagnostics.

    Args:
        recorder: Whose node listens.
        robots: Number of robots.
    """

    def __init__(self, recorder: Recorder, robots: int) -> None:
        self._recorder, self._robots = recorder, robots
        self._published: dict[str, int] = {}
        self._unchanged: dict[str, int] = {}
        self._last_received = -1
        self.all_heard_s = 0.0
        """When the estimator first reported a message of every robot."""
        recorder.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 1000)

    @property
    def published(self) -> int:
        """Odometry messages of all drivers."""
        return sum(self._published.values())

    @property
    def received(self) -> int:
        """Odometry messages that reached the estimator."""
        return self._recorder.inputs

    def are_all_heard(self) -> bool:
        """Whether the estimator has received a message of every robot."""
        if not self.all_heard_s and self._recorder.taken:
            newest = self._recorder.taken[max(self._recorder.taken)]
            if sum(count > 0 for count in newest.values()) == self._robots:
                self.all_heard_s = time.time()
        return bool(self.all_heard_s)

    def begin_to_settle(self) -> None:
        """Count reports without changes from here on."""
        self._unchanged.clear()

    def have_settled(self) -> bool:
        """Whether no driver and not the estimator has had another message for some reports."""
        settled = sum(count >= _SETTLED_REPORTS for count in self._unchanged.values())
        return settled == self._robots + 1

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {value.key: value.value for value in status.values}
            if status.name.endswith("epuck_driver") and "readings" in values:
                self._note(status.name, self._published.get(status.name), int(values["readings"]))
                self._published[status.name] = int(values["readings"])
            elif status.name == "estimator":
                self._note(status.name, self._last_received, self.received)
                self._last_received = self.received

    def _note(self, name: str, before: int | None, now: int) -> None:
        self._unchanged[name] = self._unchanged.get(name, 0) + 1 if before == now else 0


def measure(robots: int, discovery: str, duration_s: float) -> dict[str, float]:
    """All figures of one number of robots."""
    log = OUT / "drivers" / f"{discovery}_{robots}.log"
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        save_swarm(_swarm(robots), work / "swarm.yaml")
        with _emulated(work) as robots_answer, _server() if discovery == SERVER else nullcontext():
            began_s = time.time()
            with LiveGraph(_nodes(robots, work), log) as graph:
                # start until every robot is heard
                counts = Counts(graph.recorder, robots)
                graph.wait_for(counts.are_all_heard, "receive odometry of every robot", _PATIENCE_S)
                before = _settled(graph, counts, robots_answer)
                pids = [graph.process(name).pid for name in ("estimator", "epuck1/epuck_driver")]
                cpu_s = [cpu_seconds(pid) for pid in pids]
                # drive, and count what arrives
                measured_s = time.monotonic()
                robots_answer.send(True)
                until_s = measured_s + duration_s
                graph.wait_for(lambda: time.monotonic() > until_s, "go on", _PATIENCE_S)
                used = [cpu_seconds(pid) - at_first for pid, at_first in zip(pids, cpu_s, strict=True)]
                measured_s = time.monotonic() - measured_s
                after = _settled(graph, counts, robots_answer)
                robots_answer.send(True)
    # figures
    sent, received = np.subtract(after, before).tolist()
    connected_s = max(float(match[1]) for match in _CONNECTED.finditer(log.read_text(encoding="utf-8")))
    figures = (
        counts.all_heard_s - began_s,
        max(counts.all_heard_s - connected_s, 0.0),
        sent,
        sent - received,
        used[0] / measured_s,
        used[1] / measured_s,
    )
    return {name: float(value) for name, value in zip(_UNITS, figures, strict=True)}


def _swarm(robots: int) -> Swarm:
    """Robots that stand in a square; their emulated cameras want markers, which nobody looks for."""
    side = int(np.ceil(np.sqrt(robots)))
    standing = (
        Robot(
            f"epuck{k + 1}",
            faces=(Face("front", k, yaw=0.0),),
            start=(_SPACING_M * (k % side), _SPACING_M * (k // side), 0.0),
        )
        for k in range(robots)
    )
    return Swarm(tuple(standing), (Landmark(robots, x=-1.0, y=0.0, yaw=0.0),))


def _nodes(robots: int, work: Path) -> list[NodeSpec]:
    estimator = {"swarm_file": str(work / "swarm.yaml")}
    nodes = [NodeSpec("swarm_loc_estimator", "estimator_node", "estimator", "", estimator)]
    for name in (f"epuck{k + 1}" for k in range(robots)):
        # robots pause in the measurement, which their drivers shall not take for a lost link
        driver: dict[str, ParameterValue] = {
            "address": f"{work}/{name}",
            "reading_rate": RATE_HZ,
            "reply_timeout_s": 10.0,
        }
        nodes.append(NodeSpec("swarm_loc_drivers", "epuck_driver_node", "epuck_driver", name, driver))
    return nodes


def _settled(graph: LiveGraph, counts: Counts, robots_answer: Connection) -> tuple[int, int]:
    """Let the robots pause, and wait until nothing is on its way; messages published and received so far."""
    robots_answer.send(False)
    counts.begin_to_settle()
    graph.wait_for(counts.have_settled, "settle", _PATIENCE_S)
    return counts.published, counts.received


@contextmanager
def _emulated(work: Path) -> Iterator[Connection]:
    """Serial ports at which a process answers for each robot while True was the last thing sent to it."""
    context = get_context("spawn")
    orders, theirs = context.Pipe()
    process = context.Process(target=_emulate, args=(work, theirs), daemon=True)
    process.start()
    theirs.close()
    with orders:
        orders.recv()  # raises EOFError if the process ends before
        yield orders
    process.join()


def _emulate(work: Path, orders: Connection) -> None:
    """Answer, or pause, as ordered, until the other end of the pipe is closed."""
    parameters = EpuckWorldParameters(swarm_file=str(work / "swarm.yaml"), arena_x=100.0, arena_y=100.0)
    swarm, world = make_world(parameters)
    host = FirmwareHost()
    for index, robot in enumerate(swarm.robots):
        host.serve_pty(SerialFirmware(SimulatedEpuck(world, index), EPUCK2), work / robot.name)
    orders.send(len(swarm.robots))
    answers = True
    with suppress(EOFError):
        while True:
            if orders.poll(0.0 if answers else None):
                answers = orders.recv()
            else:
                host.poll(_CYCLE_S)


@contextmanager
def _server() -> Iterator[None]:
    """A Fast DDS discovery server, which this process and its children use."""
    port = 11811
    server = subprocess.Popen(["fast-discovery-server", "-i", "0", "-l", "127.0.0.1", "-p", str(port)])
    os.environ["ROS_DISCOVERY_SERVER"] = f"127.0.0.1:{port}"
    try:
        yield
    finally:
        del os.environ["ROS_DISCOVERY_SERVER"]
        server.terminate()
        server.wait()


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    ways = (MULTICAST, SERVER)
    options = options_of(
        __doc__,
        arguments,
        robots=(SIZES, "numbers of drivers"),
        discovery=(ways, "how drivers are found", ways),
        duration=(DURATION_S, "of a measurement [s]"),
    )
    results: dict[str, dict[int, dict[str, float]]] = {}
    for discovery in options.discovery:
        for robots in options.robots:
            figures = measure(robots, discovery, options.duration)
            results.setdefault(discovery, {})[robots] = figures
            print(robots, discovery, figures, flush=True)
    rows: list[list[Cell]] = [
        [n, way, *figures.values()] for way, found in results.items() for n, figures in found.items()
    ]
    print(table(["robots", "discovery", *_UNITS.values()], rows))
    shown = {name: _UNITS[name] for name in ("start_up_s", "discovery_s", "estimator_core")}
    print(f"plot: {plot_by_size('drivers', results, shown, 'driver processes', 'discovery')}")
    named = {f"{way}{n}": figures for way, found in results.items() for n, figures in found.items()}
    print(f"figures: {write_figures('drivers', flat(named))}")


if __name__ == "__main__":
    main()
