"""Static transforms on the graph into frames that a node owns."""

from __future__ import annotations

from collections.abc import Collection

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage

_TF_STATIC = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_LONGEST = 64
"""Of a foreign name no more letters are told."""


class StaticTransforms:
    """Listens to `/tf_static` for transforms into a node's own frames, which tf2 would take for theirs.

    Args:
        node: Whose subscription it is.
        owned: The frames whose parent only this node may tell.
    """

    def __init__(self, node: Node, owned: Collection[str]) -> None:
        self._parents: dict[str, str] = {}
        self._owned = frozenset(owned)
        # tf2's publishers know this one absolute name, whatever the namespace
        node.create_subscription(TFMessage, "/tf_static", self._on_transforms, _TF_STATIC)

    @property
    def foreign(self) -> list[str]:
        """One sentence for each owned frame that another node has given a parent."""
        return [
            f"/tf_static has a transform from '{parent}' to '{child}', which only the estimator may publish"
            for child, parent in self._parents.items()
        ]

    def _on_transforms(self, message: TFMessage) -> None:
        for transform in message.transforms:
            child = transform.child_frame_id.lstrip("/")
            if child in self._owned:
                self._parents[child] = transform.header.frame_id.lstrip("/")[:_LONGEST]
