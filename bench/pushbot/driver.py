"""What the path of events costs: bytes to packets in one core, and robots at once through the graph."""

from __future__ import annotations

import time
from collections import Counter

import numpy as np

from bench.pushbot.event_feed import StandingBody
from bench.pushbot.event_flow import RATE, EventFlow, Measured
from bench.shared.common import Cell, new_plot, save_plot, table
from swarm_loc_drivers.pushbot.driver import PushbotSession
from swarm_loc_drivers.pushbot.parameters import PushbotParameters
from swarm_loc_drivers.pushbot.protocol import SECOND_FIRMWARE, TIMESTAMPS
from swarm_loc_drivers.sim.pushbot.firmware import EventRing, PushbotFirmware

ROBOTS = (1, 2, 10)
_CORES = 2
_CHUNK_S = 0.003


def session_rate(timestamps: str, seed: int) -> float:
    """Events that a session turns from bytes into packets in a second of one core [1/s]."""
    body = StandingBody()
    firmware = PushbotFirmware(body, SECOND_FIRMWARE)
    params = PushbotParameters("/dev/none", timestamps=timestamps, laser_frequency=0.0, led_frequency=0.0)
    session = PushbotSession(params, lambda: (0, 0), Counter())
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
    flows = {robots: EventFlow(robots).measure() for robots in ROBOTS}
    rows: list[list[Cell]] = [[robots, *flow, robots_on_two_cores(flow)] for robots, flow in flows.items()]
    head = ["robots", "events/s of each that came", "packets lost", "cores of a driver", "of a tracker"]
    print(table([*head, "of the feed", "of others", f"robots on {_CORES} cores"], rows))
    _draw(rates, flows)
    return {
        "driver.events_per_s": float(np.median(rates["24bit"])),
        "driver.core": flows[1].driver,
        "driver.tracker_core": flows[1].tracker,
        "driver.robots_on_two_cores": robots_on_two_cores(flows[1]),
        **{f"driver.events_per_s.robots{robots}": flow.events_per_s for robots, flow in flows.items()},
        **{f"driver.lost_share.robots{robots}": flow.lost for robots, flow in flows.items()},
        **{f"driver.other_cores.robots{robots}": flow.others for robots, flow in flows.items()},
        **{
            f"driver.not_passed_share.robots{robots}": max(0.0, 1.0 - flow.events_per_s / RATE)
            for robots, flow in flows.items()
        },
    }


def robots_on_two_cores(flow: Measured) -> float:
    """How many robots at full rate two cores could carry, with a driver and a tracker each."""
    share = max(flow.events_per_s / RATE, 1e-6)  # what was not passed cost nothing
    return _CORES * share / max(flow.driver + flow.tracker, 1e-6)


def _draw(rates: dict[str, list[float]], flows: dict[int, Measured]) -> None:
    figure, (left, right) = new_plot(2)
    left.bar(list(rates), [1e-6 * float(np.median(one)) for one in rates.values()])
    left.axhline(1e-6 * RATE, color="k", ls=":")
    left.set(xlabel="timestamps", ylabel="events of one core [M/s]", title="bytes to packets")
    right.bar([str(one) for one in flows], [100.0 * flow.events_per_s / RATE for flow in flows.values()])
    right.set(xlabel="robots of 300 k events/s", ylabel="events that came [%]", title="through the graph")
    print(f"wrote {save_plot(figure, 'pushbot_driver')}")
