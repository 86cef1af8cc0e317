"""How far one core carries: simulated swarms of growing size, beside filterpy and gtsam on the same data.

The swarm is a grid with about three neighbours in view of each robot (`bench.shared.grid`):
odometry at 20 Hz, cameras at 7.5 Hz, 150-300 ms late; for one figure (`prompt_cpu_s_per_s`) nothing is late.
Everybody gives all poses ten times a second; each uses measurements as often as suits it, the estimator as
its default settings say. Measured is CPU time of this process per simulated second, without reading
messages; the optimum is gtsam's batch solution of all data that have arrived by the same moment. Swarms of
several shapes are compared with the exact filter (`shapes.py`). At the end some are played into the live
graph in real time (`make bench-large_swarms`).
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from bench.graph import large_swarms
from bench.peers import filterpy_ekf, gtsam_batch, gtsam_lag
from bench.peers.shapes import ShapeRuns, measure_shape, scored, show
from bench.shared.common import new_plot, save_plot, table, write_figures
from bench.shared.grid import GridSettings, Shape, simulate_grid
from bench.shared.simulated_run import errors_of, position_rmse, run_core, ticks, without_delay
from swarm_loc_estimator.timeline.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from swarm_loc_drivers.sim.run import SimulatedRun

SIZES = (5, 20, 50, 100, 200, 300, 500, 1000)
SHAPE_SIZES = (300, 1000)
SHAPE_DURATION_S = 120.0
EXACT_S = 10.0
"""Of the largest swarms the exact filter has only so much: its cost per second grows with their cube."""
LARGEST_FOR_EXACT = 300
LARGEST_FOR_BATCH = 50
DURATION_S = 20.0
PEER_ROBOT_SECONDS = 1500.0
"""Peers get the first part of a large swarm's run: their cost per second does not change with its length."""
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
    figures |= scored(errors, core.covariances[settled])
    part = first_part(run, min(duration_s, max(2.0, PEER_ROBOT_SECONDS / robots)))
    for name, peer in (("filterpy", filterpy_ekf), ("gtsam", gtsam_lag)):
        figures[f"{name}_cpu_s_per_s"] = peer.solve(part, ticks(part)).cpu_s / part.duration_s
        figures[f"{name}_cpu_ratio"] = figures[f"{name}_cpu_s_per_s"] / figures["cpu_s_per_s"]
    if robots <= LARGEST_FOR_BATCH:
        chosen = np.flatnonzero(settled)[:: max(1, int(settled.sum()) * robots // 240)]
        best = gtsam_batch.solve(run, tick_ns[chosen])
        optimum = position_rmse(errors_of(best.poses, run, tick_ns[chosen]))
        reached = position_rmse(errors_of(core.poses[chosen], run, tick_ns[chosen]))
        figures["position_rmse_ratio_to_batch"] = reached / optimum
    return figures


def first_part(run: SimulatedRun, duration_s: float) -> SimulatedRun:
    """The run as if it had ended after `duration_s`."""
    end_ns = run.start_ns + round(duration_s * 1e9)
    kept = run.truth.stamp_ns <= end_ns
    truth = replace(run.truth, stamp_ns=run.truth.stamp_ns[kept], poses=run.truth.poses[kept])
    odometry = run.odometry[run.odometry["arrival_ns"] <= end_ns]
    frames = run.frames[run.frames["arrival_ns"] <= end_ns]
    return replace(
        run, truth=truth, odometry=odometry, frames=frames, sightings=run.sightings[: frames["count"].sum()]
    )


def draw(results: dict[int, dict[str, float]]) -> None:
    """CPU time and consistency against swarm size."""
    figure, (speed, quality) = new_plot(2)
    sizes = list(results)
    names = (("", "this estimator"), ("filterpy_", "filterpy EKF"), ("gtsam_", "gtsam fixed-lag smoother"))
    for prefix, label in names:
        speed.plot(sizes, [results[n][f"{prefix}cpu_s_per_s"] for n in sizes], "o-", label=label)
    speed.axhline(1.0, color="0.5", linestyle=":", label="real time")
    speed.set(xscale="log", yscale="log", xlabel="robots", ylabel="CPU seconds per second")
    speed.legend()
    quality.plot(sizes, [results[n]["nees"] / 3.0 for n in sizes], "o-", label="NEES / 3")
    with_batch = [n for n in sizes if "position_rmse_ratio_to_batch" in results[n]]
    ratios = [results[n]["position_rmse_ratio_to_batch"] for n in with_batch]
    quality.plot(with_batch, ratios, "s-", label="position RMSE / batch optimum")
    quality.axhline(1.0, color="0.5", linestyle=":")
    quality.set(xscale="log", xlabel="robots", ylim=(0.5, 1.5))
    quality.legend()
    print(f"plot: {save_plot(figure, 'scaling')}")


def report(results: dict[int, dict[str, float]], shapes: dict[str, float], live: dict[str, float]) -> None:
    """Print the tables, draw the plot and write the figures."""
    keys = {
        "cpu_s_per_s": "CPU s/s",
        "prompt_cpu_s_per_s": "without delay s/s",
        "filterpy_cpu_s_per_s": "filterpy s/s",
        "gtsam_cpu_s_per_s": "gtsam s/s",
        "gtsam_cpu_ratio": "gtsam / own",
        "position_rmse_mm": "RMSE mm",
        "heading_rmse_deg": "RMSE deg",
        "position_rmse_ratio_to_batch": "RMSE / batch",
        "nees": "NEES",
        "tracked_share": "tracked",
    }
    rows = [[robots, *(figures.get(key) for key in keys)] for robots, figures in results.items()]
    print(table(["robots", *keys.values()], rows))
    if results:
        draw(results)
    flat = {
        f"n{robots}.{key}": value for robots, figures in results.items() for key, value in figures.items()
    }
    flat |= shapes | live
    print(f"figures: {write_figures('scaling', flat)}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="*", default=SIZES, help="swarm sizes")
    parser.add_argument("--duration", type=float, default=DURATION_S, help="simulated time [s]")
    parser.add_argument("--seed", type=int, default=1, help="of the simulation")
    names = [shape.value for shape in Shape]
    parser.add_argument("--shapes", nargs="*", choices=names, default=names, help="shapes of swarms")
    parser.add_argument("--shape-robots", type=int, nargs="+", default=SHAPE_SIZES, help="their sizes")
    parser.add_argument("--shape-duration", type=float, default=SHAPE_DURATION_S, help="simulated time [s]")
    parser.add_argument("--shape-seeds", type=int, nargs="+", default=(1, 2, 3), help="of the simulation")
    parser.add_argument("--no-live", action="store_true", help="leave the live graph out")
    options = parser.parse_args(arguments)
    settings = Settings()
    results = {}
    for robots in options.robots:
        print(f"{robots} robots ...", flush=True)
        results[robots] = measure(robots, options.duration, options.seed, settings)
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
