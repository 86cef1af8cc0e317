"""Driver of one PushBot: session, wheel commands and odometry from its ticks, without ROS.

The board is reset first: this stops its motors, sets its clock and ticks to zero, and its banner identifies
it. While it streams, a velocity is sent when it changes and repeated before it decays, so a firmware with
decaying velocities stops the robot by itself soon after the last command. The firmware can lose a stop: when
it parses the command just after a tick of its clock, the pending update of the velocity controller sets the
duty cycle again, which then lasts. So a stop is repeated until the wheel ticks stand still.
"""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from swarm_loc_drivers.common.link import Link, open_link
from swarm_loc_drivers.common.odometry import DeadReckoning, OdometryState, WheelGeometry
from swarm_loc_drivers.common.robot_driver import (
    RobotDriver,
    SessionError,
    Talk,
    TalkSession,
    Velocity,
    VelocityCommand,
)
from swarm_loc_drivers.pushbot import protocol
from swarm_loc_drivers.pushbot.event_parser import EventPacket, EventPackets, EventParser
from swarm_loc_drivers.pushbot.parameters import PushbotParameters
from swarm_loc_drivers.pushbot.protocol import (
    MAX_TICK_RATE,
    FirmwareGeneration,
    tick_difference,
    wheel_velocities,
)
from swarm_loc_estimator.common.arrays import IntArray

# Clocks: checked by test_pushbot_clock.py; stops below: by test_pushbot_session.py.
_WINDOW_NS = 2_000_000_000  # Window of the smallest delay; the clocks drift by less than 0.1 ms within it
_MAX_AHEAD_US = 250_000  # Longest time that one of the board's 4092 buffered events waits [us]
_LEAK = 1e-4  # Share by which periods are shortened, so that a late estimate recovers
_US = 1000


class EventClock:
    """Converts times of the board to stamps, by the smallest recent delay of its bytes.

    The bytes of an event arrive with a varying delay (buffers, wireless link), so the smallest difference
    between the two clocks is the best estimate of their offset. A constant delay remains in the stamps. The
    board's timestamps wrap after `span_us`; 0: never.
    """

    def __init__(self, span_us: int) -> None:
        self._span_us = span_us
        self._added_us = 0
        self._last: tuple[int, int] | None = None  # computer [ns], board [us] of the newest event
        self._window_ns = 0
        self._offsets_ns: list[int] = []  # the smallest of this window and of the previous one

    def stamps(self, time_us: IntArray, now_ns: int) -> IntArray:
        """Stamps (N,) [ns] of events that arrive now; N > 0.

        `time_us` (N,) is the board's clock, unwrapped.
        """
        if self._last is not None and now_ns < self._last[0]:
            self._last, self._offsets_ns = None, []  # the computer's clock was set back
        if self._last is not None and self._span_us:
            # a silence may be longer than the timestamps' span: add the missed wraps by the computer's clock
            silence_us = (now_ns - self._last[0]) // _US - (int(time_us[0]) - self._last[1])
            self._added_us += max(0, round(silence_us / self._span_us)) * self._span_us
        time_ns = (time_us + self._added_us) * _US
        # the smallest delay of this window and of the previous one
        offset_ns = now_ns - int(time_ns[-1])
        if not self._offsets_ns:
            self._window_ns, self._offsets_ns = now_ns, [offset_ns]
        elif now_ns > self._window_ns + _WINDOW_NS:
            self._window_ns, self._offsets_ns = now_ns, [offset_ns, self._offsets_ns[0]]
        self._offsets_ns[0] = min(self._offsets_ns[0], offset_ns)
        self._last = now_ns, int(time_us[-1])
        stamps: IntArray = time_ns + min(self._offsets_ns)
        return np.minimum(stamps, now_ns)


