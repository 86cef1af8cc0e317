"""Thread of a driver: connects to one robot, reconnects after failures, stops the robot at the end."""

from __future__ import annotations

import math
import threading
import time
import traceback
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import Generic, TypeVar

from swarm_loc_drivers.common.link import Link, LinkError
from swarm_loc_drivers.common.session import Session, SessionError

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
