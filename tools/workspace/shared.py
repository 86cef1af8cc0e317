"""Built packages of messages in the user's cache, by what they are built from: other clones copy them."""

from __future__ import annotations

import os
import shutil
import stat
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from workspace.layout import ROOT
from workspace.progress import say

_ROOT_MARK = b"@workspace@"  # Stands for the folder of a workspace in the texts of a kept package
_KEPT_S = 30 * 86400.0
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def take(key: str, target: Path) -> bool:
    """Copy a package, whose folder does not exist yet, from the cache; returns whether it is there."""
    kept = _folder() / key
    try:
        if not _is_private(kept):
            say(f"  {kept} is not used, since others than this user and root own it or can write to it")
            return False
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
        _folder().mkdir(mode=0o700, parents=True, exist_ok=True)
        shutil.copytree(source, partial, copy_function=_replacing(bytes(ROOT), _ROOT_MARK))
        for path in (partial, *partial.rglob("*")):
            path.chmod(path.stat().st_mode & ~_OTHERS_WRITE)
        if kept.exists() and not _is_private(kept):
            shutil.rmtree(kept)
        partial.rename(kept)
        for folder in _folder().iterdir():
            if folder.stat().st_mtime < time.time() - _KEPT_S:
                shutil.rmtree(folder)
    except OSError:  # where nothing can be kept, the next clone builds again
        shutil.rmtree(partial, ignore_errors=True)


def _is_private(kept: Path) -> bool:
    """Whether only this user and root own a package, and its folder, and nobody else can write to them."""
    states = [path.lstat() for path in (kept.parent, kept, *kept.rglob("*"))]
    states.append(kept.parent.stat())
    return all(
        one.st_uid in {0, os.geteuid()} and (stat.S_ISLNK(one.st_mode) or not one.st_mode & _OTHERS_WRITE)
        for one in states
    )


def _replacing(old: bytes, new: bytes) -> Callable[[str, str], object]:
    """A function that copies a file, a text with another folder of the workspace."""

    def copy(source: str, target: str) -> None:
        data = Path(source).read_bytes()
        Path(target).write_bytes(data if b"\0" in data else data.replace(old, new))
        shutil.copymode(source, target)

    return copy


def _folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "swarm_loc_workspace"
