"""Robots that send nothing but events, at a rate that no wire of theirs could carry: a load for drivers.

python -m bench.pushbot.event_feed 56000 10 300000
"""

from __future__ import annotations

import sys
import time

import numpy as np

from swarm_loc_drivers.pushbot.protocol import SECOND_FIRMWARE
from swarm_loc_drivers.sim.link_host import FirmwareHost
from swarm_loc_drivers.sim.pushbot.event_camera import Blinking
from swarm_loc_drivers.sim.pushbot.firmware import PushbotFirmware

_STEP_S = 0.005
_POLLS = 4  # A firmware hands on no more than two of its buffers at once
_BAUD_RATE = 1_000_000_000  # Ten of them at once are to test the driver and the graph, not the wire


class StandingBody:
    """A robot on a desk."""

    def set_duties(self, left: float, right: float) -> None:
        """It has no wheels."""

    def wheel_ticks(self) -> tuple[int, int]:
        """None are done."""
        return 0, 0

    def set_lights(self, laser: Blinking, rear: Blinking, front: Blinking) -> None:
        """It has no lights."""

    @property
    def now_ns(self) -> int:
        """The time [ns]."""
        return time.monotonic_ns()


class Feed:
    """Robots behind TCP ports.

    Args:
        first_port: Of the first robot, the others follow.
        robots: How many.
        rate: Events of each [1/s].
    """

    def __init__(self, first_port: int, robots: int, rate: float) -> None:
        self.host = FirmwareHost()
        self._firmwares = [
            PushbotFirmware(StandingBody(), SECOND_FIRMWARE, _BAUD_RATE) for _ in range(robots)
        ]
        for robot, firmware in enumerate(self._firmwares):
            self.host.serve_tcp(firmware, port=first_port + robot)
        rng = np.random.default_rng(1)
        self._words = rng.integers(0, 1 << 15, round(rate)).astype(np.uint16)
        self._rate = rate
        self._fed_us = time.monotonic_ns() // 1000

    def step(self) -> None:
        """Let the events of the time since the last step be seen, and send what is due."""
        now_us = time.monotonic_ns() // 1000
        count = min(round(self._rate * 1e-6 * (now_us - self._fed_us)), len(self._words))
        times = np.linspace(self._fed_us, now_us, count, endpoint=False).astype(np.int64)
        self._fed_us = now_us
        for firmware in self._firmwares:
            for _ in range(round(1e3 * _STEP_S)):
                firmware.millisecond()
            firmware.see(self._words[:count], times)
        for _ in range(_POLLS):
            self.host.poll(0.0)


def main() -> None:
    """Feed until ended."""
    feed = Feed(int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]))
    print("feeding", flush=True)
    due_s = time.monotonic()
    while True:
        feed.step()
        due_s = max(due_s + _STEP_S, time.monotonic())
        while (left_s := due_s - time.monotonic()) > 0.0:
            feed.host.poll(left_s)


if __name__ == "__main__":
    main()
