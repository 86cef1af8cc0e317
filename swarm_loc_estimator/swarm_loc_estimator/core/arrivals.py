"""What has arrived, in columns: as the robots sent it, and as the estimator takes it in."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.core.measurements import MEASUREMENT_DTYPE, MeasurementArray
from swarm_loc_estimator.core.se2 import FloatArray

IntArray = NDArray[np.int64]


class OdometryRows(NamedTuple):
    """Odometry messages (k,) in order of arrival.

    Attributes:
        robot: (k,) index of the robot.
        stamp_ns: (k,) acquisition stamps.
        pose: (k, 3) x [m], y [m], yaw [rad] in the robot's own odom frame.
        arrival_ns: (k,).
    """

    robot: IntArray
    stamp_ns: IntArray
    pose: FloatArray
    arrival_ns: IntArray

    def chosen(self, rows: slice | NDArray[np.bool_]) -> OdometryRows:
        """Some of them."""
        return OdometryRows(self.robot[rows], self.stamp_ns[rows], self.pose[rows], self.arrival_ns[rows])

    @classmethod
    def joined(cls, parts: Sequence[OdometryRows]) -> OdometryRows:
        """All of them, one part after the other."""
        return parts[0] if len(parts) == 1 else cls(*map(np.concatenate, zip(*parts, strict=True)))


class DetectionRows(NamedTuple):
    """What cameras saw, a row per detection (d,), in order of arrival.

    Attributes:
        robot: (d,) index of the robot that carries the camera.
        stamp_ns: (d,) exposure times.
        detection: (d,) structured, see `SightingConverter.convert`.
        arrival_ns: (d,).
    """

    robot: IntArray
    stamp_ns: IntArray
    detection: NDArray[np.void]
    arrival_ns: IntArray

    def chosen(self, rows: slice | NDArray[np.bool_]) -> DetectionRows:
        """Some of them."""
        return DetectionRows(
            self.robot[rows], self.stamp_ns[rows], self.detection[rows], self.arrival_ns[rows]
        )


class Messages(NamedTuple):
    """Messages as the robots sent them, of a stretch in which time does not go back.

    Attributes:
        odometry: Of all robots.
        detections: Of all cameras.
        begin_ns: Arrival of the first message.
        end_ns: Arrival of the last one.
        malformed: How many more were no messages of their type.
    """

    odometry: OdometryRows
    detections: DetectionRows
    begin_ns: int
    end_ns: int
    malformed: int = 0


class Arrivals(NamedTuple):
    """Data that has been looked through and converted, in order of arrival.

    Attributes:
        odometry: Finite poses.
        measurements: (m,) with finite values and sound covariances.
        measured_ns: (m,) when they arrived.
    """

    odometry: OdometryRows
    measurements: MeasurementArray
    measured_ns: IntArray

    def until_each(self, stamps_ns: IntArray) -> Iterator[Arrivals]:
        """What arrived before the first instant (s,), between it and the next, ..., and from the last on."""
        rows = [0, *np.searchsorted(self.odometry.arrival_ns, stamps_ns).tolist(), self.odometry.robot.size]
        measured = [0, *np.searchsorted(self.measured_ns, stamps_ns).tolist(), self.measured_ns.size]
        for k in range(len(stamps_ns) + 1):
            some = slice(measured[k], measured[k + 1])
            yield Arrivals(
                self.odometry.chosen(slice(rows[k], rows[k + 1])),
                self.measurements[some],
                self.measured_ns[some],
            )


NO_MEASUREMENTS: MeasurementArray = np.zeros(0, dtype=MEASUREMENT_DTYPE)