class TickClock:
    """Stamps wheel readings, which have a constant period [ms].

    Text overtakes events in the transmit buffer: if the camera sees more than the link carries, the event
    before a reading is up to 50 ms older than the reading. But no reading is older than that event, or less
    than a period after the previous reading.
    """

    def __init__(self, period_ms: int) -> None:
        self._step_us = _US * period_ms * (1.0 - _LEAK)
        self._last_us: float | None = None
        self._event: tuple[int, int] | None = None

    def pass_event(self, time_us: int, stamp_ns: int) -> None:
        """Note an event: its time by the board's clock, not wrapped [us], and its stamp [ns]."""
        self._event = time_us, stamp_ns

    def stamp_ns(self, now_ns: int) -> int:
        """Stamp of a reading that has just arrived [ns]; `now_ns` before the first event."""
        if self._event is None:
            return now_ns
        event_us, event_ns = self._event
        time_us = float(event_us)
        if self._last_us is not None:
            due_us = self._last_us + self._step_us
            if 0.0 < due_us - event_us < _MAX_AHEAD_US:
                time_us = due_us
        self._last_us = time_us
        return min(now_ns, event_ns + round(_US * (time_us - event_us)))


@dataclass(frozen=True)
class WheelTicks:
    """A reading of the wheels' counters."""

    stamp_ns: int  # Best estimate of the acquisition time [ns]
    left: int  # Ticks of the left wheel, 32 bits, wrapping
    right: int  # Ticks of the right wheel, 32 bits, wrapping


Velocities = Callable[[], tuple[int, int]]
"""Commands for the left and the right wheel [ticks per 21 ms]; called just before they are sent."""

NO_STOP = "the wheels go on turning although the stop is repeated"  # What a robot does that does not stop
_BOOT_S = 2.0  # Time in which a board starts, in addition to that of an answer [s]
_ATTEMPTS = 3
_REPEAT_S = 0.4  # A constant velocity is repeated after so long; a decaying one holds for a second [s]
_REPEAT_STOP_S = 0.1  # A stop is repeated after so long while the wheels turn [s]
_STILL_S = 0.1  # The wheels stand when their ticks have not changed for so long [s]
_STALE_STEPS = 100  # In so many steps after this driver was stopped, what waited in buffers still comes
_STOP_S = 1.0  # The wheels must stand so long after a stop, and two periods of their ticks later [s]


