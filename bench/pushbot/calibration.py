"""Laser calibration from simulated drives at a wall: emulated wheels, spot and tracker, then the two fits."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bench.common import Cell, new_plot, save_plot, table
from swarm_loc_drivers.sim.common.body import Blinking
from swarm_loc_drivers.sim.pushbot import optics
from swarm_loc_drivers.sim.pushbot.event_camera import CameraNoise, EventCamera, Spot
from swarm_loc_estimator.numerics.arrays import FloatArray
from swarm_loc_vision.core.events.centroid_tracker import CentroidTracker
from swarm_loc_vision.core.events.settings import LightSource, TrackerSettings
from swarm_loc_vision.core.laser.calibration import LaserCalibration
from swarm_loc_vision.core.laser.fit import Drive, fit_hyperbola, fit_logarithm, logarithm_depth

DEPTHS_M = np.linspace(0.1, 2.5, 241)
_STEP_US = 5_000
_SPEED, _NOISE_RATE = 0.1, 5.0
_START_M, _STOP_M = 2.55, 0.15
_START_SIGMA, _WHEEL_NOISE = 0.003, 1e-6
"""The tape at the start [m]; variance of the path per metre [m^2/m]."""
_LASER = LightSource(450.0, is_above=False)
_MAX_ROW = 125.0


class Calibrated(NamedTuple):
    """One robot's calibration.

    Attributes:
        truth: (p_inf, f b) as it was put together.
        found: What the fit gives.
        drive: What it was fitted to.
        hyperbola_cm: (D,) errors of depths read by it from true rows.
        logarithm_cm: Likewise by the logarithm of the paper.
        window_cm: (W,) errors of single windows, read by the hyperbola.
    """

    truth: tuple[float, float]
    found: LaserCalibration
    drive: Drive
    hyperbola_cm: FloatArray
    logarithm_cm: FloatArray
    window_cm: FloatArray


def drive_at_wall(seed: int) -> tuple[Drive, optics.LaserOptics, FloatArray]:
    """A robot's drive: what odometry and tracker tell, how the robot was put together, and true depths."""
    rng = np.random.default_rng(seed)
    built = optics.assembled(rng)
    camera = EventCamera(CameraNoise(noise_rate=_NOISE_RATE), rng)
    tracker = CentroidTracker([_LASER], (128, 128), TrackerSettings())
    wrong_start = _START_SIGMA * rng.standard_normal()
    step_m = _SPEED * _STEP_US * 1e-6
    depth = _START_M - optics.CAMERA_X_M + wrong_start
    stamps, told, truths, seen = [], [0.0], [depth], []
    for step in range(round((_START_M - _STOP_M) / step_m)):
        begin = 1_000_000 + step * _STEP_US
        moved = step_m + np.sqrt(_WHEEL_NOISE * step_m) * rng.standard_normal()
        spot = Spot(
            built.spot(depth), built.spot(depth - moved), optics.spot_brightness(depth), Blinking(2222, 1111)
        )
        depth -= moved
        events = camera.look(begin, begin + _STEP_US, [spot], np.zeros((0, 3)))
        stamps.append(begin)
        told.append(told[-1] + step_m)
        truths.append(depth)
        columns = (events.x.astype(np.uint16), events.y.astype(np.uint16), events.polarity == 0)
        seen += tracker.track(*columns, 1000 * events.time_us)
    stamps.append(stamps[-1] + _STEP_US)
    rows = np.array([(one.stamp_ns * 1e-3, one.v) for report in seen for one in report.sightings])
    driven = np.interp(rows[:, 0], stamps, told)
    depths = np.interp(rows[:, 0], stamps, truths)
    return Drive(_START_M, 0.005, driven, rows[:, 1], optics.CAMERA_X_M), built, depths


def calibrate(seed: int) -> Calibrated:
    """Calibrate a robot, and hold both relations against how it was put together."""
    drive, built, depths = drive_at_wall(seed)
    found = fit_hyperbola(drive)
    a, b = fit_logarithm(drive)
    row_at_infinity, focal_base = built.row
    wanted = DEPTHS_M[row_at_infinity + focal_base / DEPTHS_M < _MAX_ROW]
    rows = row_at_infinity + focal_base / wanted
    read = found.focal_base / (rows - found.row_at_infinity)
    logarithm = np.array([logarithm_depth(a, b, row) for row in rows])
    windows = found.focal_base / (drive.rows - found.row_at_infinity)
    return Calibrated(
        built.row,
        found,
        drive,
        100.0 * (read - wanted),
        100.0 * (logarithm - wanted),
        100.0 * (windows - depths),
    )


def measure_calibration(seeds: int) -> dict[str, float]:
    """Figures of the calibration; prints a table and draws it.

    Args:
        seeds: How many robots.
    """
    robots = [calibrate(seed) for seed in range(seeds)]
    rows: list[list[Cell]] = [
        [seed, one.truth[0], one.found.row_at_infinity, one.truth[1], one.found.focal_base,
         _rms(one.hyperbola_cm), _rms(one.logarithm_cm), _rms(one.window_cm)]
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
        "calibration.distance_rms_cm": _rms(np.concatenate([one.hyperbola_cm for one in robots])),
        "calibration.worst_distance_rms_cm": max(_rms(one.hyperbola_cm) for one in robots),
        "calibration.logarithm_rms_cm": _rms(np.concatenate([one.logarithm_cm for one in robots])),
        "calibration.window_rms_cm": _rms(np.concatenate([one.window_cm for one in robots])),
    }


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


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


if __name__ == "__main__":
    print(measure_calibration(5))
