"""Maps that simulated PushBots make: one robot in three halls, several in the hallway, and how fast."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np

from bench.pushbot.maps import draw_maps
from bench.pushbot.runs import RunResult, RunSettings, run
from bench.shared.common import Cell, table

PLANS = ("corridor", "office", "ring")
UNSEEN = ("bend", "atrium", "tee")  # Halls that nothing was developed in
WIDE = ("open12", "corridor25")
"""Halls whose walls are out of the laser's range, or do not tell how far along a robot is."""
SLIPS = (0.0, 0.02, 0.05)
LIDAR_SLIPS = (0.02, 0.035, 0.05)  # Shares of paths and turns that wheels lose, of seeds 1, 2 and 3 and so on
LIDAR_MINUTES = 5.0
_SPEED_ROBOTS = (1, 2, 5, 10)
_SPEED_MINUTES = 5.0
_MAX_PROCESSES = 2
_POSES = ("position_cm", "heading_deg", "online_position_cm", "wall_cm", "wall_aligned_cm", "coverage")


@dataclass(frozen=True)
class MappingEffort:
    """How much is run."""

    seeds: int  # Of each hall with one robot; slips take turns
    team_seeds: int  # Of runs with several robots, of other halls, and at .3 px
    minutes: float  # Of a run of one robot; teams get half of it
    processes: int  # At a time


def measure_mapping(effort: MappingEffort) -> dict[str, float]:
    """Run everything, print tables, draw maps, and return the figures."""
    jobs = planned(effort)
    results: dict[str, list[RunResult]] = {name: [] for name in jobs}
    settings = [(name, one) for name, ones in jobs.items() for one in ones]
    count = min(_MAX_PROCESSES, max(1, effort.processes))
    with ProcessPoolExecutor(count, mp_context=get_context("spawn")) as pool:
        for number, (name, result) in enumerate(
            zip((name for name, _ in settings), pool.map(run, [one for _, one in settings]), strict=True), 1
        ):
            results[name].append(result)
            print(f"\rmaps: {number} of {len(settings)} runs", end="", flush=True)
    print()
    report(results)
    print(f"plot: {draw_maps(results)}")
    return {**figures_of(results), **_speed_factors(results)}


def planned(effort: MappingEffort) -> dict[str, list[RunSettings]]:
    """All runs by the prefix of their figures."""

    def seeds(count: int, minutes: float, plan: str, **more: float) -> list[RunSettings]:
        return [
            RunSettings(plan, SLIPS[seed % len(SLIPS)], seed, minutes, **more)  # type: ignore[arg-type]
            for seed in range(1, count + 1)
        ]

    whole, half = effort.minutes, 0.5 * effort.minutes
    jobs = {plan: seeds(effort.seeds, whole, plan) for plan in PLANS}
    jobs |= {plan: seeds(effort.team_seeds, whole, plan) for plan in UNSEEN}
    jobs |= {plan: seeds(effort.team_seeds, half, plan, robots=2, checks_covariances=True) for plan in WIDE}
    jobs["corridor.px3"] = seeds(effort.team_seeds, whole, "corridor", pixel=0.3)
    jobs["one_robot"] = seeds(effort.team_seeds, half, "corridor")
    jobs["two_robots"] = seeds(effort.team_seeds, half, "corridor", robots=2)
    jobs["five_robots"] = seeds(effort.team_seeds, half, "corridor", robots=5)
    jobs["two_robots.no_lights"] = seeds(effort.team_seeds, half, "corridor", robots=2, lights=False)
    jobs["five_robots.no_lights"] = seeds(effort.team_seeds, half, "corridor", robots=5, lights=False)
    for plan in PLANS:
        jobs[f"lidar.{plan}"] = [
            RunSettings(plan, LIDAR_SLIPS[k % len(LIDAR_SLIPS)], k + 1, min(whole, LIDAR_MINUTES), lidar=True)
            for k in range(effort.team_seeds)
        ]
    for robots in _SPEED_ROBOTS:
        jobs[f"speed{robots}"] = seeds(1, min(whole, _SPEED_MINUTES), "corridor", robots=robots)
    return jobs


def figures_of(results: Mapping[str, Sequence[RunResult]]) -> dict[str, float]:
    """Medians over the runs of each kind."""
    figures: dict[str, float] = {}
    for name, runs in _mapped(results):
        medians = {key: _median(runs, key) for key in (*_POSES, "aligned_cm", "coverage_90_s")}
        figures |= {f"{name}.{key}": value for key, value in medians.items() if math.isfinite(value)}
        figures[f"{name}.diverged"] = float(sum(one.is_diverged for one in runs))
        figures[f"{name}.online_diverged"] = float(sum(one.is_diverged_online for one in runs))
        figures[f"{name}.good_share"] = float(np.mean([one.is_good for one in runs]))
        reached = [math.isfinite(one.coverage_90_s) for one in runs]
        figures[f"{name}.coverage_90_share"] = float(np.mean(reached))
        if runs[0].settings.lidar:
            figures[f"{name}.worst_wall_cm"] = max(one.wall_cm for one in runs)
            figures[f"{name}.sweep_ms"] = _median(runs, "sweep_ms")
        if name in WIDE:
            figures[f"{name}.misleading_share"] = float(np.mean([one.misleading_share for one in runs]))
            unreported = sum(one.diverged_unreported for one in runs)
            figures[f"{name}.diverged_unreported"] = float(unreported)
    return figures


def report(results: Mapping[str, Sequence[RunResult]]) -> None:
    """Print a table of medians."""
    head = ["runs", "n", "diverged", "online", "good", "position cm", "deg", "worst", "online cm"]
    head += ["aligned cm", "wall cm", "aligned", "coverage", "90 % s", "CPU s/s", "bumps", "misleading"]
    rows: list[list[Cell]] = []
    for name, runs in _mapped(results):
        numbers: list[Cell] = [
            name,
            len(runs),
            sum(one.is_diverged for one in runs),
            sum(one.is_diverged_online for one in runs),
            float(np.mean([one.is_good for one in runs])),
            _median(runs, "position_cm"),
            _median(runs, "heading_deg"),
            max(one.worst_cm for one in runs),
        ]
        keys = ["online_position_cm", "aligned_cm", "wall_cm", "wall_aligned_cm", "coverage"]
        numbers += [_median(runs, key) for key in [*keys, "coverage_90_s", "cpu_s_per_s"]]
        numbers.append(float(np.mean([one.bumps for one in runs])))
        rows.append([*numbers, float(np.mean([one.misleading_share for one in runs]))])
    print(table(head, rows))


def _mapped(results: Mapping[str, Sequence[RunResult]]) -> Iterator[tuple[str, Sequence[RunResult]]]:
    return ((name, runs) for name, runs in results.items() if runs and not name.startswith("speed"))


def _median(runs: Sequence[RunResult], key: str) -> float:
    """The median over runs; what was never reached counts as later than all else."""
    values = [getattr(one, key) for one in runs]
    return float(np.median([math.inf if math.isnan(value) else value for value in values]))


def _speed_factors(results: Mapping[str, Sequence[RunResult]]) -> dict[str, float]:
    """How many times faster than real time one core maps."""
    factors = {}
    for robots in _SPEED_ROBOTS:
        costs = [one.cpu_s_per_s for one in results[f"speed{robots}"]]
        factors[f"speed_factor.robots{robots}"] = 1.0 / float(np.median(costs))
    print(
        table(
            ["robots", "times real time"],
            [[r, f] for r, f in zip(_SPEED_ROBOTS, factors.values(), strict=True)],
        )
    )
    return factors
