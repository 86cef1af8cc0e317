"""Subscribe to the inputs of the estimator, and take what has come when a tick asks for it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import partial

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock
from tf2_msgs.msg import TFMessage

from swarm_loc_estimator.common.messages.cdr import nanoseconds
from swarm_loc_estimator.sensors.topics import InputKind, InputTopic
from swarm_loc_msgs.msg import (
    AnonymousDetectionArray,
    BrightnessMatrix,
    MarkerDetectionArray,
    SwarmDetections,
    SwarmFixes,
    SwarmOdometry,
)

DEPTH = 1000
"""So many messages of a topic wait for a tick at most: a busy moment as long as the horizon."""
_SHARED_DEPTH = 500
"""Likewise of a topic with the readings of many robots: its messages are large."""
_MAX_PER_TAKE = 5000
"""What a tick may take of all topics, so that none takes long."""
_MIN_PER_TOPIC = 100
"""Of each topic at least so many: what comes within the usual horizon. With less, an estimator that is once
behind would get ever older data, which cost more to use, and never catch up."""

_MESSAGE_CLASSES = {
    InputKind.ODOMETRY: Odometry,
    InputKind.DETECTIONS: MarkerDetectionArray,
    InputKind.BRIGHTNESS: BrightnessMatrix,
    InputKind.FIXES: PoseWithCovarianceStamped,
    InputKind.AERIAL: AnonymousDetectionArray,
    InputKind.SWARM_ODOMETRY: SwarmOdometry,
    InputKind.SWARM_DETECTIONS: SwarmDetections,
    InputKind.SWARM_FIXES: SwarmFixes,
}
_LOST = {ReliabilityPolicy.RELIABLE: "overload", ReliabilityPolicy.BEST_EFFORT: "lost"}
"""Why messages are missing between two others of a publisher."""
_TF_STATIC = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_MAX_FRAME_LENGTH = 64
"""Longer names of foreign frames are cut."""


class EstimatorInputs:
    """All inputs, as raw bytes: building message objects would cost more than estimating.

    The messages wait in the middleware, which keeps the newest of each topic, and not in the executor, which
    would enter each of them into a queue without bound. What is missing is known by the publishers' numbers.

    Args:
        node: Has the subscriptions; no executor may handle them.
        topics: What to subscribe to; their index is their handle.
        drop: Is told of messages that went missing: reason and count.
    """

    def __init__(self, node: Node, topics: Sequence[InputTopic], drop: Callable[[str, int], None]) -> None:
        self._node = node
        self._topics = topics
        self._drop = drop
        self._newest: list[int | None] = [None] * len(topics)
        self._looked_ns = 0
        self._quota = max(_MIN_PER_TOPIC, _MAX_PER_TAKE // len(topics))
        self._subscriptions = [self._subscribe(k, ReliabilityPolicy.RELIABLE) for k in range(len(topics))]

    def take(self, time_ns: Callable[[], int]) -> list[tuple[int, bytes, int]]:
        """Messages as handle, bytes and arrival, in order of arrival; what is too much now comes next time.

        Args:
            time_ns: Tells the node's time [ns], asked when they have been taken: asked before, it could be
                behind their stamps. By simulated time, all arrive then.
        """
        taken = []
        for handle, subscription in enumerate(self._subscriptions):
            take, message_class = subscription.handle.take_message, subscription.msg_type
            for _ in range(self._quota):
                message = take(message_class, True)
                if message is None:
                    break
                data, info = message
                self._count_gap(handle, info["publication_sequence_number"])
                taken.append((info["received_timestamp"], handle, data))
        taken.sort(key=lambda one: one[0])
        now_ns = time_ns()
        # time must not seem to go back to where it was looked at before
        begin_ns = now_ns if self._node.get_clock().ros_time_is_active else self._looked_ns
        self._looked_ns = now_ns
        return [(handle, data, min(max(at_ns, begin_ns), now_ns)) for at_ns, handle, data in taken]

    def _count_gap(self, handle: int, number: int | None) -> None:
        """Count what is missing between the newest message and this one, if one publisher numbers them."""
        before, self._newest[handle] = self._newest[handle], number
        if before is None or number is None or number <= before + 1:
            return
        if len(self._node.get_publishers_info_by_topic(self._topics[handle].name)) == 1:
            self._drop(_LOST[self._subscriptions[handle].qos_profile.reliability], number - before - 1)

    def _subscribe(self, handle: int, reliability: ReliabilityPolicy) -> Subscription:
        topic = self._topics[handle]
        return self._node.create_subscription(
            _MESSAGE_CLASSES[topic.kind],
            topic.name,
            lambda _: None,
            QoSProfile(depth=_SHARED_DEPTH if topic.kind.stands_for else DEPTH, reliability=reliability),
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=partial(self._follow, handle)),
        )

    def _follow(self, handle: int, _event: object) -> None:
        """Subscribe anew, best effort: that hears every publisher, but what is lost is not sent again."""
        before = self._subscriptions[handle]
        if before.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT:
            return
        self._subscriptions[handle] = self._subscribe(handle, ReliabilityPolicy.BEST_EFFORT)
        self._node.destroy_subscription(before)
        self._node.get_logger().info(
            f"{self._topics[handle].name} is published best effort: what is lost on the way is not sent again"
        )


def newest_time_ns(node: Node) -> int:
    """Time of a node [ns]; in simulated time that of the newest /clock received, handled or not.

    On a busy machine a node may take data that are newer than the /clock that its executor handled last; they
    would seem to come from the future. A clock that jumped back is left to the executor.
    """
    now_ns = int(node.get_clock().now().nanoseconds)
    source = node._time_source  # noqa: SLF001 - rclpy has no public access to it
    subscription = source._clock_sub  # noqa: SLF001
    taken = subscription.handle.take_message(Clock, False) if subscription is not None else None
    if taken is None:
        return now_ns
    newest = taken[0].clock
    if nanoseconds(newest) < now_ns:
        node.executor.create_task(source.clock_callback, taken[0])
        return now_ns
    source.clock_callback(taken[0])
    return int(node.get_clock().now().nanoseconds)


class StaticTransforms:
    """Listens to `/tf_static` for transforms into the estimator's own frames, which tf2 would accept.

    Args:
        node: Has the subscription.
        owned: The frames whose parent only this node may publish.
    """

    def __init__(self, node: Node, owned: Collection[str]) -> None:
        self._parents: dict[str, str] = {}
        self._owned = frozenset(owned)
        # tf2 uses this absolute name, whatever the namespace
        node.create_subscription(TFMessage, "/tf_static", self._on_transforms, _TF_STATIC)

    @property
    def foreign(self) -> list[str]:
        """One sentence for each owned frame to which another node has given a parent."""
        return [
            f"/tf_static has a transform from '{parent}' to '{child}', which only the estimator may publish"
            for child, parent in self._parents.items()
        ]

    def _on_transforms(self, message: TFMessage) -> None:
        for transform in message.transforms:
            child = transform.child_frame_id.lstrip("/")
            if child in self._owned:
                self._parents[child] = transform.header.frame_id.lstrip("/")[:_MAX_FRAME_LENGTH]
