"""Memory of what is done: a stamp is taken away before a step touches anything and written when it has ended.

So a step that was interrupted, however hard, has no stamp and starts from nothing.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from workspace.layout import ROOT, STATE


def digest(files: Iterable[Path], *facts: str) -> str:
    """The hash of files' names and contents, and of further facts."""
    state = hashlib.sha256()
    for path in sorted(files):
        content = path.read_bytes()
        state.update(f"{path.relative_to(ROOT)} {len(content)}\n".encode())
        state.update(content)
    for fact in facts:
        state.update(f"{len(fact)} {fact}\n".encode())
    return state.hexdigest()


def write_whole(path: Path, text: str) -> None:
    """Write a file so that it is there whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.{os.getpid()}")
    with partial.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)


class Stamp:
    """The record that one step was done for certain inputs."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def read(self) -> str | None:
        """What the step was done for, or None where it never ended."""
        try:
            return self._path.read_text(encoding="utf-8").strip()
        except FileNotFoundError:
            return None

    def clear(self) -> None:
        """Say that the step is under way."""
        self._path.unlink(missing_ok=True)

    def write(self, value: str) -> None:
        """Say that the step is done."""
        write_whole(self._path, value + "\n")


@contextmanager
def only_one(patience_s: float = 2.0) -> Iterator[None]:
    """Hold the workspace's lock, so that two set-ups do not meet; the kernel frees it when a holder dies.

    Args:
        patience_s: Waiting longer is reported. Nodes that start at once hold the lock for a moment each.
    """
    STATE.mkdir(exist_ok=True)
    sentence = "Another set-up of this workspace is running: waiting for it."
    with (STATE / "lock").open("w") as lock:
        report = threading.Timer(patience_s, print, [sentence], {"flush": True})
        report.daemon = True
        report.start()
        fcntl.flock(lock, fcntl.LOCK_EX)
        report.cancel()
        yield
