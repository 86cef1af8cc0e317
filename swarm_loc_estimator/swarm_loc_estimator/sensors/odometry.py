"""Odometry: poses of robots in their own odom frames."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.cdr import ODOMETRY as MESSAGE_TYPE
from swarm_loc_estimator.common.messages.cdr import SWARM_ODOMETRY
from swarm_loc_estimator.common.messages.detections import SharedMessage, decode_shared_numbers
from swarm_loc_estimator.common.messages.poses import decode_odometry
from swarm_loc_estimator.common.messages.streams import MessageBatch, PoseColumns, PoseReader
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.sensors.sensor import (
    NO_ROWS,
    Converter,
    DropCounts,
    InputKind,
    Known,
    Sensor,
    SensorSettings,
    shared_kind,
)
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

_MAX_DISTANCE_M = 1e6


class OdometryRows(NamedTuple):
    """Odometry messages (k,)."""

    robot: IntArray  #: (k,) index of the robot
    stamp_ns: IntArray  #: (k,) acquisition stamps
    pose: FloatArray  #: (k, 3) x [m], y [m], yaw [rad] in the robot's own odom frame
    #: (k, 3) velocity forward and left [m/s] and turn rate [rad/s] of base_link; NaN: not known
    twist: FloatArray
    arrival_ns: IntArray  #: (k,) arrival times

    @classmethod
    def without_twist(
        cls, robot: IntArray, stamp_ns: IntArray, pose: FloatArray, arrival_ns: IntArray
    ) -> OdometryRows:
        """Messages of which only the poses are known."""
        return cls(robot, stamp_ns, pose, np.full(pose.shape, np.nan), arrival_ns)


NO_ODOMETRY = OdometryRows.without_twist(NO_ROWS, NO_ROWS, np.zeros((0, 3)), NO_ROWS)


def _columns(
    found: PoseColumns, batch: MessageBatch, robot: IntArray, _known: Known
) -> tuple[OdometryRows, Mapping[str, int]]:
    rows = OdometryRows(robot, found.stamp_ns, found.pose, found.twist, batch.log_ns)
    return rows if found.valid.all() else select(rows, found.valid), {}


def _shared_rows(message: SharedMessage, arrival_ns: IntArray) -> OdometryRows:
    return OdometryRows.without_twist(message.robot, message.reading_ns, message.columns[0], arrival_ns)


def _create_converter(swarm: Swarm, _settings: SensorSettings, drops: DropCounts) -> Converter:
    """Create a filter for finite poses of plausible size, of robots with odometry."""
    stands = np.array([robot.stands for robot in swarm.robots], dtype=bool)

    def valid(rows: OdometryRows) -> OdometryRows:
        reasons = {
            "no_odometry": stands[rows.robot],
            "odometry_non_finite": ~np.isfinite(rows.pose).all(axis=1),
            "odometry_absurd": ~(np.abs(rows.pose).max(axis=1) <= _MAX_DISTANCE_M),
        }
        good = drops.screen(rows.robot, reasons)
        return rows if good.all() else select(rows, good)

    return valid


def _moves(robot: Robot) -> bool:
    return not robot.stands


_OWN = InputKind(
    "odometry", "odom", MESSAGE_TYPE, lambda n, _: PoseReader(n, decode_odometry, names=2), _columns, _moves
)
_decode_shared = partial(decode_shared_numbers, widths=(3,))
_SHARED = shared_kind(_OWN, "swarm/odom", SWARM_ODOMETRY, _decode_shared, _shared_rows, NO_ODOMETRY)
ODOMETRY = Sensor("odometry", NO_ODOMETRY, (_OWN, _SHARED), _create_converter, unit=None)
"""The sensor, see `registry.SENSORS`."""
