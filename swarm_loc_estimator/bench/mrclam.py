"""Five real robots (MRCLAM): parameters fitted on one set, then all sets untouched.

    make bench-mrclam
    make bench-mrclam ARGS="FOLDER --fit 1"

Online poses at 10 Hz against ground truth, started at the true pose. "plain" has only its noise fitted,
"calibrated" everything. The smoother is the offline limit with the same models and noise. In `blind_robots`
two robots see landmarks and all see robots; the errors are those of the others, pooled over all choices.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from bench._common import OUT, Cell, new_plot, save_plot, table, write_figures
from bench.mrclam_sets import (
    NoSetsError,
    find_sets,
    import_set,
    load,
    transferred,
    unknown_start,
    with_two_seeing,
    without_robots,
    without_sightings,
)
from swarm_loc_estimator.calibration.fit import Options, calibrate
from swarm_loc_estimator.calibration.recording import CalibrationError, Recording
from swarm_loc_estimator.calibration.rerun import rerun
from swarm_loc_estimator.core.metrics import Errors, pool
from swarm_loc_estimator.core.swarm import Swarm
from swarm_loc_estimator.io.mrclam import MrclamError
from swarm_loc_estimator.io.swarm_file import load_swarm
from swarm_loc_estimator.io.swarm_writer import save_swarm
from swarm_loc_estimator.replay import replay
from swarm_loc_estimator.replay_result import ReplayResult

DEFAULT_FOLDER = OUT.parent.parent / "shared" / "data" / "mrclam"
MODELS = ("plain", "calibrated")
COLUMNS = ("odometry", "landmarks", "landmarks_robots", "smoother", "blind_robots")
FIGURES = ("position_rmse_m", "heading_rmse_deg", "nees")
WORK = OUT / "mrclam"
TICK_S, BLIND_TICK_S = 0.1, 0.5
PUBLISHED_S = 600.0
PUBLISHED = (
    ("CoLo centralized EKF", 0.099),
    ("CoLo best decentralized", 0.107),
    ("CoLo covariance intersection", 0.131),
)
"""Mean position error over the first 600 s of set 2 [m]: CoLo toolbox (see README)."""
_REPLAYS = 3
_PROCESSES = 2


@dataclass(frozen=True)
class Job:
    """One thing to compute.

    Attributes:
        number: Of the set.
        model: "plain" or "calibrated".
        column: What is run.
        seeing: For blind_robots, which two robots see landmarks.
    """

    number: int
    model: str
    column: str
    seeing: tuple[int, int] | None = None


@dataclass(frozen=True)
class Sums:
    """Errors in a form that adds up over runs: counts, and means of squares by count.

    Attributes:
        count: Of poses.
        position: Sum of squared position errors [m^2].
        heading: Sum of squared heading errors [rad^2].
        nees: Sum of the normalised ones.
        nees_count: Of these.
        early: Mean position error over the first minutes as published [m].
    """

    count: int
    position: float
    heading: float
    nees: float
    nees_count: int
    early: float = math.nan

    def __add__(self, other: Sums) -> Sums:
        return Sums(
            self.count + other.count,
            self.position + other.position,
            self.heading + other.heading,
            self.nees + other.nees,
            self.nees_count + other.nees_count,
        )

    @property
    def figures(self) -> dict[str, float]:
        """The figures by name."""
        return {
            "position_rmse_m": math.sqrt(self.position / self.count),
            "heading_rmse_deg": math.degrees(math.sqrt(self.heading / self.count)),
            "nees": self.nees / self.nees_count,
        }


def bag_of(number: int) -> Path:
    """Where a set lies as a bag."""
    return WORK / f"set{number}"


def prepare(number: int, folder: Path) -> tuple[int, tuple[str, ...]]:
    """Import a set."""
    return number, import_set(folder, bag_of(number))


def fit(number: int, model: str) -> tuple[str, str]:
    """Fit a model to a set and keep it as a file; returns what came out in a line."""
    recording, swarm = load(bag_of(number))
    options = Options(plain=model == "plain")
    done = calibrate(recording, swarm, options, lambda _share, _what: None)
    save_swarm(done.swarm, WORK / f"{model}.yaml", f"{model}: fitted to set {number}")
    numbers = ", ".join(f"{name} {value:.3g}" for name, value in done.noise.items())
    return model, f"{model} fitted to set {number}: {numbers}"


def run(job: Job) -> tuple[Job, Sums | None]:
    """Run one job; None when there is nothing to compare with."""
    recording, own = load(bag_of(job.number))
    swarm = transferred(load_swarm(WORK / f"{job.model}.yaml"), own)
    if job.column == "smoother":
        return job, _smoothed(recording, swarm)
    if job.column == "unknown_start":
        return job, sums_of(rerun(recording, unknown_start(swarm), TICK_S))
    if job.seeing is not None:
        masked = with_two_seeing(recording, swarm, job.seeing)
        blind = [r.name for index, r in enumerate(swarm.robots) if index not in job.seeing]
        return job, sums_of(rerun(masked, swarm, BLIND_TICK_S), blind)
    masks: dict[str, Callable[[], Recording]] = {
        "odometry": lambda: without_sightings(recording),
        "landmarks": lambda: without_robots(recording, swarm),
        "landmarks_robots": lambda: recording,
    }
    return job, sums_of(rerun(masks[job.column](), swarm, TICK_S))


def sums_of(result: ReplayResult, names: Sequence[str] | None = None) -> Sums | None:
    """Errors of all robots, or of those named, pooled."""
    errors = pool([one for name, one in result.errors.items() if names is None or name in names])
    if not errors.stamp_ns.size:
        return None
    return Sums(
        errors.stamp_ns.size,
        float(np.sum(errors.position**2)),
        float(np.sum(errors.error[:, 2] ** 2)),
        float(np.nansum(errors.nees)),
        int(np.sum(~np.isnan(errors.nees))),
        _early(result, errors),
    )


def _early(result: ReplayResult, errors: Errors) -> float:
    """Mean position error as published: over the first 600 s."""
    early = errors.stamp_ns <= result.stamp_ns[0] + PUBLISHED_S * 1e9
    return float(errors.position[early].mean()) if early.any() else math.nan


def _smoothed(recording: Recording, swarm: Swarm) -> Sums | None:
    """Errors of the offline limit."""
    from bench.smoother import smooth  # noqa: PLC0415 # gtsam is a requirement of benchmarks, not of their tests

    online = rerun(recording, swarm, TICK_S)
    if not any(errors.stamp_ns.size for errors in online.errors.values()):
        return None
    errors = smooth(recording, online)
    return Sums(
        errors.position.size,
        float(np.sum(errors.position**2)),
        float(np.sum(errors.heading**2)),
        float(np.sum(errors.nees)),
        errors.nees.size,
    )


def jobs_of(number: int, swarm: Swarm) -> list[Job]:
    """Everything to run on a set, long jobs first."""
    robots = len(swarm.robots)
    pairs = [*itertools.combinations(range(robots), 2)] if robots > 2 else []
    columns = ("smoother", "landmarks_robots", "unknown_start", "landmarks", "odometry")
    jobs = [Job(number, model, column) for column in columns for model in MODELS]
    return jobs + [Job(number, model, "blind_robots", pair) for model in MODELS for pair in pairs]


def speed_factor(number: int) -> float:
    """How much faster than its own time a set replays from its bag, best of a few."""
    bag = bag_of(number)
    swarm = transferred(load_swarm(WORK / "calibrated.yaml"), load_swarm(bag / "swarm.yaml"))
    return max(replay(bag, swarm).speed_factor for _ in range(_REPLAYS))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; returns its exit status."""
    options = _parser().parse_args(arguments)
    try:
        sets = find_sets(options.folder)
        fitted = chosen_to_fit(sets, options.fit)
        figures, early = measure(sets, fitted)
    except (NoSetsError, MrclamError, CalibrationError) as error:
        print(error, file=sys.stderr)
        return 1
    report(figures, early, sets)
    return 0


