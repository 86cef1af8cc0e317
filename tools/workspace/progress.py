"""Progress on the terminal; long commands with a status line and their output in a log file."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from workspace.layout import LOGS

SHOWN_EVERY_S = 5.0  # Period of status lines where the output is not a terminal [s]


def say(text: str) -> None:
    """Print a line and flush it."""
    print(text, flush=True)


@contextmanager
def step(text: str) -> Iterator[None]:
    """Print what a step does before it begins, and how long it took after it."""
    begun = time.monotonic()
    say(f"  {text}")
    yield
    say(f"    done in {time.monotonic() - begun:.0f} s")


class StatusLine:
    """A status line that is overwritten on a terminal, and printed periodically to a log."""

    def __init__(self) -> None:
        self._terminal = sys.stdout.isatty()
        self._shown = time.monotonic()
        self._open = False

    def show(self, text: str) -> None:
        """Show the progress of the step."""
        if self._terminal:
            print(f"\r\x1b[K    {text[:70]}", end="", flush=True)
            self._open = True
        elif time.monotonic() - self._shown > SHOWN_EVERY_S:
            self._shown = time.monotonic()
            say(f"    {text}")

    def close(self) -> None:
        """End the status line with a line break."""
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
        status: Returns the text of the status line for a line of output; None: unchanged.
        env: Environment, by default that of this process.
        cwd: Working directory, by default that of this process.

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
