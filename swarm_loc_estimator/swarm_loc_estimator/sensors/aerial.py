"""Anonymous detections of robots in aerial images, identified by `timeline/aerial_images.py`."""

from __future__ import annotations

from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.cdr import ANONYMOUS_DETECTIONS
from swarm_loc_estimator.common.messages.detections import (
    ANONYMOUS_DTYPE,
    DetectionArrayMessage,
    decode_detections,
)
from swarm_loc_estimator.common.messages.streams import Messages
from swarm_loc_estimator.filter.measurements import NOBODY, Measurements
from swarm_loc_estimator.filter.models import ANONYMOUS, MODELS
from swarm_loc_estimator.sensors.fix import about_robots, take_out_headings
from swarm_loc_estimator.sensors.sensor import DropCounts, Sensor, SensorSettings
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

TOO_MANY = "aerial_too_many"  # Reason to drop an aerial image with more detections than MAX_ANONYMOUS
MAX_ANONYMOUS = 2000
_UNKNOWN_VARIANCE = -1.0  # First element of an unknown covariance


class AerialRows(NamedTuple):
    """Anonymous detections of aerial images, a row per detection (d,)."""

    robot: IntArray  #: (d,) always -1, the whole swarm
    stamp_ns: IntArray  #: (d,) exposure times
    number: IntArray  #: (d,) index of the detection in its message
    pose: FloatArray  #: (d, 3) x [m], y [m], heading [rad] in `map`; heading NaN: not measured
    covariance: FloatArray  #: (d, 3, 3) of the pose; a first element of -1: unknown
    arrival_ns: IntArray  #: (d,) arrival times


class AerialSensor(Sensor):
    """Overhead cameras that see robots without identity."""

    name, topic, message_type = "aerial", "aerial/detections", ANONYMOUS_DETECTIONS
    of_each, in_map = False, True
    optional = MappingProxyType({"covariance": _UNKNOWN_VARIANCE})
    unit = ("robot", "stamp_ns")  # a partial image would imply missing robots

    decode = staticmethod(partial(decode_detections, message_type=ANONYMOUS_DETECTIONS))

    def __init__(self, swarm: Swarm, settings: SensorSettings, drops: DropCounts) -> None:
        super().__init__(swarm, settings, drops)
        sigma, heading_sigma = settings.aerial_position_sigma, settings.aerial_heading_sigma
        self._noise = np.diag(np.square([sigma, sigma, heading_sigma]))
        self._gate = float(MODELS[ANONYMOUS].gate(settings.aerial_gate_probability))

    @classmethod
    def fault_of(cls, message: DetectionArrayMessage, map_frame: str) -> str:
        """Reason to drop an image, "" if there is none."""
        too_many = TOO_MANY if message.detections.size > MAX_ANONYMOUS else ""
        return super().fault_of(message, map_frame) or too_many

    @classmethod
    def columns(cls, messages: Messages[Any]) -> AerialRows:
        """Convert decoded messages (n,) to a row per detection."""
        sizes = [message.detections.size for message in messages.decoded]
        found = (message.detections for message in messages.decoded)
        detections = np.concatenate([np.zeros(0, ANONYMOUS_DTYPE), *found])
        robot, stamp_ns, arrival_ns = (
            np.repeat(column, sizes) for column in (messages.robot, messages.stamp_ns, messages.arrival_ns)
        )
        number = np.concatenate([np.zeros(0, dtype=np.int64), *(np.arange(size) for size in sizes)])
        pose = np.column_stack([detections["x"], detections["y"], detections["theta"]]).astype(float)
        covariance = detections["covariance"].astype(float)
        return AerialRows(robot, stamp_ns, number, pose, covariance, arrival_ns)

    def measure(self, rows: AerialRows) -> Measurements:
        """Convert detections (d,)."""
        shown = about_robots(NOBODY, rows.stamp_ns, rows.pose, rows.covariance, ANONYMOUS)
        shown.reading[:], shown.arrival_ns[:] = rows.number, rows.arrival_ns
        shown.gate[:] = self._gate
        shown.covariance[rows.covariance[:, 0, 0] == _UNKNOWN_VARIANCE] = self._noise
        take_out_headings(shown, np.isnan(rows.pose[:, 2]))
        return shown

    @classmethod
    def expected_of(cls, _robot: Robot) -> bool:
        """Aerial images are optional."""
        return False