def chosen_to_fit(sets: dict[int, Path], wanted: int | None) -> int:
    """The number of the set to fit to: the first unless one is wanted."""
    if wanted is not None and wanted not in sets:
        raise NoSetsError(f"--fit {wanted}: there is no such set, only {', '.join(map(str, sets))}.")
    return min(sets) if wanted is None else wanted


def measure(sets: dict[int, Path], fitted: int) -> tuple[dict[str, float], dict[tuple[int, str], float]]:
    """All figures by name, and the mean errors of the first 600 s by set and model."""
    totals: dict[tuple[int, str, str], Sums] = {}
    early: dict[tuple[int, str], float] = {}
    with ProcessPoolExecutor(_PROCESSES, mp_context=get_context("spawn")) as workers:
        for number, remarks in _done(workers, prepare, list(sets.items()), "import"):
            for remark in remarks:
                print(f"set {number}: {remark}")
        for _, line in _done(workers, fit, [(fitted, model) for model in MODELS], "fit"):
            print(line)
        jobs = [job for k in sets for job in jobs_of(k, load_swarm(bag_of(k) / "swarm.yaml"))]
        for job, sums in _done(workers, run, [(job,) for job in jobs], "runs"):
            if sums is None:
                continue
            key = (job.number, job.model, job.column)
            totals[key] = totals[key] + sums if key in totals else sums
            if job.column == "landmarks_robots" and math.isfinite(sums.early):
                early[job.number, job.model] = sums.early
    figures = {
        f"set{number}.{model}.{column}.{name}": value
        for (number, model, column), sums in sorted(totals.items())
        for name, value in sums.figures.items()
        if math.isfinite(value)
    }
    for number in sets:
        figures[f"set{number}.replay.speed_factor"] = speed_factor(number)
    return figures, early


