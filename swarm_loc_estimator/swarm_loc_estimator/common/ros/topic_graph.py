"""Who publishes a topic, as the graph knows: publishers beside the one that should be, and wrong types."""

from __future__ import annotations

from rclpy.node import Node

_UNKNOWN = "_NODE_NAME_UNKNOWN_"
"""How the middleware calls a node whose publisher it has met before the node itself."""


class TopicGraph:
    """What a node knows of the publishers of topics.

    Args:
        node: Whose names are resolved.
    """

    def __init__(self, node: Node) -> None:
        self._node = node

    def rivals(self, topic: str) -> list[str]:
        """Full names of the nodes that publish a topic, one for each publisher, if there is more than one."""
        if self._node.count_publishers(topic) < 2:  # asking who they are takes four times as long
            return []
        found = self._node.get_publishers_info_by_topic(topic)
        names = sorted(f"{one.node_namespace.rstrip('/')}/{one.node_name}" for one in found)
        known = not any(name.endswith(_UNKNOWN) for name in names)
        return names if len(names) > 1 and known else []

    def why_missing(self, topic: str, message_type: str) -> str:
        """Why nothing comes on a topic, such as " (no publisher)"; "" if its publishers look well."""
        types = {one.topic_type for one in self._node.get_publishers_info_by_topic(topic)}
        if not types:
            return " (no publisher)"
        return "" if message_type in types else f" (published as {', '.join(sorted(types))})"
