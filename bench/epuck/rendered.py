"""The eight through rendered pictures, the real detector, emulated firmware and the whole graph over DDS.

The nodes of `simulate` run as child processes. Part of `make bench-epuck`.
"""

import shutil
from collections.abc import Sequence

import numpy as np

from bench.graph.listener import Listener, starting_swarm
from bench.shared.common import OUT, Cell, ProgressLine, table
from swarm_loc_drivers.sim.simulation import SimulationOptions, graph_of
from swarm_loc_drivers.sim.worlds import WORLDS
from swarm_loc_estimator.common.messages.detections import decode_detections
from swarm_loc_estimator.offline.live_run import LiveGraph, cpu_seconds
from swarm_loc_estimator.offline.report.plots import plot_overview
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import save_swarm
from swarm_loc_vision.markers.detector import precompile

WORLD = "w2"
OUTPUT_NS = 100_000_000
"""Interval of the compared poses, as in the other rows of the benchmark; poses come twice as often."""
_SILENCE_PATIENCE_S = 120.0


def measure(seeds: Sequence[int], duration_s: float, settling_s: float, swarm: Swarm) -> dict[str, float]:
    """Run worlds one after the other, print a table, plot the first one, and return the means.

    Args:
        seeds: Of the worlds.
        duration_s: Of driving [s].
        settling_s: Errors count after it [s].
        swarm: As described to the estimator.

    Raises:
        LiveError: A node has ended, or the graph has stopped.
    """
    precompile()  # once, not in every robot's detector at a time
    found: list[dict[str, float]] = []
    for seed in seeds:
        live, figures = run_rendered(swarm, seed, duration_s, settling_s)
        if not found:
            plot_overview(live, OUT / "epuck_rendered.png")
        found.append(figures)
    means = {key: float(np.mean([one[key] for one in found])) for key in found[0]}
    rows: list[list[Cell]] = [[key, *(one[key] for one in found), mean] for key, mean in means.items()]
    print(table(["rendered", *(f"seed {seed}" for seed in seeds), "mean"], rows))
    return {f"rendered.robots5.{key}": value for key, value in means.items()}


def swarm_of_world() -> Swarm:
    """The robots at their starts, as the world describes them."""
    return starting_swarm(WORLDS[WORLD])


def run_rendered(
    swarm: Swarm, seed: int, duration_s: float, settling_s: float
) -> tuple[ReplayResult, dict[str, float]]:
    """Drive the eight in a rendered world: the poses of the graph while the robots drove, and figures."""
    # the graph of simulated robots
    folder = OUT / "epuck_rendered" / f"seed{seed}"
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "links").mkdir(parents=True)
    save_swarm(swarm, folder / "swarm.yaml")
    names, say = [robot.name for robot in swarm.robots], ProgressLine(f"rendered world {seed}")
    options = SimulationOptions(str(folder / "swarm.yaml"), world=WORLD, seed=seed)
    nodes = graph_of(options, swarm, str(folder / "links"))
    with LiveGraph(nodes, folder / "nodes.log") as graph:
        listener = Listener(graph, names)
        # drive
        begin_ns = listener.wait_until_they_drive(say)
        processes = {node.full_name: graph.process(node.full_name).pid for node in nodes}
        used_s = {name: cpu_seconds(pid) for name, pid in processes.items()}

        def is_over() -> bool:
            """Whether they have driven long enough; reports the progress."""
            now_s = (listener.now_ns - begin_ns) * 1e-9
            say(f"{min(now_s, duration_s):.0f} of {duration_s:.0f} simulated s")
            return now_s >= duration_s

        graph.wait_for(is_over, "go on driving", _SILENCE_PATIENCE_S)
        cpu_s = {name: cpu_seconds(pid) - used_s[name] for name, pid in processes.items()}
    # errors ten times a second, and the load
    print()
    live = graph.recorder.result("rendered, live", swarm, listener.truth(swarm))
    live = live.select(live.stamp_ns >= begin_ns)
    settled = live.stamp_ns >= begin_ns + settling_s * 1e9
    errors = live.select(settled & (live.stamp_ns % OUTPUT_NS == 0)).overall
    images = [decode_detections(data) for name in names for data in listener.kept[name, "detections"][1]]
    seen = [len(one.detections) for one in images if one.stamp_ns >= begin_ns]
    detectors_s = sum(used for node, used in cpu_s.items() if node.endswith("/marker_detector"))
    driven_s = 1e-9 * float(live.stamp_ns[-1] - begin_ns)
    return live, {
        "position_cm": 100.0 * errors.position_mean,
        "heading_deg": float(np.degrees(errors.heading_mean)),
        "nees": errors.nees,
        "detections_per_frame": float(np.mean(seen)),
        "cpu_ms_per_frame": 1e3 * detectors_s / len(seen),
        "estimator_cpu": cpu_s["estimator"] / driven_s,
        "world_cpu": cpu_s["epuck_world"] / driven_s,
    }