class PushbotSession(TalkSession):
    """A `Session` with one PushBot; it is connected when the robot has answered and sent wheel ticks.

    Counts `events`, `readings`, `refused_commands`, `other_lines`, `repeated_stops`, `ignored_stops`, and
    what `EventParser` counts.
    """

    def __init__(self, params: PushbotParameters, velocities: Velocities, counts: Counter[str]) -> None:
        super().__init__(counts)
        self.found: list[WheelTicks | EventPacket] = []  # Measurements; the reader empties the list
        self.generation: FirmwareGeneration | None = None  # Its firmware, once it is known
        self._params = params
        self._velocities = velocities
        # Whether the wheels go on turning although the stop has been repeated for a second
        self.does_not_stop = False
        self._sent, self._sent_s = (0, 0), 0.0
        self._ticks: tuple[int, int] | None = None
        self._ticks_s, self._is_turning = 0.0, False  # of the newest reading
        self._turned_s = 0.0  # of the last reading that changed, the last velocity or the first stop after it
        self._stood_s = 0.0  # when the robot last stood, was commanded to drive or was first stopped

    def _run(self) -> Talk[None]:
        yield from self._answer(protocol.RESET, protocol.BANNER, _BOOT_S)
        if not self.ending:
            # identify the firmware
            params = self._params
            self._output += protocol.NO_ECHO
            listing = yield from self._answer(protocol.LIST_SENSORS, protocol.LAST_SENSORS, 0.0)
            generation = self.generation = protocol.generation_of(listing.string[: listing.end()])
            if generation is None:
                raise SessionError("the board's firmware has no wheels: it is not built for PushBots")
            # configure it
            if timestamps := params.event_timestamps:
                if timestamps not in generation.formats:
                    raise SessionError(
                        f"the firmware, of the {generation.name} generation, has no timestamps"
                        f" '{timestamps}', only {', '.join(generation.formats)}"
                    )
                wanted = protocol.event_format(generation, timestamps) + protocol.QUERY_FORMAT
                answer = yield from self._answer(wanted, protocol.FORMAT, 0.0)
                if int(answer[1]) != generation.formats[timestamps]:
                    raise SessionError(
                        f"the robot answers {answer[0]!r} to the choice of timestamps '{timestamps}'"
                    )
            # start the stream
            self._output += protocol.lights(params.lights) + protocol.BRAKE + protocol.MOTORS_ON
            self._output += protocol.stream_ticks(generation, _tick_period_ms(params))
            self._output += protocol.EVENTS_ON if timestamps else b""
            yield from self._stream(generation)
        # turn everything off; the answer to the final query confirms all of it
        off = protocol.BRAKE + protocol.EVENTS_OFF + protocol.STOP_SENSORS + protocol.MOTORS_OFF
        dark = protocol.lights(protocol.Lights(0.0, 0.0))
        yield from self._answer(b"\n" + off + dark + protocol.QUERY_FORMAT, protocol.FORMAT, 0.0)

    def _answer(self, request: bytes, pattern: re.Pattern[bytes], extra_s: float) -> Talk[re.Match[bytes]]:
        timeout_s, who = self._params.reply_timeout_s + extra_s, f" {request.split()[0].decode()}"
        return self._ask(request, pattern, timeout_s, _ATTEMPTS, who)

    def _stream(self, generation: FirmwareGeneration) -> Talk[None]:
        """Take measurements and send velocities until the session ends."""
        params = self._params
        packets = EventPackets(params.packet_period, params.on_bit)
        parser, clock, readings = self._begin_stream()
        last_s, stale = self._steady_s, 0
        self._ticks_s = self._stood_s = self._steady_s
        while not (self.ending and self._stands()):
            yield
            received, self._received = self._received, b""
            if self._steady_s > last_s + params.reply_timeout_s:  # this driver was stopped
                parser, clock, readings = self._begin_stream()
                stale = _STALE_STEPS
            if stale:
                received, stale = b"", stale - 1
                self._ticks_s = self._turned_s = self._stood_s = self._steady_s
            last_s = self._steady_s
            parsed = parser.feed(received)
            # stamp and pack events, whose stamps time the lines between them
            stamps_ns = np.full(len(parsed.x), self._now_ns)
            if len(parsed.x):
                if clock is not None:
                    stamps_ns = clock.stamps(parsed.time_us, self._now_ns)
                self._counts["events"] += len(parsed.x)
                packets.add(parsed.x, parsed.y, parsed.polarity, stamps_ns, parsed.time_us)
            packets.flush_late(self._now_ns)
            self.found += packets.ready
            packets.ready.clear()
            for before, line in parsed.lines:
                if before and clock is not None:
                    readings.pass_event(int(parsed.time_us[before - 1]), int(stamps_ns[before - 1]))
                self._take_line(line, readings, generation)
            if self._steady_s > self._ticks_s + params.reply_timeout_s + params.tick_period_s:
                raise SessionError("the robot has stopped sending wheel ticks")
            self._send_velocity(generation)
            self._check_stop()

    def _begin_stream(self) -> tuple[EventParser, EventClock | None, TickClock]:
        """What reads and times the bytes from now on."""
        timestamps = self._params.event_timestamps or "none"
        parser = EventParser(timestamps, self._counts)
        clock = EventClock(parser.span_us) if timestamps != "none" else None
        return parser, clock, TickClock(_tick_period_ms(self._params))

    def _take_line(self, line: bytes, readings: TickClock, generation: FirmwareGeneration) -> None:
        """Take wheel ticks, or count another line."""
        ticks = protocol.wheel_ticks(line, generation)
        if ticks is not None:
            self._counts["readings"] += 1
            self.found.append(WheelTicks(readings.stamp_ns(self._now_ns), *ticks))
            self._is_turning = self._ticks not in (None, ticks)
            if self._ticks is None or self._is_turning:
                self._turned_s = self._steady_s
            self._ticks, self._ticks_s, self.connected = ticks, self._steady_s, True
            return
        if protocol.BANNER.search(line + b"\n"):
            raise SessionError("the robot has been reset")
        self._counts["refused_commands" if protocol.is_refusal(line) else "other_lines"] += 1

    def _send_velocity(self, generation: FirmwareGeneration) -> None:
        """Send a new velocity, and repeat one before it decays; a stop, while the wheels turn."""
        wanted = self._velocities() if self.connected and not self.ending else (0, 0)
        if wanted == self._sent:
            period_s = _REPEAT_S if any(wanted) else _REPEAT_STOP_S
            if self._steady_s < self._sent_s + period_s or not (any(wanted) or self._is_turning):
                return
            if not any(wanted):
                self._counts["repeated_stops"] += 1
        if any(wanted) or any(self._sent):
            self._turned_s = self._stood_s = self._steady_s
        self._output += protocol.velocity(generation, *wanted) if any(wanted) else protocol.BRAKE
        self._sent, self._sent_s = wanted, self._steady_s

    def _stands(self) -> bool:
        """Whether the robot is stopped and its wheel ticks stand still."""
        is_stopped = self._ticks is not None and not any(self._sent)
        return is_stopped and self._ticks_s >= self._turned_s + _STILL_S

    def _check_stop(self) -> None:
        """Note a robot that does not stop; at the end the next session must reset the board."""
        if self._stands():
            self._stood_s = self._steady_s
        limit_s = _STOP_S + 2.0 * self._params.tick_period_s
        fails = not any(self._sent) and self._steady_s > self._stood_s + limit_s
        if fails and not self.does_not_stop:
            self._counts["ignored_stops"] += 1
        self.does_not_stop = fails
        if fails and self.ending:
            raise SessionError(NO_STOP)


