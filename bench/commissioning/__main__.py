"""Commissioning: landmarks surveyed from recordings of robots that drive around, compared with the truth.

The eight of the demo with the noise that the e-puck paper measured, with a tenth of the ids wrong, and with
cameras, wheels and images that are systematically wrong. Nobody has a start and no landmark is described;
errors are those after a rigid fit. Then robots are localized with the surveyed landmarks and with the true
ones; their errors are after a rigid fit of all poses, too.

    make bench-commissioning
    make bench-commissioning ARGS="--seeds 1"
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.shared.common import Cell, ProgressLine, new_plot, save_plot, table, write_figures
from bench.shared.simulated_run import ticks
from swarm_loc_drivers.sim.run import SimulatedRun
from swarm_loc_drivers.sim.scenarios.bags import as_detections
from swarm_loc_drivers.sim.scenarios.eight import (
    EightSettings,
    camera_exposures,
    drive_eight,
    simulate_eight,
)
from swarm_loc_drivers.sim.worlds import W0, W2, ErrorModel, hidden_geometry
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.offline.calibration.recording import Recording, rerun
from swarm_loc_estimator.offline.survey.survey import Surveyed, survey
from swarm_loc_estimator.sensors.camera import DetectionRows
from swarm_loc_estimator.sensors.odometry import OdometryRows
from swarm_loc_estimator.swarm.swarm import Landmark, Swarm

WRONG_SHARE = 0.1
BAG_SEED = 3
"""Seed of bags/eight_five_robots."""


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
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=5, help="worlds of each case")
    parser.add_argument("--cases", nargs="+", choices=[*CASES], default=[*CASES])
    arguments = parser.parse_args()
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
    run, true = simulate_eight(settings), _true_landmarks(settings)
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


def _true_landmarks(settings: EightSettings) -> tuple[Landmark, ...]:
    """Where the landmarks of a world are, which its description may not know."""
    rng = np.random.default_rng(settings.seed)
    swarm, truth, _ = drive_eight(rng, settings)
    camera_exposures(rng, settings.robots, truth)
    hidden = hidden_geometry(rng, swarm, settings.errors)
    places = hidden.landmarks[: len(swarm.landmarks)].tolist()
    return tuple(
        replace(mark, x=x, y=y, yaw=yaw, position_sigma=0.0, yaw_sigma=0.0)
        for mark, (x, y, yaw) in zip(swarm.landmarks, places, strict=True)
    )


def _recording(run: SimulatedRun, case: Case, seed: int) -> Recording:
    rows, frames = run.odometry, run.frames
    names = ("robot", "stamp_ns", "arrival_ns")
    robot, stamp_ns, arrival_ns = (rows[name].astype(np.int64) for name in names)
    odometry = OdometryRows.without_twist(robot, stamp_ns, rows["pose"].copy(), arrival_ns)
    robot, stamp_ns, arrival_ns = (
        np.repeat(frames[name].astype(np.int64), frames["count"]) for name in names
    )
    detections = as_detections(run).copy()
    if case.wrong_ids:
        rng = np.random.default_rng([seed, 5])
        wrong = rng.uniform(size=detections.size) < WRONG_SHARE
        detections["id"][wrong] = rng.choice(np.unique(detections["id"]), int(wrong.sum()))
    return Recording("eight", odometry, DetectionRows(robot, stamp_ns, detections, arrival_ns), {})


def _errors(done: Surveyed, true: Sequence[Landmark]) -> FloatArray:
    """Errors (L, 2) of landmarks after a rigid fit."""
    found = {mark.id: (mark.x, mark.y) for mark in done.swarm.landmarks}
    return _fitted(np.array([found[mark.id] for mark in true]), np.array([(mark.x, mark.y) for mark in true]))


def _localized(run: SimulatedRun, recording: Recording, swarm: Swarm) -> float:
    """RMS error of all poses after a rigid fit, with some landmarks, from the tenth second on [m]."""
    result = rerun(recording, swarm, 0.1)
    kept = (result.stamp_ns - run.start_ns > 10_000_000_000) & (result.stamp_ns <= ticks(run)[-1])
    places = result.poses[kept][..., :2].reshape(-1, 2)
    truth = run.truth.all_at(result.stamp_ns[kept])[..., :2].reshape(-1, 2)
    known = np.isfinite(places).all(axis=1)
    return _rms(_fitted(places[known], truth[known]))


def _fitted(places: FloatArray, truth: FloatArray) -> FloatArray:
    """Errors (k, 2) of places after the rigid motion that fits the truth best."""
    a, b = places - places.mean(axis=0), truth - truth.mean(axis=0)
    turn = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    return np.asarray(se2.transform_points([0.0, 0.0, turn], a) - b)


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=-1))))


def _row(name: str, runs: Sequence[Outcome]) -> list[Cell]:
    each = [1e3 * _rms(one.error) for one in runs]
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
        figures["survey.eight.bag_landmark_mm"] = 1e3 * _rms(found["eight"][0].error)
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
