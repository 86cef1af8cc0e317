"""Compilation of the inner loops by numba, cached for every state of the sources.

The estimator's hot paths touch a handful of numbers a hundred thousand times, where calls of array
functions cost ten to fifty times the arithmetic. Compiled code is cached in the user's cache folder.
"""

from __future__ import annotations

import fcntl
import hashlib
import inspect
import os
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., object])

_IMPORT = re.compile(r"^from (?P<module>[\w.]+) import (?P<names>\([^)]*\)|.*)$", re.MULTILINE)
_NUMBERS = {"None", "bool", "int", "float", "tuple"}
_KEPT_S = 30 * 86400.0


def is_warm(source: Path) -> bool:
    """Whether all compiled code that a module imports, as it is now, has been called before."""
    return _mark(source).exists()


def note_warm(source: Path) -> None:
    """Remember that all compiled code that a module imports has now been called.

    Caches that have not been used for a month are deleted.
    """
    mark = _mark(source)
    with suppress(OSError):  # where nothing can be kept, the next start compiles again
        mark.parent.mkdir(parents=True, exist_ok=True)
        mark.touch()
        used = {_cache_folder(module) for module in _with_imports(source)}
        for cached in mark.parent.parent.iterdir():
            if cached in used:
                os.utime(cached)
            elif cached.stat().st_mtime < time.time() - _KEPT_S:  # of other states of the sources
                shutil.rmtree(cached, ignore_errors=True)


def compiled(function: Function) -> Function:
    """Compile a function on its first call; calls among compiled functions cost nothing."""
    return _compiled(function, fastmath=False)


def borrowing(function: Function) -> Function:
    """The same for functions of large tuples of arrays, to whose arrays no references are counted.

    Numba's counting for every array touched would cost more than the arithmetic. So nothing is counted
    within: such a function borrows the arrays of its caller. It cannot allocate one, which does not compile;
    and it and all that it calls return numbers, for nobody would release an array.

    Raises:
        TypeError: It is declared to return something else.
    """
    return _borrowing(function, forceinline=False)


def inlined(function: Function) -> Function:
    """The same as `borrowing`, and written out where it is called, if even the call would cost too much."""
    return _borrowing(function, forceinline=True)


def compiled_sums(function: Function) -> Function:
    """The same for sums that may be taken in any order, which is several times faster for long ones."""
    return _compiled(function, fastmath={"reassoc", "contract"})


def _borrowing(function: Function, *, forceinline: bool) -> Function:
    returned = inspect.formatannotation(function.__annotations__["return"])
    if not _NUMBERS.issuperset(re.findall(r"\w+", returned)):
        raise TypeError(
            f"{function.__qualname__} returns {returned}: functions that borrow return numbers only"
        )
    return _compiled(function, fastmath=False, forceinline=forceinline, nrt=False)


def _compiled(
    function: Function, *, fastmath: bool | set[str], forceinline: bool = False, nrt: bool = True
) -> Function:
    """Compile a function, with a cache of its module."""
    # one cache, whether a package is found by a link or not: numba has another one for every path
    source = Path(function.__code__.co_filename).resolve()
    function.__code__ = function.__code__.replace(co_filename=str(source))
    numba.config.CACHE_DIR = str(_cache_folder(source))  # type: ignore[attr-defined]
    # without _nrt a function would count references, or not, as the one that happens to call it first
    compiler = numba.njit(  # type: ignore[call-overload]  # its stubs lack _nrt
        cache=True,
        error_model="numpy",
        fastmath=fastmath,
        forceinline=forceinline,
        _nrt=nrt,
    )
    dispatcher = compiler(function)
    _let_one_save_at_a_time(dispatcher, _cache_folder(source))
    return cast("Function", dispatcher)


def _let_one_save_at_a_time(dispatcher: Any, folder: Path) -> None:
    """Let processes that compile a function at once save it one after the other.

    Numba writes index and code apart, without a lock: one process's index could name another one's code.
    """
    if not hasattr(dispatcher, "_cache"):  # numba is told not to compile
        return
    save = dispatcher._cache.save_overload  # noqa: SLF001 - numba has no other way in

    def save_overload(signature: object, result: object) -> None:
        with ExitStack() as stack:
            with suppress(OSError):  # where nothing can be kept, there is nothing to lock
                folder.mkdir(parents=True, exist_ok=True)
                lock = stack.enter_context((folder / "lock").open("a"))
                fcntl.flock(lock, fcntl.LOCK_EX)
            save(signature, result)

    dispatcher._cache.save_overload = save_overload  # noqa: SLF001


def _mark(source: Path) -> Path:
    return _cache_folder(source.resolve()) / "warm"


@cache
def _cache_folder(source: Path) -> Path:
    """A cache for every state of a module and of all that it imports.

    Numba alone would miss a change in another file than that of the function called.
    """
    place = f"{source} {numba.__version__} {sys.version}".encode()
    parts = [place, *(module.read_bytes() for module in sorted(_with_imports(source)))]
    root = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(root) / "swarm_loc_estimator" / hashlib.sha256(b"".join(parts)).hexdigest()[:16]


def _with_imports(source: Path) -> set[Path]:
    """A module, and all of this workspace that it imports, directly or not."""
    found: set[Path] = set()
    left = [source.resolve()]
    while left:
        module = left.pop()
        if module not in found:
            found.add(module)
            left.extend(_imported(module))
    return found


@cache
def _imported(source: Path) -> tuple[Path, ...]:
    """The modules of this workspace that a module imports itself."""
    return tuple(
        file
        for match in _IMPORT.finditer(source.read_text(encoding="utf-8"))
        for file in _files(source.parent, match["module"], match["names"])
        if file.exists()
    )


def _files(beside: Path, module: str, names: str) -> Iterator[Path]:
    """Where the modules of `from module import names` may be: a module, or modules of a package."""
    package, *parts = module.split(".")
    root = _package_folder(package) if package.startswith("swarm_loc_") else beside / package
    place = root.joinpath(*parts)
    yield place.with_suffix(".py")
    yield from (place / f"{name}.py" for name in re.findall(r"\w+", names))


@cache
def _package_folder(package: str) -> Path:
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError(f"the package '{package}' is not installed", name=package)
    return Path(spec.origin).resolve().parent
