"""Large swarms of several shapes: what the estimator costs, and how near it comes to the exact filter.

The same data go through the estimator as it is and through the exact dense filter, whatever the size. Errors
of the second half of a run count, of the poses told as tracked.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bench.shared.common import table
from bench.shared.grid import GridSettings, Shape, simulate_grid
from bench.shared.simulated_run import errors_of, mean_nees, position_rmse, run_core, ticks
from swarm_loc_drivers.sim.run import SimulatedRun
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.timeline.settings import Settings

_NEVER = 1_000_000


@dataclass(frozen=True)
class ShapeRuns:
    """What to run."""

    duration_s: float  # Of a run [s]
    exact_s: float  # The exact filter has so much of it at most [s], and is compared there
    seeds: tuple[int, ...]  # One run each


def measure_shape(shape: Shape, robots: int, runs: ShapeRuns) -> dict[str, float]:
    """CPU time, ratio of RMSE to the exact filter's, NEES: means over the seeds."""
    figures = [
        _measure(GridSettings(robots, seed, runs.duration_s, shape), runs.exact_s) for seed in runs.seeds
    ]
    return {name: float(np.mean([one[name] for one in figures])) for name in figures[0]}


def _measure(grid: GridSettings, exact_s: float) -> dict[str, float]:
    run = simulate_grid(grid)
    own = beside = second_half(run, Settings())
    if exact_s < grid.duration_s:
        run = simulate_grid(replace(grid, duration_s=exact_s))
        beside = second_half(run, Settings())
    exact = second_half(run, Settings(sparse_from=_NEVER))
    ratio = beside["position_rmse_mm"] / exact["position_rmse_mm"]
    reference = {f"exact_{name}": exact[name] for name in ("nees", "tracked_share", "cpu_s_per_s")}
    return own | {"position_rmse_ratio_to_exact": ratio} | reference


def second_half(run: SimulatedRun, settings: Settings) -> dict[str, float]:
    """CPU time of a run, and the figures of its second half."""
    at_ns = ticks(run)
    core = run_core(run, at_ns, settings)
    counted = np.arange(at_ns.size) >= at_ns.size // 2
    errors = errors_of(core.poses, run, at_ns)
    cost = {"cpu_s_per_s": core.cpu_s / run.duration_s}
    return cost | scored(errors[counted], core.covariances[counted])


def scored(errors: FloatArray, covariances: FloatArray) -> dict[str, float]:
    """The share of poses that are tracked, and how exact these are.

    Args:
        errors: (K, N, 3) x, y [m], theta [rad]; not finite where a pose is not told as tracked.
        covariances: (K, N, 3, 3) of them.
    """
    tracked = np.isfinite(errors).all(axis=-1)
    return {
        "tracked_share": float(np.mean(tracked)),
        "position_rmse_mm": 1e3 * position_rmse(errors[tracked]),
        "nees": mean_nees(errors[tracked], covariances[tracked]),
    }


def show(results: dict[tuple[Shape, int], dict[str, float]]) -> dict[str, float]:
    """Print a table; return the figures by name."""
    names = list(next(iter(results.values()))) if results else []
    print(table(["shape", "robots", *names], [[s.value, n, *f.values()] for (s, n), f in results.items()]))
    return {f"{s.value}.n{n}.{name}": value for (s, n), f in results.items() for name, value in f.items()}
