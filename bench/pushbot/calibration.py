"""Laser calibration from simulated drives at a wall: emulated wheels, spot and tracker, then the two fits."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from bench.shared.common import Cell, new_plot, rms, save_plot, table
from swarm_loc_drivers.sim.pushbot.optics import assembled
from swarm_loc_drivers.sim.pushbot.wall_drive import WallDriveSettings, drive_at_wall
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.laser.calibration import Drive, LaserCalibration, fit_hyperbola

DEPTHS_M = np.linspace(0.1, 2.5, 241)
_MAX_ROW = 125.0


def fit_logarithm(drive: Drive) -> tuple[float, float]:
    """Fit a and b of p = a + b ln d, the relation that the PushBot paper names; for comparison."""
    design = np.column_stack([np.ones_like(drive.depths), np.log(drive.depths)])
    a, b = np.linalg.lstsq(design, drive.rows, rcond=None)[0].tolist()
    return float(a), float(b)


def logarithm_depth(a: float, b: float, row: float) -> float:
    """Depth [m] at a row by the paper's relation."""
    return math.exp((row - a) / b)


class Calibrated(NamedTuple):
    """One robot's calibration."""

    truth: tuple[float, float]  # (p_inf, f b) as it was put together
    found: LaserCalibration  # What the fit gives
    drive: Drive  # What it was fitted to
    hyperbola_cm: FloatArray  # (D,) errors of depths read by it from true rows
    logarithm_cm: FloatArray  # The same by the logarithm of the paper
    window_cm: FloatArray  # (W,) errors of single windows, as the calibration reads them


def calibrate(seed: int) -> Calibrated:
    """Calibrate a robot, and hold both relations against how it was put together."""
    rng = np.random.default_rng(seed)
    built = assembled(rng)
    drive, depths = drive_at_wall(rng, built, WallDriveSettings())
    found = fit_hyperbola(drive)
    a, b = fit_logarithm(drive)
    row_at_infinity, focal_base = built.row
    wanted = DEPTHS_M[row_at_infinity + focal_base / DEPTHS_M < _MAX_ROW]
    rows = row_at_infinity + focal_base / wanted
    read = found.focal_base / (rows - found.row_at_infinity)
    logarithm = np.array([logarithm_depth(a, b, row) for row in rows])
    windows = np.array([found.distance(row, 0.0).distance - found.camera_x for row in drive.rows.tolist()])
    is_read = np.isfinite(windows)
    return Calibrated(
        built.row,
        found,
        drive,
        100.0 * (read - wanted),
        100.0 * (logarithm - wanted),
        100.0 * (windows - depths)[is_read],
    )


def measure_calibration(seeds: int) -> dict[str, float]:
    """Figures of the calibration; prints a table and draws it.

    Args:
        seeds: How many robots.
    """
    robots = [calibrate(seed) for seed in range(seeds)]
    rows: list[list[Cell]] = [
        [seed, one.truth[0], one.found.row_at_infinity, one.truth[1], one.found.focal_base,
         rms(one.hyperbola_cm), rms(one.logarithm_cm), rms(one.window_cm)]
        for seed, one in enumerate(robots)
    ]  # fmt: skip
    head = [
        "robot",
        "p_inf [px]",
        "found",
        "f b [px m]",
        "found",
        "hyperbola [cm]",
        "logarithm [cm]",
        "window [cm]",
    ]
    print(table(head, rows))
    _draw(robots)
    return {
        "calibration.distance_rms_cm": rms(np.concatenate([one.hyperbola_cm for one in robots])),
        "calibration.worst_distance_rms_cm": max(rms(one.hyperbola_cm) for one in robots),
        "calibration.logarithm_rms_cm": rms(np.concatenate([one.logarithm_cm for one in robots])),
        "calibration.window_rms_cm": rms(np.concatenate([one.window_cm for one in robots])),
    }


def _draw(robots: list[Calibrated]) -> None:
    figure, (left, right) = new_plot(2)
    one = robots[0]
    left.plot(100.0 * one.drive.depths, one.drive.rows, ".", ms=2, alpha=0.4, label="tracked")
    left.plot(100.0 * DEPTHS_M, [one.found.row(depth) for depth in DEPTHS_M], label="hyperbola")
    a, b = fit_logarithm(one.drive)
    left.plot(100.0 * DEPTHS_M, a + b * np.log(DEPTHS_M), ls="--", label="logarithm")
    left.set(xlabel="distance [cm]", ylabel="row of the spot [px]", ylim=(60, 128))
    left.legend()
    for robot in robots:
        right.plot(100.0 * DEPTHS_M[-len(robot.hyperbola_cm) :], robot.hyperbola_cm, lw=1)
    right.set(xlabel="distance [cm]", ylabel="error of the hyperbola [cm]", title=f"{len(robots)} robots")
    print(f"wrote {save_plot(figure, 'pushbot_calibration')}")
