"""Range, bearing and heading of Droplets from brightness matrices, beside what theory allows.

    make bench-droplet
    make bench-droplet ARGS="--poses 500"

Bearings and headings are uniform, readings have one count of noise and saturate at 255. Beside errors stands
the Cramer-Rao bound, which no unbiased estimate betters. "mismatch" are robots whose elements differ by 10 %,
before and after their gains were calibrated from 200 exchanges of the two, poses unknown and known.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bench.droplet.cramer_rao import information
from bench.shared.common import Cell, options_of, plot_curves, table, write_figures
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.infrared.gains import Exchanges, estimate_gains
from swarm_loc_estimator.infrared.likelihood import MaximumLikelihood
from swarm_loc_estimator.infrared.search import IrOutcome, IrSolutions
from swarm_loc_estimator.swarm.ir_board import IrPlatform, PairGains, load_ir_platform

CENTIMETRES = (6, 8, 10, 12, 13, 14, 15, 16, 18, 20, 24, 28)
POSES = 12000
MISMATCH, CALIBRATION, COUPLES = 0.1, 200, 12
"""How much elements of each of so many couples of robots differ, and their exchanges to calibrate with."""
_TIMED, _REPEATS = 200, 20
_SEED = 3
_UNITS = np.array([100.0, np.degrees(1.0), np.degrees(1.0)])


@dataclass(frozen=True)
class Errors:
    """Errors of one estimator at some ranges."""

    mean: FloatArray  # (3,) mean absolute error [cm, deg, deg]
    rms: FloatArray  # (3,) likewise root mean square
    worst: FloatArray  # (3,) largest
    nees: float  # Ideally 3
    found: float  # Share of poses that there are

    @classmethod
    def of(cls, solutions: IrSolutions, poses: FloatArray) -> Errors:
        """Of solutions for true poses (k, 3)."""
        found = solutions.outcomes == IrOutcome.FOUND
        errors = solutions.poses[found] - poses[found]
        errors[:, 1:] = wrap_angle(errors[:, 1:])
        solved = np.linalg.solve(solutions.covariances[found], errors[..., None])[..., 0]
        size = np.abs(errors) * _UNITS
        return cls(
            size.mean(axis=0),
            np.sqrt(np.mean(size**2, axis=0)),
            size.max(axis=0),
            float(np.mean(np.sum(errors * solved, axis=1))),
            float(found.mean()),
        )


def random_poses(rng: np.random.Generator, count: int, low_cm: float, high_cm: float) -> FloatArray:
    """(count, 3), all uniform."""
    angles = rng.uniform(-np.pi, np.pi, (count, 2))
    return np.column_stack([0.01 * rng.uniform(low_cm, high_cm, count), angles])


def readings_of(
    platform: IrPlatform, poses: FloatArray, rng: np.random.Generator, gains: PairGains | None = None
) -> FloatArray:
    """Readings (k, modes, n, n) with noise, cut at saturation."""
    bright = expected_brightness(platform, poses, gains)
    noisy = bright + platform.noise * rng.standard_normal(bright.shape)
    return np.asarray(np.minimum(noisy, platform.saturation))


def accuracy(poses_each: int) -> dict[str, float]:
    """Errors at all ranges, of elements that are alike; prints, draws, and returns figures."""
    platform = replace(load_ir_platform("droplet"), element_sigma=0.0)
    estimator = MaximumLikelihood(platform)
    figures: dict[str, float] = {}
    rows: list[list[Cell]] = []
    curves: dict[str, list[FloatArray]] = {"ml": [], "bound": []}
    # at each range: errors, and the bound of Cramer and Rao
    for centimetres in CENTIMETRES:
        rng = np.random.default_rng([centimetres, _SEED])
        poses = random_poses(rng, poses_each, centimetres, centimetres)
        readings = readings_of(platform, poses, rng)
        bound = np.diagonal(np.linalg.inv(information(platform, poses)), axis1=1, axis2=2)
        limit = np.sqrt(np.mean(bound, axis=0)) * _UNITS
        errors = Errors.of(estimator.solve(readings), poses)
        ratio = errors.rms / limit
        figures |= named(f"ml.r{centimetres}", errors.mean)
        figures[f"ml.r{centimetres}.nees"] = errors.nees
        figures[f"ml.r{centimetres}.rmse_over_crb"] = float(ratio.max())
        values = (*errors.mean, errors.nees, errors.worst[0], *ratio)
        rows.append([centimetres, *map(float, values)])
        curves["ml"].append(errors.rms)
        curves["bound"].append(limit)
        print(f"\rat {centimetres:2} cm", end="", flush=True)
    # table and plot
    head = ["R cm", "ml cm", "deg", "deg", "NEES", "worst cm", "rms/CRB", "", ""]
    print("\rmean errors of range, bearing, heading\n" + table(head, rows))
    units = ("range [cm]", "bearing [deg]", "heading [deg]")
    shown = {
        label: np.array(curves[key]) for key, label in (("ml", "likelihood"), ("bound", "Cramer-Rao bound"))
    }
    plot_curves(
        "droplet",
        *(
            ("distance [cm]", f"rms error of {unit}", CENTIMETRES, {k: v[:, place] for k, v in shown.items()})
            for place, unit in enumerate(units)
        ),
        style=".-",
        yscale="log",
    )
    # all ranges together
    rng = np.random.default_rng(7)
    poses = random_poses(rng, 3 * poses_each, 6, 28)
    errors = Errors.of(estimator.solve(readings_of(platform, poses, rng)), poses)
    together = {
        "worst_range_cm": float(errors.worst[0]),
        "found_6_28": errors.found,
        "nees_6_28": errors.nees,
    }
    print(table(["likelihood, 6-28 cm", "value"], list(together.items())))
    return figures | {f"ml.{name}": value for name, value in together.items()}


def mismatch(poses_each: int) -> dict[str, float]:
    """The likelihood at 20 cm of elements that differ: unknown, calibrated, and known gains."""
    platform = load_ir_platform("droplet")
    estimator = MaximumLikelihood(platform)
    cases: dict[str, list[Errors]] = {}
    for couple in range(COUPLES):
        rng = np.random.default_rng([20, couple])
        factors = np.exp(MISMATCH * rng.standard_normal((2, 2, platform.n)))
        poses = random_poses(rng, poses_each, 20, 20)
        known = pairs(factors, np.zeros(poses_each, dtype=np.int64))
        readings = readings_of(platform, poses, rng, known)
        gains: dict[str, PairGains | None] = {"mismatch": None, "mismatch_true_gains": known}
        for name, poses_known in (("mismatch_calibrated", False), ("mismatch_calibrated_with_poses", True)):
            fit = estimate_gains(platform, 2, recorded(platform, factors, rng, known=poses_known))
            gains[name] = PairGains.of([fit.gains[0]] * poses_each, [fit.gains[1]] * poses_each)
        for name, one in gains.items():
            cases.setdefault(name, []).append(Errors.of(estimator.solve(readings, one), poses))
        print(f"\rmismatch: robots {couple + 1} of {COUPLES}", end="", flush=True)
    figures: dict[str, float] = {}
    rows: list[list[Cell]] = []
    for name, ones in cases.items():
        mean = np.mean([one.mean for one in ones], axis=0)
        nees = float(np.mean([one.nees for one in ones]))
        rows.append([name, *map(float, mean), nees])
        figures |= named(f"ml.{name}.r20", mean)
        figures[f"ml.{name}.r20.nees"] = nees
    print("\r" + table(["20 cm, elements differ by 10 %", "cm", "deg", "deg", "NEES"], rows))
    return figures


def named(prefix: str, mean: FloatArray) -> dict[str, float]:
    """Figures of mean errors (3,)."""
    units = ("range_cm", "bearing_deg", "heading_deg")
    return {f"{prefix}.{unit}": float(value) for unit, value in zip(units, mean, strict=True)}


def pairs(factors: FloatArray, receiver: NDArray[np.int64]) -> PairGains:
    """Exact gains of exchanges of two robots, from (2, 2, n) of sensors and emitters of each."""
    return PairGains(factors[0, receiver], factors[1, 1 - receiver], np.zeros((len(receiver), 4)))


def recorded(
    platform: IrPlatform, factors: FloatArray, rng: np.random.Generator, *, known: bool
) -> Exchanges:
    """Exchanges of two robots to calibrate with."""
    receiver = rng.integers(0, 2, CALIBRATION)
    poses = random_poses(rng, CALIBRATION, 8, 28)
    readings = readings_of(platform, poses, rng, pairs(factors, receiver))
    saturation = np.full(readings.shape[:2], platform.saturation)
    told = poses if known else np.full_like(poses, np.nan)
    return Exchanges(receiver, 1 - receiver, readings, saturation, told)


def times() -> dict[str, float]:
    """Microseconds per solve, of one pair at a time and of many: the best of many tries."""
    figures: dict[str, float] = {}
    rows: list[list[Cell]] = []
    alike, differing = (replace(load_ir_platform("droplet"), element_sigma=s) for s in (0.0, MISMATCH))
    rng = np.random.default_rng(3)
    readings = readings_of(alike, random_poses(rng, _TIMED, 6, 28), rng)
    solvers = {"ml": MaximumLikelihood(alike), "ml.gains_unknown": MaximumLikelihood(differing)}
    for name, estimator in solvers.items():
        single = best_time(estimator, np.split(readings, _TIMED))
        many = best_time(estimator, [readings])
        figures |= {f"{name}.us_per_solve": single, f"{name}.us_per_solve_of_many": many}
        rows.append([name, single, many])
    print(table(["microseconds per solve", "one pair a call", f"{_TIMED} pairs a call"], rows))
    return figures


def best_time(estimator: MaximumLikelihood, calls: Sequence[FloatArray]) -> float:
    """Microseconds per pair of the fastest of some runs through all calls."""
    runs = []
    for _ in range(_REPEATS):
        begun = time.perf_counter()
        for readings in calls:
            estimator.solve(readings)
        runs.append(time.perf_counter() - begun)
    return 1e6 * min(runs) / sum(len(readings) for readings in calls)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = options_of(__doc__, arguments, poses=(POSES, "per range; of mismatch a twelfth per couple"))
    figures = accuracy(options.poses)
    figures |= mismatch(options.poses // COUPLES)
    figures |= times()
    print(f"figures: {write_figures('droplet', figures)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
