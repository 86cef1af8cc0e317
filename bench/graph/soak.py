"""Run the live graph for an hour: memory, lost messages, and the time to end by SIGINT.

    make bench-soak
    make bench-soak ARGS="--minutes 6 --rate 3 --overload-minutes 3"

A bag is looped through the live graph (player and estimator), first at a rate that the machine can process,
then at one that it cannot. Memory, CPU, lost messages and the age of poses are recorded every second. Growth
of memory is that of its maximum after the first tenth of a run.
"""

from __future__ import annotations

import argparse
import signal
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.shared.common import OUT, new_plot, save_plot, table, write_figures
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.launch import GraphOptions, graph_nodes
from swarm_loc_estimator.offline.live_run import (
    ESTIMATOR,
    PLAYER,
    START_PATIENCE_S,
    LiveGraph,
    Recorder,
    cpu_seconds,
    read_poses,
    resident_mb,
)

BAG = OUT.parent / "bags" / "eight_five_robots"
COLUMNS = ("second", "memory_mb", "core", "lost", "pose_age_s")
_SILENCE_PATIENCE_S = 60.0
_MISSING = ("overload", "lost")
_TOLERATED = {"memory_growth_share": 0.1, "sigint_s": 2.0}


def run(bag: Path, rate: float, minutes: float) -> tuple[FloatArray, float]:
    """Loop a bag; returns (s, 5) of COLUMNS, a row per second, and how long the estimator took to end [s]."""
    options = GraphOptions(str(bag / "swarm.yaml"), bag=str(bag), rate=rate)
    nodes = [
        replace(node, parameters={**node.parameters, "loop": True}) if node.name == PLAYER else node
        for node in graph_nodes(options)
    ]
    rows: list[tuple[float, ...]] = []
    with LiveGraph(nodes, OUT / "soak" / f"rate_{rate:g}.log") as graph:
        recorder, estimator = graph.recorder, graph.process(ESTIMATOR)
        graph.wait_for(lambda: bool(recorder.raw), "publish poses", START_PATIENCE_S)
        begin_s = before_s = time.monotonic()
        before_cpu_s = cpu_seconds(estimator.pid)

        def is_over() -> bool:
            """Append a row once a second."""
            nonlocal before_s, before_cpu_s
            now_s = time.monotonic()
            if now_s >= before_s + 1.0:
                cpu_s = cpu_seconds(estimator.pid)
                core = (cpu_s - before_cpu_s) / (now_s - before_s)
                rows.append((now_s - begin_s, resident_mb(estimator.pid), core, *heard(recorder)))
                before_s, before_cpu_s = now_s, cpu_s
            return now_s > begin_s + 60.0 * minutes

        graph.wait_for(is_over, "go on publishing poses", _SILENCE_PATIENCE_S)
        end_s = time.monotonic()
        estimator.send_signal(signal.SIGINT)
        estimator.wait()
        sigint_s = time.monotonic() - end_s
    return np.array(rows), sigint_s


def heard(recorder: Recorder) -> tuple[float, float]:
    """Messages lost so far, and the median age of poses [s of the bag] since the last call; clears these."""
    pairs = zip(recorder.received_ns, recorder.raw, strict=True)
    ages_s = [1e-9 * (at_ns - read_poses(data).stamp_ns) for at_ns, data in pairs]
    recorder.raw.clear()
    recorder.received_ns.clear()
    lost = sum(recorder.drops.get(reason, 0) for reason in _MISSING)
    return float(lost), float(np.median(ages_s)) if ages_s else float("nan")


def figures_of(rows: FloatArray, sigint_s: float) -> dict[str, float]:
    """All figures of one run."""
    _, memory, core, lost, age_s = rows.T
    settled = memory[len(memory) // 10 :]
    return {
        "minutes": rows[-1, 0] / 60.0,
        "memory_mb": float(settled[0]),
        "memory_growth_share": float(settled.max() / settled[0] - 1.0),
        "core": float(core.mean()),
        "lost": float(lost[-1]),
        "pose_age_median_s": float(np.nanmedian(age_s)),
        "pose_age_95_s": float(np.nanpercentile(age_s, 95.0)),
        "sigint_s": sigint_s,
    }


def draw(name: str, rows: FloatArray) -> None:
    """Plot memory, CPU, lost messages and age of poses over time."""
    figure, axes = new_plot(len(COLUMNS) - 1)
    for axis, column, title in zip(axes, rows.T[1:], COLUMNS[1:], strict=True):
        axis.plot(rows[:, 0] / 60.0, column)
        axis.set(xlabel="time [min]", ylabel=title, ylim=(0.0, None))
    print(f"plot: {save_plot(figure, f'soak_{name}')}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; 1 when memory grows or the estimator does not end in time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0, help="at the rate that should lose nothing")
    parser.add_argument("--rate", type=float, default=3.0, help="that rate")
    parser.add_argument("--overload-minutes", type=float, default=3.0, help="at the rate that is too much")
    parser.add_argument("--overload-rate", type=float, default=100.0, help="that rate")
    options = parser.parse_args(arguments)
    figures = {}
    for name, rate, minutes in (
        ("steady", options.rate, options.minutes),
        ("overload", options.overload_rate, options.overload_minutes),
    ):
        print(f"{BAG.name} at {rate:g} x for {minutes:g} min ...", flush=True)
        rows, sigint_s = run(BAG, rate, minutes)
        draw(name, rows)
        figures[name] = figures_of(rows, sigint_s)
    keys = list(figures["steady"])
    print(table(["figure", *figures], [[key, *(f[key] for f in figures.values())] for key in keys]))
    flat = {f"{name}.{key}": value for name, one in figures.items() for key, value in one.items()}
    print(f"figures: {write_figures('soak', flat)}")
    return int(any(one[key] > most for one in figures.values() for key, most in _TOLERATED.items()))


if __name__ == "__main__":
    raise SystemExit(main())
