"""A folder for the serial links of a simulation, which does not outlive the process that made it."""

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
    """Make a folder and remove it in the end; those of processes that were killed are removed, too."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        if (lock := _lock(folder)) is not None:
            _remove(folder, lock)
    while (lock := _lock(folder := Path(tempfile.mkdtemp(prefix=_PREFIX)))) is None:
        pass  # somebody who cleans up has just taken it
    try:
        yield str(folder)
    finally:
        _remove(folder, lock)


def _lock(folder: Path) -> int | None:
    """A hold on a folder that the system gives up when this process ends, however it does.

    None where another process has it, or where there is no such folder of this user.
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
