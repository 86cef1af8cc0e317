"""How far one core carries: simulated swarms of growing size, and large ones of several shapes.

The swarm is a grid with about three neighbours in view of each robot (`bench.shared.grid`): odometry at
20 Hz, cameras at 7.5 Hz, 150-300 ms late; for one figure (`prompt_cpu_s_per_s`) nothing is late. Poses come
ten times a second, with default settings. Measured is CPU time of this process per simulated second, without
reading messages. The data of shapes go through the exact dense filter, too, whatever the size; errors of the
second half of such a run count, of the poses with status TRACKED. At the end some swarms are played into the
live graph in real time (`make bench-large_swarms`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.graph import large_swarms
from bench.scenarios.lived_run import SimulatedRun
from bench.shared.common import flat, options_of, plot_curves, table, write_figures
from bench.shared.grid import GridSettings, Shape, simulate_grid
from bench.shared.simulated_run import errors_of, mean_nees, position_rmse, run_core, ticks, without_delay
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


SIZES = (5, 20, 50, 100, 200, 300, 500, 1000)
SHAPE_SIZES = (300, 1000)
SHAPE_DURATION_S = 120.0
EXACT_S = 10.0
"""Of the largest swarms the exact filter has only so much: its cost per second grows with their cube."""
LARGEST_FOR_EXACT = 300
DURATION_S = 20.0
WARM_UP_S = 2.0
SETTLING_S = 3.0  # Errors count from here on


def measure(robots: int, duration_s: float, seed: int, settings: Settings) -> dict[str, float]:
    """All figures of one size."""
    warm_up = simulate_grid(GridSettings(robots=robots, duration_s=WARM_UP_S))
    run_core(warm_up, ticks(warm_up), settings)  # compiles what is not compiled yet, or loads it
    run = simulate_grid(GridSettings(robots=robots, seed=seed, duration_s=duration_s))
    tick_ns = ticks(run)
    core = run_core(run, tick_ns, settings)
    prompt = run_core(without_delay(run), tick_ns, settings)
    settled = tick_ns >= run.start_ns + SETTLING_S * 1e9
    errors = errors_of(core.poses, run, tick_ns)[settled]
    figures = {
        "cpu_s_per_s": core.cpu_s / run.duration_s,
        "prompt_cpu_s_per_s": prompt.cpu_s / run.duration_s,
        "heading_rmse_deg": float(np.degrees(np.sqrt(np.nanmean(errors[..., 2] ** 2)))),
    }
    return figures | scored(errors, core.covariances[settled])


def report(results: dict[int, dict[str, float]], shapes: dict[str, float], live: dict[str, float]) -> None:
    """Print the table, draw the plot and write the figures."""
    if results:
        names = list(next(iter(results.values())))
        print(table(["robots", *names], [[robots, *one.values()] for robots, one in results.items()]))
        sizes, shown = list(results), ("cpu_s_per_s", "nees")
        cpu, nees = ([one[name] for one in results.values()] for name in shown)
        plot_curves(
            "scaling",
            ("robots", "CPU seconds per second", sizes, {"": cpu, "real time": np.ones(len(sizes))}),
            ("robots", "NEES", sizes, {"": nees, "ideal": np.full(len(sizes), 3.0)}),
            style="o-",
            xscale="log",
        )
    sized = {f"n{robots}": figures for robots, figures in results.items()}
    print(f"figures: {write_figures('scaling', flat(sized) | shapes | live)}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    names = tuple(shape.value for shape in Shape)
    options = options_of(
        __doc__,
        arguments,
        robots=(SIZES, "swarm sizes"),
        duration=(DURATION_S, "simulated time [s]"),
        seed=(1, "of the simulation"),
        shapes=(names, "shapes of swarms", names),
        shape_robots=(SHAPE_SIZES, "their sizes"),
        shape_duration=(SHAPE_DURATION_S, "simulated time [s]"),
        shape_seeds=((1, 2, 3), "of the simulation"),
        no_live=(False, "leave the live graph out"),
    )
    results = {}
    for robots in options.robots:
        print(f"{robots} robots ...", flush=True)
        results[robots] = measure(robots, options.duration, options.seed, Settings())
    shaped = {}
    for name in options.shapes:
        for robots in options.shape_robots:
            print(f"{name}, {robots} robots ...", flush=True)
            longest = options.shape_duration if robots <= LARGEST_FOR_EXACT else EXACT_S
            runs = ShapeRuns(options.shape_duration, longest, tuple(options.shape_seeds))
            shaped[Shape(name), robots] = measure_shape(Shape(name), robots, runs)
    live = {}
    if not options.no_live:
        live = large_swarms.measure(large_swarms.SIZES, large_swarms.LAYOUTS, options.duration, options.seed)
    report(results, show(shaped), live)


if __name__ == "__main__":
    main()
