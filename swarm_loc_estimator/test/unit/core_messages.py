"""Messages for the tests of the core."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from swarm_loc_estimator.core.arrivals import DetectionRows, FixRows, Messages, OdometryRows
from swarm_loc_estimator.core.estimator import SwarmEstimator
from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.io.cdr import DETECTION_DTYPE

SECOND = 10**9
T0 = 1_000 * SECOND
POSITION, POSE, POSE_TWO = 1, 2, 3


def detection(marker_id: int, pose: FloatArray, content: int = POSE) -> NDArray[np.void]:
    """A detection (1,) of a marker whose pose in the optical frame is (4, 4); its noise is the sensor's."""
    one = np.zeros(1, dtype=DETECTION_DTYPE)
    one["id"], one["content"], one["position"] = marker_id, content, pose[:3, 3]
    one["orientation"] = Rotation.from_matrix(pose[:3, :3]).as_quat()
    one["alternative_position"], one["alternative_orientation"] = one["position"], one["orientation"]
    one["covariance"][0, 0, 0] = -1.0
    return one


def joined(detections: Sequence[NDArray[np.void]]) -> NDArray[np.void]:
    """All detections in one array of the same dtype, which numpy's own concatenation would not keep."""
    together: NDArray[np.void] = np.frombuffer(
        b"".join(one.tobytes() for one in detections), dtype=DETECTION_DTYPE
    ).copy()
    return together


def give_fix(
    estimator: SwarmEstimator, robot: int, stamp_ns: int, pose: ArrayLike, covariance: ArrayLike, now_ns: int
) -> None:
    """Hand in an absolute fix: pose (3,) in `map`, heading NaN if not measured, and covariance (3, 3)."""
    fix = FixRows(
        robot=np.array([robot]),
        stamp_ns=np.array([stamp_ns]),
        pose=np.array([pose], dtype=float),
        covariance=np.array([covariance], dtype=float),
        arrival_ns=np.array([now_ns]),
    )
    estimator.receive(Messages(now_ns, now_ns, fixes=fix))


@dataclass(frozen=True)
class Event:
    """One message: odometry when `pose` is given, else detections."""

    robot: int
    stamp_ns: int
    pose: tuple[float, float, float] | None = None
    detections: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, dtype=DETECTION_DTYPE))

    def give(self, estimator: SwarmEstimator, now_ns: int) -> None:
        """Hand the message in."""
        rows = 0 if self.pose is None else 1
        poses = np.array([self.pose or ()], dtype=float).reshape(rows, 3)
        robot, stamp_ns, arrival_ns = np.array([[self.robot], [self.stamp_ns], [now_ns]], dtype=np.int64)
        odometry = OdometryRows(robot[:rows], stamp_ns[:rows], poses, arrival_ns[:rows])
        each = np.zeros(self.detections.size, dtype=np.int64)
        seen = DetectionRows(robot[each], stamp_ns[each], self.detections, arrival_ns[each])
        estimator.receive(Messages(now_ns, now_ns, odometry, seen))
