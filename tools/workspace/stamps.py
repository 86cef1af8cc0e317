"""Stamps of completed steps: a stamp is removed before a step changes anything and written after it.

So a step that was interrupted in any way has no stamp and is repeated from the beginning.
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
    """Hash of the names and contents of files, and of further texts."""
    state = hashlib.sha256()
    for path in sorted(files):
        content = path.read_bytes()
        state.update(f"{path.relative_to(ROOT)} {len(content)}\n".encode())
        state.update(content)
    for fact in facts:
        state.update(f"{len(fact)} {fact}\n".encode())
    return state.hexdigest()


def write_whole(path: Path, text: str) -> None:
    """Write a file atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.{os.getpid()}")
    with partial.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)


class Stamp:
    """Record of a completed step and its inputs."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def read(self) -> str | None:
        """Inputs of the completed step; None if it is not completed."""
        try:
            return self._path.read_text(encoding="utf-8").strip()
        except FileNotFoundError:
            return None

    def clear(self) -> None:
        """Mark the step as not completed."""
        self._path.unlink(missing_ok=True)

    def write(self, value: str) -> None:
        """Mark the step as completed."""
        write_whole(self._path, value + "\n")


@contextmanager
def only_one(patience_s: float = 2.0) -> Iterator[None]:
    """Hold the workspace's lock against concurrent set-ups; the kernel frees it if the process dies.

    Args:
        patience_s: Longer waiting is reported. Starting nodes hold the lock for a short time each.
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
