"""A temporary folder for the serial ports of a simulation, which is removed even after a kill."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_PREFIX = "swarm_loc-"


@contextmanager
def link_folder() -> Iterator[str]:
    """Create a folder and remove it at the end; also remove those that killed processes have left."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        if (lock := _lock(folder)) is not None:
            _remove(folder, lock)
    while (lock := _lock(folder := Path(tempfile.mkdtemp(prefix=_PREFIX)))) is None:
        pass  # another process that cleans up has locked it
    try:
        yield str(folder)
    finally:
        _remove(folder, lock)


def _lock(folder: Path) -> int | None:
    """Lock a folder until this process ends; the handle of the lock.

    None if another process holds the lock, or if this user has no such folder.
    """
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if folder.stat().st_uid == os.getuid():
            return handle
    except OSError:
        pass
    os.close(handle)
    return None


def _remove(folder: Path, lock: int) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    os.close(lock)
