"""Odometry: poses of robots in their own odom frames."""

from __future__ import annotations

import math
from functools import partial
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.cdr import ODOMETRY as MESSAGE_TYPE
from swarm_loc_estimator.common.messages.cdr import SWARM_ODOMETRY
from swarm_loc_estimator.common.messages.detections import SharedMessage, decode_shared_numbers
from swarm_loc_estimator.common.messages.poses import decode_odometry
from swarm_loc_estimator.common.messages.streams import PoseColumns, PoseReader
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.sensors import sensor
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


NO_ODOMETRY = OdometryRows.without_twist(sensor.NO_ROWS, sensor.NO_ROWS, np.zeros((0, 3)), sensor.NO_ROWS)


def _shared_rows(message: SharedMessage, arrival_ns: IntArray) -> OdometryRows:
    return OdometryRows.without_twist(message.robot, message.reading_ns, message.columns[0], arrival_ns)


class OdometrySensor(sensor.Sensor):
    """Odometry of robots; its readings are used unchanged."""

    name, topic, message_type = "odometry", "odom", MESSAGE_TYPE
    shared = sensor.SharedTopic(
        "swarm/odom", SWARM_ODOMETRY, partial(decode_shared_numbers, widths=(3,)), _shared_rows
    )
    unit = None
    optional = MappingProxyType({"twist": math.nan})

    def __init__(self, swarm: Swarm, settings: sensor.SensorSettings, drops: sensor.DropCounts) -> None:
        super().__init__(swarm, settings, drops)
        self._stands = np.array([robot.stands for robot in swarm.robots], dtype=bool)

    @classmethod
    def create_reader(cls, topics: int, _known: sensor.Known) -> sensor.Reader:
        """Create a reader that decodes all messages of a batch at once."""
        return PoseReader(topics, decode_odometry, names=2)

    @classmethod
    def nothing(cls) -> OdometryRows:
        """Empty readings."""
        return NO_ODOMETRY

    @classmethod
    def columns(cls, messages: PoseColumns) -> OdometryRows:
        """Convert decoded messages (n,)."""
        rows = OdometryRows(
            messages.robot, messages.stamp_ns, messages.pose, messages.twist, messages.arrival_ns
        )
        return rows if messages.valid.all() else select(rows, messages.valid)

    def measure(self, rows: OdometryRows) -> OdometryRows:
        """Select finite poses of plausible size, of robots with odometry."""
        reasons = {
            "no_odometry": self._stands[rows.robot],
            "odometry_non_finite": ~np.isfinite(rows.pose).all(axis=1),
            "odometry_absurd": ~(np.abs(rows.pose).max(axis=1) <= _MAX_DISTANCE_M),
        }
        good = self.drops.screen(rows.robot, reasons)
        return rows if good.all() else select(rows, good)

    @classmethod
    def expected_of(cls, robot: Robot) -> bool:
        """Whether the robot moves."""
        return not robot.stands
