"""Files that are written whole or not at all, and whose only writers are this user and root."""

from __future__ import annotations

import os
import secrets
import stat
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from fnmatch import fnmatch
from pathlib import Path

from swarm_loc_estimator.common.parameters import UserError

_ROOM_BYTES = 4_000_000
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
_REMOVES = ("/bin/sh", "-c", 'read _; rm -rf -- "$0"')
"""Removes a folder when its standard input ends, as it does with the process at the other end."""


class FileError(UserError):
    """A file or folder that cannot be written; the message names it."""


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Raise FileError, with the path, in place of the system's errors, such as that of a full disk."""
    try:
        yield
    except OSError as error:
        raise FileError(f"{path} cannot be written: {error.strerror or error}.") from error


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Path of a new file on the disk of `path`, whose folder is created, to replace it without an error.

    It has no name until it is whole, so that a kill leaves nothing, but on file systems without such files.
    Raises FileError if it cannot be written, or is a link or no regular file.
    """
    part = path.with_name(f".{secrets.token_hex(8)}.part")  # nobody can put a link there before
    with naming(path), ExitStack() as stack:
        path.parent.mkdir(parents=True, exist_ok=True)
        check_file(path)
        stack.callback(part.unlink, missing_ok=True)
        try:
            handle = os.open(path.parent, os.O_TMPFILE | os.O_RDWR, 0o666)
        except OSError:
            yield part
        else:
            stack.callback(os.close, handle)
            nameless = Path(f"/proc/self/fd/{handle}")
            yield nameless
            os.link(nameless, part, src_dir_fd=handle)  # else Python links to the link
        part.replace(path)


@contextmanager
def temporary_folder(prefix: str = ".", parent: Path | None = None) -> Iterator[Path]:
    """A new folder of this user, in `parent` or where such are, removed however this process ends."""
    folder = (parent or Path(tempfile.gettempdir())).absolute() / f"{prefix}{secrets.token_hex(8)}.part"
    null, pipe = subprocess.DEVNULL, subprocess.PIPE
    with subprocess.Popen(
        [*_REMOVES, str(folder)], stdin=pipe, stdout=null, stderr=null, start_new_session=True
    ):
        with naming(folder):
            folder.mkdir(mode=0o700)
        yield folder


def write_whole(path: Path, text: str) -> None:
    """Write a text, see `replacing`."""
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")


def check_file(path: Path) -> None:
    """Raise FileError if something is in the place of a file that must not be replaced."""
    if path.is_symlink() or (path.exists() and not path.is_file()):
        kind = "a symbolic link" if path.is_symlink() else "a folder" if path.is_dir() else "no regular file"
        raise FileError(f"{path} cannot be written: it is {kind}.")


def check_folder(folder: Path, *patterns: str) -> None:
    """Raise FileError if a folder cannot be written or has no room, or files of these patterns cannot."""
    nearest = next(one for one in (folder, *folder.absolute().parents) if os.path.lexists(one))
    with naming(nearest), tempfile.TemporaryFile(dir=nearest) as probe:
        os.posix_fallocate(probe.fileno(), 0, _ROOM_BYTES)
    for path in folder.iterdir() if folder.is_dir() else ():
        if any(fnmatch(path.name, pattern) for pattern in patterns):
            check_file(path)


def is_private(*states: os.stat_result) -> bool:
    """Whether only this user or root own files or folders, and nobody else can write to them."""
    modes = [one.st_mode for one in states if not stat.S_ISLNK(one.st_mode)]
    owners = {one.st_uid for one in states}
    return owners <= {0, os.geteuid()} and not any(mode & _OTHERS_WRITE for mode in modes)