def _tick_period_ms(params: PushbotParameters) -> int:
    return max(1, round(1e3 * params.tick_period_s))


_MAX_RATE = 2.0 * MAX_TICK_RATE  # Largest rate of a wheel, also while its controller catches up [ticks/s]
_SLACK_S = 0.15  # Largest error of a stamp [s]
_MAX_CORRECTION_S = 0.5
"""Stamps step back by at most so much when a smaller delay is found, or events arrive after ticks [s]."""
_UNHEARD_S = 1.0  # A robot that was not heard for so long before its board was reset has moved [s]


class PushbotOdometry:
    """Integrates ticks to a pose, see `DeadReckoning`.

    The wheels may also be turned by hand, so only readings that no motor can cause are rejected. Counts
    `implausible_counters`, `counter_restarts`, `time_jumps` and `corrected_times`.
    """

    def __init__(self, geometry: WheelGeometry, wheel_noise: float, counts: Counter[str]) -> None:
        self._metres_per_tick = geometry.metres_per_step
        self._begin = partial(DeadReckoning, geometry, wheel_noise)
        self._reckoning = self._begin()
        self._counts = counts
        self._last: WheelTicks | None = None
        self._heard_ns: int | None = None
        self._doubtful = False

    def restart(self) -> None:
        """The board is reset and its ticks are zero; the pose is, too, unless it is heard again soon."""
        self._heard_ns, self._last = self._last.stamp_ns if self._last else self._heard_ns, None

    def update(self, ticks: WheelTicks) -> OdometryState | None:
        """Take a reading; the state, or None if the reading is not newer or is impossible."""
        last = self._last
        if last is None:
            if self._heard_ns is not None and ticks.stamp_ns - self._heard_ns > 1e9 * _UNHEARD_S:
                self._reckoning = self._begin()
            self._last = ticks
            return self._reckoning.state(ticks.stamp_ns, 0.0, 0.0, 0.0)
        if ticks.stamp_ns == last.stamp_ns:
            return None
        elapsed_s = (ticks.stamp_ns - last.stamp_ns) * 1e-9
        if -_MAX_CORRECTION_S < elapsed_s < 0.0:
            self._counts["corrected_times"] += 1  # its motion is part of the next reading
            return None
        if elapsed_s < 0.0:
            self._counts["time_jumps"] += 1
            elapsed_s = 0.0
        done = tick_difference(last.left, ticks.left), tick_difference(last.right, ticks.right)
        if max(map(abs, done)) > _MAX_RATE * (elapsed_s + _SLACK_S):
            # a single reading may have lost bytes; a second one shows that the counters have changed
            if not self._doubtful:
                self._counts["implausible_counters"] += 1
                self._doubtful = True
                return None
            self._counts["counter_restarts"] += 1
            self._reckoning.forget_motion(_MAX_RATE * self._metres_per_tick * elapsed_s)
            self._last, self._doubtful = ticks, False
            return self._reckoning.state(ticks.stamp_ns, 0.0, 0.0, 0.0)
        self._last, self._doubtful = ticks, False
        left, right = (self._metres_per_tick * one for one in done)
        self._reckoning.advance(left, right)
        return self._reckoning.state(ticks.stamp_ns, left, right, elapsed_s)


