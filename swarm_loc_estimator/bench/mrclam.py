"""Five real robots (MRCLAM): parameters fitted on one set, then all sets untouched.

    make bench-mrclam
    make bench-mrclam ARGS="FOLDER --fit 1"

FOLDER holds MRCLAM_Dataset<k> folders, or is one; robots and ground truth may be missing. Parameters are
fitted on set 1, which is looked for in ../shared/data/mrclam where FOLDER does not have it.

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
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench._common import OUT, new_plot, save_plot, table, write_figures
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
from swarm_loc_estimator.calibration.in_order import run_in_order
from swarm_loc_estimator.calibration.recording import CalibrationError, Recording
from swarm_loc_estimator.calibration.rerun import rerun
from swarm_loc_estimator.core.metrics import Errors, pool
from swarm_loc_estimator.core.swarm import Swarm
from swarm_loc_estimator.io.mrclam import MrclamError
from swarm_loc_estimator.io.swarm_file import load_swarm
from swarm_loc_estimator.io.swarm_writer import save_swarm
from swarm_loc_estimator.replay import replay

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DEFAULT_FOLDER = OUT.parent.parent / "shared" / "data" / "mrclam"
MODELS = ("plain", "calibrated")
COLUMNS = ("odometry", "landmarks", "landmarks_robots", "unknown_start", "smoother", "blind_robots")
_ALL = "landmarks_robots"
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
_SHARE_PRINTED = 0.1
_CASES_LABELLED = 4
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
    printed = 0.0

    def progress(share: float, what: str) -> None:
        nonlocal printed
        if share >= printed:
            print(f"fit {model}, {share:.0%}: {what}", flush=True)
            printed = share + _SHARE_PRINTED

    done = calibrate(recording, swarm, Options(plain=model == "plain"), progress)
    save_swarm(done.swarm, WORK / f"{model}.yaml", f"{model}: fitted to set {number}")
    numbers = ", ".join(f"{name} {value:.3g}" for name, value in done.noise.items())
    return model, f"{model} fitted to set {number}: {numbers}"


def run(job: Job) -> tuple[Job, Sums | None]:
    """Run one job; None when there is nothing to compare with."""
    recording, own = load(bag_of(job.number))
    swarm = transferred(load_swarm(WORK / f"{job.model}.yaml"), own)
    if job.column == "smoother":
        return job, _smoothed(job, recording, swarm)
    if job.column == "unknown_start":
        return job, sums_of(rerun(recording, unknown_start(swarm), TICK_S).errors)
    if job.seeing is not None:
        masked = with_two_seeing(recording, swarm, job.seeing)
        seeing = {swarm.robots[index].name for index in job.seeing}
        errors = rerun(masked, swarm, BLIND_TICK_S).errors
        return job, sums_of({name: one for name, one in errors.items() if name not in seeing})
    masks: dict[str, Callable[[], Recording]] = {
        "odometry": lambda: without_sightings(recording),
        "landmarks": lambda: without_robots(recording, swarm),
        "landmarks_robots": lambda: recording,
    }
    return job, sums_of(rerun(masks[job.column](), swarm, TICK_S).errors)


def sums_of(errors: Mapping[str, Errors]) -> Sums | None:
    """Errors of robots, by name, pooled; None without any."""
    pooled = pool([*errors.values()])
    if not pooled.stamp_ns.size:
        return None
    early = pooled.stamp_ns <= pooled.stamp_ns.min() + PUBLISHED_S * 1e9
    return Sums(
        pooled.stamp_ns.size,
        float(np.sum(pooled.position**2)),
        float(np.sum(pooled.error[:, 2] ** 2)),
        float(np.nansum(pooled.nees)),
        int(np.sum(~np.isnan(pooled.nees))),
        float(pooled.position[early].mean()),
    )


def _smoothed(job: Job, recording: Recording, swarm: Swarm) -> Sums | None:
    """Errors of the offline limit; none where it cannot be found, and a line that says so."""
    from bench.smoother import SmootherError, smooth  # noqa: PLC0415 # only benchmarks require gtsam

    try:
        return sums_of(smooth(recording, run_in_order(recording, swarm, TICK_S)))
    except SmootherError as error:
        print(f"set {job.number}, {job.model}: {error}", flush=True)
        return None


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
        figures, early = measure(sets, *chosen_to_fit(sets, options.fit))
    except (NoSetsError, MrclamError, CalibrationError) as error:
        print(error, file=sys.stderr)
        return 1
    report(figures, early, sets)
    return 0


def chosen_to_fit(
    sets: dict[int, Path], wanted: int | None, elsewhere: Path = DEFAULT_FOLDER
) -> tuple[int, Path]:
    """Number and folder of the set to fit to: the wanted one or set 1, here or elsewhere; else the first."""
    others = find_sets(elsewhere) if elsewhere.is_dir() else {}
    known = {**others, **sets}
    number = 1 if wanted is None else wanted
    if number in known:
        return number, known[number]
    if wanted is None:
        return min(sets), sets[min(sets)]
    raise NoSetsError(f"--fit {wanted}: there is no such set, only {', '.join(map(str, sorted(known)))}.")


def measure(
    sets: dict[int, Path], fitted: int, fitted_folder: Path
) -> tuple[dict[str, float], dict[tuple[int, str], float]]:
    """All figures by name, and the mean errors of the first 600 s by set and model."""
    totals: dict[tuple[int, str, str], Sums] = {}
    with ProcessPoolExecutor(_PROCESSES, mp_context=get_context("spawn")) as workers:
        imported = {fitted: fitted_folder, **sets}
        for number, remarks in _done(workers, prepare, list(imported.items()), "import"):
            for remark in remarks:
                print(f"set {number}: {remark}")
        for _, line in _done(workers, fit, [(fitted, model) for model in MODELS], "fit"):
            print(line)
        jobs = [job for k in sets for job in jobs_of(k, load_swarm(bag_of(k) / "swarm.yaml"))]
        for job, sums in _done(workers, run, [(job,) for job in jobs], "runs"):
            if sums is not None:
                key = (job.number, job.model, job.column)
                totals[key] = totals[key] + sums if key in totals else sums
    early = {(k, model): sums.early for (k, model, column), sums in totals.items() if column == _ALL}
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
    rows = []
    for number, model in itertools.product(sets, MODELS):
        cells = [_cell(figures, f"set{number}.{model}.{column}") for column in COLUMNS]
        rows.append([f"set {number} {model}", *cells])
    print("\nposition RMSE [m] / heading RMSE [deg] / NEES (ideal 3)")
    print(table(["", *COLUMNS], rows))
    print("\nmean position error [m] over the first 600 s, landmarks + robots")
    print(table(["", "m"], [[*row] for row in beside_published(early)]))
    for number in sets:
        print(f"set {number}: replay {figures[f'set{number}.replay.speed_factor']:.0f} x real time")
    print(f"plot: {draw(figures, early, sets)}")
    print(f"figures: {write_figures('mrclam', figures)}")


def beside_published(early: dict[tuple[int, str], float]) -> list[tuple[str, float]]:
    """Mean errors by name, ours and the published ones."""
    ours = [(f"ours, set {k}, {model}", value) for (k, model), value in sorted(early.items())]
    return ours + [(f"{name}, set 2", value) for name, value in PUBLISHED]


def _cell(figures: dict[str, float], key: str) -> str:
    values = [figures.get(f"{key}.{name}") for name in FIGURES]
    if values[0] is None:
        return "-"
    formats = ("{:.4f}", "{:.2f}", "{:.1f}")
    return "/".join("-" if v is None else f.format(v) for f, v in zip(formats, values, strict=True))


def draw(figures: dict[str, float], early: dict[tuple[int, str], float], sets: dict[int, Path]) -> Path:
    """Errors and consistency by column, and ours beside the published; returns the file."""
    figure, axes = new_plot(4, width=5.8, height=4.4)
    labels = ("position RMSE [m]", "heading RMSE [deg]", "NEES")
    for axis, name, label in zip(axes, FIGURES, labels, strict=False):
        _bars(axis, figures, list(itertools.product(sets, MODELS)), name)
        axis.set_ylabel(label)
    for axis in axes[:2]:
        axis.set_yscale("log")
    axes[0].legend(fontsize=8)
    axes[2].axhspan(2.0, 5.0, color="0.93", zorder=0)
    axes[2].axhline(3.0, color="0.5", linestyle=":")
    rows = beside_published(early)[::-1]
    colours = ["0.6" if "CoLo" in name else "tab:blue" for name, _ in rows]
    bars = axes[3].barh([name for name, _ in rows], [value for _, value in rows], color=colours)
    axes[3].bar_label(bars, fmt="%.3f", fontsize=8)
    axes[3].set_xlabel("mean position error, first 600 s [m]")
    return save_plot(figure, "mrclam")


def _bars(axis: Axes, figures: dict[str, float], cases: list[tuple[int, str]], name: str) -> None:
    """A group of bars per column, one per set and model: pale where plain."""
    width = 0.84 / len(cases)
    numbers = sorted({number for number, _ in cases})
    for place, (number, model) in enumerate(cases):
        found = [(x, figures.get(f"set{number}.{model}.{column}.{name}")) for x, column in enumerate(COLUMNS)]
        there = [(x + (place - 0.5 * (len(cases) - 1)) * width, v) for x, v in found if v is not None]
        bars = axis.bar(
            [x for x, _ in there],
            [v for _, v in there],
            width,
            color=f"C{numbers.index(number)}",
            alpha=0.45 if model == MODELS[0] else 1.0,
            label=f"set {number}, {model}",
        )
        if len(cases) <= _CASES_LABELLED:
            axis.bar_label(bars, fmt="{:.3g}", fontsize=6, rotation=90, padding=2)
    axis.margins(y=0.12)
    axis.set_xticks(range(len(COLUMNS)), [column.replace("_", "\n") for column in COLUMNS], fontsize=8)


def _parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "folder", type=Path, nargs="?", default=DEFAULT_FOLDER, help="folder with MRCLAM_Dataset<k> folders"
    )
    parser.add_argument("--fit", type=int, help="number of the set to fit to (default: 1)")
    return parser


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # for the workers: they are parallel already
    sys.exit(main())
