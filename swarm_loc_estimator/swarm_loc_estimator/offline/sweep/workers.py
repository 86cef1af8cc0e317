"""Where the replays of a sweep run: processes of this machine, or a cluster of Ray or Dask, all by joblib."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from socket import create_connection
from typing import Any, Literal, NamedTuple, get_args
from urllib.parse import urlsplit

import joblib

from swarm_loc_estimator.common.parameters import UserError

Name = Literal["loky", "ray", "dask"]
NAMES: tuple[Name, ...] = get_args(Name)
_PATIENCE_S = 10.0


class BackendError(UserError):
    """A back end that is not installed or not reached; the message is one sentence."""


class Backend(NamedTuple):
    """What runs the workers."""

    name: Name = "loky"  # loky for processes of this machine
    address: str | None = None  # Of a running cluster; None: Ray or Dask is started on this machine


@contextmanager
def workers(count: int, backend: Backend) -> Iterator[None]:
    """A context in which `joblib.Parallel` has these workers.

    Args:
        count: Number of replays at a time; -1: one for each processor.
        backend: Runs them.

    Raises:
        BackendError: A package is missing, or the cluster is not reached.
    """
    start = {"loky": _loky, "ray": _ray, "dask": _dask}[backend.name]
    with start(count, backend.address) as options, joblib.parallel_config(n_jobs=count, **options):
        yield


@contextmanager
def _loky(_count: int, _address: str | None) -> Iterator[dict[str, Any]]:
    """Processes of one thread each."""
    yield {"backend": "loky", "inner_max_num_threads": 1}


@contextmanager
def _ray(count: int, address: str | None) -> Iterator[dict[str, Any]]:
    """Actors of Ray."""
    ray, backend = loaded("ray", "ray"), loaded("ray.util.joblib.ray_backend", "ray")
    options = {"address": address} if address else {"num_cpus": None if count < 0 else count}
    with _reached(address):
        if address:  # Ray itself asks an address where nobody answers for many minutes
            place = urlsplit(address if "//" in address else f"//{address}")
            create_connection((place.hostname, place.port or 0), _PATIENCE_S).close()
        ray.init(**options, logging_level="ERROR", log_to_driver=False)
    try:
        pool = backend.RayBackend()
        pool.supports_return_generator = (
            True  # denied to the pool of multiprocessing, from which Ray derives its own
        )
        yield {"backend": pool}
    finally:
        ray.shutdown()


@contextmanager
def _dask(count: int, address: str | None) -> Iterator[dict[str, Any]]:
    """Workers of Dask."""
    client = loaded("distributed", "dask").Client
    local = {"n_workers": None if count < 0 else count, "threads_per_worker": 1, "dashboard_address": None}
    with _reached(address):
        connected = client(address) if address else client(**local)
    with connected:
        yield {"backend": "dask"}


@contextmanager
def _reached(address: str | None) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError) as cause:
        raise BackendError(f"--cluster {address} is not reached: {' '.join(str(cause).split())}.") from cause


def loaded(module: str, extra: str) -> Any:
    """A module that only some sweeps need.

    Raises:
        BackendError: It is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        needed = f"{extra} needs a package that is not installed"
        raise BackendError(f"{needed}: pip install 'swarm_loc_estimator[{extra}]' ({error}).") from error
