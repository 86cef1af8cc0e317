"""The time of a node when it has taken data by itself, and not when its executor last handled a /clock."""

from __future__ import annotations

from rclpy.node import Node
from rosgraph_msgs.msg import Clock


def newest_time_ns(node: Node) -> int:
    """The time of a node [ns], in simulated time by the newest /clock that has come, handled or not.

    A busy machine may let a node wait between a /clock that it handles and data that it takes: these would
    seem to come from the future. Time that goes back waits for its turn, as a /clock that is handled does.
    """
    now_ns = int(node.get_clock().now().nanoseconds)
    source = node._time_source  # noqa: SLF001 - rclpy has no way to ask it
    subscription = source._clock_sub  # noqa: SLF001
    taken = subscription.handle.take_message(Clock, False) if subscription is not None else None
    if taken is None:
        return now_ns
    told = taken[0].clock
    if told.sec * 1_000_000_000 + told.nanosec < now_ns:
        node.executor.create_task(source.clock_callback, taken[0])
        return now_ns
    source.clock_callback(taken[0])
    return int(node.get_clock().now().nanoseconds)
