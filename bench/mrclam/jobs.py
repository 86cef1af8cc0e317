"""Jobs of the MRCLAM benchmark, run in parallel processes: fits, runs and their errors."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.mrclam.sets import (
    import_set,
    load,
    transferred,
    unknown_start,
    with_two_seeing,
    without_robots,
    without_sightings,
)
from bench.shared.common import OUT
from swarm_loc_estimator.offline.batch.smooth import SmoothError, smooth_recording
from swarm_loc_estimator.offline.calibration.fit import calibrate
from swarm_loc_estimator.offline.calibration.models import Options
from swarm_loc_estimator.offline.calibration.recording import Recording, rerun
from swarm_loc_estimator.offline.metrics import Errors, pool
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm, save_swarm

MODELS = ("plain", "calibrated")
ONLINE = "landmarks_robots"  # The column with landmarks and robots
SMOOTHER = "smoother"
WORK = OUT / "mrclam"
TICK_S, BLIND_TICK_S = 0.1, 0.5
EARLY_S = 600.0  # Published errors are those of the first 600 s
_REPLAYS = 3
_SHARE_PRINTED = 0.1


@dataclass(frozen=True)
class Job:
    """One run of a set."""

    number: int  # Of the set
    model: str  # "plain" or "calibrated"
    column: str  # Of the table
    seeing: tuple[int, int] | None = None  # For blind_robots, the two robots that see landmarks


@dataclass(frozen=True)
class Sums:
    """Sums of squared errors, which add up over runs."""

    count: int  # Of poses
    position: float  # Sum of squared position errors [m^2]
    heading: float  # Sum of squared heading errors, as if all headings were known [rad^2]
    nees: float  # Sum of normalized errors squared
    nees_count: int  # Their number
    misleading: int  # Number of poses TRACKED with an error beyond 5 sigma and 2 cm
    early: float = math.nan  # Mean position error over the first 600 s [m]

    def __add__(self, other: Sums) -> Sums:
        return Sums(
            self.count + other.count,
            self.position + other.position,
            self.heading + other.heading,
            self.nees + other.nees,
            self.nees_count + other.nees_count,
            self.misleading + other.misleading,
        )

    @property
    def figures(self) -> dict[str, float]:
        """The figures by name."""
        return {
            "position_rmse_m": math.sqrt(self.position / self.count),
            "heading_rmse_deg": math.degrees(math.sqrt(self.heading / self.count)),
            "nees": self.nees / self.nees_count,
            "misleading_share": self.misleading / self.count,
        }


@dataclass(frozen=True)
class Done:
    """Result of a job."""

    job: Job  # The job
    sums: Sums | None  # Its errors; None without ground truth
    failure: str = ""  # Why it has failed, one sentence; "" if it has not


@dataclass(frozen=True)
class Results:
    """Results of all jobs."""

    figures: dict[str, float]  # By name, such as set1.calibrated.smoother.nees
    early: dict[tuple[int, str], float]  # Mean errors of the first minutes by set and model [m]
    failures: dict[tuple[int, str, str], str]  # Sentences by set, model and column


def collected(all_done: Iterable[Done]) -> Results:
    """Pool errors over the jobs of a column; a failed job leaves its column without figures."""
    totals: dict[tuple[int, str, str], Sums] = {}
    failures: dict[tuple[int, str, str], str] = {}
    for done in all_done:
        key = (done.job.number, done.job.model, done.job.column)
        if done.failure:
            failures[key] = done.failure
        elif done.sums is not None:
            totals[key] = totals[key] + done.sums if key in totals else done.sums
    figures = {
        f"set{number}.{model}.{column}.{name}": value
        for (number, model, column), sums in sorted(totals.items())
        for name, value in sums.figures.items()
        if math.isfinite(value)
    }
    early = {(k, model): sums.early for (k, model, column), sums in totals.items() if column == ONLINE}
    return Results(figures, early, failures)


def bag_of(number: int) -> Path:
    """The bag of a set."""
    return WORK / f"set{number}"


def prepare(number: int, folder: Path) -> tuple[int, tuple[str, ...]]:
    """Import a set."""
    return number, import_set(folder, bag_of(number))


def fit(number: int, model: str) -> tuple[str, str]:
    """Fit a model to a set and write it to a file; returns a line with the fitted noise."""
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


def run(job: Job) -> Done:
    """Run one job."""
    recording, own = load(bag_of(job.number))
    swarm = transferred(load_swarm(WORK / f"{job.model}.yaml"), own)
    if job.column == SMOOTHER:
        return smoothed(job, recording, swarm)
    if job.seeing is not None:
        masked = with_two_seeing(recording, swarm, job.seeing)
        seeing = {swarm.robots[index].name for index in job.seeing}
        errors = rerun(masked, swarm, BLIND_TICK_S).errors
        return Done(job, sums_of({name: one for name, one in errors.items() if name not in seeing}))
    cases: dict[str, Callable[[], tuple[Recording, Swarm]]] = {
        "odometry": lambda: (without_sightings(recording), swarm),
        "landmarks": lambda: (without_robots(recording, swarm), swarm),
        "unknown_start": lambda: (recording, unknown_start(swarm)),
        ONLINE: lambda: (recording, swarm),
    }
    return Done(job, sums_of(rerun(*cases[job.column](), TICK_S).errors))


def sums_of(errors: Mapping[str, Errors]) -> Sums | None:
    """Errors of robots by name, pooled; None without any."""
    pooled = pool([*errors.values()])
    if not pooled.stamp_ns.size:
        return None
    early = pooled.stamp_ns <= pooled.stamp_ns.min() + EARLY_S * 1e9
    return Sums(
        pooled.stamp_ns.size,
        float(np.sum(pooled.position**2)),
        float(np.nanmean(pooled.error[:, 2] ** 2)) * pooled.stamp_ns.size,
        float(np.nansum(pooled.nees)),
        int(np.sum(~np.isnan(pooled.nees))),
        int(pooled.misleading.sum()),
        float(pooled.position[early].mean()),
    )


def smoothed(job: Job, recording: Recording, swarm: Swarm) -> Done:
    """Errors of the smoother, or why it failed."""
    try:
        return Done(job, sums_of(smooth_recording(recording, rerun(recording, swarm, TICK_S)).errors))
    except SmoothError as error:
        return Done(job, None, str(error))


def jobs_of(number: int, swarm: Swarm) -> list[Job]:
    """All jobs of a set, long ones first."""
    robots = len(swarm.robots)
    pairs = [*itertools.combinations(range(robots), 2)] if robots > 2 else []
    columns = ("smoother", "landmarks_robots", "unknown_start", "landmarks", "odometry")
    jobs = [Job(number, model, column) for column in columns for model in MODELS]
    return jobs + [Job(number, model, "blind_robots", pair) for model in MODELS for pair in pairs]


def speed_factor(number: int) -> float:
    """Duration of a set divided by that of its replay from a bag, best of a few."""
    bag = bag_of(number)
    swarm = transferred(load_swarm(WORK / "calibrated.yaml"), load_swarm(bag / "swarm.yaml"))
    return max(replay(bag, swarm).speed_factor for _ in range(_REPLAYS))
