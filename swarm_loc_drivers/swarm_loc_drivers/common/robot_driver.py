"""Session, velocity command and driver of one robot: a thread that connects, and stops it at the end."""

from __future__ import annotations

import math
import re
import threading
import time
import traceback
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Generator
from contextlib import suppress
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from swarm_loc_drivers.common.link import Link, LinkError
from swarm_loc_estimator.common.parameters import flag, number, text

STANDING_CLOCK_S = 1.0  # A clock that stands still for so long of real time is dead: the robot stops [s]
MAX_VELOCITY = 1e3  # [m/s] and [rad/s]; larger velocities are dropped as errors

Velocity = tuple[float, float, float]  # Forward [m/s], to the left [m/s], turning to the left [rad/s]
STILL: Velocity = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class DriverParameters:
    """Parameters that all drivers have."""

    cmd_vel_timeout_s: float = number(0.5, "s", 0.02, 10.0, "time without cmd_vel until the robot stops")
    odom_frame: str = text("odom", "the pose is in <robot>/odom_frame", required=True)
    base_frame: str = text("base_link", "the pose is that of <robot>/base_frame", required=True)
    publish_tf: bool = flag(True, "publish the transform from odom to base_link")


class VelocityCommand:
    """Holds the newest velocity; zero after a timeout [s]. Counts `bad_cmd_vel` and `stale_cmd_vel`.

    The clock [ns] may be simulated, and 0 means no time; `steady_s` is real time.
    """

    def __init__(
        self,
        timeout_s: float,
        clock: Callable[[], int],
        counts: Counter[str],
        steady_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._timeout_ns = round(timeout_s * 1e9)
        self._clock = clock
        self._counts = counts
        self._steady_s = steady_s
        self._latest: tuple[int, Velocity] | None = None
        self._expired: tuple[int, Velocity] | None = None  # by `velocity`; `_latest` by `set`
        self._clock_ran = (0, steady_s())

    def set(self, velocity: Velocity) -> None:
        """Take a velocity; one that is not finite or too large is dropped."""
        if not all(abs(component) <= MAX_VELOCITY for component in velocity):
            self._counts["bad_cmd_vel"] += 1
            return
        self._latest = (self._clock(), velocity)

    def velocity(self) -> Velocity:
        """The velocity to drive now."""
        latest, now_ns = self._latest, self._clock()
        if now_ns != self._clock_ran[0]:
            self._clock_ran = (now_ns, self._steady_s())
        if latest is None or latest is self._expired:
            return STILL
        age_ns = now_ns - latest[0]
        if 0 <= age_ns <= self._timeout_ns and self._steady_s() <= self._clock_ran[1] + STANDING_CLOCK_S:
            return latest[1]
        if latest[1] != STILL:
            self._counts["stale_cmd_vel"] += 1
        self._expired = latest
        return STILL


MAX_NONSENSE_S = 2.5  # A robot whose answers make no sense for so long is no longer connected [s]
NONSENSE = "what the robot sends makes no sense"
_MAX_RECEIVED = 1 << 16  # Bytes kept while an answer is awaited: a camera may still be streaming

Result = TypeVar("Result")
Talk = Generator[None, None, Result]  # Part of a conversation; it continues at every step


class SessionError(Exception):
    """The robot does not answer as it must; the link is closed and opened again."""


class Session(Protocol):
    """A conversation with one robot."""

    ending: bool  # Set it to stop the robot and end the conversation
    connected: bool  # Whether the robot has answered; `step` fails soon after answers make no sense
    ended: bool  # Whether the conversation has ended; the robot stands


class TalkSession(ABC):
    """A `Session` that is written as one generator, and counts what happens."""

    def __init__(self, counts: Counter[str]) -> None:
        self.ending = self.connected = self.ended = False
        self._counts = counts
        self._received = self._output = b""
        self._now_ns, self._steady_s = 0, 0.0
        self._talk = self._run()

    @abstractmethod
    def _run(self) -> Talk[None]:
        """Talk to the robot: append to `_output`, yield, and read `_received`."""

    def step(self, data: bytes, now_ns: int, steady_s: float) -> bytes:
        """Continue with the bytes received since the last step; returns bytes to send, or a SessionError.

        The time [ns] may be simulated, stand still or jump back; 0 means no time. `steady_s` is real time.
        """
        self._received += data
        self._now_ns, self._steady_s = now_ns, steady_s
        try:
            next(self._talk)
        except StopIteration:
            self.ended = True
        output, self._output = self._output, b""
        return output

    def _ask_once(
        self, request: bytes, answer: re.Pattern[bytes], timeout_s: float
    ) -> Talk[re.Match[bytes] | None]:
        """Send a request and wait for its answer; None after the timeout."""
        self._received = b""
        self._output += request
        deadline_s = self._steady_s + timeout_s
        while self._steady_s < deadline_s:
            yield
            if match := answer.search(self._received):
                self._received = self._received[match.end() :]
                return match
            self._received = self._received[-_MAX_RECEIVED:]
        return None

    def _ask(
        self, request: bytes, answer: re.Pattern[bytes], timeout_s: float, tries: int, who: str = ""
    ) -> Talk[re.Match[bytes]]:
        """The answer to a request, which is sent several times; an error says `who` does not answer."""
        for _ in range(tries):
            if (match := (yield from self._ask_once(request, answer, timeout_s))) is not None:
                return match
        raise SessionError(f"the robot does not answer{who}")


_MIN_PAUSE_S, _MAX_PAUSE_S = 0.1, 2.0
NO_CLOCK = "waiting for simulated time: nothing on /clock yet"
"""Why a driver has not tried to connect yet: a simulated robot has its link when time begins."""
MAX_STOP_S = 3.0  # How long the driver tries to stop a robot that may be moving before it gives up


SomeSession = TypeVar("SomeSession", bound=Session)


class RobotDriver(ABC, Generic[SomeSession]):
    """Talks to one robot until the driver is stopped and the robot is known to stand.

    After a defect of the driver, any exception, it stops the robot and connects again. `name` is that of the
    robot's link in messages. The clock [ns] may be simulated, and 0 means no time.
    """

    def __init__(self, name: str, clock: Callable[[], int]) -> None:
        self._clock = clock
        # `connections`, `link_failures`, and the counts of the sessions
        self.counts: Counter[str] = Counter()
        self.trouble = f"connecting to {name}"  # Why there is no connection; "" while there is one
        self.warning = ""  # What is wrong with the connected robot; "" for nothing
        self.defects: dict[str, str] = {}  # Traceback of the first defect of the driver at each place
        self._stopping = threading.Event()
        self.may_run = False  # Whether the robot may be moving after the driver has been stopped
        self._thread = threading.Thread(target=self._run, name=f"driver of {name}")

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def begin_to_stop(self) -> None:
        """Begin to stop the robot and the driver; `stop` waits for both."""
        self._stopping.set()

    def stop(self) -> None:
        """Stop the robot and the driver; also before `start`."""
        self.begin_to_stop()
        if self._thread.ident is not None:
            self._thread.join()

    @abstractmethod
    def _open(self) -> Link:
        """Open the link."""

    @abstractmethod
    def _begin(self) -> SomeSession:
        """Create the session for a link that has just been opened."""

    @abstractmethod
    def _step(self, session: SomeSession, link: Link) -> bytes:
        """Wait briefly for bytes of the robot; the bytes to send."""

    @abstractmethod
    def _serve(self, session: SomeSession) -> None:
        """Hand on what the session has received."""

    def _lose(self, session: SomeSession) -> None:
        """The link is being closed."""

    def _run(self) -> None:
        connecting = self.trouble
        while self._clock() <= 0:
            self.trouble = NO_CLOCK
            if self._stopping.wait(_MIN_PAUSE_S):
                return
        self.trouble = connecting
        pause_s, give_up_s = _MIN_PAUSE_S, math.inf
        while True:
            connections, defects = self.counts["connections"], self.counts["defects"]
            try:
                self._converse()
            except (LinkError, SessionError) as error:
                self.trouble = str(error)
                self.counts["link_failures"] += 1
            except Exception as error:  # noqa: BLE001 # a defect, which the next session may not meet
                self.trouble = f"the driver has failed: {error!r}"
                self.counts["defects"] += 1
                place = "".join(traceback.format_tb(error.__traceback__))
                self.defects.setdefault(place, traceback.format_exc())
            else:
                return
            is_ending, now_s = self._stopping.is_set(), time.monotonic()
            if is_ending:
                give_up_s = min(give_up_s, now_s + MAX_STOP_S)
                if not self.may_run or now_s > give_up_s:
                    return
            is_sound = self.counts["connections"] > connections and self.counts["defects"] == defects
            pause_s = _MIN_PAUSE_S if is_sound or is_ending else min(2.0 * pause_s, _MAX_PAUSE_S)
            if is_ending:
                time.sleep(pause_s)
            else:
                self._stopping.wait(pause_s)

    def _converse(self) -> None:
        """One connection, until the driver is stopped."""
        link = self._open()
        session = self._begin()
        self.may_run = True
        try:
            self._talk(session, link, self._serve)
            self.may_run = False
        except (LinkError, SessionError):
            raise
        except Exception:  # a defect of the driver must neither leave the robot moving nor be hidden
            with suppress(Exception):
                last = self._begin()
                last.ending = True
                self._talk(last, link, lambda _: None)
                self.may_run = False
            raise
        finally:
            self.warning = ""
            link.close()
            self._lose(session)

    def _talk(self, session: SomeSession, link: Link, serve: Callable[[SomeSession], None]) -> None:
        """Exchange bytes until the conversation has ended."""
        end_s = math.inf
        while not session.ended:
            session.ending |= self._stopping.is_set()
            if session.ending:
                end_s = min(end_s, time.monotonic() + MAX_STOP_S)
            if time.monotonic() > end_s:
                raise SessionError("the robot does not confirm that it has stopped")
            was_connected = session.connected
            if output := self._step(session, link):
                link.write(output)
            if session.connected and not was_connected:
                self.counts["connections"] += 1
                self.trouble = ""
            serve(session)
