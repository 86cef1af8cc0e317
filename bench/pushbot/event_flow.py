"""Robots of 300 k events/s each through the graph: each with a driver and an event tracker of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.qos import QoSProfile

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.launch import executable_path
from swarm_loc_estimator.offline.live_run import cpu_seconds

RATE = 300_000  # Events of each robot [1/s]
FIRST_PORT = 57_100
_SECONDS = 6.0
_START_S, _SETTLE_S = 120.0, 2.0
_EVENTS, _PACKETS, _LOST = "events", "packets", "packets lost on the way"


class Measured(NamedTuple):
    """What came of robots at once."""

    events_per_s: float  # Events of each robot that its tracker has taken [1/s]
    # Share of packets that were lost between driver and tracker, as the tracker's diagnostics count
    lost: float
    driver: float  # Cores of one driver
    tracker: float  # Cores of one tracker
    feed: float  # Cores of the process that plays all robots
    others: float  # Cores that the rest of the machine had, of all there are


class EventFlow:
    """One process that feeds, and for each robot a driver and a tracker.

    Args:
        robots: How many.
    """

    def __init__(self, robots: int) -> None:
        self._robots = robots
        self._counts: dict[str, tuple[float, dict[str, int]]] = {}

    def measure(self) -> Measured:
        """Let events flow for a while."""
        with ExitStack() as running:
            feed_command = [sys.executable, "-m", "bench.pushbot.event_feed"]
            feed = _start(running, [*feed_command, str(FIRST_PORT), str(self._robots), str(RATE)])
            drivers = [_start(running, _driver(robot)) for robot in range(self._robots)]
            trackers = [_start(running, _tracker(robot)) for robot in range(self._robots)]
            rclpy.init(args=[])
            node = rclpy.create_node("bench_events")
            node.create_subscription(
                DiagnosticArray, "/diagnostics", self._on_diagnostics, QoSProfile(depth=200)
            )
            executor = EventsExecutor()
            executor.add_node(node)
            try:
                self._spin_until(executor, lambda: len(self._counts) == self._robots, _START_S)
                self._spin_until(executor, lambda: False, _SETTLE_S)
                before, begin_s = dict(self._counts), time.monotonic()
                used = [cpu_seconds(one.pid) for one in (feed, *drivers, *trackers)]
                machine = _machine_s()
                self._spin_until(executor, lambda: False, _SECONDS)
                elapsed_s = time.monotonic() - begin_s
                cores = (
                    np.array([cpu_seconds(one.pid) for one in (feed, *drivers, *trackers)]) - used
                ) / elapsed_s
                others = (_machine_s() - machine) / elapsed_s - float(cores.sum())
                return self._result(before, cores, others)
            finally:
                executor.shutdown()
                node.destroy_node()
                rclpy.try_shutdown()

    def _result(
        self, before: dict[str, tuple[float, dict[str, int]]], cores: FloatArray, others: float
    ) -> Measured:
        rates, lost, packets = [], 0, 0
        for name, (first_s, first) in before.items():
            last_s, last = self._counts[name]
            rates.append((last[_EVENTS] - first[_EVENTS]) / max(last_s - first_s, 1e-3))
            lost += last[_LOST] - first[_LOST]
            packets += last[_PACKETS] - first[_PACKETS]
        came = sum(rates) / self._robots
        drivers, trackers = cores[1 : 1 + self._robots], cores[1 + self._robots :]
        share = lost / max(1, lost + packets)
        return Measured(came, share, float(drivers.mean()), float(trackers.mean()), float(cores[0]), others)

    def _spin_until(self, executor: EventsExecutor, done: Callable[[], bool], patience_s: float) -> None:
        end_s = time.monotonic() + patience_s
        while not done() and time.monotonic() < end_s:
            executor.spin_once(timeout_sec=0.05)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith("/event_tracker"):
                values = {one.key: one.value for one in status.values}
                counts = {key: int(values.get(key, 0)) for key in (_EVENTS, _PACKETS, _LOST)}
                if counts[_EVENTS]:
                    self._counts[status.name] = time.monotonic(), counts


def _start(running: ExitStack, command: list[str]) -> subprocess.Popen[bytes]:
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    running.callback(process.wait)
    running.callback(process.send_signal, signal.SIGTERM)
    return process


def _driver(robot: int) -> list[str]:
    executable = str(executable_path("swarm_loc_drivers", "pushbot_driver_node"))
    address = f"address:=tcp://localhost:{FIRST_PORT + robot}"
    return [executable, "--ros-args", "-r", f"__ns:=/pushbot{robot}", "-p", address]


def _tracker(robot: int) -> list[str]:
    executable = str(executable_path("swarm_loc_vision", "event_tracker_node"))
    return [executable, "--ros-args", "-r", f"__ns:=/pushbot{robot}", "-p", "light_frequencies:=['1000']"]


def _machine_s() -> float:
    """Time that all processes of the machine have used of its cores [s]."""
    fields = [int(one) for one in Path("/proc/stat").read_text(encoding="ascii").split("\n")[0].split()[1:]]
    idle = fields[3] + fields[4]
    return (sum(fields) - idle) / os.sysconf("SC_CLK_TCK")
