"""Surveys: landmarks found from recordings of robots that drive around, compared with the truth.

The eight of the demo with the noise that the e-puck paper measured, with a tenth of the ids wrong, and with
cameras, wheels and images that are systematically wrong. Nobody has a start and no landmark is described;
errors are those after a rigid fit. Then robots are localized with the surveyed landmarks and with the true
ones; their errors are after a rigid fit of all poses, too.

    make bench-commissioning
    make bench-commissioning ARGS="--seeds 1"
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from bench.scenarios.eight_run import VIEW, EightSettings, camera_exposures, drive_eight
from bench.scenarios.lived_run import SimulatedRun
from bench.scenarios.sightings import observe_markers
from bench.shared.common import (
    Cell,
    ProgressLine,
    new_plot,
    options_of,
    save_plot,
    table,
    write_figures,
)
from bench.shared.simulated_run import detection_rows, fitted_errors, odometry_rows, position_rmse, ticks
from swarm_loc_drivers.sim.worlds import W0, W2, ErrorModel, hidden_geometry
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.offline.calibration.recording import Recording, rerun
from swarm_loc_estimator.offline.survey.survey import Surveyed, survey
from swarm_loc_estimator.swarm.swarm import Landmark, Swarm

WRONG_SHARE = 0.1
BAG_SEED = 3  # Seed of bags/eight_five_robots


@dataclass(frozen=True)
class Case:
    """What is surveyed: errors of the world, duration [s], and whether a tenth of the ids are wrong."""

    errors: ErrorModel
    duration_s: float
    wrong_ids: bool = False


CASES = {
    "eight": Case(W0, 54.0),
    "wrong_ids": Case(W0, 54.0, wrong_ids=True),
    "w2": Case(W2, 108.0),
    "w2_three_minutes": Case(W2, 180.0),
}


@dataclass(frozen=True)
class Outcome:
    """Errors (L, 2) of landmarks [m], CPU time [s], errors of poses by survey and by the truth [m]."""

    error: FloatArray
    cpu_s: float
    surveyed_m: float
    true_m: float


def main() -> None:
    """Print the table, write the figures, draw the errors."""
    names = tuple(CASES)
    arguments = options_of(__doc__, seeds=(5, "worlds of each case"), cases=(names, "what to survey", names))
    seeds = [BAG_SEED, *(seed for seed in range(1, arguments.seeds + 2) if seed != BAG_SEED)]
    found: dict[str, list[Outcome]] = {}
    for name in arguments.cases:
        say = ProgressLine(name)
        found[name] = [_run(CASES[name], seed, say) for seed in seeds[: arguments.seeds]]
        say("done")
        print()
    columns = ("case", "landmarks [mm]", "worst seed", "CPU [s]", "poses by survey [mm]", "by truth [mm]")
    print(table(columns, [_row(name, runs) for name, runs in found.items()]))
    print(write_figures("commissioning", _figures(found)))
    print(_plot(found))


def _run(case: Case, seed: int, say: ProgressLine) -> Outcome:
    say(f"seed {seed}: simulating")
    settings = EightSettings(seed=seed, duration_s=case.duration_s, errors=case.errors)
    run, true = _world(settings)
    recording = _recording(run, case, seed)
    nobody = tuple(replace(robot, start=None) for robot in run.swarm.robots)
    say(f"seed {seed}: surveying")
    begun_s = time.process_time()
    done = survey(recording, Swarm(nobody))
    cpu_s = time.process_time() - begun_s
    say(f"seed {seed}: localizing")
    by_truth = Swarm(done.swarm.robots, true)
    poses = [_localized(run, recording, swarm) for swarm in (done.swarm, by_truth)]
    return Outcome(_errors(done, true), cpu_s, *poses)


@cache
def _world(settings: EightSettings) -> tuple[SimulatedRun, tuple[Landmark, ...]]:
    """A run as by `simulate_eight`, and where its landmarks are, which its description may not know."""
    rng = np.random.default_rng(settings.seed)
    swarm, truth, odometry = drive_eight(rng, settings)
    exposures = camera_exposures(rng, settings.robots, truth)
    hidden = hidden_geometry(deepcopy(rng), swarm, settings.errors)  # as drawn again for the sightings
    seen = observe_markers(rng, swarm, truth, exposures, VIEW, settings.errors)
    places = hidden.landmarks[: len(swarm.landmarks)].tolist()
    return SimulatedRun(swarm, truth, odometry, *seen), tuple(
        replace(mark, x=x, y=y, yaw=yaw, position_sigma=0.0, yaw_sigma=0.0)
        for mark, (x, y, yaw) in zip(swarm.landmarks, places, strict=True)
    )


def _recording(run: SimulatedRun, case: Case, seed: int) -> Recording:
    seen = detection_rows(run)
    if case.wrong_ids:
        rng = np.random.default_rng([seed, 5])
        ids = seen.detection["id"]
        wrong = rng.uniform(size=ids.size) < WRONG_SHARE
        ids[wrong] = rng.choice(np.unique(ids), int(wrong.sum()))
    return Recording("eight", odometry_rows(run), seen, {})


def _errors(done: Surveyed, true: Sequence[Landmark]) -> FloatArray:
    """Errors (L, 2) of landmarks after a rigid fit; those that were seen too rarely are left out."""
    found = {mark.id: (mark.x, mark.y) for mark in done.swarm.landmarks}
    seen = [mark for mark in true if mark.id in found]
    return fitted_errors(np.array([found[mark.id] for mark in seen]), np.array([(m.x, m.y) for m in seen]))


def _localized(run: SimulatedRun, recording: Recording, swarm: Swarm) -> float:
    """RMS error of all poses after a rigid fit, with some landmarks, after the first ten seconds [m]."""
    result = rerun(recording, swarm, 0.1)
    kept = (result.stamp_ns - run.start_ns > 10_000_000_000) & (result.stamp_ns <= ticks(run)[-1])
    places = result.poses[kept][..., :2].reshape(-1, 2)
    truth = run.truth.all_at(result.stamp_ns[kept])[..., :2].reshape(-1, 2)
    errors = fitted_errors(places, truth)
    return position_rmse(errors[np.isfinite(errors).all(axis=1)])


def _row(name: str, runs: Sequence[Outcome]) -> list[Cell]:
    each = [1e3 * position_rmse(one.error) for one in runs]
    mean = [
        float(np.mean([getattr(one, what) for one in runs])) for what in ("cpu_s", "surveyed_m", "true_m")
    ]
    return [name, float(np.mean(each)), max(each), mean[0], 1e3 * mean[1], 1e3 * mean[2]]


def _figures(found: Mapping[str, Sequence[Outcome]]) -> dict[str, float]:
    figures = {}
    for name, runs in found.items():
        _, mean, worst, cpu_s, surveyed_mm, true_mm = _row(name, runs)
        for key, value in (("landmark_mm", mean), ("worst_landmark_mm", worst), ("cpu_s", cpu_s)):
            figures[f"survey.{name}.{key}"] = float(value or 0.0)
        figures[f"survey.{name}.localization_ratio"] = float(surveyed_mm or 0.0) / float(true_mm or 1.0)
    if "eight" in found:
        figures["survey.eight.bag_landmark_mm"] = 1e3 * position_rmse(found["eight"][0].error)
    return figures


def _plot(found: Mapping[str, Sequence[Outcome]]) -> str:
    figure, axes = new_plot(len(found), width=3.2, height=3.2)
    for axis, (name, runs) in zip(axes, found.items(), strict=True):
        for one in runs:
            axis.plot(*(1e3 * one.error).T, ".", markersize=4)
        axis.set(title=name, xlabel="x error [mm]", xlim=(-20, 20), ylim=(-20, 20), aspect="equal")
    axes[0].set_ylabel("y error [mm]")
    return str(save_plot(figure, "commissioning"))


if __name__ == "__main__":
    main()
