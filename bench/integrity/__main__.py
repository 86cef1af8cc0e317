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

import math
import shutil
from collections.abc import Sequence

import numpy as np

from bench.integrity.live import LATE_START, LIVE_SCENARIOS, run_late_start, run_live
from bench.integrity.scenarios import SCENARIOS
from bench.integrity.scoring import Score, plot_errors, score
from bench.shared.common import OUT, Cell, ProgressLine, options_of, rms, table, write_figures

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
    chosen = options_of(__doc__, seeds=(5, "runs of each scenario"), scenarios=(_NAMES, "which", _NAMES))
    scores = {name: _runs(name, chosen.seeds) for name in chosen.scenarios}
    print(table(_COLUMNS, [_row(name, runs) for name, runs in scores.items()]))
    figures = {key: value for name, runs in scores.items() for key, value in _figures(name, runs).items()}
    print(write_figures("integrity", figures))
    for first in range(0, len(scores), _PLOTS_PER_FILE):
        some = {name: scores[name] for name in [*scores][first : first + _PLOTS_PER_FILE]}
        print(plot_errors(some, f"integrity-{first // _PLOTS_PER_FILE + 1}"))


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


if __name__ == "__main__":
    main()
