"""Absolute fixes: poses of robots in `map`, with or without heading."""

from __future__ import annotations

from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.messages.cdr import POSE_WITH_COVARIANCE, SWARM_FIXES
from swarm_loc_estimator.common.messages.detections import SharedMessage, decode_shared_numbers
from swarm_loc_estimator.common.messages.poses import HEADING_UNKNOWN, decode_fix
from swarm_loc_estimator.common.messages.streams import Messages
from swarm_loc_estimator.filter.measurements import Measurements, select
from swarm_loc_estimator.filter.models import CARTESIAN, MODELS
from swarm_loc_estimator.sensors.sensor import NO_ROWS, DropCounts, Sensor, SensorSettings, SharedTopic
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

NO_COVARIANCE = "fix_without_covariance"
"""Reason to drop a fix without covariance of a robot whose description has no `fix.position_sigma`."""
_FLOOR = np.diag(np.square([5e-4, 5e-4, 1e-3]))  # Least covariance of a fix, whatever it claims [m, m, rad]
_GATE = float(MODELS[CARTESIAN].gate(0.9999))


class FixRows(NamedTuple):
    """Absolute fixes (f,)."""

    robot: IntArray  #: (f,) index of the robot
    stamp_ns: IntArray  #: (f,) time of measurement
    pose: FloatArray  #: (f, 3) x [m], y [m], heading [rad] in `map`; heading NaN: not measured
    #: (f, 3, 3) of the pose; the part of a heading not measured is ignored. With variances 0 of x and y it is
    #: unknown, and that of the swarm description is used.
    covariance: FloatArray
    arrival_ns: IntArray  #: (f,) arrival times


NO_FIXES = FixRows(NO_ROWS, NO_ROWS, np.zeros((0, 3)), np.zeros((0, 3, 3)), NO_ROWS)


def is_unknown(covariance: FloatArray) -> BoolArray:
    """Whether covariances (f, 3, 3) are unset (f,): zeros, or -1 in the first element, as in ROS."""
    first = covariance[:, 0, 0]
    return np.asarray(((first == 0.0) | (first == -1.0)) & (covariance[:, 1, 1] == 0.0))


def has_heading(covariance: FloatArray) -> BoolArray:
    """Whether fixes with covariances (f, 3, 3) may include a heading (f,)."""
    known = (covariance[:, 2, 2] > 0.0) & (covariance[:, 2, 2] < HEADING_UNKNOWN)
    return np.asarray(known | is_unknown(covariance))


def _shared_rows(message: SharedMessage, arrival_ns: IntArray) -> FixRows:
    pose, covariance = message.columns[0], message.columns[1].reshape(-1, 3, 3)
    pose[~has_heading(covariance), 2] = np.nan
    return FixRows(message.robot, message.reading_ns, pose, covariance, arrival_ns)


def about_robots(
    robots: IntArray | int, stamps_ns: IntArray | int, poses: FloatArray, covariances: FloatArray, model: int
) -> Measurements:
    """Absolute measurements (m,) of poses (m, 3) in `map` with covariances (m, 3, 3)."""
    out = Measurements.empty(len(poses))
    out.stamp_ns[:], out.model[:] = stamps_ns, model
    out.received_from[:] = out.target[:] = robots
    out.value[:], out.covariance[:] = poses, covariances
    out.has_heading[:], out.gate[:] = True, _GATE
    return out


def take_out_headings(measurements: Measurements, without: BoolArray) -> None:
    """Remove the headings of those measurements (m,) selected by `without` (m,)."""
    measurements.has_heading[without], measurements.value[without, 2] = False, 0.0
    covariance = measurements.covariance
    covariance[without, 2, :] = covariance[without, :, 2] = [0.0, 0.0, 1.0]


class FixSensor(Sensor):
    """Absolute poses of robots from outside, such as motion capture or AMCL."""

    name, topic, message_type = "fixes", "fix", POSE_WITH_COVARIANCE
    shared = SharedTopic(
        "swarm/fixes", SWARM_FIXES, partial(decode_shared_numbers, widths=(3, 9)), _shared_rows
    )
    in_map = True
    optional = MappingProxyType({"covariance": 0.0})

    decode = staticmethod(decode_fix)

    def __init__(self, swarm: Swarm, settings: SensorSettings, drops: DropCounts) -> None:
        super().__init__(swarm, settings, drops)
        models = [robot.fix for robot in swarm.robots]
        sigmas = [(one.position_sigma, one.position_sigma, one.heading_sigma) for one in models]
        self._default = np.array(sigmas).reshape(-1, 3, 1) ** 2 * np.eye(3)
        self._share = np.array([one.systematic_share for one in models])
        self._gate = MODELS[CARTESIAN].gate([one.gate_probability for one in models])

    @classmethod
    def columns(cls, messages: Messages[Any]) -> FixRows:
        """Convert decoded messages (n,).

        A heading with a NaN, non-positive or very large variance counts as not measured.
        """
        pose = np.array([message.pose for message in messages.decoded], dtype=float).reshape(-1, 3)
        covariance = np.array([message.covariance for message in messages.decoded]).reshape(-1, 3, 3)
        pose[~has_heading(covariance), 2] = np.nan
        return FixRows(messages.robot, messages.stamp_ns, pose, covariance, messages.arrival_ns)

    def measure(self, rows: FixRows) -> Measurements:
        """Convert fixes (f,)."""
        unknown = is_unknown(rows.covariance)
        if unknown.any():
            rows, unknown = self._described(rows, unknown), unknown & (self._default[rows.robot, 0, 0] == 0.0)
            self.drops.add(NO_COVARIANCE, rows.robot[unknown])
            rows = select(rows, ~unknown)
        fixes = about_robots(rows.robot, rows.stamp_ns, rows.pose, rows.covariance + _FLOOR, CARTESIAN)
        fixes.systematic_share[:], fixes.arrival_ns[:] = self._share[rows.robot][:, None], rows.arrival_ns
        fixes.gate[:] = self._gate[rows.robot]
        take_out_headings(fixes, np.isnan(rows.pose[:, 2]))
        return fixes

    def _described(self, rows: FixRows, unknown: BoolArray) -> FixRows:
        """Fill in covariances that are not known from the swarm description."""
        pose, covariance = rows.pose.copy(), rows.covariance.copy()
        covariance[unknown] = self._default[rows.robot[unknown]]
        pose[unknown & (covariance[:, 2, 2] == 0.0), 2] = np.nan
        return rows._replace(pose=pose, covariance=covariance)

    @classmethod
    def expected_of(cls, _robot: Robot) -> bool:
        """Fixes are optional."""
        return False
