"""Raw proximity values against distance: a typical e-puck before a white wall, not a calibration.

The points are those of the platform's simulation model and published driver (cyberbotics/epuck_ros2).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from swarm_loc_estimator.common.arrays import FloatArray

_DISTANCE_M = np.array([0.0, 0.005, 0.01, 0.015, 0.02, 0.03, 0.04, 0.05, 0.06])
_RAW = np.array([4095.0, 2133.33, 1465.73, 601.46, 383.84, 234.93, 158.03, 120.0, 104.09])

MIN_RANGE_M = 0.005
MAX_RANGE_M = 0.06
FIELD_OF_VIEW = 0.26
"""Opening of a sensor's cone [rad]."""


def raw_of_distance(distance_m: ArrayLike) -> FloatArray:
    """Raw values (...) of a wall at distances (...) [m]; past the table's end that of free space."""
    raw: FloatArray = np.interp(np.asarray(distance_m, dtype=float), _DISTANCE_M, _RAW)
    return raw


def range_of_raw(raw: ArrayLike) -> FloatArray:
    """Ranges (...) [m] of raw values (...); by REP 117 +inf when nothing is near, -inf when too close."""
    raw = np.asarray(raw, dtype=float)
    distance = np.interp(raw, _RAW[::-1], _DISTANCE_M[::-1])
    distance = np.where(raw <= _RAW[-1], np.inf, distance)
    return np.where(distance < MIN_RANGE_M, -np.inf, distance)
