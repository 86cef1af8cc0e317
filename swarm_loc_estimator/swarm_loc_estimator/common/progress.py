"""Progress bar of commands, in a terminal."""

from __future__ import annotations

import sys
import time
from typing import TextIO

from typing_extensions import Self

_REDRAW_S = 0.1
_WIDTH = 30


class ProgressLine:
    """One line that is redrawn while a command works, and gone after; silent where nobody watches.

    Args:
        stream: Where it is drawn; only when that is a terminal.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._shown = self._stream.isatty()
        self._last = 0.0

    def __call__(self, share: float, what: str) -> None:
        """Show the share done, 0 to 1, and what is being done."""
        now = time.monotonic()
        if not self._shown or (share < 1.0 and now - self._last < _REDRAW_S):
            return
        self._last = now
        bar = "#" * round(_WIDTH * share)
        self._stream.write(f"\r[{bar:<{_WIDTH}}] {share:4.0%} {what}\x1b[K")
        self._stream.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._shown:
            self._stream.write("\r\x1b[K")
            self._stream.flush()
