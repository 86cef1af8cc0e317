"""Five real robots (MRCLAM): calibrate on one set, evaluate on all.

    make bench-mrclam
    make bench-mrclam ARGS="FIT TEST..."

FIT and TEST are numbers of sets in ../shared/data/mrclam or folders: a set, or several named
MRCLAM_Dataset<k>. Robots and ground truth may be missing. Set 1 is fitted to if FIT is left out or holds
several sets, which are tests then; without TEST all sets of ../shared/data/mrclam are.

Errors are those of online poses at 10 Hz, started at the true pose. For "plain" only the noise is fitted, for
"calibrated" everything. The smoother is that of `replay --smooth`. In `blind_robots`
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

from bench.mrclam.jobs import MODELS, Results, bag_of, collected, fit, jobs_of, prepare, run, speed_factor
from bench.mrclam.report import report
from bench.mrclam.sets import NoSetsError, find_sets
from bench.shared.common import SHARED
from swarm_loc_estimator.common.command_line import exit_with_message
from swarm_loc_estimator.swarm.swarm_file import load_swarm

DEFAULT_FOLDER = SHARED / "data" / "mrclam"
_PROCESSES = 2


@exit_with_message
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; returns its exit status."""
    fitted, tests = chosen_sets(_parser().parse_args(arguments).sets)
    report(measure(tests, fitted), tests)
    return 0


def chosen_sets(
    arguments: Sequence[str], folder: Path = DEFAULT_FOLDER
) -> tuple[tuple[int, Path], dict[int, Path]]:
    """The set to fit to, as number and folder, and the folders of the sets to test by number.

    Args:
        arguments: As on the command line.
        folder: Of the sets that are named by number.

    Raises:
        NoSetsError: A set is missing, or two tests have the same number.
    """
    wanted = [_sets_of(argument, folder) for argument in arguments]
    known = find_sets(folder) if folder.is_dir() or not wanted else {}
    if wanted and len(wanted[0]) == 1:
        [fitted] = wanted.pop(0).items()
    else:
        every = {**known, **(wanted[0] if wanted else {})}
        number = min(every, key=lambda k: (k != 1, k))
        fitted = (number, every[number])
    tests: dict[int, Path] = {}
    for number, path in [one for sets in wanted for one in sets.items()] or known.items():
        if tests.setdefault(number, path) != path:
            raise NoSetsError(f"'{tests[number]}' and '{path}' are both set {number}; test one of them.")
    if fitted[0] in tests and tests[fitted[0]] != fitted[1]:
        raise NoSetsError(f"'{fitted[1]}' and '{tests[fitted[0]]}' are both set {fitted[0]}; rename one.")
    return fitted, tests


def _sets_of(argument: str, folder: Path) -> dict[int, Path]:
    """The sets that an argument names."""
    if not argument.isdigit():
        return find_sets(Path(argument))
    known = find_sets(folder)
    if int(argument) not in known:
        names = ", ".join(map(str, known))
        raise NoSetsError(f"There is no set {argument} in '{folder}', only {names}; name its folder.")
    return {int(argument): known[int(argument)]}


def measure(sets: Mapping[int, Path], fitted: tuple[int, Path]) -> Results:
    """Import all sets, calibrate with one of them, given by number and folder, and run all jobs."""
    with ProcessPoolExecutor(_PROCESSES, mp_context=get_context("spawn")) as workers:
        imported = dict([fitted, *sets.items()])
        for number, remarks in _done(workers, prepare, list(imported.items()), "import"):
            for remark in remarks:
                print(f"set {number}: {remark}")
        for _, line in _done(workers, fit, [(fitted[0], model) for model in MODELS], "fit"):
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
    parser.add_argument("sets", nargs="*", metavar="SET", help="FIT TEST...: numbers or folders of sets")
    return parser


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # for the workers: they are parallel already
    sys.exit(main())
