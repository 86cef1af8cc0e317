"""Inertial measurement units: turn rates of robots, which replace the turns that the wheels report.

Angular velocities are used. Of the orientation that some IMUs compute, the heading drifts like their
integral; its tilt, by gravity, says which of their parts turns a robot that leans, as on a ramp or on legs.
"""

from __future__ import annotations

import math
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.cdr import IMU
from swarm_loc_estimator.common.messages.streams import Messages
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.sensors.sensor import NO_ROWS, DropCounts, Sensor, SensorSettings
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

_MAX_RATE = 200.0  # Larger turn rates are no measurements [rad/s]
_MAX_TILT = 0.5  # An orientation that leans by more against the mount is none, or of other axes [rad]


class TurnRateRows(NamedTuple):
    """Turn rates (k,)."""

    robot: IntArray  #: (k,) index of the robot
    stamp_ns: IntArray  #: (k,) acquisition stamps
    velocity: FloatArray  #: (k, 3) angular velocity in the frame of the IMU [rad/s]
    #: (k,) turn rate about the vertical, without calibration [rad/s]; before the conversion NaN, -inf: none
    rate: FloatArray
    up: FloatArray  #: (k, 3) the vertical in the frame of the IMU, by its orientation; NaN: not known
    arrival_ns: IntArray  #: (k,) arrival times


NO_TURN_RATES = TurnRateRows(NO_ROWS, NO_ROWS, np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), NO_ROWS)


class TurnRateSensor(Sensor):
    """Gyroscopes of robots; their readings are used for prediction."""

    name, topic, message_type = "imu", "imu", IMU
    only_expected, unit = True, None
    optional = MappingProxyType({"rate": math.nan, "up": math.nan})

    def __init__(self, swarm: Swarm, settings: SensorSettings, drops: DropCounts) -> None:
        super().__init__(swarm, settings, drops)
        # last row of Ry(pitch) Rx(roll): what rates about the axes of the IMU turn about the vertical
        tilts = [(robot.imu.pitch, robot.imu.roll) for robot in swarm.robots]
        rows = [(-math.sin(p), math.cos(p) * math.sin(r), math.cos(p) * math.cos(r)) for p, r in tilts]
        self._vertical = np.array(rows).reshape(-1, 3)

    @classmethod
    def columns(cls, messages: Messages[Any]) -> TurnRateRows:
        """Convert decoded messages (n,); a first covariance of -1 says that there is no rate."""
        rates = [
            (one.angular_velocity.x, one.angular_velocity.y, one.angular_velocity.z)
            for one in messages.decoded
        ]
        velocity = np.array(rates, dtype=float).reshape(-1, 3)
        # the convention of sensor_msgs
        has_none = [message.angular_velocity_covariance[0] == -1.0 for message in messages.decoded]
        rate = np.where(has_none, -np.inf, np.nan)
        up = np.array([_vertical(message) for message in messages.decoded], dtype=float).reshape(-1, 3)
        return TurnRateRows(messages.robot, messages.stamp_ns, velocity, rate, up, messages.arrival_ns)

    def measure(self, rows: TurnRateRows) -> TurnRateRows:
        """Select finite turn rates of robots with an IMU, turned to the vertical."""
        has_none = rows.rate == -np.inf
        vertical = self._vertical[rows.robot]
        leans = np.sum(vertical * rows.up, axis=1) > math.cos(_MAX_TILT)  # False for NaN
        vertical = np.where(leans[:, None], rows.up, vertical)
        rows = rows._replace(rate=np.sum(vertical * rows.velocity, axis=1))
        reasons = {
            "imu_no_rate": has_none,
            "imu_non_finite": ~np.isfinite(rows.rate),
            "imu_absurd": ~(np.abs(rows.rate) <= _MAX_RATE),
        }
        good = self.drops.screen(rows.robot, reasons)
        return rows if good.all() else select(rows, good)

    @classmethod
    def expected_of(cls, robot: Robot) -> bool:
        """Whether the description says that the robot has an IMU."""
        return robot.imu.is_used


def _vertical(message: Any) -> tuple[float, float, float]:
    """The vertical in the frame of an IMU; NaN if its first covariance is -1 or it has no orientation."""
    q = message.orientation
    norm = q.x**2 + q.y**2 + q.z**2 + q.w**2
    if message.orientation_covariance[0] == -1.0 or not 0.5 < norm < 2.0:  # False for NaN
        return math.nan, math.nan, math.nan
    x, y = 2.0 * (q.x * q.z - q.w * q.y) / norm, 2.0 * (q.y * q.z + q.w * q.x) / norm
    return x, y, 1.0 - 2.0 * (q.x**2 + q.y**2) / norm
