"""Sweeps: 200 replays on one worker, on two, killed and resumed, on a Ray cluster; evo beside our errors.

    make bench-sweep
    make bench-sweep ARGS="--seconds 5"

Two parts of simulated recordings are replayed with four horizons and 25 losses. All tables must be the same,
byte for byte: that of one worker, of two, of a sweep whose processes were killed and which was started again,
of a Ray cluster of two local nodes, and of Dask. `evo_ape` judges what `replay --tum` has written.
"""

import argparse
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple
from zipfile import ZipFile

from ray.cluster_utils import Cluster

from bench.shared.bags import copy_part
from bench.shared.common import Cell, table, write_figures
from swarm_loc_estimator.offline.replay import replay

BAGS = Path(__file__).resolve().parents[1] / "bags"
PROGRAM = [
    sys.executable,
    "-c",
    "import sys; from swarm_loc_estimator import start; sys.exit(start.swarm_loc())",
]
NAMES = ("eight_five_robots", "eight_five_robots_w2")
GRID = """
bags: [eight_five_robots, eight_five_robots_w2]
settings:
  horizon_s: [0.2, 0.5, 1.0, 2.0]
lost: [0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 0.9]
seeds: [1, 2, 3]
workers: {workers}
"""
REPLAYS = 200
_POLL_S = 0.1


class Run(NamedTuple):
    """A finished sweep: its table, wall time [s] and CPU time of all its processes [s]."""

    table: bytes
    wall_s: float
    cpu_s: float


def prepare(work: Path, seconds: float) -> None:
    """Cut the recordings, and write a sweep for one worker and one for two."""
    for name in NAMES:
        copy_part(BAGS / name, work / name, seconds)
        shutil.copy(BAGS / name / "swarm.yaml", work / name)
    for workers in (1, 2):
        (work / f"on{workers}.yaml").write_text(GRID.format(workers=workers), encoding="utf-8")


def command(work: Path, workers: int, out: str, *more: str) -> list[str]:
    """The command line of a sweep."""
    return [*PROGRAM, "sweep", str(work / f"on{workers}.yaml"), "--out", str(work / out), *more]


def run(work: Path, workers: int, out: str, *more: str) -> Run:
    """Run a sweep to its end."""
    began_s, used_s = time.monotonic(), _children_s()
    subprocess.run(command(work, workers, out, *more), check=True, stdout=subprocess.DEVNULL)
    content = (work / out / "table.csv").read_bytes()
    return Run(content, time.monotonic() - began_s, _children_s() - used_s)


def killed(work: Path, out: str) -> int:
    """Kill all processes of a sweep in its middle; returns the number of finished replays."""
    path = work / out / "jobs.jsonl"
    with subprocess.Popen(command(work, 2, out), start_new_session=True) as process:
        while not path.exists() or path.read_bytes().count(b"\n") < REPLAYS // 3:
            try:
                process.wait(_POLL_S)
            except subprocess.TimeoutExpired:
                continue
            raise RuntimeError(f"the sweep ended with status {process.returncode} before it was killed.")
        os.killpg(process.pid, signal.SIGKILL)
    return path.read_bytes().count(b"\n")


def on_ray(work: Path) -> Run:
    """Run the sweep on a Ray cluster of two local nodes with one processor each."""
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        cluster.add_node(num_cpus=1)
        return run(work, 2, "ray", "--backend", "ray", "--cluster", cluster.address)
    finally:
        cluster.shutdown()


def evo_difference_m(bag: Path, work: Path) -> float:
    """Greatest difference, over the robots of a bag, of evo's position RMSE and ours [m]."""
    subprocess.run(
        [*PROGRAM, "replay", str(bag), "--out", str(work / "report"), "--tum", str(work / "tum")],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    differences: list[float] = []
    evo = Path(sys.executable).with_name("evo_ape")
    for name, ours in replay(bag).summaries.items():
        saved = work / f"{name}.zip"
        trajectories = [work / "tum" / f"{name}.truth.tum", work / "tum" / f"{name}.tum"]
        options: list[str | Path] = ["--pose_relation", "trans_part", "--save_results", saved]
        environment = {**os.environ, "HOME": str(work)}  # where evo keeps its settings
        arguments = [evo, "tum", *trajectories, *options]
        subprocess.run(arguments, check=True, stdout=subprocess.DEVNULL, env=environment)
        with ZipFile(saved) as archive:
            differences.append(abs(json.loads(archive.read("stats.json"))["rmse"] - ours.position_rmse))
    return max(differences)


def measure(work: Path) -> dict[str, float]:
    """Run everything and print a table; returns the figures."""
    done = killed(work, "resumed")  # the first, which compiles what is not compiled yet
    runs = {
        "resumed": run(work, 2, "resumed"),
        "one_worker": run(work, 1, "one"),
        "two_workers": run(work, 2, "two"),
        "ray": on_ray(work),
        "dask": run(work, 2, "dask", "--backend", "dask"),
    }
    alone = runs["one_worker"]
    rows: list[list[Cell]] = [
        [name, one.wall_s, one.cpu_s, str(one.table == alone.table)] for name, one in runs.items()
    ]
    print(table(["sweep", "wall s", "CPU s", "same table"], rows))
    print(f"{done} of {REPLAYS} replays were finished when the sweep was killed.")
    figures = {f"{name}_equal": float(one.table == alone.table) for name, one in runs.items()}
    del figures["one_worker_equal"]
    for name in ("one_worker", "two_workers"):
        figures |= {f"{name}.wall_s": runs[name].wall_s, f"{name}.cpu_s": runs[name].cpu_s}
    figures["two_workers.speedup"] = alone.wall_s / runs["two_workers"].wall_s
    figures["replays"] = float(alone.table.count(b"\n") - 1)
    figures["killed_after"] = float(done)
    return figures


def _children_s() -> float:
    """CPU time of all processes that this one has started and that have ended [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="length of the recordings")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        prepare(work, options.seconds)
        figures = measure(work)
        figures["evo_ape_difference_m"] = evo_difference_m(work / NAMES[0], work)
    print(f"figures: {write_figures('sweep', figures)}")


if __name__ == "__main__":
    main()
