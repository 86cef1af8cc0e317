"""Run the replays of a sweep in workers; each finished one is a line of a file, and is not run again.

Where the replays of a sweep run: processes of this machine, or a cluster of Ray or Dask, all by joblib.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from socket import create_connection
from typing import Any, Literal, NamedTuple, get_args
from urllib.parse import urlsplit

import joblib
import numpy as np

from swarm_loc_estimator.common.jit import is_precompiled
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.offline.metrics import pool
from swarm_loc_estimator.offline.recorded_bag import Progress
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.offline.sweep.grid import Job, Sweep
from swarm_loc_estimator.precompile import precompile, size_of
from swarm_loc_estimator.timeline.estimate import Status

Line = dict[str, Any]
"""A finished job: its key, and either its figures by column of the table or the reason of its failure."""

_IN_ORDER = tuple(map(int, joblib.__version__.split(".")[:2])) < (1, 4)
"""Whether this joblib, such as that of Ubuntu 24.04, gives results in the order of the jobs only."""


def run_sweep(sweep: Sweep, path: Path, backend: Backend, progress: Progress) -> dict[str, Line]:
    """Run all jobs but those that are finished in the file, and add them to it.

    Args:
        sweep: The jobs.
        path: File with one line of JSON per job; created if missing, and what is not whole in it is ignored.
        backend: Runs the workers.
        progress: Called after each job.

    Returns:
        Key of a job -> its newest line.

    Raises:
        BackendError: The back end is not installed or not reached.
        UserError: A worker was killed.
    """
    finished = {key: line for key, line in _read(path).items() if "figures" in line}
    jobs = {job.key: job for job in sweep.jobs if job.key not in finished}
    _compile(jobs)
    path.parent.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    with path.open("a", encoding="utf-8") as file:
        if file.tell() and not path.read_bytes().endswith(b"\n"):
            file.write("\n")  # ends the line in which the last run was killed
        progress(0.0, f"0 of {len(jobs)} replays")
        for done, line in enumerate(_outcomes(jobs, sweep.workers, backend), 1):
            file.write(json.dumps(line) + "\n")
            file.flush()
            left_s = (time.monotonic() - began) / done * (len(jobs) - done)
            progress(done / len(jobs), f"{done} of {len(jobs)} replays, {left_s:.0f} s left")
    return _read(path)


def _outcomes(jobs: Mapping[str, Job], count: int, backend: Backend) -> Iterator[Line]:
    """The lines of jobs as they finish; batches of one, so that a kill costs only what is running."""
    if not jobs:
        return
    try:
        with workers(count, backend):
            as_done = "generator" if _IN_ORDER else "generator_unordered"
            calls = (joblib.delayed(outcome)(job) for job in jobs.values())
            yield from joblib.Parallel(return_as=as_done, batch_size=1)(calls)
    except BrokenProcessPool as error:
        reason = "A worker was killed, perhaps for its memory: give fewer workers; the next run goes on here."
        raise UserError(reason) from error


def _compile(jobs: Mapping[str, Job]) -> None:
    """Compile what the jobs need, before each worker does it."""
    for size, infrared in {
        (size_of(job.swarm, job.settings), any(robot.ir for robot in job.swarm.robots))
        for job in jobs.values()
    }:
        compiled = partial(precompile, size, infrared)
        if not is_precompiled(compiled):
            compiled()


def _read(path: Path) -> dict[str, Line]:
    """Key -> newest line of a file; broken ones, such as a kill leaves, are not there."""
    lines: dict[str, Line] = {}
    for text in path.read_text("utf-8", "replace").splitlines() if path.exists() else ():
        try:
            line = json.loads(text)
            lines[line["key"]] = line
        except (ValueError, TypeError, KeyError):
            continue
    return lines


class _Failure:
    """A context in which any error ends a job and not the sweep.

    Attributes:
        reason: The error in one line.
    """

    reason = ""

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> bool:
        if kind is None or not isinstance(error, Exception):
            return False
        self.reason = " ".join(
            f"{'' if isinstance(error, UserError) else kind.__name__ + ': '}{error}".split()
        )
        return True


def outcome(job: Job) -> Line:
    """Replay a job; only its figures leave the worker."""
    failure = _Failure()
    with failure:
        result = replay(job.bag, job.swarm, job.settings, loss=job.loss)
        return {"key": job.key, "figures": figures_of(result)}
    return {"key": job.key, "reason": failure.reason}


FIGURES = (
    *("robots", "poses", "position_rmse_m", "position_median_m", "position_p95_m", "position_max_m"),
    *("heading_rmse_deg", "nees", "misleading_share", "tracked_share", "position_sigma_m"),
)
"""Columns of the table with results."""


def figures_of(result: ReplayResult) -> dict[str, float | None]:
    """The results of a replay by column of the table; None where there is nothing to compare or no pose."""
    located = np.isfinite(result.poses).all(axis=2)
    variance = result.covariances[located][:, (0, 1), (0, 1)].sum(axis=1)
    errors, row = pool([*result.errors.values()]), result.overall
    values = (
        *(len(result.swarm.robots), int(located.sum())),
        *(row.position_rmse, row.position_median, row.position_p95, row.position_max),
        *(math.degrees(row.heading_rmse), row.nees),
        float(errors.misleading.mean()) if row.count else math.nan,
        float(np.mean(result.status == Status.TRACKED)) if result.status.size else math.nan,
        float(np.median(np.sqrt(variance))) if variance.size else math.nan,
    )
    return {name: None if math.isnan(value) else value for name, value in zip(FIGURES, values, strict=True)}


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
