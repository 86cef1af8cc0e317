"""Compilation of the inner loops, and the plane's geometry on single numbers for use inside them.

The estimator's hot paths touch a handful of numbers a hundred thousand times, where calls of array
functions cost ten to fifty times the arithmetic. Compiled code is cached in the user's cache folder.
"""

from __future__ import annotations

import hashlib
import math
import os
import shutil
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

Function = TypeVar("Function", bound=Callable[..., object])

_CORE = Path(__file__).resolve().parent
_KEPT_S = 30 * 86400.0


@cache
def _cache_folder(folder: Path) -> Path:
    """A cache for every state of a folder's sources and of the core's.

    Numba alone would miss a change in another file than that of the function called.
    """
    sources = sorted({*_CORE.rglob("*.py"), *folder.glob("*.py")})
    place = f"{folder} {numba.__version__} {sys.version}".encode()
    parts = [place, *(source.read_bytes() for source in sources)]
    root = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(root) / "swarm_loc_estimator" / hashlib.sha256(b"".join(parts)).hexdigest()[:16]


def is_warm(folder: Path = _CORE) -> bool:
    """Whether the compiled code of a folder's sources, as they are, has been called throughout before."""
    return _mark(folder).exists()


def note_warm(folder: Path = _CORE) -> None:
    """Remember that the compiled code of a folder's sources has now been called throughout.

    Caches that have not been used for a month are deleted.
    """
    own = _cache_folder(folder)
    with suppress(OSError):  # where nothing can be kept, the next start compiles again
        _mark(folder).touch()
        os.utime(own)
        for other in own.parent.iterdir():  # of other states of the sources
            if other != own and other.stat().st_mtime < time.time() - _KEPT_S:
                shutil.rmtree(other, ignore_errors=True)


def _mark(folder: Path) -> Path:
    return _cache_folder(folder) / "warm"


def compiled(function: Function) -> Function:
    """Compile a function on its first call; calls among compiled functions cost nothing."""
    return _compiled(function, fastmath=False)


def compiled_sums(function: Function) -> Function:
    """The same for sums that may be taken in any order, which is several times faster for long ones."""
    return _compiled(function, fastmath={"reassoc", "contract"})


def _compiled(function: Function, *, fastmath: bool | set[str]) -> Function:
    """Compile a function, with a cache of its folder."""
    # one cache, whether a package is found by a link or not: numba has another one for every path
    source = Path(function.__code__.co_filename).resolve()
    function.__code__ = function.__code__.replace(co_filename=str(source))
    numba.config.CACHE_DIR = str(_cache_folder(source.parent))  # type: ignore[attr-defined]
    return cast("Function", numba.njit(cache=True, error_model="numpy", fastmath=fastmath)(function))


@compiled
def assign(target: NDArray[np.float64], source: NDArray[np.float64]) -> None:
    """Copy a vector; a slice assignment would cost seconds of compilation at every place it stands."""
    for i in range(target.size):
        target[i] = source[i]


@compiled
def assign_matrix(target: NDArray[np.float64], source: NDArray[np.float64]) -> None:
    """Copy a matrix."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = source[i, j]


@compiled
def wrap(angle: float) -> float:
    """An angle [rad] in [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@compiled
def composed(
    ax: float, ay: float, atheta: float, bx: float, by: float, btheta: float
) -> tuple[float, float, float]:
    """The pose b, given in frame a, in the frame that a is given in; heading not wrapped."""
    cos, sin = math.cos(atheta), math.sin(atheta)
    return ax + cos * bx - sin * by, ay + sin * bx + cos * by, atheta + btheta


@compiled
def moved_by_twist(
    rho_x: float, rho_y: float, phi: float, x: float, y: float, theta: float
) -> tuple[float, float, float]:
    """exp(twist) composed with a pose, heading wrapped."""
    if abs(phi) < 1e-4:
        a, b = 1.0 - phi * phi / 6.0, 0.5 * phi
    else:
        a, b = math.sin(phi) / phi, (1.0 - math.cos(phi)) / phi
    ex, ey, etheta = composed(a * rho_x - b * rho_y, b * rho_x + a * rho_y, phi, x, y, theta)
    return ex, ey, wrap(etheta)


@compiled
def adjoint_of(transform: NDArray[np.float64]) -> tuple[tuple[float, ...], ...]:
    """Ad(T) of a transform (3,), see `se2.adjoint`."""
    cos, sin = math.cos(transform[2]), math.sin(transform[2])
    return (cos, -sin, transform[1]), (sin, cos, -transform[0]), (0.0, 0.0, 1.0)


@compiled
def carry(transform: NDArray[np.float64], matrix: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Write Ad(T) M Ad(T)^T (3, 3), of a transform (3,) and the covariance M (3, 3) of an error behind it."""
    adjoint = adjoint_of(transform)
    for i in range(3):
        a, b, c = adjoint[i]
        x = a * matrix[0, 0] + b * matrix[1, 0] + c * matrix[2, 0]
        y = a * matrix[0, 1] + b * matrix[1, 1] + c * matrix[2, 1]
        z = a * matrix[0, 2] + b * matrix[1, 2] + c * matrix[2, 2]
        for j in range(3):
            out[i, j] = x * adjoint[j][0] + y * adjoint[j][1] + z * adjoint[j][2]
