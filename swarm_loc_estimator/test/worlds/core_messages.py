"""Messages for the tests of the core."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.bags.writer import typestore
from swarm_loc_estimator.common.messages.detections import ANONYMOUS_DTYPE, DETECTION_DTYPE
from swarm_loc_estimator.common.messages.poses import encode_odometry
from swarm_loc_estimator.sensors.aerial import AerialRows
from swarm_loc_estimator.sensors.camera import DetectionRows
from swarm_loc_estimator.sensors.fix import FixRows
from swarm_loc_estimator.sensors.inputs import Batch
from swarm_loc_estimator.sensors.odometry import OdometryRows
from swarm_loc_estimator.timeline.estimator import Estimator

SECOND = 10**9
T0 = 1_000 * SECOND
POSITION, POSE, POSE_TWO = 1, 2, 3


def big_endian(data: bytes, message_type: str) -> bytes:
    store = typestore()
    message = store.deserialize_cdr(data, message_type)
    return bytes(store.serialize_cdr(message, message_type, little_endian=False))


def odometry_bytes(
    robot: str, stamp_ns: int, pose: ArrayLike = (0.0, 0.0, 0.0), frame: str | None = None
) -> bytes:
    """A nav_msgs/Odometry of a robot, in `frame` if that is another than it should be."""
    poses, frames = np.reshape(pose, (1, 3)), (frame or f"{robot}/odom", f"{robot}/base_link")
    return encode_odometry(*frames, np.array([stamp_ns]), poses, np.zeros((1, 3)))[0]


def detection(marker_id: int, pose: FloatArray, content: int = POSE) -> NDArray[np.void]:
    """A detection (1,) of a marker whose pose in the optical frame is (4, 4); its noise is the sensor's."""
    one = np.zeros(1, dtype=DETECTION_DTYPE)
    one["id"], one["content"], one["position"] = marker_id, content, pose[:3, 3]
    one["orientation"] = quaternion(pose[:3, :3])
    one["alternative_position"], one["alternative_orientation"] = one["position"], one["orientation"]
    one["covariance"][0, 0, 0] = -1.0
    return one


def quaternion(rotation: FloatArray) -> list[float]:
    """The unit quaternion [x, y, z, w] of a rotation matrix (3, 3)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.tolist()
    rows = (  # of 4 q q^T: each is the quaternion but for its length
        (1.0 + xx - yy - zz, xy + yx, zx + xz, zy - yz),
        (xy + yx, 1.0 - xx + yy - zz, yz + zy, xz - zx),
        (zx + xz, yz + zy, 1.0 - xx - yy + zz, yx - xy),
        (zy - yz, xz - zx, yx - xy, 1.0 + xx + yy + zz),
    )
    longest = max(range(4), key=lambda k: rows[k][k])
    length = math.hypot(*rows[longest])
    return [part / length for part in rows[longest]]


def joined(detections: Sequence[NDArray[np.void]]) -> NDArray[np.void]:
    """All detections in one array of the same dtype, which numpy's own concatenation would not keep."""
    together: NDArray[np.void] = np.frombuffer(
        b"".join(one.tobytes() for one in detections), dtype=DETECTION_DTYPE
    ).copy()
    return together


def give_fix(
    estimator: Estimator, robot: int, stamp_ns: int, pose: ArrayLike, covariance: ArrayLike, now_ns: int
) -> None:
    """Hand in an absolute fix: pose (3,) in `map`, heading NaN if not measured, and covariance (3, 3)."""
    fix = FixRows(
        robot=np.array([robot]),
        stamp_ns=np.array([stamp_ns]),
        pose=np.array([pose], dtype=float),
        covariance=np.array([covariance], dtype=float),
        arrival_ns=np.array([now_ns]),
    )
    estimator.receive(Batch.of(now_ns, now_ns, fixes=fix))


@dataclass(frozen=True)
class Event:
    """One message: odometry when `pose` is given, else detections, by the robot or from above."""

    robot: int
    stamp_ns: int
    pose: tuple[float, float, float] | None = None
    detections: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, dtype=DETECTION_DTYPE))
    aerial: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, dtype=ANONYMOUS_DTYPE))

    def give(self, estimator: Estimator, now_ns: int) -> None:
        """Hand the message in."""
        give(estimator, [(now_ns, self)])


def give(estimator: Estimator, arrivals: Sequence[tuple[int, Event]]) -> None:
    """Hand in messages (arrival, event) in order of their arrivals, as a node does at a tick."""
    estimator.receive(batch_of(arrivals))


def batch_of(arrivals: Sequence[tuple[int, Event]]) -> Batch:
    """Messages (arrival, event) in order of their arrivals."""
    moved = [(e.robot, e.stamp_ns, now_ns, e.pose) for now_ns, e in arrivals if e.pose is not None]
    seen = [(e.robot, e.stamp_ns, now_ns) for now_ns, e in arrivals for _ in range(e.detections.size)]
    rows: dict[str, Any] = {}
    if moved:
        *columns, poses = zip(*moved, strict=True)
        robot, stamp_ns, arrival_ns = np.array(columns, dtype=np.int64)
        rows["odometry"] = OdometryRows.without_twist(
            robot, stamp_ns, np.array(poses, dtype=float), arrival_ns
        )
    if seen:
        robot, stamp_ns, arrival_ns = np.array(list(zip(*seen, strict=True)), dtype=np.int64)
        detections = joined([event.detections for _, event in arrivals])
        rows["detections"] = DetectionRows(robot, stamp_ns, detections, arrival_ns)
    images = [(now_ns, event) for now_ns, event in arrivals if event.aerial.size]
    if images:
        rows["aerial"] = _aerial_rows(images)
    return Batch(arrivals[0][0], arrivals[-1][0], rows)


def _aerial_rows(images: Sequence[tuple[int, Event]]) -> AerialRows:
    """The rows of aerial images (arrival, event)."""
    sizes = [event.aerial.size for _, event in images]
    shown = np.concatenate([event.aerial for _, event in images])
    return AerialRows(
        robot=np.full(shown.size, -1),
        stamp_ns=np.repeat([event.stamp_ns for _, event in images], sizes),
        number=np.concatenate([np.arange(size) for size in sizes]),
        pose=np.column_stack([shown["x"], shown["y"], shown["theta"]]),
        covariance=shown["covariance"].copy(),
        arrival_ns=np.repeat([now_ns for now_ns, _ in images], sizes),
    )
