"""What the path of events costs: bytes to packets in one core, and robots at once through the graph."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy

from bench.pushbot.event_feed import StandingBody
from bench.shared.common import Cell, new_plot, save_plot, table
from swarm_loc_drivers.core.pushbot.session import PushbotSession
from swarm_loc_drivers.core.pushbot.settings import PushbotSettings, WheelGeometry
from swarm_loc_drivers.protocols.pushbot.commands import Lights
from swarm_loc_drivers.protocols.pushbot.hardware import SECOND_FIRMWARE, TIMESTAMPS
from swarm_loc_drivers.sim.pushbot.firmware.event_stream import EventRing
from swarm_loc_drivers.sim.pushbot.firmware.pushbot_firmware import PushbotFirmware
from swarm_loc_drivers.transports.link import Address
from swarm_loc_estimator.launching.processes import executable_path
from swarm_loc_msgs.msg import EventPacket

RATE = 300_000
"""Events of each robot [1/s]."""
FIRST_PORT = 57_100
_CHUNK_S = 0.003
_SECONDS = 3.0
_EVENT_BYTES = 8
_PACKETS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)


def settings(timestamps: str) -> PushbotSettings:
    """Settings of a driver that does nothing but take events."""
    return PushbotSettings(
        address=Address(device="/dev/none"),
        baud_rate=4_000_000,
        geometry=WheelGeometry(1e-4, 0.085),
        wheel_noise=2e-4,
        command_timeout_s=0.5,
        reply_timeout_s=0.5,
        tick_period_s=0.02,
        timestamps=timestamps,
        on_bit=0,
        packet_period_s=0.005,
        lights=Lights(0.0, 0.0),
    )


def session_rate(timestamps: str, seed: int) -> float:
    """Events that a session turns from bytes into packets in a second of one core [1/s]."""
    body = StandingBody()
    firmware = PushbotFirmware(body, SECOND_FIRMWARE)
    session = PushbotSession(settings(timestamps), lambda: (0, 0), Counter())
    while not firmware.board.is_streaming:
        firmware.receive(session.step(firmware.stream(), body.now_ns, time.monotonic()))
    rng = np.random.default_rng(seed)
    count = round(RATE * _CHUNK_S)
    ring, chunks, at_us = EventRing(), [], 0
    for _ in range(400):
        times = at_us + np.sort(rng.integers(0, round(1e6 * _CHUNK_S), count))
        at_us += round(1e6 * _CHUNK_S)
        ring.put(rng.integers(0, 1 << 15, count).astype(np.uint16), times, count)
        chunks.append(ring.take(at_us, 1 << 20, TIMESTAMPS[timestamps]))
    begin_s, now_ns = time.process_time(), 10**9
    for chunk in chunks:
        now_ns += round(1e9 * _CHUNK_S)
        session.step(chunk, now_ns, 0.0)
        session.found.clear()
    return len(chunks) * count / (time.process_time() - begin_s)


class Flow:
    """Robots at once: one process that feeds, one driver each, and this process that counts.

    Args:
        robots: How many.
    """

    def __init__(self, robots: int) -> None:
        self._robots = robots
        self._events, self._packets, self._lost = Counter[int](), Counter[int](), Counter[int]()
        self._next: dict[int, int] = {}

    def measure(self) -> tuple[float, float, float]:
        """Events that came [1/s of each robot], share of packets that did not, cores of a driver."""
        with ExitStack() as running:
            feed = [sys.executable, "-m", "bench.pushbot.event_feed"]
            self._start(running, [*feed, str(FIRST_PORT), str(self._robots), str(RATE)])
            drivers = [self._start(running, self._driver(robot)) for robot in range(self._robots)]
            rclpy.init(args=[])
            node = rclpy.create_node("bench_events")
            for robot in range(self._robots):
                count = partial(self._count, robot)
                node.create_subscription(EventPacket, f"pushbot{robot}/events", count, _PACKETS)
            executor = EventsExecutor()
            executor.add_node(node)
            try:
                return self._spin(executor, drivers)
            finally:
                executor.shutdown()
                node.destroy_node()
                rclpy.try_shutdown()

    def _spin(
        self, executor: EventsExecutor, drivers: list[subprocess.Popen[bytes]]
    ) -> tuple[float, float, float]:
        end_s = time.monotonic() + 60.0
        while len(self._next) < self._robots and time.monotonic() < end_s:
            executor.spin_once(timeout_sec=0.05)
        settled_s = time.monotonic() + 1.0
        while time.monotonic() < settled_s:
            executor.spin_once(timeout_sec=0.05)
        for counter in (self._events, self._packets, self._lost):
            counter.clear()
        begin_s, used_s = time.monotonic(), [_cpu_s(driver.pid) for driver in drivers]
        while time.monotonic() < begin_s + _SECONDS:
            executor.spin_once(timeout_sec=0.05)
        elapsed_s = time.monotonic() - begin_s
        cores = (
            np.mean([_cpu_s(one.pid) - before for one, before in zip(drivers, used_s, strict=True)])
            / elapsed_s
        )
        came = sum(self._events.values()) / self._robots / elapsed_s
        lost, packets = sum(self._lost.values()), sum(self._packets.values())
        return came, lost / max(1, lost + packets), float(cores)

    def _count(self, robot: int, message: EventPacket) -> None:
        self._events[robot] += len(message.events) // _EVENT_BYTES
        self._packets[robot] += 1
        # a driver that connects anew counts from 0 again
        self._lost[robot] += max(0, message.seq - self._next.get(robot, message.seq))
        self._next[robot] = message.seq + 1

    def _start(self, running: ExitStack, command: list[str]) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        running.callback(process.wait)
        running.callback(process.send_signal, signal.SIGTERM)
        return process

    def _driver(self, robot: int) -> list[str]:
        executable = str(executable_path("swarm_loc_drivers", "pushbot_driver_node"))
        address = f"address:=tcp://localhost:{FIRST_PORT + robot}"
        return [executable, "--ros-args", "-r", f"__ns:=/pushbot{robot}", "-p", address]


def _cpu_s(process: int) -> float:
    """Time that a process has used of a core [s]."""
    fields = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure_driver(seeds: int) -> dict[str, float]:
    """Figures of the path of events; prints a table and draws it.

    Args:
        seeds: How many repetitions of what is measured within a process.
    """
    rates = {name: [session_rate(name, seed) for seed in range(seeds)] for name in TIMESTAMPS}
    print(
        table(
            ["timestamps", "events/s in one core", "least"], [[k, max(v), min(v)] for k, v in rates.items()]
        )
    )
    flows: dict[int, tuple[float, float, float]] = {robots: Flow(robots).measure() for robots in (1, 2, 10)}
    rows: list[list[Cell]] = [[robots, *flow] for robots, flow in flows.items()]
    print(table(["robots", "events/s of each that came", "share of packets lost", "cores of a driver"], rows))
    _draw(rates, flows)
    return {
        "driver.events_per_s": float(np.median(rates["24bit"])),
        "driver.core": flows[1][2],
        **{f"driver.events_per_s.robots{robots}": flow[0] for robots, flow in flows.items()},
        **{f"driver.lost_share.robots{robots}": flow[1] for robots, flow in flows.items()},
        **{
            f"driver.not_passed_share.robots{robots}": max(0.0, 1.0 - flow[0] / RATE)
            for robots, flow in flows.items()
        },
    }


def _draw(rates: dict[str, list[float]], flows: dict[int, Any]) -> None:
    figure, (left, right) = new_plot(2)
    left.bar(list(rates), [1e-6 * float(np.median(one)) for one in rates.values()])
    left.axhline(1e-6 * RATE, color="k", ls=":")
    left.set(xlabel="timestamps", ylabel="events of one core [M/s]", title="bytes to packets")
    right.bar([str(one) for one in flows], [100.0 * flow[0] / RATE for flow in flows.values()])
    right.set(xlabel="robots of 300 k events/s", ylabel="events that came [%]", title="through the graph")
    print(f"wrote {save_plot(figure, 'pushbot_driver')}")


if __name__ == "__main__":
    print(measure_driver(3))
