"""A driver's thread: connects to one robot, anew when the link breaks, and has it stand at the end."""

from __future__ import annotations

import math
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from typing import Generic, TypeVar

from swarm_loc_drivers.common.link import Link, LinkError
from swarm_loc_drivers.common.session import Session, SessionError

_MIN_PAUSE_S, _MAX_PAUSE_S = 0.1, 2.0
MAX_STOP_S = 3.0
"""A robot that may be running is asked, or sought, for so long before the driver gives up."""


SomeSession = TypeVar("SomeSession", bound=Session)


class RobotDriver(ABC, Generic[SomeSession]):
    """Talks to one robot until it is asked to stop, and until the robot is known to stand.

    Args:
        name: Of the robot's link, for people.

    Attributes:
        counts: What happened how often: `connections`, `link_failures`, and what sessions count.
        trouble: Why there is no connection; "" while there is one.
    """

    def __init__(self, name: str) -> None:
        self.counts: Counter[str] = Counter()
        self.trouble = f"connecting to {name}"
        self._stopping = threading.Event()
        self._may_run = False
        self._thread = threading.Thread(target=self._run, name=f"driver of {name}")

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def begin_to_stop(self) -> None:
        """Have the robot stand and the driver end; `stop` waits for it."""
        self._stopping.set()

    def stop(self) -> None:
        """Stop the robot and end, also what has not begun."""
        self.begin_to_stop()
        if self._thread.ident is not None:
            self._thread.join()

    @abstractmethod
    def _open(self) -> Link:
        """Open the link."""

    @abstractmethod
    def _begin(self) -> SomeSession:
        """Begin a conversation over a link that has just been opened."""

    @abstractmethod
    def _step(self, session: SomeSession, link: Link) -> bytes:
        """Wait a moment for what the robot sends; what to send it."""

    @abstractmethod
    def _serve(self, session: SomeSession) -> None:
        """Hand on what the session has brought."""

    def _lose(self, session: SomeSession) -> None:
        """The link is being closed."""

    def _run(self) -> None:
        pause_s, give_up_s = _MIN_PAUSE_S, math.inf
        while True:
            connections = self.counts["connections"]
            try:
                self._converse()
            except (LinkError, SessionError) as error:
                self.trouble = str(error)
                self.counts["link_failures"] += 1
            except Exception as error:  # a mistake up here: the thread ends, and nobody else would say so
                self.trouble = f"the driver has failed: {error!r}"
                raise
            else:
                return
            is_ending, now_s = self._stopping.is_set(), time.monotonic()
            if is_ending:
                give_up_s = min(give_up_s, now_s + MAX_STOP_S)
                if not self._may_run or now_s > give_up_s:
                    return
            connected = self.counts["connections"] > connections
            pause_s = _MIN_PAUSE_S if connected or is_ending else min(2.0 * pause_s, _MAX_PAUSE_S)
            if is_ending:
                time.sleep(pause_s)
            else:
                self._stopping.wait(pause_s)

    def _converse(self) -> None:
        """One connection, from its begin to the end of the driver."""
        link = self._open()
        session = self._begin()
        self._may_run = True
        try:
            self._talk(session, link, self._serve)
            self._may_run = False
        except (LinkError, SessionError):
            raise
        except BaseException:  # a robot must not run on because of a mistake up here
            self._stopping.set()
            self._talk(self._begin(), link, lambda _: None)
            raise
        finally:
            self._lose(session)
            link.close()

    def _talk(self, session: SomeSession, link: Link, serve: Callable[[SomeSession], None]) -> None:
        """Hand bytes to and fro until the conversation has ended."""
        end_s = math.inf
        while not session.ended:
            if self._stopping.is_set():
                session.ending = True
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
