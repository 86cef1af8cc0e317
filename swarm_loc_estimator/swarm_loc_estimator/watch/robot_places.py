"""Frames of published positions: ground truth, goals, aerial detections with identities."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from swarm_loc_estimator.common.messages.cdr import CdrError, nanoseconds
from swarm_loc_estimator.common.messages.poses import decode_pose_stamped
from swarm_loc_estimator.watch.page import Frame, aerial_frame, places_frame
from swarm_loc_msgs.msg import AnonymousDetectionArray, RobotIdentities, RobotIdentity

_OLD_NS = 500_000_000
_IMAGES = 8
_NEWEST_ONLY = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Matches reliable and best-effort publishers, and never blocks one."""


class Places:
    """The newest place of each robot of one kind.

    Args:
        kind: Kind of the frames.
        keeps: Whether a place is valid until the next one, at any age.
        drop: Called with the reason of a dropped message.
    """

    def __init__(self, kind: str, drop: Callable[[str], None], *, keeps: bool) -> None:
        self._kind = kind
        self._drop = drop
        self._keeps = keeps
        self._newest: dict[int, tuple[int, tuple[float, float, float]]] = {}
        self._sent_ns = -1

    def take(self, robot: int, data: bytes) -> None:
        """Store a serialized PoseStamped of a robot."""
        try:
            message = decode_pose_stamped(data)
        except CdrError:
            self._drop("malformed")
            return
        if not np.isfinite(message.pose).all():
            self._drop("not_finite")
            return
        self._newest[robot] = (message.stamp_ns, message.pose)

    def frame(self) -> Frame | None:
        """All places; None if none has changed since the last call."""
        newest_ns = max((stamp_ns for stamp_ns, _ in self._newest.values()), default=-1)
        if newest_ns == self._sent_ns:
            return None
        self._sent_ns = newest_ns
        limit_ns = 0 if self._keeps else newest_ns - _OLD_NS
        shown = {robot: pose for robot, (at_ns, pose) in self._newest.items() if at_ns >= limit_ns}
        return places_frame(self._kind, newest_ns, [*shown], np.array([*shown.values()]).reshape(-1, 3))

    def clear(self) -> None:
        """Clear all places."""
        self._newest.clear()
        self._sent_ns = -1


class AerialNames:
    """Joins anonymous detections with their identities, by the stamp of their image.

    Args:
        index_of: Robot name -> index.
    """

    def __init__(self, index_of: dict[str, int]) -> None:
        self._index_of = index_of
        self._images: dict[int, AnonymousDetectionArray] = {}

    def detections(self, message: AnonymousDetectionArray) -> Frame:
        """The frame of an image without identities."""
        stamp_ns = nanoseconds(message.header.stamp)
        self._images[stamp_ns] = message
        while len(self._images) > _IMAGES:
            del self._images[next(iter(self._images))]
        return self._frame(stamp_ns, ())

    def identities(self, message: RobotIdentities) -> Frame | None:
        """The frame of one of the newest images with identities; None for an older image."""
        stamp_ns = nanoseconds(message.header.stamp)
        if stamp_ns not in self._images:
            return None
        return self._frame(stamp_ns, message.identities)

    def _frame(self, stamp_ns: int, identities: Iterable[RobotIdentity]) -> Frame:
        seen = self._images[stamp_ns].detections
        position = np.array([(one.x, one.y) for one in seen]).reshape(-1, 2)
        robot, probability = np.full(len(seen), -1), np.zeros(len(seen))
        for one in identities:
            if 0 <= one.detection < len(seen) and one.name in self._index_of:
                robot[one.detection] = self._index_of[one.name]
                probability[one.detection] = one.probability
        return aerial_frame(stamp_ns, position, robot, probability)


class NewestMessages:
    """Topics of one type, one per robot; each is subscribed to once it has a publisher.

    Args:
        node: Owns the subscriptions; no executor may handle them.
        message_class: Type of the topics.
        topics: Names of the topics, in the order of the robots.
    """

    def __init__(self, node: Node, message_class: type, topics: Sequence[str]) -> None:
        self._node = node
        self._class = message_class
        self._topics = {node.resolve_topic_name(topic): index for index, topic in enumerate(topics)}
        self._subscriptions: dict[int, Subscription] = {}

    def look_for_publishers(self, published: Mapping[str, object]) -> None:
        """Subscribe to the topics that have a publisher by now."""
        for topic, index in self._topics.items():
            if index not in self._subscriptions and topic in published:
                self._subscriptions[index] = self._node.create_subscription(
                    self._class, topic, _unused, _NEWEST_ONLY, raw=True
                )

    @property
    def subscriptions(self) -> frozenset[Subscription]:
        """Subscriptions that no executor may handle."""
        return frozenset(self._subscriptions.values())

    def take(self, use: Callable[[int, bytes], None]) -> None:
        """Return the newest message of each robot with a message since the last call."""
        for index, subscription in self._subscriptions.items():
            taken = subscription.handle.take_message(self._class, True)
            if taken is not None:
                use(index, taken[0])


def _unused(_data: bytes) -> None:
    """No executor calls back."""
