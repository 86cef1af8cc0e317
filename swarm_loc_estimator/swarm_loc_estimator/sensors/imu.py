"""Inertial measurement units: turn rates of robots, which replace the turns that the wheels report.

Only the angular velocity is used. The orientation that some IMUs compute drifts like its integral, and
accelerations say nothing about a robot that drives on a floor.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.cdr import IMU, decode, nanoseconds
from swarm_loc_estimator.common.messages.streams import EachReader, MessageBatch, MessageColumns
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.sensors.sensor import (
    NO_ROWS,
    Converter,
    DropCounts,
    InputKind,
    Known,
    Sensor,
    SensorSettings,
)
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

_MAX_RATE = 200.0  # Larger turn rates are no measurements [rad/s]


class TurnRateRows(NamedTuple):
    """Turn rates (k,)."""

    robot: IntArray  # (k,) index of the robot
    stamp_ns: IntArray  # (k,) acquisition stamps
    velocity: FloatArray  # (k, 3) angular velocity in the frame of the IMU [rad/s]
    # (k,) turn rate about the vertical, without calibration [rad/s]; NaN before the conversion
    rate: FloatArray
    arrival_ns: IntArray  # (k,) arrival times


NO_TURN_RATES = TurnRateRows(NO_ROWS, NO_ROWS, np.zeros((0, 3)), np.zeros(0), NO_ROWS)


class ImuMessage(NamedTuple):
    """The used part of a sensor_msgs/Imu: angular velocity [rad/s]."""

    stamp_ns: int
    frame_id: str
    velocity: tuple[float, float, float]


def decode_imu(data: bytes) -> ImuMessage:
    """Read a sensor_msgs/Imu.

    Raises:
        CdrError: The bytes are not one whole message.
    """
    message = decode(data, IMU)
    header, turn = message.header, message.angular_velocity
    unknown = message.angular_velocity_covariance[0] == -1.0  # the convention of sensor_msgs
    velocity = (math.nan,) * 3 if unknown else (turn.x, turn.y, turn.z)
    return ImuMessage(nanoseconds(header.stamp), header.frame_id, velocity)


def _columns(
    found: MessageColumns[ImuMessage], batch: MessageBatch, robot: IntArray, _known: Known
) -> tuple[TurnRateRows, Mapping[str, int]]:
    velocity = np.array([message.velocity for message in found.messages], dtype=float).reshape(-1, 3)
    valid = found.valid
    rate = np.full(len(velocity), np.nan)
    return TurnRateRows(robot[valid], found.stamp_ns[valid], velocity, rate, batch.log_ns[valid]), {}


def _create_converter(swarm: Swarm, _settings: SensorSettings, drops: DropCounts) -> Converter:
    """Create a filter for finite turn rates of robots with an IMU, which turns them to the vertical."""
    models = [robot.imu for robot in swarm.robots]
    # last row of Ry(pitch) Rx(roll): what rates about the axes of the IMU turn about the vertical
    vertical = np.array(
        [
            [
                -math.sin(one.pitch),
                math.cos(one.pitch) * math.sin(one.roll),
                math.cos(one.pitch) * math.cos(one.roll),
            ]
            for one in models
        ]
    ).reshape(-1, 3)

    def valid(rows: TurnRateRows) -> TurnRateRows:
        rows = rows._replace(rate=np.sum(vertical[rows.robot] * rows.velocity, axis=1))
        reasons = {
            "imu_non_finite": ~np.isfinite(rows.rate),
            "imu_absurd": ~(np.abs(rows.rate) <= _MAX_RATE),
        }
        good = drops.screen(rows.robot, reasons)
        return rows if good.all() else select(rows, good)

    return valid


def _has_imu(robot: Robot) -> bool:
    return robot.imu.is_used


_OWN = InputKind(
    "imu", "imu", IMU, lambda n, _: EachReader(n, decode_imu), _columns, _has_imu, only_expected=True
)
TURN_RATES = Sensor("imu", NO_TURN_RATES, (_OWN,), _create_converter, unit=None)
"""The sensor, see `registry.SENSORS`."""
