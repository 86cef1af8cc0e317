"""Five real robots (MRCLAM): calibrate on one set, evaluate on all.

    make bench-mrclam
    make bench-mrclam ARGS="FOLDER --fit 1"

FOLDER holds MRCLAM_Dataset<k> folders, or is one; robots and ground truth may be missing. Set 1 is used for
calibration, from ../shared/data/mrclam if FOLDER does not hold it.

Errors are those of online poses at 10 Hz, started at the true pose. For "plain" only the noise is fitted, for
"calibrated" everything. The smoother is the offline optimum with the same models and noise. In `blind_robots`
only two robots see landmarks and all see robots; errors are those of the others, pooled over all pairs.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from bench.mrclam.jobs import (
    MODELS,
    Results,
    bag_of,
    collected,
    fit,
    jobs_of,
    prepare,
    run,
    speed_factor,
)
from bench.mrclam.report import report
from bench.mrclam.sets import NoSetsError, find_sets
from bench.shared.common import OUT
from swarm_loc_estimator.common.command_line import exit_with_message
from swarm_loc_estimator.swarm.swarm_file import load_swarm

DEFAULT_FOLDER = OUT.parent.parent / "shared" / "data" / "mrclam"
_PROCESSES = 2


@exit_with_message
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; returns its exit status."""
    options = _parser().parse_args(arguments)
    sets = find_sets(options.folder)
    report(measure(sets, *chosen_to_fit(sets, options.fit)), sets)
    return 0


def chosen_to_fit(
    sets: dict[int, Path], wanted: int | None, elsewhere: Path = DEFAULT_FOLDER
) -> tuple[int, Path]:
    """Number and folder of a set for calibration: the wanted one, or set 1 of either folder, or the first."""
    others = find_sets(elsewhere) if elsewhere.is_dir() else {}
    known = {**others, **sets}
    number = 1 if wanted is None else wanted
    if number in known:
        return number, known[number]
    if wanted is None:
        return min(sets), sets[min(sets)]
    raise NoSetsError(f"--fit {wanted}: there is no such set, only {', '.join(map(str, sorted(known)))}.")


def measure(sets: Mapping[int, Path], fitted: int, fitted_folder: Path) -> Results:
    """Import all sets, calibrate with one of them, and run all jobs."""
    with ProcessPoolExecutor(_PROCESSES, mp_context=get_context("spawn")) as workers:
        imported = {fitted: fitted_folder, **sets}
        for number, remarks in _done(workers, prepare, list(imported.items()), "import"):
            for remark in remarks:
                print(f"set {number}: {remark}")
        for _, line in _done(workers, fit, [(fitted, model) for model in MODELS], "fit"):
            print(line)
        jobs = [job for k in sets for job in jobs_of(k, load_swarm(bag_of(k) / "swarm.yaml"))]
        results = collected(_done(workers, run, [(job,) for job in jobs], "runs"))
    for number in sets:
        results.figures[f"set{number}.replay.speed_factor"] = speed_factor(number)
    return results


def _done(
    workers: ProcessPoolExecutor, function: Callable[..., Any], calls: Sequence[tuple[Any, ...]], what: str
) -> list[Any]:
    """Results of all calls; prints the progress."""
    began = time.monotonic()
    waiting = [workers.submit(function, *call) for call in calls]
    results = []
    for count, future in enumerate(as_completed(waiting), 1):
        results.append(future.result())
        if count == len(calls) or count % 5 == 0:
            print(f"{what}: {count} of {len(calls)} after {time.monotonic() - began:.0f} s", flush=True)
    return results


def _parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "folder", type=Path, nargs="?", default=DEFAULT_FOLDER, help="folder with MRCLAM_Dataset<k> folders"
    )
    parser.add_argument("--fit", type=int, help="number of the set to fit to (default: 1)")
    return parser


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # for the workers: they are parallel already
    sys.exit(main())
