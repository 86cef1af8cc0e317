"""The drive at a wall that calibrates a laser: the samples that it collects, live or from a bag."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from swarm_loc_estimator import decode_laser
from swarm_loc_estimator.common.messages.cdr import LASER, ODOMETRY, CdrError
from swarm_loc_estimator.common.messages.poses import decode_odometry
from swarm_loc_vision.laser.calibration import CalibrationError, Drive

_MAX_SAMPLES = 100_000
_MAX_OFF_COURSE = 0.1  # A robot that turns by more does not drive straight at a wall [rad]


@dataclass
class WallDrive:
    """Collects rows of the laser's spot with the path driven since the start."""

    start_distance: float  # From base_link to the wall at the start [m]
    stop_distance: float  # From base_link to the wall at the end [m]
    driven: float = 0.0  # Path so far [m]
    _begin: tuple[float, float, float] | None = None
    _odometry: deque[tuple[int, float]] = field(default_factory=lambda: deque(maxlen=1000))
    _waiting: deque[tuple[int, float]] = field(default_factory=lambda: deque(maxlen=1000))
    _samples: list[tuple[float, float]] = field(default_factory=list)

    @property
    def is_done(self) -> bool:
        """Whether the robot has reached `stop_distance`."""
        return self.driven >= self.start_distance - self.stop_distance

    @property
    def count(self) -> int:
        """Samples so far."""
        return len(self._samples)

    def take_odometry(self, stamp_ns: int, x: float, y: float, theta: float) -> None:
        """Add an odometry pose [m, rad].

        Raises:
            CalibrationError: The robot has turned.
        """
        begin = self._begin = self._begin or (x, y, theta)
        turned = abs(np.remainder(theta - begin[2] + np.pi, 2.0 * np.pi) - np.pi)
        if turned > _MAX_OFF_COURSE:
            raise CalibrationError(f"the robot has turned by {turned:.2g} rad on its way to the wall.")
        self.driven = (x - begin[0]) * np.cos(begin[2]) + (y - begin[1]) * np.sin(begin[2])
        self._odometry.append((stamp_ns, self.driven))
        while self._waiting and self._waiting[0][0] <= stamp_ns:
            self._sample(*self._waiting.popleft())

    def take_row(self, stamp_ns: int, row: float) -> None:
        """Add a row of the spot [px]; it is used once there is odometry before and after it."""
        if np.isfinite(row):
            self._waiting.append((stamp_ns, row))

    def _sample(self, stamp_ns: int, row: float) -> None:
        stamps, driven = np.array(self._odometry, dtype=float).T
        if stamp_ns >= stamps[0] and len(self._samples) < _MAX_SAMPLES:
            self._samples.append((float(np.interp(stamp_ns, stamps, driven)), row))

    def drive(self, start_sigma: float, camera_x: float) -> Drive:
        """The samples, for the fit."""
        driven, rows = np.array(self._samples, dtype=float).reshape(-1, 2).T
        return Drive(self.start_distance, start_sigma, driven, rows, camera_x)


def recorded_drive(bag: Path, robot: str, drive: WallDrive) -> WallDrive:
    """Fill a drive from a bag until it is done; returns the drive.

    Args:
        bag: With `<robot>/odom` and `<robot>/laser`; `start_distance` is that at the first odometry.
        robot: Name of the robot; "" for topics without a namespace.
        drive: An empty drive.

    Raises:
        CalibrationError: A topic has no usable message, or the robot turns on its way.
        UserError: The bag cannot be read.
    """
    from swarm_loc_estimator.common.bags.reader import BagReader  # noqa: PLC0415 - a live drive reads no bag

    prefix = f"{robot}/" if robot else ""
    types = {f"{prefix}odom": ODOMETRY, f"{prefix}laser": LASER}
    seen = dict.fromkeys(types, 0)
    with BagReader(bag) as reader:
        for topic, message_type, _, data in reader.messages(types):
            if message_type != types[topic] or drive.is_done:
                continue
            seen[topic] += _take(drive, data, is_laser=message_type == LASER)
    for topic, count in seen.items():
        if not count:
            raise CalibrationError(f"'{bag}' has nothing usable on {topic}.")
    return drive


def _take(drive: WallDrive, data: bytes, *, is_laser: bool) -> bool:
    """Add a message to the drive; whether it could be used."""
    try:
        if is_laser:
            seen = decode_laser(data)
            drive.take_row(seen.stamp_ns, seen.row)
            return math.isfinite(seen.row)
        odometry = decode_odometry(data)
    except CdrError:
        return False
    if not all(map(math.isfinite, odometry.pose)):
        return False
    drive.take_odometry(odometry.stamp_ns, *odometry.pose)
    return True
