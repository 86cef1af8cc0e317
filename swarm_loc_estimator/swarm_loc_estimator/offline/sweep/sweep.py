"""Sweeps, see doc/sweep.md: read one, run its replays, and fit settings.

A YAML file gives the list of all replays, in the order of the table. They run in workers: processes of this
machine, or a cluster of Ray or Dask, all by joblib. Each finished one is a line of a file, and is not run
again. A fit is a sweep whose grid optuna extends by what it has seen so far.
"""

from __future__ import annotations

import glob
import hashlib
import itertools
import json
import math
import os
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib import import_module
from io import FileIO
from pathlib import Path
from socket import create_connection
from typing import Any, Literal, NamedTuple, get_args
from urllib.parse import urlsplit

import joblib
import numpy as np
from joblib._parallel_backends import LokyBackend

from swarm_loc_estimator.common.bags.reader import is_storage
from swarm_loc_estimator.common.codec import WHOLE_FILE, Tree, TreeChecks
from swarm_loc_estimator.common.files import check_file, naming
from swarm_loc_estimator.common.jit import is_precompiled
from swarm_loc_estimator.common.parameters import (
    NumberSpec,
    ParameterError,
    ParameterSpec,
    UserError,
    Value,
    parameter_specs,
)
from swarm_loc_estimator.common.processes import end_with, uninterrupted
from swarm_loc_estimator.common.yaml_tree import read_tree
from swarm_loc_estimator.mapping.map_file import load_map
from swarm_loc_estimator.offline.metrics import pool
from swarm_loc_estimator.offline.recorded_bag import Loss, Progress
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.precompile import precompile, size_of
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.estimate import Status
from swarm_loc_estimator.timeline.settings import Settings

MAX_JOBS = 100_000
KEYS = ("bags", "swarms", "settings", "lost", "seeds", "workers", "fit")
MINIMIZED = (
    *("position_rmse_m", "position_median_m", "position_p95_m", "position_max_m"),
    *("heading_rmse_deg", "misleading_share"),
)
"""Columns of the table that a fit can minimize."""
_SETTINGS = {spec.name: spec for spec in parameter_specs(Settings)}
_SHARE, _SEED = parameter_specs(Loss)
_WORKERS = ParameterSpec("workers", 1, "", NumberSpec("1", 1, 4096, False, "replays at a time"))
_TRIALS = ParameterSpec("trials", 1, "", NumberSpec("1", 2, 10_000, False, "sets of values that are tried"))
_BLOCK = 2**22


class SweepFileError(UserError):
    """A sweep that cannot be run."""


@dataclass(frozen=True)
class Job:
    """One replay."""

    bag: Path  # Path of the bag
    swarm: Swarm  # Its robots and landmarks
    settings: Settings  # Of the estimator
    loss: Loss  # Messages that are lost
    # Hash of all that determines the result: contents of bag, swarm and map, settings, loss, program
    key: str
    cells: dict[str, Value | None]  # Its values by column of the table; None: no seed where nothing is lost

    def having(self, values: Mapping[str, Value]) -> Job:
        """The same replay with other values of settings."""
        settings = replace(self.settings, **values)  # type: ignore[arg-type]
        key = hashlib.sha256(f"{self.key} {settings}".encode()).hexdigest()
        lost, seed = self.cells["lost"], self.cells["seed"]
        cells = {**{name: self.cells[name] for name in self.cells if name not in {"lost", "seed"}}, **values}
        return replace(self, settings=settings, key=key, cells={**cells, "lost": lost, "seed": seed})


@dataclass(frozen=True)
class Fit:
    """A search for the values of settings with the least mean of a column over all replays."""

    minimize: str  # The column
    trials: int  # Number of sets of values that are tried
    # Setting -> least and greatest value; whole numbers for those that are
    ranges: Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Sweep:
    """All replays of a sweep, in the order of the table."""

    jobs: tuple[Job, ...]  # The replays
    varied: tuple[str, ...]  # Columns with more than one value, but for bag and seed
    workers: int  # Number of replays at a time; -1: one for each processor
    fit: Fit | None = None  # Makes the replays of each trial from these; None: there is no fit


def read_sweep(path: Path) -> Sweep:
    """Read a sweep and the swarm descriptions that it needs.

    Raises:
        SweepFileError: A key or value cannot be used, or there is no such bag.
        YamlTreeError: The file is no YAML.
        SwarmFileError: A swarm description cannot be used.
        MapFileError: The map that it names cannot be used.
    """
    return _SweepReader(path).sweep(read_tree(path))


