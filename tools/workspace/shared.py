"""Built packages of messages in the user's cache, by what they are built from: other clones copy them."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from workspace.layout import ROOT

_ROOT_MARK = b"@workspace@"  # Stands for the folder of a workspace in the texts of a kept package
_KEPT_S = 30 * 86400.0


def take(key: str, target: Path) -> bool:
    """Copy a package, whose folder does not exist yet, from the cache; returns whether it is there."""
    kept = _folder() / key
    try:
        shutil.copytree(kept, target, copy_function=_replacing(_ROOT_MARK, bytes(ROOT)))
    except OSError:
        shutil.rmtree(target, ignore_errors=True)
        return False
    with suppress(OSError):  # another user's cache may be used, but not touched
        os.utime(kept)
    return True


def keep(key: str, source: Path) -> None:
    """Copy a built package to the cache; delete those unused for a month."""
    kept = _folder() / key
    partial = kept.with_name(f"{key}.{os.getpid()}")
    try:
        shutil.copytree(source, partial, copy_function=_replacing(bytes(ROOT), _ROOT_MARK))
        partial.rename(kept)
        for folder in _folder().iterdir():
            if folder.stat().st_mtime < time.time() - _KEPT_S:
                shutil.rmtree(folder)
    except OSError:  # where nothing can be kept, the next clone builds again
        shutil.rmtree(partial, ignore_errors=True)


def _replacing(old: bytes, new: bytes) -> Callable[[str, str], object]:
    """A function that copies a file, a text with another folder of the workspace."""

    def copy(source: str, target: str) -> None:
        data = Path(source).read_bytes()
        Path(target).write_bytes(data if b"\0" in data else data.replace(old, new))
        shutil.copymode(source, target)

    return copy


def _folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "swarm_loc_workspace"
