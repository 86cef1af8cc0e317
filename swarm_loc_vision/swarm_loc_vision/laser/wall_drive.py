"""The drive at a wall that calibrates a laser: what the robot is to do, and what is kept of what it sees."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from swarm_loc_vision.laser.fit import CalibrationError, Drive

_MAX_SAMPLES = 100_000
_MAX_OFF_COURSE = 0.1
"""Turning by more on the way is no drive straight at a wall [rad]."""


@dataclass
class WallDrive:
    """Collects rows of the laser's spot at the way driven since the begin.

    Attributes:
        start_distance: From base_link to the wall at the begin [m].
        stop_distance: Where it ends [m].
        driven: Path so far [m].
    """

    start_distance: float
    stop_distance: float
    driven: float = 0.0
    _begin: tuple[float, float, float] | None = None
    _odometry: deque[tuple[int, float]] = field(default_factory=lambda: deque(maxlen=1000))
    _waiting: deque[tuple[int, float]] = field(default_factory=lambda: deque(maxlen=1000))
    _samples: list[tuple[float, float]] = field(default_factory=list)

    @property
    def is_done(self) -> bool:
        """Whether the robot is where it is to end."""
        return self.driven >= self.start_distance - self.stop_distance

    @property
    def count(self) -> int:
        """Samples so far."""
        return len(self._samples)

    def take_odometry(self, stamp_ns: int, x: float, y: float, theta: float) -> None:
        """Odometry has come.

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
        """The laser's spot was seen at a row [px]; it counts once odometry on both sides of it is there."""
        if np.isfinite(row):
            self._waiting.append((stamp_ns, row))

    def _sample(self, stamp_ns: int, row: float) -> None:
        stamps, driven = np.array(self._odometry, dtype=float).T
        if stamp_ns >= stamps[0] and len(self._samples) < _MAX_SAMPLES:
            self._samples.append((float(np.interp(stamp_ns, stamps, driven)), row))

    def drive(self, start_sigma: float, camera_x: float) -> Drive:
        """What was collected, for the fit."""
        driven, rows = np.array(self._samples, dtype=float).reshape(-1, 2).T
        return Drive(self.start_distance, start_sigma, driven, rows, camera_x)
