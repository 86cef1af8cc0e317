"""Large swarms through the live graph over DDS, in real time: start-up, losses, load, memory, age of poses.

    make bench-large_swarms
    make bench-large_swarms ARGS="--robots 1000 --duration 60"

A recording of the grid of `bench-scaling` is played into the estimator by another process. A pose's
age is that of its stamp when it is received here; the data behind it is older.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench.shared.common import OUT, new_plot, save_plot, table, write_figures
from swarm_loc_drivers.sim.recording.bag import write_bag
from swarm_loc_drivers.sim.scenarios.grid import GridSettings, simulate_grid
from swarm_loc_estimator.evaluation.metrics import pool, summarise
from swarm_loc_estimator.launching.graph import GraphOptions
from swarm_loc_estimator.live.run import play_live

SIZES = (100, 300, 1000)
DURATION_S = 30.0
SETTLING_S = 5.0
"""Errors count from here on."""
_UNITS = {
    "start_up_s": "start-up [s]",
    "sent_messages": "messages sent",
    "lost_messages": "messages lost",
    "estimator_core": "estimator [core]",
    "memory_mb": "memory [MB]",
    "pose_age_ms": "pose age, 95 % [ms]",
    "position_rmse_mm": "RMSE [mm]",
    "nees": "NEES",
}


def measure(sizes: Sequence[int], duration_s: float, seed: int) -> dict[str, float]:
    """Run swarms of several sizes, print a table and draw it.

    Returns:
        The figures, named `live<robots>.<figure>`; without errors where no robot was located.
    """
    results = {}
    for robots in sizes:
        print(f"{robots} robots over DDS, in real time ...", flush=True)
        results[robots] = run(robots, duration_s, seed)
    if results:
        print(table(["robots", *_UNITS.values()], [[n, *one.values()] for n, one in results.items()]))
        draw(results)
    named = {f"live{n}.{name}": value for n, one in results.items() for name, value in one.items()}
    return {name: value for name, value in named.items() if np.isfinite(value)}


def run(robots: int, duration_s: float, seed: int) -> dict[str, float]:
    """All figures of one size, named as `_UNITS`."""
    recording = simulate_grid(GridSettings(robots=robots, seed=seed, duration_s=duration_s))
    with tempfile.TemporaryDirectory() as work:
        bag = Path(work, f"grid{robots}")
        write_bag(recording, bag, "A simulated grid.")
        log = OUT / "scaling" / f"nodes{robots}.log"
        options = GraphOptions(str(bag / "swarm.yaml"), bag=str(bag))
        live = play_live(options, log=log, inputs_only=True)
    settled = live.result.stamp_ns >= recording.start_ns + SETTLING_S * 1e9
    errors = summarise(pool(list(live.result.chosen(settled).errors.values())))
    figures = (
        live.start_up_s,
        live.sent,
        live.lost,
        live.estimator_core,
        live.memory_mb,
        1e3 * np.percentile(live.age_s, 95.0),
        1e3 * errors.position_rmse,
        errors.nees,
    )
    return {name: float(value) for name, value in zip(_UNITS, figures, strict=True)}


def draw(results: dict[int, dict[str, float]]) -> None:
    """What grows with the swarm."""
    names = ("start_up_s", "estimator_core", "memory_mb", "pose_age_ms")
    figure, axes = new_plot(len(names), width=3.4)
    for axis, name in zip(axes, names, strict=True):
        axis.plot(list(results), [one[name] for one in results.values()], "o-")
        axis.set(xlabel="robots", ylabel=_UNITS[name], xlim=(0.0, None), ylim=(0.0, None))
    print(f"plot: {save_plot(figure, 'large_swarms')}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="+", default=SIZES, help="swarm sizes")
    parser.add_argument("--duration", type=float, default=DURATION_S, help="of a recording [s]")
    parser.add_argument("--seed", type=int, default=1, help="of the simulation")
    options = parser.parse_args(arguments)
    figures = measure(options.robots, options.duration, options.seed)
    print(f"figures: {write_figures('large_swarms', figures)}")


if __name__ == "__main__":
    main()
