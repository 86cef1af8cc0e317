"""The newest message of many topics, taken when asked for: messages that nobody looks at cost no callback."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

_NEWEST_ONLY = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Hears reliable publishers and best-effort ones, and never makes one wait."""


class NewestMessages:
    """Topics of one type, one of each robot; subscribed to once somebody publishes them.

    Args:
        node: Has the subscriptions; no executor may handle them.
        message_class: Their type.
        topics: Their names, in the order of the robots.
    """

    def __init__(self, node: Node, message_class: type, topics: Sequence[str]) -> None:
        self._node = node
        self._class = message_class
        self._topics = {node.resolve_topic_name(topic): index for index, topic in enumerate(topics)}
        self._subscriptions: dict[int, Subscription] = {}

    def look_for_publishers(self, published: Mapping[str, object]) -> None:
        """Subscribe to those of the topics that are published by now."""
        for topic, index in self._topics.items():
            if index not in self._subscriptions and topic in published:
                self._subscriptions[index] = self._node.create_subscription(
                    self._class, topic, _unused, _NEWEST_ONLY, raw=True
                )

    @property
    def subscriptions(self) -> frozenset[Subscription]:
        """Those that no executor may handle."""
        return frozenset(self._subscriptions.values())

    def take(self, use: Callable[[int, bytes], None]) -> None:
        """Hand over the newest message of each robot that has sent one since."""
        for index, subscription in self._subscriptions.items():
            taken = subscription.handle.take_message(self._class, True)
            if taken is not None:
                use(index, taken[0])


def _unused(_data: bytes) -> None:
    """No executor calls back."""
