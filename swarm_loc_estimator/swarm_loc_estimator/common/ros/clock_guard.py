"""Simulated time that cannot be: a /clock before zero is dropped instead of ending the node."""

from __future__ import annotations

from rclpy.time_source import TimeSource
from rosgraph_msgs.msg import Clock

_THROTTLE_S = 10.0


def drop_negative_clocks() -> None:
    """From now on, no node of this process takes a time before zero from /clock; the log says so.

    rclpy's own callback raises an error for such a message, and whoever spins ends with it.
    """
    take = TimeSource.clock_callback

    def checked(source: TimeSource, message: Clock) -> None:
        node = source._get_node()  # noqa: SLF001 - nothing public tells whose time it is
        if message.clock.sec >= 0:
            take(source, message)
        elif node is not None:
            node.get_logger().warning(
                f"dropped a /clock of {message.clock.sec} s, before zero", throttle_duration_sec=_THROTTLE_S
            )

    TimeSource.clock_callback = checked
