"""Record swarm/poses and /diagnostics, for evaluation only."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.time import Time

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.sensors.topics import InputKind
from swarm_loc_msgs.msg import SwarmPoses

_DEEP = QoSProfile(depth=1000)
_ESTIMATOR = "estimator"
_DROPPED = "dropped: "
_RECEIVED = {f"{kind.topic} received": kind for kind in InputKind}


class Poses(NamedTuple):
    """One message of swarm/poses.

    Attributes:
        stamp_ns: When the poses hold.
        pose: (N, 3) x [m], y [m], theta [rad] in map.
        covariance: (N, 3, 3).
        status: (N,) of `SwarmPose.status`.
    """

    stamp_ns: int
    pose: FloatArray
    covariance: FloatArray
    status: NDArray[np.uint8]


class PoseHistory(NamedTuple):
    """Many messages of swarm/poses; begins like the columns of a `ReplayResult`.

    Attributes:
        stamp_ns: (T,) when the poses hold.
        pose: (T, N, 3) x [m], y [m], theta [rad] in map.
        covariance: (T, N, 3, 3).
        status: (T, N) of `SwarmPose.status`.
    """

    stamp_ns: NDArray[np.int64]
    pose: FloatArray
    covariance: FloatArray
    status: NDArray[np.uint8]


class Recorder(Node):
    """Keeps every message of swarm/poses with its time of reception, and the newest /diagnostics.

    Args:
        node_arguments: Further arguments of `rclpy.node.Node`.

    Attributes:
        raw: Serialized messages in order of reception.
        received_ns: The graph's time at each reception; with /clock it advances in steps of that.
        taken: Stamp of poses -> topic -> messages that the estimator had taken in for them; of those poses
            of which /diagnostics told, about once a second.
        inputs: Messages that it has taken in, of all topics.
        drops: Data that it did not use, by reason.
        diagnostics: How many messages of /diagnostics have come from it.
    """

    def __init__(self, **node_arguments: Any) -> None:
        simulated = Parameter("use_sim_time", value=True)
        super().__init__("recorder", parameter_overrides=[simulated], **node_arguments)
        self.raw: list[bytes] = []
        self.received_ns: list[int] = []
        self._poses: list[Poses] = []
        self.taken: dict[int, dict[str, int]] = {}
        self.inputs = 0
        self.drops: dict[str, int] = {}
        self.diagnostics = 0
        self.create_subscription(SwarmPoses, "swarm/poses", self._on_poses, _DEEP, raw=True)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, _DEEP)

    def poses(self) -> Sequence[Poses]:
        """The numbers of all messages so far, in order of reception; each is read once."""
        self._poses.extend(map(read_poses, self.raw[len(self._poses) :]))
        return self._poses

    def _on_poses(self, data: bytes) -> None:
        self.raw.append(data)
        self.received_ns.append(self.get_clock().now().nanoseconds)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        own = [status for status in message.status if status.name == _ESTIMATOR]
        if not own:  # of another node
            return
        taken = _taken(message.status)
        self.taken[Time.from_msg(message.header.stamp).nanoseconds] = taken
        self.inputs = sum(taken.values())
        self.drops = {
            value.key.removeprefix(_DROPPED): int(value.value)
            for value in own[0].values
            if value.key.startswith(_DROPPED)
        }
        self.diagnostics += 1


def _taken(statuses: Sequence[DiagnosticStatus]) -> dict[str, int]:
    """Topic -> messages that the estimator has taken in, by its statuses: one per robot, and its own."""
    taken = {}
    for status in statuses:
        robot = status.name.removeprefix(_ESTIMATOR).removeprefix(": ")
        for value in status.values:
            if (kind := _RECEIVED.get(value.key)) is not None:
                taken[f"{robot}/{kind.topic}" if robot else kind.topic] = int(value.value)
    return taken


def read_poses(data: bytes) -> Poses:
    """The numbers of a serialized SwarmPoses."""
    message = deserialize_message(data, SwarmPoses)
    stamp = message.header.stamp
    robots = message.robots
    return Poses(
        stamp.sec * 1_000_000_000 + stamp.nanosec,
        np.array([(one.x, one.y, one.theta) for one in robots]).reshape(-1, 3),
        np.array([one.covariance for one in robots]).reshape(-1, 3, 3),
        np.array([one.status for one in robots], dtype=np.uint8),
    )


def read_history(raw: Sequence[bytes]) -> PoseHistory:
    """The numbers of serialized SwarmPoses, of which there is at least one."""
    stamps_ns, *columns = zip(*map(read_poses, raw), strict=True)
    return PoseHistory(np.array(stamps_ns, dtype=np.int64), *map(np.array, columns))
