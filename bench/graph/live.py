"""Compare poses of the live graph over DDS with those of a replay of the same bag.

    make bench-live
    make bench-live ARGS="--mrclam FOLDER"

The bag of the demo is played at its own speed and, if the data are present, the first five minutes of MRCLAM
set 1 at ten times theirs. Live poses lack messages that are still in transport. "equal" is the share of poses
that differ by less than a micrometre; at "settled" stamps no message was in transport.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench.shared.bags import copy_part
from bench.shared.common import OUT, new_plot, save_plot, table, write_figures
from bench.shared.live import settled
from swarm_loc_estimator.common.launch import GraphOptions
from swarm_loc_estimator.offline.datasets.mrclam import Delay, convert, read_dataset
from swarm_loc_estimator.offline.live_run import Agreement, LiveRun, compare_with_replay, play_live

ROOT = OUT.parent
DEMO_BAG = ROOT / "bags" / "eight_five_robots"
MRCLAM_SET = ROOT.parent / "shared" / "data" / "mrclam" / "MRCLAM_Dataset1"
MRCLAM_S, MRCLAM_RATE = 300.0, 10.0

Outcome = tuple[LiveRun, Agreement]


def run_bag(bag: Path, swarm_file: Path, rate: float) -> Outcome:
    """Play a bag live and compare with its replay."""
    options = GraphOptions(str(swarm_file), bag=str(bag), rate=rate)
    live = play_live(options, log=OUT / "live" / f"{bag.name}.log")
    return live, compare_with_replay(live, bag)


def run_mrclam(folder: Path, work: Path, duration_s: float, rate: float) -> Outcome:
    """The first part of an MRCLAM set."""
    whole, part = work / "whole", work / f"{folder.name}_beginning"
    convert(read_dataset(folder), whole, Delay(0, 0, 0), lambda _share, _what: None)
    copy_part(whole, part, duration_s)
    return run_bag(part, whole / "swarm.yaml", rate)


def figures_of(outcome: Outcome) -> dict[str, float]:
    """All figures of one bag."""
    live, compared = outcome
    at_rest = settled(live)
    settled_m = compared.distance_m[at_rest]
    figures = {
        "lost_messages": float(live.lost),
        "estimator_core": live.estimator_core,
        "pose_age_ms": 1e3 * float(np.percentile(live.age_s, 95.0)),
        "position_rmse_m": live.result.overall.position_rmse,
        "replay_position_rmse_m": compared.replayed.overall.position_rmse,
        "difference_rms_m": compared.rms_m,
        "equal_share": compared.equal_share,
        "settled_difference_max_m": float(np.nanmax(settled_m)) if settled_m.size else float("nan"),
        "settled_stamps": float(at_rest.sum()),
    }
    return {name: value for name, value in figures.items() if np.isfinite(value)}


def draw(outcomes: dict[str, Outcome]) -> None:
    """Plot the distribution of differences."""
    figure, (axis,) = new_plot(1, width=6.0)
    for name, (_, compared) in outcomes.items():
        distance = np.sort(compared.distance_m[np.isfinite(compared.distance_m)])
        share = np.arange(1, distance.size + 1) / distance.size
        axis.plot(np.maximum(distance, 1e-9), share, label=name)
    axis.set(xscale="log", xlabel="live to replayed position [m]", ylabel="share of poses", ylim=(0.0, 1.02))
    axis.legend(loc="lower right")
    print(f"plot: {save_plot(figure, 'live')}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rate", type=float, default=1.0, help="speed of the demo's bag")
    parser.add_argument("--mrclam", type=Path, default=MRCLAM_SET, help="folder of an MRCLAM set")
    parser.add_argument("--mrclam-rate", type=float, default=MRCLAM_RATE, help="its speed")
    parser.add_argument("--mrclam-seconds", type=float, default=MRCLAM_S, help="how much of it")
    options = parser.parse_args(arguments)
    print(f"{DEMO_BAG.name} ...", flush=True)
    outcomes = {"demo": run_bag(DEMO_BAG, DEMO_BAG / "swarm.yaml", options.rate)}
    if options.mrclam.is_dir():
        print(f"{options.mrclam.name} ...", flush=True)
        with tempfile.TemporaryDirectory() as work:
            outcomes["mrclam"] = run_mrclam(
                options.mrclam, Path(work), options.mrclam_seconds, options.mrclam_rate
            )
    else:
        print(f"'{options.mrclam}' is not here: MRCLAM is left out")
    results = {name: figures_of(outcome) for name, outcome in outcomes.items()}
    keys = list(dict.fromkeys(key for figures in results.values() for key in figures))
    print(table(["figure", *results], [[key, *(f.get(key) for f in results.values())] for key in keys]))
    draw(outcomes)
    flat = {f"{name}.{key}": value for name, figures in results.items() for key, value in figures.items()}
    print(f"figures: {write_figures('live', flat)}")


if __name__ == "__main__":
    main()
