"""Steps on the terminal; long commands whose output goes to a file while one line tells how far they are."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from workspace.layout import LOGS

SHOWN_EVERY_S = 5.0
"""How often a log that is no terminal gets a line."""


def say(text: str) -> None:
    """Print a line at once."""
    print(text, flush=True)


class StatusLine:
    """One line that overwrites itself on a terminal and appears now and then in a log."""

    def __init__(self) -> None:
        self._terminal = sys.stdout.isatty()
        self._shown = time.monotonic()
        self._open = False

    def show(self, text: str) -> None:
        """Show how far the step is."""
        if self._terminal:
            print(f"\r\x1b[K    {text[:70]}", end="", flush=True)
            self._open = True
        elif time.monotonic() - self._shown > SHOWN_EVERY_S:
            self._shown = time.monotonic()
            say(f"    {text}")

    def close(self) -> None:
        """Leave the terminal at the start of an empty line."""
        if self._open:
            print("\r\x1b[K", end="", flush=True)


def run_logged(
    command: Sequence[str | Path],
    log_name: str,
    status: Callable[[str], str | None],
    env: Mapping[str, str] | None = None,
    cwd: Path | None = None,
) -> tuple[int, str]:
    """Run a command with its output in a log file.

    Args:
        command: Program and arguments.
        log_name: Name of the file under the workspace's log folder.
        status: Makes the text of the status line from a line of output, or None to leave it.
        env: Environment, the own one by default.
        cwd: Working directory, the own one by default.

    Returns:
        The exit status and all output.
    """
    LOGS.mkdir(parents=True, exist_ok=True)
    line = StatusLine()
    output: list[str] = []
    process = subprocess.Popen(
        [str(part) for part in command],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        stdin=subprocess.DEVNULL,
        text=True,
        errors="replace",
        env=env,
        cwd=cwd,
    )
    with process, (LOGS / log_name).open("w", encoding="utf-8") as log:
        for text in process.stdout or ():
            log.write(text)
            output.append(text)
            shown = status(text.rstrip())
            if shown is not None:
                line.show(shown)
    line.close()
    return process.returncode, "".join(output)
