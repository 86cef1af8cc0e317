"""Threads in which emulated robots and controllers of tests go on."""

import threading
from collections.abc import Callable


class Background:
    """Repeats something in a thread until it is ended.

    Args:
        step: What is repeated.
        period_s: Pause before each step [s].
    """

    def __init__(self, step: Callable[[], object], period_s: float = 0.0) -> None:
        self._step, self._period_s = step, period_s
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._ended.wait(self._period_s):
            self._step()

    def end(self) -> None:
        """Stop once the current step is done."""
        self._ended.set()
        self._thread.join()