_READ_S = 0.02
_BATCH_S = 0.002  # Shortest time between two reads [s]; each read has a fixed cost


@dataclass(frozen=True)
class PushbotListeners:
    """Receivers of the robot's data, called in the driver's thread."""

    odometry: Callable[[OdometryState], None]  # Receives every new state
    events: Callable[[EventPacket], None]  # Receives packets of events


class PushbotDriver(RobotDriver[PushbotSession]):
    """Drives one robot in its own thread, see `RobotDriver`."""

    def __init__(
        self, params: PushbotParameters, listeners: PushbotListeners, clock: Callable[[], int]
    ) -> None:
        super().__init__(str(params.link_address), clock)
        self._params = params
        self._listeners = listeners
        self._command = VelocityCommand(params.cmd_vel_timeout_s, clock, self.counts)
        self._odometry = PushbotOdometry(params.geometry, params.wheel_noise, self.counts)
        self._read_s = 0.0

    def set_velocity(self, velocity: Velocity) -> None:
        """Follow a velocity from now on; wheels ignore its component to the left."""
        forward, _, turn_rate = velocity
        self._command.set((forward, 0.0, turn_rate))

    def _open(self) -> Link:
        params = self._params
        return open_link(params.link_address, params.baud_rate, params.reply_timeout_s)

    def _begin(self) -> PushbotSession:
        self._odometry.restart()
        return PushbotSession(self._params, self._velocities, self.counts)

    def _step(self, session: PushbotSession, link: Link) -> bytes:
        early_s = self._read_s + _BATCH_S - time.monotonic()
        if early_s > 0.0:
            time.sleep(early_s)
        data = link.read(_READ_S)
        self._read_s = time.monotonic()
        return session.step(data, self._clock(), self._read_s)

    def _serve(self, session: PushbotSession) -> None:
        self.warning = NO_STOP if session.does_not_stop else ""
        found, session.found = session.found, []
        for one in found:
            if one.stamp_ns <= 0:  # no clock yet, or a time before its beginning
                self.counts["no_clock"] += 1
            elif isinstance(one, EventPacket):
                self.counts["packets"] += 1
                self._listeners.events(one)
            elif (state := self._odometry.update(one)) is not None:
                self._listeners.odometry(state)

    def _velocities(self) -> tuple[int, int]:
        """Commands of the wheels now."""
        speed, _, turn_rate = self._command.velocity()
        return wheel_velocities(self._params.geometry, speed, turn_rate)
