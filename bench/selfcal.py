"""Calibration without ground truth: fitted to the first half of a recording, replayed on the second.

Real robots (MRCLAM sets, imported without calibration) by `set<k>.imported` and `set<k>.self`; simulated
bags, whose description is right, by `<bag>.self.ratio_to_described`.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

from bench.mrclam.__main__ import DEFAULT_FOLDER
from bench.mrclam.jobs import TICK_S, bag_of, prepare, sums_of
from bench.mrclam.sets import find_sets, load
from bench.shared.common import ProgressLine, table, write_figures
from swarm_loc_estimator.offline.calibration.fit import calibrate
from swarm_loc_estimator.offline.calibration.models import Options
from swarm_loc_estimator.offline.calibration.recording import Recording, rerun, started_at_truth
from swarm_loc_estimator.swarm.swarm import Swarm

_BAGS = {"eight": Path("bags/eight_five_robots"), "w2": Path("bags/eight_five_robots_w2")}


def halves(recording: Recording) -> tuple[Recording, Recording]:
    """The first and the second half."""
    first_ns, last_ns = recording.range_ns
    middle_ns = (first_ns + last_ns) // 2
    return recording.between(first_ns, middle_ns), recording.between(middle_ns, last_ns + 1)


def errors(recording: Recording, swarm: Swarm) -> dict[str, float]:
    """Figures of the estimator, started at the truth."""
    sums = sums_of(rerun(recording, started_at_truth(swarm, recording), TICK_S).errors)
    return sums.figures if sums is not None else {}


def fitted(recording: Recording, swarm: Swarm, say: ProgressLine) -> tuple[Swarm, float]:
    """The swarm calibrated without ground truth, and the CPU time that it took [s]."""
    begin = time.process_time()
    blind = replace(recording, truth={})
    done = calibrate(blind, swarm, Options(alone=True), lambda share, what: say(f"{share:.0%} {what}"))
    return done.swarm, time.process_time() - begin


def main() -> None:
    """Measure, print the table, write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sets", nargs="*", type=int, default=[2, 3], help="numbers of MRCLAM sets")
    arguments = parser.parse_args()
    figures: dict[str, float] = {}
    found = find_sets(DEFAULT_FOLDER)
    for number in arguments.sets:
        prepare(number, found[number])
        recording, swarm = load(bag_of(number))
        first, second = halves(recording)
        own, cpu_s = fitted(first, swarm, ProgressLine(f"set {number}"))
        for name, one in (("imported", swarm), ("self", own)):
            figures |= {f"set{number}.{name}.{key}": value for key, value in errors(second, one).items()}
        figures[f"set{number}.self.cpu_s"] = cpu_s
    for name, bag in _BAGS.items():
        recording, swarm = load(bag)
        first, second = halves(recording)
        own, _ = fitted(first, swarm, ProgressLine(name))
        new, old = (errors(second, one)["position_rmse_m"] for one in (own, swarm))
        figures[f"{name}.self.ratio_to_described"] = new / old
    print(table(("figure", "value"), list(figures.items())))
    print(write_figures("selfcal", figures))


if __name__ == "__main__":
    main()
