"""UWB: errors with ranges to anchors or between robots, beside their bound and gtsam's batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np

from bench.inputs.uwb_world import (
    STEP_NS,
    TICK_STEPS,
    Plan,
    UwbResult,
    UwbWorld,
    bounds,
    motion_noise,
    rms,
    run,
    simulate,
)
from bench.shared.common import ProgressLine, new_plot, save_plot
from bench.shared.simulated_run import mean_nees
from swarm_loc_drivers.sim.run import START_NS
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.offline.metrics import is_misleading
from swarm_loc_estimator.timeline.estimator import Status

_ANCHORS, _AMONG_ROBOTS = Plan(), Plan(robots=4, anchors=0, between_robots=True, duration_s=30.0)
_UNKNOWN_START, _NLOS = Plan(robots=4, known_starts=0, duration_s=20.0), Plan(nlos=0.2)
_BIASED = Plan(bias_sigma=0.2)
_SETTLED_TICKS = 20
_RIGHT_M = 0.2
_BATCH_TICKS = slice(100, None, 50)  # Ticks at which gtsam solves the whole past


class _Case(NamedTuple):
    """All runs of one plan."""

    worlds: list[UwbWorld]  # The runs
    results: list[UwbResult]  # Their estimates
    squared: list[FloatArray]  # (K, N) squared distances from the truth of each


def measure(seeds: Sequence[int], say: ProgressLine) -> dict[str, float]:
    """Figures of all cases; draws errors over time."""
    # simulate and run all cases
    cases = {}
    plans = {"anchors4": _ANCHORS, "robots_only": _AMONG_ROBOTS, "unknown_start": _UNKNOWN_START}
    for name, plan in {**plans, "nlos20": _NLOS, "biased": _BIASED}.items():
        worlds, results = [], []
        for seed in seeds:
            say(f"{name}, seed {seed}")
            worlds.append(simulate(plan, seed))
            results.append(run(worlds[-1]))
        squared = [np.square(result.error[..., :2]).sum(axis=-1) for result in results]
        cases[name] = _Case(worlds, results, squared)
    # errors compared with the bound, and with a batch solution
    figures: dict[str, float] = {}
    bound_of = {}
    for name in ("anchors4", "robots_only"):
        say(f"{name}: bound")
        bound_of[name] = [bounds(world) for world in cases[name].worlds]
        position, bound = rms(_settled(cases[name].squared)), rms(_settled(bound_of[name]))
        figures |= {f"uwb.{name}.position_cm": 100.0 * position, f"uwb.{name}.bound_cm": 100.0 * bound}
        figures[f"uwb.{name}.ratio_to_bound"] = position / bound
        figures[f"uwb.{name}.nees"] = _nees(cases[name].results)
    say("anchors4: gtsam")
    batches = [_batch(world) for world in cases["anchors4"].worlds]
    figures["uwb.anchors4.gtsam_batch_cm"] = 100.0 * rms(batches)
    same = [squared[_BATCH_TICKS] for squared in cases["anchors4"].squared]
    figures["uwb.anchors4.position_cm_where_batch"] = 100.0 * rms(same)
    # located starts, and ranges through obstacles
    unknown, nlos = cases["unknown_start"], cases["nlos20"]
    right = [
        (result.status[-1] == Status.TRACKED) & (squared[-1] < _RIGHT_M**2)
        for result, squared in zip(unknown.results, unknown.squared, strict=True)
    ]
    figures["uwb.unknown_start.located"] = float(np.mean(right))
    figures["uwb.unknown_start.misleading_share"] = _misleading(unknown.results)
    figures["uwb.nlos20.misleading_share"] = _misleading(nlos.results)
    tracked = [result.status[_SETTLED_TICKS:] == Status.TRACKED for result in nlos.results]
    figures["uwb.nlos20.tracked_share"] = float(np.mean(tracked))
    whole = [squared[_SETTLED_TICKS:][one] for squared, one in zip(nlos.squared, tracked, strict=True)]
    figures["uwb.nlos20.position_cm"] = 100.0 * rms(whole)
    # anchors that nobody calibrated
    biased = cases["biased"]
    figures["uwb.biased.position_cm"] = 100.0 * rms(_settled(biased.squared))
    figures["uwb.biased.nees"] = _nees(biased.results)
    figures["uwb.biased.misleading_share"] = _misleading(biased.results)
    _draw(cases, bound_of)
    return figures


def _settled(arrays: Sequence[FloatArray]) -> list[FloatArray]:
    return [one[_SETTLED_TICKS:] for one in arrays]


def _nees(results: Sequence[UwbResult]) -> float:
    """Mean normalised error squared after the first seconds; 3 is ideal."""
    pairs = [(r.error[_SETTLED_TICKS:], r.covariance[_SETTLED_TICKS:]) for r in results]
    return float(np.mean([mean_nees(*pair) for pair in pairs]))


def _misleading(results: Sequence[UwbResult]) -> float:
    """Share of robot-seconds TRACKED with a position wrong by more than 5 sigma and 2 cm."""
    shares = []
    for result in results:
        wrong = result.status == Status.TRACKED
        wrong[wrong] = is_misleading(result.error[wrong], result.covariance[wrong])
        shares.append(wrong.mean())
    return float(np.mean(shares))


def _batch(world: UwbWorld) -> FloatArray:
    """Squared distances (K, N) of gtsam's Levenberg-Marquardt over all that has arrived by some ticks.

    Ranges are made horizontal, since its poses are: heights are known.
    """
    places, plan, ranges = world.anchor_places(), world.plan, world.ranges
    found = []
    for tick in world.tick_steps[_BATCH_TICKS].tolist():
        arrived = ranges.arrival_ns <= START_NS + tick * STEP_NS
        for robot in range(plan.robots):
            # the start
            graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
            mine = np.flatnonzero(arrived & (ranges.robot == robot))
            steps = np.unique([0, *ranges.step[mine].tolist(), tick])
            start = world.swarm.robots[robot].start or (0.0, 0.0, 0.0)
            sigma = world.swarm.robots[robot].start_sigma
            noise = gtsam.noiseModel.Gaussian.Covariance(np.diag(np.square([sigma.x, sigma.y, sigma.theta])))
            graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*start), noise))
            # odometry between the steps with ranges
            report = world.odometry[steps, robot]
            begin = se2.compose(se2.compose(start, se2.inverse(report[0])), report)
            for key, pose in enumerate(begin.tolist()):
                values.insert(key, gtsam.Pose2(*pose))
            moves = se2.between(report[:-1], report[1:])
            for key, (first, last) in enumerate(zip(steps[:-1].tolist(), steps[1:].tolist(), strict=True)):
                covariance = motion_noise(world, robot, first, last)
                model = gtsam.noiseModel.Gaussian.Covariance(covariance)
                graph.add(gtsam.BetweenFactorPose2(key, key + 1, gtsam.Pose2(*moves[key]), model))
            # fixed anchors, and ranges
            for k, place in enumerate(places):
                x, y, _ = place.tolist()
                fixed, at = gtsam.noiseModel.Isotropic.Sigma(3, 1e-6), gtsam.Pose2(x, y, 0.0)
                values.insert(10**6 + k, at)
                graph.add(gtsam.PriorFactorPose2(10**6 + k, at, fixed))
            for row in mine.tolist():
                anchor = int(ranges.device[row]) - plan.robots
                height = places[anchor, 2] - world.antenna_z
                level = float(np.sqrt(max(ranges.range[row] ** 2 - height**2, 1e-4)))
                model = gtsam.noiseModel.Isotropic.Sigma(1, plan.sigma * ranges.range[row] / level)
                key = int(np.searchsorted(steps, ranges.step[row]))
                graph.add(gtsam.RangeFactorPose2(key, 10**6 + anchor, level, model))
            pose = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize().atPose2(len(steps) - 1)
            away = np.array([pose.x(), pose.y()]) - world.truth[tick, robot, :2]
            found.append(float(away @ away))
    return np.array(found)


def _draw(cases: dict[str, _Case], bound_of: dict[str, list[FloatArray]]) -> None:
    """Errors over time, root mean square of all seeds and tracked robots."""
    figure, axes = new_plot(len(cases), width=3.6)
    for one, (name, case) in zip(axes, cases.items(), strict=True):
        count = len(case.squared[0])
        time_s = (1 + np.arange(count)) * TICK_STEPS * STEP_NS * 1e-9
        tracked = np.array([result.status == Status.TRACKED for result in case.results])
        squared = np.where(tracked, np.array(case.squared), np.nan)
        with np.errstate(invalid="ignore"):
            shown = np.sqrt(np.nansum(squared, axis=(0, 2)) / tracked.sum(axis=(0, 2)))
        one.plot(time_s, 100.0 * shown, label="tracked robots")
        if name in bound_of:
            bound = np.sqrt(np.mean(bound_of[name], axis=(0, 2)))
            one.plot(time_s, 100.0 * bound, "--", color="black", label="bound")
        one.set(xlabel="time [s]", ylabel="position error [cm]", title=name, ylim=(0.0, None))
        one.legend()
    save_plot(figure, "inputs-uwb")