class _SweepReader(TreeChecks):
    def __init__(self, path: Path) -> None:
        super().__init__(path, SweepFileError)
        self._folder = path.absolute().parent
        # a version stays the same while the package is developed
        self._program = _digest(sorted(Path(__file__).parents[2].rglob("*.py")))
        self._content = cache(lambda bag: _digest(_storages(bag)))
        self._described = cache(_described)

    def sweep(self, tree: Tree) -> Sweep:
        said = self.mapping(tree, WHOLE_FILE, KEYS, required=("bags",))
        found = [bag for k, one in enumerate(self._some(said["bags"], "bags")) for bag in self._bags(one, k)]
        bags = list(dict.fromkeys(found))
        swarms = self._some(said["swarms"], "swarms") if "swarms" in said else [""]
        given = self.mapping(said.get("settings"), "settings", _SETTINGS)
        grid = {name: self._some(one, f"settings.{name}", _SETTINGS[name]) for name, one in given.items()}
        lost = self._some(said.get("lost", [0.0]), "lost", _SHARE)
        if "seeds" in said and not any(lost):
            raise self.said("seeds choose which messages are lost, but lost names no share above 0")
        seeds = self._some(said.get("seeds", [1]), "seeds", _SEED)
        losses = [(share, seed) for share in lost for seed in (seeds if share else [None])]
        workers = self._checked(said["workers"], "workers", _WORKERS) if "workers" in said else -1
        fit = self._fit(said["fit"], grid) if "fit" in said else None
        count = len(bags) * len(swarms) * math.prod(map(len, grid.values())) * len(losses)
        count *= fit.trials if fit else 1
        if count > MAX_JOBS:
            raise self.said(f"it makes {count} replays but must make at most {MAX_JOBS}")
        jobs = [
            self._job(bag, swarm, dict(zip(grid, values, strict=True)), *loss)
            for bag, swarm, values, loss in itertools.product(
                bags, swarms, itertools.product(*grid.values()), losses
            )
        ]
        axes = {"swarm": swarms, **grid, **(fit.ranges if fit else {}), "lost": lost}
        return Sweep(tuple(jobs), tuple(name for name in axes if len(axes[name]) > 1), int(workers), fit)

    def _fit(self, tree: Tree, grid: Collection[str]) -> Fit:
        said = self.mapping(tree, "fit", ("minimize", "trials", "ranges"), required=("trials", "ranges"))
        minimize = said.get("minimize", MINIMIZED[0])
        if minimize not in MINIMIZED:
            raise self.error("fit.minimize", minimize, f"must be one of {', '.join(MINIMIZED)}")
        ranges = {}
        for name, one in self.mapping(said["ranges"], "fit.ranges", _SETTINGS).items():
            spec, key = _SETTINGS[name], f"fit.ranges.{name}"
            if spec.number is None or isinstance(spec.default, bool) or name in grid:
                raise self.error(key, one, "must be of a number that is not in settings, too")
            bounds = [self._checked(bound, key, spec) for bound in self.items(one, key)]
            if len(bounds) != 2 or not bounds[0] < bounds[1]:
                raise self.error(key, one, "must be its least and its greatest value")
            ranges[name] = (bounds[0], bounds[1])
        if not ranges:
            raise self.error("fit.ranges", said["ranges"], "must name at least one setting")
        return Fit(minimize, int(self._checked(said["trials"], "fit.trials", _TRIALS)), ranges)

    def _bags(self, text: str, number: int) -> list[str]:
        """Paths of bags, from the folder of the file, that fit a path or pattern."""
        found = sorted(glob.glob(text, root_dir=self._folder, recursive=True))  # noqa: PTH207 - pathlib refuses absolute patterns
        if glob.has_magic(text):
            found = [one for one in found if _storages(self._folder / one)]
        if not found:
            raise self.error(f"bags[{number}]", text, "must be a bag or a pattern of bags")
        return found

    def _some(self, tree: Tree, key: str, spec: ParameterSpec | None = None) -> list[Any]:
        """A list of at least one value, each once: those of a parameter, or texts."""
        values = [
            self._checked(one, f"{key}[{k}]", spec) if spec else str(one)
            for k, one in enumerate(self.items(tree, key))
        ]
        if not values or len({*values}) < len(values):
            raise self.error(key, tree, "must be a list of at least one value, each once")
        return values

    def _checked(self, value: Tree, key: str, spec: ParameterSpec) -> Any:
        try:
            return replace(spec, name=key).checked(value)
        except ParameterError as error:
            raise self.said(str(error).removesuffix(".")) from error

    def _job(self, bag: str, swarm: str, values: dict[str, Value], share: float, seed: int | None) -> Job:
        path = self._folder / bag
        swarm = swarm or str((Path(bag) if path.is_dir() else Path(bag).parent) / "swarm.yaml")
        described, digest = self._described(self._folder / swarm)
        settings, loss = replace(Settings(), **values), Loss(share, seed or 0)  # type: ignore[arg-type]
        determined = (self._program, self._content(path), digest, settings, loss)
        key = hashlib.sha256(repr(determined).encode()).hexdigest()
        cells = {"bag": bag, "swarm": swarm, **values, "lost": share, "seed": seed}
        return Job(path, described, settings, loss, key, cells)


