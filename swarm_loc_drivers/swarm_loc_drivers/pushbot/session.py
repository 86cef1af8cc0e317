"""A conversation with a PushBot: handshake, then a stream of events and wheel ticks. No I/O.

The board is reset first. So its motors stand whatever was before, its clock and its ticks begin at zero, and
what it says at its start tells that it is one. While it streams it gets a velocity whenever that changes, and
otherwise so often that a firmware that can stops by itself soon after it hears nothing.
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
    """How to reach a robot and what it is to do.

    Attributes:
        address: Where it answers.
        baud_rate: Of a serial port [bit/s].
        geometry: Its wheels.
        wheel_noise: Variance of each wheel's path per metre it rolls [m^2/m].
        command_timeout_s: How long a velocity counts [s].
        reply_timeout_s: How long an answer, or the next wheel ticks, may take [s].
        tick_period_s: Between two readings of the wheel ticks [s].
        timestamps: Of events, a key of `hardware.TIMESTAMPS`; "" for no events at all.
        on_bit: The polarity bit of pixels that became brighter.
        packet_period_s: Of packets of events [s].
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
        stamp_ns: Acquisition, as well as it can be known [ns].
        left: Ticks of the left wheel, 32 bits, wrapping.
        right: Likewise of the right wheel.
    """

    stamp_ns: int
    left: int
    right: int


Velocities = Callable[[], tuple[int, int]]
"""Tells what the wheels are to do, left and right [ticks per 21 ms]; called when it is about to be sent."""

_BOOT_S = 2.0
"""So long a board may take to start, besides the time of an answer."""
_ATTEMPTS = 3
_REPEAT_S = 0.4
"""A velocity that does not change is told again after so long; a decaying one holds for a second."""


class PushbotSession(TalkSession):
    """Goes on whenever there are bytes, or time has passed.

    Args:
        settings: Of the robot.
        velocities: Tells what the wheels are to do.
        counts: Gets `events`, `readings`, `refused_commands`, `other_lines`, and those of `EventParser`.

    Attributes:
        ending: Set it to have the robot stand and the conversation end.
        connected: Whether the robot has answered and told its wheel ticks.
        ended: Whether the conversation has ended; the robot stands.
        found: What the robot has measured; whoever takes it empties the list.
        generation: Its firmware, once that is known.
    """

    def __init__(self, settings: PushbotSettings, velocities: Velocities, counts: Counter[str]) -> None:
        super().__init__(counts)
        self.found: list[WheelTicks | EventPacket] = []
        self.generation: FirmwareGeneration | None = None
        self._settings = settings
        self._velocities = velocities
        self._told, self._told_s = (0, 0), 0.0

    def _run(self) -> Talk[None]:
        yield from self._answer(protocol.RESET, protocol.BANNER, _BOOT_S)
        if not self.ending:
            generation = yield from self._set_up()
            yield from self._stream(generation)
        yield from self._answer(self._farewell(), protocol.FORMAT, 0.0)

    def _set_up(self) -> Talk[FirmwareGeneration]:
        """Find out what firmware it is, and have it do what is wanted; it streams at the end."""
        settings = self._settings
        self._output += protocol.NO_ECHO
        listing = yield from self._answer(protocol.LIST_SENSORS, protocol.LAST_SENSORS, 0.0)
        generation = self.generation = protocol.generation_of(listing.string[: listing.end()])
        if generation is None:
            raise SessionError("the board's firmware has no wheels: it is not one built for PushBots")
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
        """Take what it measures, and tell the wheels what to do, until it is to end."""
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
                raise SessionError("the robot tells no wheel ticks any more")
            self._tell_velocity(generation)

    def _take_events(self, parsed: Parsed, clock: EventClock | None, packets: EventPackets) -> list[int]:
        """Stamp and pack events; their stamps [ns], which lines among them get, too."""
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
            SessionError: The board has begun anew.
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

    def _tell_velocity(self, generation: FirmwareGeneration) -> None:
        """Say a velocity that is new, and one that is not before it decays; wheels stand until it answers."""
        wanted = self._velocities() if self.connected else (0, 0)
        if wanted == self._told and (wanted == (0, 0) or self._steady_s < self._told_s + _REPEAT_S):
            return
        self._output += protocol.velocity(generation, *wanted) if any(wanted) else protocol.BRAKE
        self._told, self._told_s = wanted, self._steady_s

    def _farewell(self) -> bytes:
        """Everything off; the answer to the question behind it says that all of it was heard."""
        dark = protocol.lights(protocol.Lights(0.0, 0.0))
        off = protocol.EVENTS_OFF + protocol.STOP_SENSORS + protocol.MOTORS_OFF
        return b"\n" + protocol.BRAKE + off + dark + protocol.QUERY_FORMAT


def _tick_period_ms(settings: PushbotSettings) -> int:
    """Between two readings of the wheel ticks [ms]."""
    return max(1, round(1e3 * settings.tick_period_s))