def _done(
    workers: ProcessPoolExecutor, function: Callable[..., Any], calls: Sequence[tuple[Any, ...]], what: str
) -> list[Any]:
    """Results of all calls, with a line of progress."""
    began = time.monotonic()
    waiting = [workers.submit(function, *call) for call in calls]
    results = []
    for count, future in enumerate(as_completed(waiting), 1):
        results.append(future.result())
        if count == len(calls) or count % 5 == 0:
            print(f"{what}: {count} of {len(calls)} after {time.monotonic() - began:.0f} s", flush=True)
    return results


def report(figures: dict[str, float], early: dict[tuple[int, str], float], sets: dict[int, Path]) -> None:
    """Print the tables, draw the plot and write the figures."""
    columns = ("odometry", "landmarks", "landmarks_robots", "unknown_start", "smoother", "blind_robots")
    rows = []
    for number, model in itertools.product(sets, MODELS):
        cells = [_cell(figures, f"set{number}.{model}.{column}") for column in columns]
        rows.append([f"set {number} {model}", *cells])
    print("\nposition RMSE [m] / heading RMSE [deg] / NEES (ideal 3)")
    print(table(["", *columns], rows))
    print("\nmean position error [m] over the first 600 s, landmarks + robots")
    means: list[list[Cell]] = [
        [f"ours, set {k}, {model}", value] for (k, model), value in sorted(early.items())
    ]
    means += [[f"{name}, set 2", value] for name, value in PUBLISHED]
    print(table(["", "m"], means))
    for number in sets:
        print(f"set {number}: replay {figures[f'set{number}.replay.speed_factor']:.0f} x real time")
    draw(figures, sets)
    print(f"figures: {write_figures('mrclam', figures)}")


def _cell(figures: dict[str, float], key: str) -> str:
    values = [figures.get(f"{key}.{name}") for name in FIGURES]
    if values[0] is None:
        return "-"
    formats = ("{:.4f}", "{:.2f}", "{:.1f}")
    return "/".join("-" if v is None else f.format(v) for f, v in zip(formats, values, strict=True))


def draw(figures: dict[str, float], sets: dict[int, Path]) -> None:
    """Position errors and consistency, one plot per model."""
    figure, axes = new_plot(2, width=5.6)
    columns = ("landmarks", "landmarks_robots", "smoother", "blind_robots")
    width = 0.8 / (len(sets) * len(MODELS))
    for place, (number, model) in enumerate(itertools.product(sets, MODELS)):
        shift = (place - 0.5 * (len(sets) * len(MODELS) - 1)) * width
        for axis, name, scale in zip(axes, ("position_rmse_m", "nees"), (100.0, 1.0), strict=True):
            found = [figures.get(f"set{number}.{model}.{column}.{name}", math.nan) for column in columns]
            x = np.arange(len(columns)) + shift
            bars = axis.bar(x, scale * np.array(found), width, label=f"set {number}, {model}")
            axis.bar_label(bars, fmt="%.1f", fontsize=7)
    names = ["landmarks", "landmarks\n+ robots", "smoother\n(offline)", "blind\nrobots"]
    for axis, label in zip(axes, ("position RMSE [cm]", "NEES"), strict=True):
        axis.set_xticks(range(len(columns)), names)
        axis.set_ylabel(label)
    axes[1].axhline(3.0, color="0.5", linestyle=":")
    axes[1].text(len(columns) - 0.5, 3.05, "ideal", ha="right", color="0.4")
    axes[0].legend()
    print(f"plot: {save_plot(figure, 'mrclam')}")


def _parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "folder", type=Path, nargs="?", default=DEFAULT_FOLDER, help="folder with MRCLAM_Dataset<k> folders"
    )
    parser.add_argument("--fit", type=int, help="number of the set to fit to (default: the first)")
    return parser


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # for the workers: they are parallel already
    sys.exit(main())
