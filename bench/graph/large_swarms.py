"""Large swarms through the live graph over DDS, in real time: start-up, losses, load, memory, age of poses.

    make bench-large_swarms
    make bench-large_swarms ARGS="--robots 1000 --duration 60"

A recording of the grid of `bench-scaling` is played into the estimator by another process: once with topics
of each robot, once with topics that all share (`shared_topics`). The age of a pose is that of its stamp at
reception; the data behind it is older.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench.graph.shared_bag import write_shared_bag
from bench.shared.common import OUT, plot_by_size, table, write_figures
from bench.shared.grid import GridSettings, simulate_grid
from swarm_loc_drivers.sim.run import SimulatedRun
from swarm_loc_drivers.sim.scenarios.bags import write_bag
from swarm_loc_estimator.common.launch import GraphOptions
from swarm_loc_estimator.nodes.load import SHED_REASONS
from swarm_loc_estimator.offline.live_run import play_live

SIZES = (100, 300, 1000)
DURATION_S = 30.0
SETTLING_S = 5.0  # Errors are computed after this time
OWN, SHARED = "own", "shared"
LAYOUTS = (OWN, SHARED)  # Layouts of topics
_FIGURES_OF = {OWN: "live", SHARED: "shared"}  # Prefixes of the names of figures
_PARAMETERS = "estimator: {{ros__parameters: {{shared_topics: {shared}}}}}\n"
_UNITS = {
    "start_up_s": "start-up [s]",
    "sent_messages": "messages sent",
    "lost_messages": "messages lost",
    "shed_sightings": "sightings left out",
    "estimator_core": "estimator [core]",
    "memory_mb": "memory [MB]",
    "pose_age_ms": "pose age, 95 % [ms]",
    "position_rmse_mm": "RMSE [mm]",
    "nees": "NEES",
}


def measure(sizes: Sequence[int], layouts: Sequence[str], duration_s: float, seed: int) -> dict[str, float]:
    """Run swarms of several sizes, print a table and draw it.

    Returns:
        The figures, named `live<robots>.<figure>` with topics of each robot and `shared<robots>.<figure>`
        with those that all share; without errors where no robot was located.
    """
    results: dict[str, dict[int, dict[str, float]]] = {layout: {} for layout in layouts}
    for robots in sizes:
        recording = simulate_grid(GridSettings(robots=robots, seed=seed, duration_s=duration_s))
        for layout, figures in results.items():
            print(f"{robots} robots over DDS, {layout} topics, in real time ...", flush=True)
            figures[robots] = run(recording, shared=layout == SHARED)
    rows: list[list[str | float]] = [
        [n, layout, *one.values()] for layout, found in results.items() for n, one in found.items()
    ]
    if rows:
        print(table(["robots", "topics", *_UNITS.values()], rows))
        draw(results)
    named = {
        f"{_FIGURES_OF[layout]}{n}.{name}": value
        for layout, found in results.items()
        for n, one in found.items()
        for name, value in one.items()
    }
    return {name: value for name, value in named.items() if np.isfinite(value)}


def run(recording: SimulatedRun, *, shared: bool) -> dict[str, float]:
    """All figures of one size, named as `_UNITS`."""
    robots = len(recording.swarm.robots)
    with tempfile.TemporaryDirectory() as work:
        bag, parameters = Path(work, f"grid{robots}"), Path(work, "parameters.yaml")
        write = write_shared_bag if shared else write_bag
        write(recording, bag, "A simulated grid.")
        parameters.write_text(_PARAMETERS.format(shared=str(shared).lower()), encoding="utf-8")
        log = OUT / "scaling" / f"nodes{robots}{'_shared' if shared else ''}.log"
        options = GraphOptions(str(bag / "swarm.yaml"), bag=str(bag), parameter_file=str(parameters))
        live = play_live(options, log=log, inputs_only=True)
    settled = live.result.stamp_ns >= recording.start_ns + SETTLING_S * 1e9
    errors = live.result.select(settled).overall
    figures = (
        live.start_up_s,
        live.sent,
        live.lost,
        sum(live.result.counters.get(reason, 0) for reason in SHED_REASONS),
        live.estimator_core,
        live.memory_mb,
        1e3 * np.percentile(live.age_s, 95.0),
        1e3 * errors.position_rmse,
        errors.nees,
    )
    return {name: float(value) for name, value in zip(_UNITS, figures, strict=True)}


def draw(results: dict[str, dict[int, dict[str, float]]]) -> None:
    """Plot figures over the size of the swarm."""
    shown = {name: _UNITS[name] for name in ("start_up_s", "estimator_core", "memory_mb", "pose_age_ms")}
    print(f"plot: {plot_by_size('large_swarms', results, shown, 'robots', 'topics')}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="+", default=SIZES, help="swarm sizes")
    parser.add_argument("--topics", nargs="+", default=LAYOUTS, choices=LAYOUTS, help="layouts")
    parser.add_argument("--duration", type=float, default=DURATION_S, help="of a recording [s]")
    parser.add_argument("--seed", type=int, default=1, help="of the simulation")
    options = parser.parse_args(arguments)
    figures = measure(options.robots, options.topics, options.duration, options.seed)
    print(f"figures: {write_figures('large_swarms', figures)}")


if __name__ == "__main__":
    main()
