"""Keeps a conversation with one robot going, in a thread of its own: connects, anew when the link breaks."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable

from swarm_loc_drivers.transports.link import LinkError

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.1, 2.0
LAST_ATTEMPTS_S = 3.0
"""A robot that may be running when its link is down is sought for so long before the driver gives up."""


class SessionError(Exception):
    """The robot answers, but not as it must; the link is opened anew."""


class LinkKeeper:
    """Calls `converse` until it is asked to stop, and until the robot is known to stand.

    Args:
        name: Of the robot's link, for people.
        converse: One connection, from its begin to the end of the driver; raises LinkError or SessionError.
        counts: Gets `link_failures`; `converse` counts its `connections`.

    Attributes:
        trouble: Why there is no connection; "" while there is one.
        stopping: Set when the conversation shall end.
        may_run: Whether the robot may be running; up to `converse`.
    """

    def __init__(self, name: str, converse: Callable[[], None], counts: Counter[str]) -> None:
        self._converse = converse
        self._counts = counts
        self.trouble = f"connecting to {name}"
        self.stopping = threading.Event()
        self.may_run = False
        self._thread = threading.Thread(target=self._run, name=f"driver of {name}")

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End, also what has not begun; returns when it has ended."""
        self.stopping.set()
        if self._thread.ident is not None:
            self._thread.join()

    def note_connection(self) -> None:
        """The robot answers."""
        self._counts["connections"] += 1
        self.trouble = ""

    def _run(self) -> None:
        pause_s = _FIRST_PAUSE_S
        give_up_s: float | None = None
        while True:
            connections = self._counts["connections"]
            try:
                self._converse()
            except (LinkError, SessionError) as error:
                self.trouble = str(error)
                self._counts["link_failures"] += 1
            except Exception as error:  # a mistake up here: the thread ends, and nobody else would say so
                self.trouble = f"the driver has failed: {error!r}"
                raise
            else:
                return
            if self.stopping.is_set():
                give_up_s = give_up_s or time.monotonic() + LAST_ATTEMPTS_S
                if not self.may_run or time.monotonic() > give_up_s:
                    return
            connected = self._counts["connections"] > connections
            pause_s = _FIRST_PAUSE_S if connected or give_up_s else min(2.0 * pause_s, _LONGEST_PAUSE_S)
            self._pause(pause_s)

    def _pause(self, pause_s: float) -> None:
        """Wait; when the end is near no longer than that."""
        if self.stopping.is_set():
            time.sleep(_FIRST_PAUSE_S)
        else:
            self.stopping.wait(pause_s)
