"""Reader of sweeps, see doc/sweep.md: a YAML file to the list of all replays, in the order of the table."""

from __future__ import annotations

import glob
import hashlib
import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import joblib

from swarm_loc_estimator.common.bags.reader import is_storage
from swarm_loc_estimator.common.parameters import (
    NumberSpec,
    ParameterError,
    ParameterSpec,
    UserError,
    Value,
    parameter_specs,
)
from swarm_loc_estimator.common.yaml_tree import WHOLE_FILE, Tree, TreeChecks, read_tree
from swarm_loc_estimator.mapping.map_file import load_map
from swarm_loc_estimator.offline.recorded_bag import Loss
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
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
    """A sweep that cannot be run; the message is one sentence."""


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
    """Checks one file."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, SweepFileError)
        self._folder = path.absolute().parent
        # a version stays the same while the package is developed
        self._program = _digest(sorted(Path(__file__).parents[2].rglob("*.py")))
        self._content = cache(lambda bag: _digest(_storages(bag)))
        self._described = cache(_described)

    def sweep(self, tree: Tree) -> Sweep:
        """All replays of the file."""
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
        """The section `fit`."""
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
        """The value of a parameter."""
        try:
            return replace(spec, name=key).checked(value)
        except ParameterError as error:
            raise self.said(str(error).removesuffix(".")) from error

    def _job(self, bag: str, swarm: str, values: dict[str, Value], share: float, seed: int | None) -> Job:
        """One replay."""
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
    return swarm, joblib.hash((swarm, None if swarm.map is None else load_map(swarm.map)))


def _storages(bag: Path) -> list[Path]:
    """The files of a bag with messages, plain or compressed."""
    files = sorted(bag.iterdir()) if bag.is_dir() else [bag]
    return [one for one in files if is_storage(one) and one.is_file()]


def _digest(files: Sequence[Path]) -> str:
    """Hash of the contents of files."""
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.stat().st_size.to_bytes(8, "big"))
        with path.open("rb") as file:
            while block := file.read(_BLOCK):
                digest.update(block)
    return digest.hexdigest()
