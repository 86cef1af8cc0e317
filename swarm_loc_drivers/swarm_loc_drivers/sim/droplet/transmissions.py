"""Infrared transmissions on their way between Droplets: messages, and exchanges of brightness."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.droplet import infrared_timing as timing
from swarm_loc_drivers.droplet.hardware import ELEMENTS


def overlap(one: Message | Exchange, other: Message | Exchange) -> bool:
    """Whether two transmissions are on their way at the same time."""
    return one.begin_ns < other.end_ns and one.end_ns > other.begin_ns


@dataclass
class Message:
    """A transmission.

    Attributes:
        sender: Index of the robot.
        begin_ns: When.
        end_ns: When it is through.
        hearers: Indices of the robots in its reach at its begin.
        line: The command; "" for the call that begins an exchange.
        target: Id of whom it is for; 0: all.
    """

    sender: int
    begin_ns: int
    end_ns: int
    hearers: NDArray[np.int64]
    line: str = ""
    target: int = 0
    done: bool = False

    def reaches(self, robot: int) -> bool:
        """Whether a robot sends it or may hear it."""
        return robot == self.sender or robot in self.hearers


@dataclass
class Exchange:
    """An exchange.

    Attributes:
        emitter: Index of the robot.
        begin_ns: When the call began.
        power: Of its emitters.
        receivers: (k,) indices of the robots that have heard the call.
        readings: (k, n, n) emitters by sensors, as far as measured.
        flashes: How many.
        done: Whether it is over and its readings are told.
    """

    emitter: int
    begin_ns: int
    power: int
    receivers: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    readings: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 0, 0), dtype=np.int64))
    flashes: int = 0
    done: bool = False

    @property
    def end_ns(self) -> int:
        """When the last flash is over."""
        return self.begin_ns + timing.EXCHANGE_NS

    def has(self, robot: int) -> bool:
        """Whether a robot emits or measures."""
        return robot == self.emitter or robot in self.receivers

    def lit(self, now_ns: int) -> int | None:
        """The emitter that is lit now."""
        since_ns = now_ns - self.begin_ns - timing.LEAD_NS
        flash, within = divmod(since_ns, timing.FLASH_NS + timing.GAP_NS)
        return flash if since_ns >= 0 and flash < ELEMENTS and within < timing.FLASH_NS else None
