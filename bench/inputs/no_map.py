"""Swarms without a map: poses relative to one robot, and their move to the map when landmarks come.

Five simulated e-pucks drive the eight for a minute with unknown starts. In the first part they see each other
only; errors are those after a rigid fit at each instant, compared with a run in which one start is known. In
the second part, robots of two groups do not see each other for half a minute, and landmarks come after 40 s.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from bench.integrity.faults import CLEAN, seconds
from bench.scenarios.eight_run import EightSettings, simulate_eight
from bench.scenarios.lived_run import SimulatedRun
from bench.shared.common import ProgressLine, plot_curves, rms
from bench.shared.simulated_run import errors_of, estimates_of, fitted_errors, inputs_of, ticks
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.offline.metrics import is_misleading
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator, Status

SETTLED_S, TOGETHER_S, LANDMARKS_S = 25.0, 30.0, 40.0
_GROUP = (0, 1)


def measure(seeds: Sequence[int], say: ProgressLine) -> Mapping[str, float]:
    """Relative errors without a map, and misleading poses after the move to the map."""
    relative: dict[str, list[FloatArray]] = {"no map": [], "one start known": []}
    moved: list[tuple[FloatArray, BoolArray]] = []
    wrong, tracked, moves = [], [], []
    for seed in seeds:
        say(f"seed {seed}")
        run = _unknown_starts(simulate_eight(EightSettings(seed=seed, duration_s=60.0, errors=CLEAN)))
        blind = run.masked(~_of_landmarks(run))
        relative["no map"].append(_relative_errors(blind))
        relative["one start known"].append(_relative_errors(_with_start(blind)))
        apart = (_between_groups(run) & (_time_s(run) < TOGETHER_S)) | (
            _of_landmarks(run) & (_time_s(run) < LANDMARKS_S)
        )
        error, misleading, is_tracked, count = _in_map(run.masked(~apart))
        moved.append((error, misleading))
        wrong.append(misleading.mean())
        tracked.append(is_tracked[-10:].mean())
        moves.append(count)
    fitted = {name: np.concatenate(errors) for name, errors in relative.items()}
    relative_cm = {name: 100.0 * rms(one[np.isfinite(one)]) for name, one in fitted.items()}
    shown = {
        name: 100.0 * np.sqrt(np.nanmean(np.concatenate(errors, axis=1) ** 2, axis=1))
        for name, errors in relative.items()
    }
    away = 100.0 * np.concatenate([np.hypot(*error[..., :2].T).T for error, _ in moved], axis=1)
    plot_curves(
        "inputs-no_map",
        ("time [s]", "RMS after a rigid fit [cm]", SETTLED_S + 0.1 * np.arange(len(shown["no map"])), shown),
        ("time [s]", "error in map [cm]", 1.0 + 0.1 * np.arange(len(away)), {"": away}),
        yscale="log",
    )
    return {
        "no_map.relative_cm": relative_cm["no map"],
        "no_map.known_frame_relative_cm": relative_cm["one start known"],
        "no_map.ratio_to_known_frame": relative_cm["no map"] / relative_cm["one start known"],
        "merge.misleading_share": float(np.mean(wrong)),
        "merge.tracked_share_at_end": float(np.mean(tracked)),
        "merge.frame_moves": float(np.mean(moves)),
    }


def _unknown_starts(run: SimulatedRun) -> SimulatedRun:
    robots = tuple(replace(robot, start=None) for robot in run.swarm.robots)
    return replace(run, swarm=replace(run.swarm, robots=robots))


def _with_start(run: SimulatedRun) -> SimulatedRun:
    """The run in which the robot with the most sightings has its true start."""
    robot = int(np.argmax(np.bincount(_observers(run), minlength=len(run.swarm.robots))))
    x, y, theta = run.truth.poses[0, robot].tolist()
    robots = [*run.swarm.robots]
    robots[robot] = replace(robots[robot], start=(x, y, theta))
    return replace(run, swarm=replace(run.swarm, robots=tuple(robots)))


def _observers(run: SimulatedRun) -> IntArray:
    return np.asarray(np.repeat(run.frames["robot"], run.frames["count"]), dtype=np.int64)


def _time_s(run: SimulatedRun) -> FloatArray:
    return seconds(run, np.repeat(run.frames["stamp_ns"], run.frames["count"]))


def _of_landmarks(run: SimulatedRun) -> BoolArray:
    return np.isin(run.sightings["marker_id"], [mark.id for mark in run.swarm.landmarks])


def _between_groups(run: SimulatedRun) -> BoolArray:
    """Whether each sighting (S,) is between robots of the two groups."""
    ids = [face.id for robot in _GROUP for face in run.swarm.robots[robot].faces]
    return np.asarray(np.isin(_observers(run), _GROUP) != np.isin(run.sightings["marker_id"], ids))


def _relative_errors(run: SimulatedRun) -> FloatArray:
    """Distances (T, N) from the truth after a rigid fit of all robots at each tick, once settled [m]."""
    errors = []
    for estimate, _ in _estimates(run):
        if (estimate.stamp_ns - run.start_ns) * 1e-9 >= SETTLED_S:
            truth = run.truth.all_at(np.array([estimate.stamp_ns]))[0]
            errors.append(np.linalg.norm(fitted_errors(estimate.poses[:, :2], truth[:, :2]), axis=1))
    return np.array(errors)


def _in_map(run: SimulatedRun) -> tuple[FloatArray, BoolArray, BoolArray, int]:
    """Errors (T, N, 3) in map and whether they mislead, tracked flags, and number of moves to the map."""
    errors, misleading, tracked, moves = [], [], [], 0
    for estimate, estimator in _estimates(run):
        is_tracked = (estimate.status == Status.TRACKED) & (not estimator.origin)
        error = errors_of(estimate.poses[None], run, np.array([estimate.stamp_ns]))[0]
        errors.append(np.full_like(error, np.nan) if estimator.origin else error)
        tracked.append(is_tracked)
        misleading.append(is_misleading(error, estimate.covariances) & is_tracked)
        moves = estimator.frame_moves
    return np.array(errors), np.array(misleading), np.array(tracked), moves


def _estimates(run: SimulatedRun) -> Iterator[tuple[Estimate, Estimator]]:
    """Estimates at all ticks from the first second on, and the estimator at that moment."""
    tick_ns = ticks(run)[9:]
    return estimates_of(run.swarm, inputs_of(run, tick_ns), tick_ns)
