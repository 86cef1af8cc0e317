"""A goal, in map and in the robot's own odometry."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.se2 import wrap_angle


@dataclass(frozen=True)
class Goal:
    """Where a robot should go and look around.

    Attributes:
        number: Counts the goals of a robot, from 1 on.
        position: (2,) in map [m].
        odometry: (2,) the same in the robot's odom frame, if it turns there and drives by its odometry [m].
        stamp_ns: When that was decided.
        pose: (3,) of the robot in map then.
    """

    number: int
    position: FloatArray
    odometry: FloatArray
    stamp_ns: int
    pose: FloatArray


def goal_by_odometry(
    pose: FloatArray, odometry: FloatArray, position: FloatArray, ratio: float
) -> FloatArray:
    """Where a robot that turns and drives by its odometry must go (2,) [m].

    Args:
        pose: (3,) of the robot in map.
        odometry: (3,) the same by odometry.
        position: (2,) where it should come in map [m].
        ratio: True turn over turn by odometry.
    """
    way = position - pose[:2]
    turn = float(wrap_angle(math.atan2(way[1], way[0]) - pose[2])) / ratio
    course = odometry[2] + turn
    there: FloatArray = odometry[:2] + math.hypot(way[0], way[1]) * np.array(
        [math.cos(course), math.sin(course)]
    )
    return there
