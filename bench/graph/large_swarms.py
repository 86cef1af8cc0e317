"""Large swarms through the live graph over DDS, in real time: start-up, losses, load, memory, age of poses.

    make bench-large_swarms
    make bench-large_swarms ARGS="--robots 1000 --duration 60"

A recording of the grid of `bench-scaling` is played into the estimator by another process: once with topics
of each robot, once with topics that all share (`shared_topics`). The age of a pose is that of its stamp at
reception; the data behind it is older.
"""

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from bench.scenarios.bags import as_detections, truth_stream, write_bag, write_swarm_bag
from bench.scenarios.lived_run import SimulatedRun
from bench.shared.bags import SharedHead, encode_shared_detections, encode_shared_numbers
from bench.shared.common import OUT, flat, options_of, plot_by_size, table, write_figures
from bench.shared.grid import GridSettings, simulate_grid
from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.bags.writer import Stream
from swarm_loc_estimator.common.launch import GraphOptions
from swarm_loc_estimator.common.messages.cdr import SWARM_DETECTIONS, SWARM_ODOMETRY
from swarm_loc_estimator.common.messages.detections import swarm_key
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
        shown = {name: _UNITS[name] for name in ("start_up_s", "estimator_core", "memory_mb", "pose_age_ms")}
        print(f"plot: {plot_by_size('large_swarms', results, shown, 'robots', 'topics')}")
    return flat({f"{_FIGURES_OF[layout]}{n}": results[layout][n] for layout in layouts for n in sizes})


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


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    options = options_of(
        __doc__,
        arguments,
        robots=(SIZES, "swarm sizes"),
        topics=(LAYOUTS, "layouts", LAYOUTS),
        duration=(DURATION_S, "of a recording [s]"),
        seed=(1, "of the simulation"),
    )
    figures = measure(options.robots, options.topics, options.duration, options.seed)
    print(f"figures: {write_figures('large_swarms', figures)}")


if __name__ == "__main__":
    main()


PERIOD_NS = 10_000_000  # All that arrives within this goes out together, at its end


def write_shared_bag(run: SimulatedRun, folder: Path, comment: str) -> int:
    """Write `swarm/odom`, `swarm/detections`, and `<robot>/ground_truth` of all robots.

    The folder, the comment, the result and the errors are those of `bag.write_bag`.
    """
    robots = run.swarm.robots
    truth = [truth_stream(run, index) for index in range(len(robots))]
    key = swarm_key(robot.name for robot in robots)
    return write_swarm_bag([_odometry(run, key), _detections(run, key), *truth], run.swarm, folder, comment)


def _odometry(run: SimulatedRun, key: int) -> Stream:
    rows, sent_ns, data = run.odometry, [], []
    for at_ns, some in _together(rows["arrival_ns"]):
        head = SharedHead(at_ns, "odom", key, rows["robot"][some], rows["stamp_ns"][some])
        data.append(encode_shared_numbers(head, rows["pose"][some]))
        sent_ns.append(at_ns)
    return Stream("swarm/odom", SWARM_ODOMETRY, np.array(sent_ns, dtype=np.int64), data)


def _detections(run: SimulatedRun, key: int) -> Stream:
    detections, frames = as_detections(run), run.frames
    columns = (np.repeat(frames[name], frames["count"]) for name in ("robot", "stamp_ns", "arrival_ns"))
    robot, stamp_ns, arrival_ns = columns
    sent_ns, data = [], []
    for at_ns, some in _together(arrival_ns):
        head = SharedHead(at_ns, "", key, robot[some], stamp_ns[some])
        data.append(encode_shared_detections(head, detections[some]))
        sent_ns.append(at_ns)
    return Stream("swarm/detections", SWARM_DETECTIONS, np.array(sent_ns, dtype=np.int64), data)


def _together(arrival_ns: IntArray) -> Iterator[tuple[int, IntArray]]:
    """When a message goes out, and which readings (n,) it carries, in order of arrival."""
    order = np.argsort(arrival_ns, kind="stable")
    period = -(-arrival_ns[order] // PERIOD_NS)
    starts = np.flatnonzero(np.diff(period, prepend=-1))
    for begin, end in zip(starts, [*starts[1:], order.size], strict=True):
        yield int(period[begin]) * PERIOD_NS, order[begin:end]
