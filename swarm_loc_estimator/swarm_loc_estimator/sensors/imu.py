"""Inertial measurement units: turn rates of robots, which replace the turns that the wheels report.

Only the angular velocity is used. The orientation that some IMUs compute drifts like its integral, and
accelerations say nothing about a robot that drives on a floor.
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


class TurnRateRows(NamedTuple):
    """Turn rates (k,)."""

    robot: IntArray  #: (k,) index of the robot
    stamp_ns: IntArray  #: (k,) acquisition stamps
    velocity: FloatArray  #: (k, 3) angular velocity in the frame of the IMU [rad/s]
    #: (k,) turn rate about the vertical, without calibration [rad/s]; before the conversion NaN, -inf: none
    rate: FloatArray
    arrival_ns: IntArray  #: (k,) arrival times


NO_TURN_RATES = TurnRateRows(NO_ROWS, NO_ROWS, np.zeros((0, 3)), np.zeros(0), NO_ROWS)


class TurnRateSensor(Sensor):
    """Gyroscopes of robots; their readings are used for prediction."""

    name, topic, message_type = "imu", "imu", IMU
    only_expected, unit = True, None
    optional = MappingProxyType({"rate": math.nan})

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
        return TurnRateRows(messages.robot, messages.stamp_ns, velocity, rate, messages.arrival_ns)

    def measure(self, rows: TurnRateRows) -> TurnRateRows:
        """Select finite turn rates of robots with an IMU, turned to the vertical."""
        has_none = rows.rate == -np.inf
        rows = rows._replace(rate=np.sum(self._vertical[rows.robot] * rows.velocity, axis=1))
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
