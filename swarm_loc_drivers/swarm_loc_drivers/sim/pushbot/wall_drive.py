"""A simulated drive at a wall that calibrates a laser: wheels, spot and noise, and the tracker itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from swarm_loc_drivers.sim.pushbot.event_camera import Blinking, CameraNoise, EventCamera, Spot
from swarm_loc_drivers.sim.pushbot.optics import CAMERA_X_M, LaserOptics, assembled_robots, spot_brightness
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.event_encoding import Events
from swarm_loc_vision.events.tracker import LightSource, LightTracker, TrackerSettings
from swarm_loc_vision.laser.calibration import Drive, fit_hyperbola, save_laser

_STEP_US = 5_000
_BLINKING, _LASER = Blinking(2222, 1111), LightSource(450.0, is_above=False)
_START_SIGMA = 0.005


@dataclass(frozen=True)
class WallDriveSettings:
    """A drive towards a wall, and its errors."""

    start: float = 2.55  # From base_link to the wall at the begin [m]
    stop: float = 0.15  # From base_link to the wall at the end [m]
    speed: float = 0.1  # [m/s]
    start_sigma: float = 0.003  # Of the tape at the start [m]
    wheel_noise: float = 1e-6  # Variance of the path per metre [m^2/m]
    noise_rate: float = 5.0  # Noise events of a pixel [1/s]


def drive_at_wall(
    rng: np.random.Generator, built: LaserOptics, settings: WallDriveSettings
) -> tuple[Drive, FloatArray]:
    """Odometry and tracked spots of a drive, and the true depths (N,) [m] at the same instants."""
    camera = EventCamera(CameraNoise(noise_rate=settings.noise_rate), rng, built.sensor)
    tracker = LightTracker([_LASER], (128, 128), TrackerSettings())
    step_m = settings.speed * _STEP_US * 1e-6
    depth = settings.start - CAMERA_X_M + settings.start_sigma * rng.standard_normal()
    steps = round((settings.start - settings.stop) / step_m)
    moved = step_m + np.sqrt(settings.wheel_noise * step_m) * rng.standard_normal(steps)
    depths = depth - np.concatenate([[0.0], np.cumsum(moved)])
    stamps_us = 1_000_000 + _STEP_US * np.arange(steps + 1)
    seen = []
    for step in range(steps):
        begin, end = depths[step : step + 2].tolist()
        spot = Spot(built.spot(begin), built.spot(end), spot_brightness(end), _BLINKING)
        one = camera.look(int(stamps_us[step]), int(stamps_us[step + 1]), [spot], np.zeros((0, 3)))
        columns = one.x.astype(np.uint16), one.y.astype(np.uint16), one.polarity == 0, 1000 * one.time_us
        seen += tracker.track(Events(*columns))
    rows = np.array([(1e-3 * one.stamp_ns, one.v) for report in seen for one in report.sightings])
    driven = np.interp(rows[:, 0], stamps_us, step_m * np.arange(steps + 1))
    measured = Drive(settings.start, _START_SIGMA, driven, rows[:, 1], CAMERA_X_M)
    return measured, np.interp(rows[:, 0], stamps_us, depths)


def calibrate_lasers(robots: Sequence[str], seed: int, folder: Path) -> None:
    """Write the laser calibrations of a world's robots, from drives at a wall, to FOLDER/ROBOT.yaml."""
    rng = np.random.default_rng([seed, 1])
    for name, built in zip(robots, assembled_robots(seed, len(robots)), strict=True):
        drive, _ = drive_at_wall(rng, built, WallDriveSettings(speed=0.25))
        save_laser(folder / f"{name}.yaml", fit_hyperbola(drive))