def _described(path: Path) -> tuple[Swarm, str]:
    """A swarm, and a hash of its description and map."""
    swarm = load_swarm(path)
    return swarm, joblib.hash((swarm, load_map(swarm.map) if isinstance(swarm.map, Path) else None))


def _storages(bag: Path) -> list[Path]:
    """The files of a bag with messages, plain or compressed."""
    files = sorted(bag.iterdir()) if bag.is_dir() else [bag]
    return [one for one in files if is_storage(one) and one.is_file()]


def _digest(files: Sequence[Path]) -> str:
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.stat().st_size.to_bytes(8, "big"))
        with path.open("rb") as file:
            while block := file.read(_BLOCK):
                digest.update(block)
    return digest.hexdigest()


Line = dict[str, Any]
"""A finished job: its key, and either its figures by column of the table or the reason of its failure."""

_IN_ORDER = tuple(map(int, joblib.__version__.split(".")[:2])) < (1, 4)
"""Whether this joblib, such as that of Ubuntu 24.04, gives results only in the order of the jobs."""


def run_sweep(sweep: Sweep, path: Path, backend: Backend, progress: Progress) -> dict[str, Line]:
    """Run all jobs but those that are finished in the file, and add them to it.

    The file has one line of JSON per job. It is created if missing, and what is not whole in it is ignored.

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
    check_file(path)
    began = time.monotonic()
    with path.open("ab", buffering=0) as file:
        if file.tell() and not path.read_bytes().endswith(b"\n"):
            file.write(b"\n")  # ends the line in which the last run was killed
        progress(0.0, f"0 of {len(jobs)} replays")
        for done, line in enumerate(_outcomes(jobs, sweep.workers, backend), 1):
            with naming(path):
                _append(file, f"{json.dumps(line)}\n".encode())
            left_s = (time.monotonic() - began) / done * (len(jobs) - done)
            progress(done / len(jobs), f"{done} of {len(jobs)} replays, {left_s:.0f} s left")
    return _read(path)


def _append(file: FileIO, data: bytes) -> None:
    """Append all of the data or, where there is no room, nothing."""
    begin = file.tell()
    try:
        while data:
            data = data[file.write(data) :]
    except OSError:
        file.truncate(begin)
        raise


def _outcomes(jobs: Mapping[str, Job], count: int, backend: Backend) -> Iterator[Line]:
    """The lines of jobs as they finish; batches of one, so that a kill costs only what is running."""
    if not jobs:
        return
    try:
        with workers(count, backend):
            as_done = "generator" if _IN_ORDER else "generator_unordered"
            calls = (joblib.delayed(outcome)(job) for job in jobs.values())
            with uninterrupted():
                lines = joblib.Parallel(return_as=as_done, batch_size=1)(calls)
            yield from lines
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


def outcome(job: Job) -> Line:
    """Replay a job; only its figures, or the error in one line, leave the worker."""
    try:
        result = replay(job.bag, job.swarm, job.settings, loss=job.loss)
        return {"key": job.key, "figures": figures_of(result)}
    except Exception as error:  # noqa: BLE001 - any error ends a job and not the sweep
        kind = "" if isinstance(error, UserError) else f"{type(error).__name__}: "
        return {"key": job.key, "reason": " ".join(f"{kind}{error}".split())}


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
    """A back end that is not installed or not reached."""


class Backend(NamedTuple):
    """What runs the workers."""

    name: Name = "loky"  # loky for processes of this machine
    address: str | None = None  # Of a running cluster; None: Ray or Dask is started on this machine


@contextmanager
def workers(count: int, backend: Backend) -> Iterator[None]:
    """A context in which `joblib.Parallel` has `count` workers; -1: one for each processor.

    Raises BackendError if a package is missing, or the cluster is not reached.
    """
    start = {"ray": _ray, "dask": _dask}.get(backend.name)
    local = nullcontext({"backend": _Loky(inner_max_num_threads=1)})
    with (
        start(count, backend.address) if start else local as options,
        joblib.parallel_config(n_jobs=count, **options),
    ):
        yield


class _Loky(LokyBackend):
    """Workers that end with this process; older versions of joblib have no argument for that."""

    def configure(self, **options: Any) -> int:
        started: int = super().configure(**options, initializer=end_with, initargs=(os.getpid(),))
        return started


@contextmanager
def _ray(count: int, address: str | None) -> Iterator[dict[str, Any]]:
    """Actors of Ray; a cluster that is started here listens on loopback addresses only."""
    if not address:
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"  # read on import; else it listens on all
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
    """A module that only some sweeps need; raises BackendError if it is not installed."""
    try:
        return import_module(module)
    except ImportError as error:
        needed = f"{extra} needs a package that is not installed"
        raise BackendError(f"{needed}: pip install 'swarm_loc_estimator[{extra}]' ({error}).") from error


_AT_ONCE = 8  # Trials chosen at a time, whatever the number of workers: the table does not change


class Best(NamedTuple):
    """The best trial of a fit."""

    values: Mapping[str, Value]  # Setting -> value
    minimized: str  # The column that it minimizes
    mean: float  # Of this column
    # The same with the defaults; None: they are not in the ranges, or have no figure
    mean_before: float | None


class Fitted(NamedTuple):
    """A finished fit."""

    sweep: Sweep  # With the replays of all trials
    finished: Mapping[str, Line]  # Key of a job -> its line
    best: Best | None  # None if each trial had a replay without the figure


def run_fit(sweep: Sweep, fit: Fit, path: Path, backend: Backend, progress: Progress) -> Fitted:
    """Run the trials of a fit; the defaults are the first one, where the ranges contain them.

    What is finished in the file at `path` is not run again, see `run_sweep`, so a fit can be interrupted,
    too.

    Raises:
        BackendError: optuna is not installed, or the back end is not reached.
        UserError: A worker was killed.
    """
    # what is searched, with the defaults first
    optuna = loaded("optuna", "optuna")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=0, n_startup_trials=_AT_ONCE))
    defaults = {name: getattr(Settings(), name) for name in fit.ranges}
    if all(low <= defaults[name] <= high for name, (low, high) in fit.ranges.items()):
        study.enqueue_trial(defaults)
    kinds = {int: optuna.distributions.IntDistribution, float: optuna.distributions.FloatDistribution}
    searched = {name: kinds[type(defaults[name])](*bounds) for name, bounds in fit.ranges.items()}
    # some trials at a time: ask, replay, tell
    jobs: list[Job] = []
    finished: dict[str, Line] = {}
    for first in range(0, fit.trials, _AT_ONCE):
        trials = [study.ask(searched) for _ in range(min(_AT_ONCE, fit.trials - first))]
        asked = [[job.having(trial.params) for job in sweep.jobs] for trial in trials]
        batch = tuple(itertools.chain(*asked))
        jobs += batch

        def at(share: float, what: str, first: int = first, count: int = len(trials)) -> None:
            progress((first + share * count) / fit.trials, f"trial {first + 1} and next ones: {what}")

        finished |= run_sweep(replace(sweep, jobs=batch), path, backend, at)
        for trial, own in zip(trials, asked, strict=True):
            values = [finished[job.key].get("figures", {}).get(fit.minimize) for job in own]
            mean = None if None in values else float(np.mean(values))
            study.tell(trial, mean, state=None if mean is not None else optuna.trial.TrialState.FAIL)
    # the best trial, and the gain over the defaults
    every = replace(sweep, jobs=tuple({job.key: job for job in jobs}.values()))
    complete = study.get_trials(states=[optuna.trial.TrialState.COMPLETE])
    if not complete:
        return Fitted(every, finished, None)
    best = min(complete, key=lambda trial: trial.value)
    before = complete[0].value if complete[0].params == defaults else None
    return Fitted(every, finished, Best(best.params, fit.minimize, best.value, before))
