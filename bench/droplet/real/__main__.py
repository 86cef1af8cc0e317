"""Range, bearing and heading of real Droplets: a board that is calibrated, beside what was assumed before.

    make bench-droplet_real
    make bench-droplet_real ARGS="FIT_FOLDER TEST_FOLDER"

Folders hold recordings of Droplets under a camera (*.txt, see `import_droplets`). The board is fitted to
those of the first and tested on those of the second; without them each recording of
../shared/data/droplet_2016 is tested with a board fitted to the others. Errors are those of pairs 5 to 20 cm
apart with no other robot within 44 mm of the line between them. Headings of the truth are turned by what the
fit found of each robot's fiducial. At the end whole recordings go through the estimator, see `graph`.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bench.droplet.real import graph
from bench.droplet.real.graph import Recorded, read_folder
from bench.shared.common import OUT, Cell, ProgressLine, table, write_figures
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.command_line import exit_with_message
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.infrared.likelihood import MaximumLikelihood
from swarm_loc_estimator.offline.calibration.infrared.board import (
    MAX_RANGE,
    BoardCalibration,
    BoardReadings,
    calibrate_board,
    pair_gains,
    turned,
    without_dead,
)
from swarm_loc_estimator.swarm.ir_board import load_ir_platform

DEFAULT_FOLDER = OUT.parent.parent / "shared" / "data" / "droplet_2016"
METHODS = ("stock", "board")
RANGES = (0.05, 0.2)
_CHI_SQUARE_99 = 11.345
_UNITS = np.array([100.0, np.degrees(1.0), np.degrees(1.0)])
_NAMES = ("range_cm", "bearing_deg", "heading_deg")


@dataclass
class Results:
    """Errors (s, 3) of one method over all tests, and how many pairs there were."""

    errors: list[FloatArray]
    nees: list[FloatArray]
    asked: int = 0


@exit_with_message
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; returns its exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", type=Path, nargs="*", help="FIT_FOLDER TEST_FOLDER")
    options = parser.parse_args(arguments)
    if len(options.folders) not in (0, 2):
        parser.error("give no folder, or FIT_FOLDER and TEST_FOLDER")
    names: list[str] = []
    with tempfile.TemporaryDirectory() as work:
        if options.folders:
            fit, test = (
                read_folder(folder, names, Path(work) / kind)
                for kind, folder in zip(("fit", "test"), options.folders, strict=True)
            )
            tests = [(fit, test)]
        else:
            all_of_them = read_folder(DEFAULT_FOLDER, names, Path(work) / "all")
            tests = [([o for o in all_of_them if o is not one], [one]) for one in all_of_them]
        results = {method: Results([], []) for method in METHODS}
        believed = []
        for fit, test in tests:
            done = measure(fit, test, len(names), results)
            believed += [(one, done) for one in test]
        figures = report(results) | graph.measure(believed, names)
    print(f"figures: {write_figures('droplet_real', figures)}")
    return 0


def measure(
    fit: list[Recorded], test: list[Recorded], robots: int, results: dict[str, Results]
) -> BoardCalibration:
    """Fit to some recordings, and add the errors on others to the results; returns the fit."""
    joined = BoardReadings(
        *(np.concatenate(columns) for columns in zip(*(one.clear for one in fit), strict=True))
    )
    near = select(joined, joined.poses[:, 0] < MAX_RANGE)
    said = ProgressLine(f"test on {', '.join(one.name for one in test)}")
    said("fitting")
    done = calibrate_board(load_ir_platform("droplet_2016"), near, robots)
    said("solving")
    for one in test:
        data = one.clear
        within = (data.poses[:, 0] > RANGES[0]) & (data.poses[:, 0] < RANGES[1])
        data = select(without_dead(done.model.platform, data, robots)[1], within)
        add(done, data, results)
    print()
    return done


def add(done: BoardCalibration, data: BoardReadings, results: dict[str, Results]) -> None:
    """Add the errors of all methods."""
    model, yaw = done.model, done.model.truth_yaw
    truth = turned(data.poses, yaw[data.receiver], yaw[data.transmitter])
    paper = load_ir_platform("droplet")
    stock = replace(paper, amplitudes=paper.amplitudes[:1])
    estimators = {"stock": MaximumLikelihood(stock), "board": MaximumLikelihood(model.platform)}
    readings = data.readings[:, None]
    for name, estimator in estimators.items():
        gains = pair_gains(model, data, known=done.with_gains) if name == "board" else None
        solutions = estimator.solve(readings, gains)
        gather(results[name], solutions.poses, truth, solutions.covariances)


def gather(result: Results, found: FloatArray, truth: FloatArray, covariances: FloatArray) -> None:
    """Add poses (k, 3), NaN where there is none."""
    solved = np.isfinite(found).all(axis=1)
    errors = found[solved] - truth[solved]
    errors[:, 1:] = wrap_angle(errors[:, 1:])
    result.errors.append(errors)
    result.asked += len(found)
    half = np.linalg.solve(covariances[solved], errors[..., None])[..., 0]
    result.nees.append(np.sum(errors * half, axis=1))


def report(results: dict[str, Results]) -> dict[str, float]:
    """Print the figures; returns them."""
    figures: dict[str, float] = {}
    rows: list[list[Cell]] = []
    for name, result in results.items():
        size = np.abs(np.concatenate(result.errors)) * _UNITS
        medians, tails = np.median(size, axis=0), np.quantile(size, 0.9, axis=0)
        for unit, median, tail in zip(_NAMES, medians, tails, strict=True):
            kind, measure_unit = unit.split("_")
            figures[f"{name}.{unit}"] = float(median)
            figures[f"{name}.{kind}_p90_{measure_unit}"] = float(tail)
        figures[f"{name}.solved_share"] = len(size) / max(result.asked, 1)
        rows.append([name, *map(float, medians), *map(float, tails), figures[f"{name}.solved_share"]])
    nees = np.concatenate(results["board"].nees)
    figures["board.nees_median"] = float(np.median(nees))
    figures["board.nees_beyond_99"] = float(np.mean(nees > _CHI_SQUARE_99))
    head = ["median / 90 %", "cm", "deg", "deg", "90 % cm", "deg", "deg", "solved"]
    print(table(head, rows))
    print(
        f"board: NEES median {figures['board.nees_median']:.2f} (ideal 2.37),"
        f" {100.0 * figures['board.nees_beyond_99']:.1f} % beyond the 99 % bound"
        f" of {results['board'].asked} clear pairs"
    )
    return figures


if __name__ == "__main__":
    sys.exit(main())
