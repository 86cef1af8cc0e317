"""Integrity: are poses with status TRACKED correct under faults? Five simulated e-pucks on the eight.

Each scenario injects one fault into a simulated run of a minute, see `scenarios.py`, or kills and restarts a
process of the live graph in a rendered world, see `live.py`, or starts the estimator late while PushBots map,
see `late_start.py`. A robot-second is
misleading when the robot is TRACKED with an error beyond 5 sigma and 2 cm. In `kidnapped` no data shows the
fault before the first sighting after it has arrived; this time is excluded.

Faults of `sensors.py` have a guilty source: "named" is the time until it is named, the length of the run if
it never is, "accused" the number of innocent sources that are named. "others" is the RMSE of the robots that
the fault does not concern over that of the run without it, while it lasts, and "after" in the 30 s after it.
"""

from __future__ import annotations

import argparse
import math
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from bench.integrity.late_start import LATE_START, run_late_start
from bench.integrity.live import LIVE_SCENARIOS, run_live
from bench.integrity.scenarios import SCENARIOS
from bench.integrity.scoring import Score, score
from bench.shared.common import OUT, Cell, ProgressLine, new_plot, rms, save_plot, table, write_figures

_NAMES = (*SCENARIOS, LATE_START, *LIVE_SCENARIOS)
_PLOTS_PER_FILE = 5
_OPTIONAL = {
    "recovery_s": "recovery [s]",
    "named_s": "named [s]",
    "accused": "accused",
    "others_ratio": "others",
    "others_after_ratio": "after",
}
"""Figures that not every scenario has, and their columns."""
_COLUMNS = ("scenario", "misleading", "worst seed", "tracked", "RMSE [cm]", "NEES", *_OPTIONAL.values())


def main() -> None:
    """Print the table, write the figures, plot the errors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5, help="runs of each scenario")
    parser.add_argument("--scenarios", nargs="+", choices=_NAMES, default=list(_NAMES))
    arguments = parser.parse_args()
    scores = {name: _runs(name, arguments.seeds) for name in arguments.scenarios}
    print(table(_COLUMNS, [_row(name, runs) for name, runs in scores.items()]))
    figures = {key: value for name, runs in scores.items() for key, value in _figures(name, runs).items()}
    print(write_figures("integrity", figures))
    print(*_plots(scores), sep="\n")


def _runs(name: str, seeds: int) -> list[Score]:
    runs = []
    for seed in range(1, seeds + 1):
        runs.append(_run(name, seed))
        print(f"{name} seed {seed}: misleading {runs[-1].misleading_share:.4f}", flush=True)
    return runs


def _run(name: str, seed: int) -> Score:
    if name in SCENARIOS:
        return score(SCENARIOS[name](seed))
    folder = OUT / "integrity" / f"{name}{seed}"
    shutil.rmtree(folder, ignore_errors=True)
    if name == LATE_START:
        return run_late_start(seed, folder)
    say = ProgressLine(f"{name} seed {seed}")
    found = run_live(name, seed, folder, say)
    say("done")
    print()
    return found


def _figures(name: str, runs: Sequence[Score]) -> dict[str, float]:
    """Means over the seeds; of the times until a fault is named and until robots recover the maximum."""
    figures = {
        "misleading_share": float(np.mean([one.misleading_share for one in runs])),
        "tracked_share": float(np.mean([one.tracked_share for one in runs])),
        "position_cm": 100.0 * rms([one.position_m for one in runs]),
        "nees": float(np.mean([one.nees for one in runs])),
        "recovery_s": _most([one.recovery_s for one in runs]),
    }
    blames = [one.blame for one in runs if one.blame is not None]
    if blames:
        figures |= {
            "named_s": _most([one.named_s for one in blames]),
            "accused": float(np.mean([one.accused for one in blames])),
            "others_ratio": _mean([one.others_ratio for one in blames]),
            "others_after_ratio": _mean([one.others_after_ratio for one in blames]),
        }
    return {f"{name}.{key}": value for key, value in figures.items() if not math.isnan(value)}


def _most(values: Sequence[float]) -> float:
    """The largest of the known values; NaN without any."""
    return max((one for one in values if not math.isnan(one)), default=math.nan)


def _mean(values: Sequence[float]) -> float:
    """Mean of the known values; NaN without any."""
    known = [one for one in values if not math.isnan(one)]
    return float(np.mean(known)) if known else math.nan


def _row(name: str, runs: Sequence[Score]) -> list[Cell]:
    figures, worst = _figures(name, runs), max(one.misleading_share for one in runs)
    share, tracked, position, nees = (
        figures[f"{name}.{key}"] for key in ("misleading_share", "tracked_share", "position_cm", "nees")
    )
    optional = [figures.get(f"{name}.{key}") for key in _OPTIONAL]
    return [name, share, worst, f"{tracked:.4f}", position, nees, *optional]


def _plots(scores: Mapping[str, Sequence[Score]]) -> list[Path]:
    """Plot errors of all robots over time, an axis per scenario, with misleading ones marked."""
    names, files = list(scores), []
    for first in range(0, len(names), _PLOTS_PER_FILE):
        some = names[first : first + _PLOTS_PER_FILE]
        figure, axes = new_plot(len(some), width=3.4)
        for axis, name in zip(axes, some, strict=True):
            for one in scores[name]:
                axis.semilogy(one.time_s, 100.0 * one.error_m, color="0.6", linewidth=0.5)
                ticks, robots = np.nonzero(one.misleading)
                axis.semilogy(one.time_s[ticks], 100.0 * one.error_m[ticks, robots], "r.", markersize=3)
            axis.set(title=name, xlabel="time [s]", ylabel="error [cm]", ylim=(0.01, 300.0))
        files.append(save_plot(figure, f"integrity-{first // _PLOTS_PER_FILE + 1}"))
    return files


if __name__ == "__main__":
    main()
