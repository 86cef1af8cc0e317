"""Session with a PushBot: handshake, then a stream of events and wheel ticks, without I/O.

The board is reset first: this stops its motors, sets its clock and ticks to zero, and its banner identifies
it. While it streams, a velocity is sent when it changes and repeated before it decays, so a firmware with
decaying velocities stops the robot by itself soon after the last command.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from swarm_loc_drivers.common.link import Address
from swarm_loc_drivers.common.odometry import WheelGeometry
from swarm_loc_drivers.common.session import SessionError, Talk, TalkSession
from swarm_loc_drivers.pushbot import protocol
from swarm_loc_drivers.pushbot.clocks import EventClock, TickClock
from swarm_loc_drivers.pushbot.event_packets import EventPacket, EventPackets
from swarm_loc_drivers.pushbot.event_parser import EventParser, Parsed
from swarm_loc_drivers.pushbot.hardware import FirmwareGeneration
from swarm_loc_drivers.pushbot.protocol import Lights


@dataclass(frozen=True)
class PushbotSettings:
    """How to reach a robot, and what it does.

    Attributes:
        address: Address of the robot.
        baud_rate: Baud rate of a serial port [bit/s].
        geometry: Geometry of its wheels.
        wheel_noise: Variance of each wheel's path per metre it rolls [m^2/m].
        command_timeout_s: How long a velocity is valid [s].
        reply_timeout_s: How long an answer, or the next wheel ticks, may take [s].
        tick_period_s: Time between two readings of the wheel ticks [s].
        timestamps: Timestamps of events, a key of `hardware.TIMESTAMPS`; "" for no events at all.
        on_bit: The polarity bit of pixels that became brighter.
        packet_period_s: Period of packets of events [s].
        lights: Frequencies of laser and LEDs.
    """

    address: Address
    baud_rate: int
    geometry: WheelGeometry
    wheel_noise: float
    command_timeout_s: float
    reply_timeout_s: float
    tick_period_s: float
    timestamps: str
    on_bit: int
    packet_period_s: float
    lights: Lights


@dataclass(frozen=True)
class WheelTicks:
    """A reading of the wheels' counters.

    Attributes:
        stamp_ns: Best estimate of the acquisition time [ns].
        left: Ticks of the left wheel, 32 bits, wrapping.
        right: Ticks of the right wheel, 32 bits, wrapping.
    """

    stamp_ns: int
    left: int
    right: int


Velocities = Callable[[], tuple[int, int]]
"""Commands for the left and the right wheel [ticks per 21 ms]; called just before they are sent."""

_BOOT_S = 2.0
"""Time in which a board starts, in addition to that of an answer [s]."""
_ATTEMPTS = 3
_REPEAT_S = 0.4
"""A constant velocity is repeated after so long; a decaying one holds for a second [s]."""


class PushbotSession(TalkSession):
    """Session with one PushBot.

    Args:
        settings: Settings of the robot.
        velocities: Commands of the wheels.
        counts: Counts `events`, `readings`, `refused_commands`, `other_lines`, and those of `EventParser`.

    Attributes:
        ending: Set it to stop the robot and end the conversation.
        connected: Whether the robot has answered and sent wheel ticks.
        ended: Whether the conversation has ended; the robot stands.
        found: Measurements; the reader empties the list.
        generation: Its firmware, once it is known.
    """

    def __init__(self, settings: PushbotSettings, velocities: Velocities, counts: Counter[str]) -> None:
        super().__init__(counts)
        self.found: list[WheelTicks | EventPacket] = []
        self.generation: FirmwareGeneration | None = None
        self._settings = settings
        self._velocities = velocities
        self._sent, self._sent_s = (0, 0), 0.0

    def _run(self) -> Talk[None]:
        yield from self._answer(protocol.RESET, protocol.BANNER, _BOOT_S)
        if not self.ending:
            generation = yield from self._set_up()
            yield from self._stream(generation)
        yield from self._answer(self._farewell(), protocol.FORMAT, 0.0)

    def _set_up(self) -> Talk[FirmwareGeneration]:
        """Identify the firmware, configure it and start the stream."""
        settings = self._settings
        self._output += protocol.NO_ECHO
        listing = yield from self._answer(protocol.LIST_SENSORS, protocol.LAST_SENSORS, 0.0)
        generation = self.generation = protocol.generation_of(listing.string[: listing.end()])
        if generation is None:
            raise SessionError("the board's firmware has no wheels: it is not built for PushBots")
        if settings.timestamps:
            yield from self._choose_format(generation, settings.timestamps)
        self._output += protocol.lights(settings.lights) + protocol.BRAKE + protocol.MOTORS_ON
        self._output += protocol.stream_ticks(generation, _tick_period_ms(settings))
        if settings.timestamps:
            self._output += protocol.EVENTS_ON
        return generation

    def _choose_format(self, generation: FirmwareGeneration, timestamps: str) -> Talk[None]:
        if timestamps not in generation.formats:
            raise SessionError(
                f"the firmware, of the {generation.name} generation, has no timestamps '{timestamps}', only"
                f" {', '.join(generation.formats)}"
            )
        wanted = protocol.event_format(generation, timestamps) + protocol.QUERY_FORMAT
        answer = yield from self._answer(wanted, protocol.FORMAT, 0.0)
        if int(answer[1]) != generation.formats[timestamps]:
            raise SessionError(f"the robot answers {answer[0]!r} to the choice of timestamps '{timestamps}'")

    def _answer(self, request: bytes, pattern: re.Pattern[bytes], extra_s: float) -> Talk[re.Match[bytes]]:
        """The answer to a request, which is sent up to three times."""
        for _ in range(_ATTEMPTS):
            timeout_s = self._settings.reply_timeout_s + extra_s
            if (match := (yield from self._ask_once(request, pattern, timeout_s))) is not None:
                return match
        raise SessionError(f"the robot does not answer {request.split()[0].decode()}")

    def _stream(self, generation: FirmwareGeneration) -> Talk[None]:
        """Take measurements and send velocities until the session ends."""
        settings = self._settings
        parser = EventParser(settings.timestamps or "none", self._counts)
        clock = EventClock(parser.span_us) if settings.timestamps not in ("", "none") else None
        packets = EventPackets(settings.packet_period_s, settings.on_bit)
        readings = TickClock(_tick_period_ms(settings))
        ticks_s = self._steady_s
        while not self.ending:
            yield
            received, self._received = self._received, b""
            parsed = parser.feed(received)
            stamps_ns = self._take_events(parsed, clock, packets)
            for before, line in parsed.lines:
                if before and clock is not None:
                    readings.pass_event(int(parsed.time_us[before - 1]), stamps_ns[before - 1])
                if self._take_line(line, readings, generation):
                    ticks_s, self.connected = self._steady_s, True
            if self._steady_s > ticks_s + settings.reply_timeout_s + settings.tick_period_s:
                raise SessionError("the robot has stopped sending wheel ticks")
            self._send_velocity(generation)

    def _take_events(self, parsed: Parsed, clock: EventClock | None, packets: EventPackets) -> list[int]:
        """Stamp and pack events; their stamps [ns], which time the lines between them."""
        count = len(parsed.x)
        stamps: list[int] = []
        if count:
            stamps_ns = parsed.time_us * 0 + self._now_ns
            if clock is not None:
                stamps_ns = clock.stamps(parsed.time_us, self._now_ns)
            self._counts["events"] += count
            packets.add(parsed.x, parsed.y, parsed.polarity, stamps_ns, parsed.time_us)
            stamps = stamps_ns.tolist() if parsed.lines else []
        packets.flush_late(self._now_ns)
        self.found += packets.ready
        packets.ready.clear()
        return stamps

    def _take_line(self, line: bytes, readings: TickClock, generation: FirmwareGeneration) -> bool:
        """Take a line; whether it was wheel ticks.

        Raises:
            SessionError: The board was reset.
        """
        ticks = protocol.wheel_ticks(line, generation)
        if ticks is not None:
            self._counts["readings"] += 1
            self.found.append(WheelTicks(readings.stamp_ns(self._now_ns), *ticks))
            return True
        if protocol.BANNER.search(line + b"\n"):
            raise SessionError("the robot has been reset")
        self._counts["refused_commands" if protocol.is_refusal(line) else "other_lines"] += 1
        return False

    def _send_velocity(self, generation: FirmwareGeneration) -> None:
        """Send a new velocity, and repeat one before it decays; zero until the robot is connected."""
        wanted = self._velocities() if self.connected else (0, 0)
        if wanted == self._sent and (wanted == (0, 0) or self._steady_s < self._sent_s + _REPEAT_S):
            return
        self._output += protocol.velocity(generation, *wanted) if any(wanted) else protocol.BRAKE
        self._sent, self._sent_s = wanted, self._steady_s

    def _farewell(self) -> bytes:
        """Commands that turn everything off; the answer to the final query confirms all of them."""
        dark = protocol.lights(protocol.Lights(0.0, 0.0))
        off = protocol.EVENTS_OFF + protocol.STOP_SENSORS + protocol.MOTORS_OFF
        return b"\n" + protocol.BRAKE + off + dark + protocol.QUERY_FORMAT


def _tick_period_ms(settings: PushbotSettings) -> int:
    """Period of the wheel ticks [ms]."""
    return max(1, round(1e3 * settings.tick_period_s))
