"""From the command line to a node and back: start, spin, and end cleanly however it ends."""

from __future__ import annotations

import sys
from collections.abc import Callable

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from swarm_loc_estimator.io.bag_file import BagError
from swarm_loc_estimator.io.swarm_file import SwarmFileError
from swarm_loc_estimator.nodes.parameter_table import ParameterError

KNOWN_ERRORS = (BagError, ParameterError, ParameterException, SwarmFileError)
"""Mistakes of a user, told in one sentence."""

_WAKE_S = 0.5


def run_node(name: str, create: Callable[[], Node], work: Callable[[Node], int] | None = None) -> int:
    """Create a node, let it work, and end.

    Args:
        name: Name of the executable, for errors.
        create: Makes the node once ROS is up.
        work: What the node does, returning the exit status; spins until a signal when left out.

    Returns:
        The exit status: that of `work`, 0 after SIGINT or SIGTERM, 1 after a mistake of the user.
    """
    node: Node | None = None
    try:
        rclpy.init()
    except rclpy_implementation.RCLError as error:
        print(f"{name}: {str(error).splitlines()[0]}", file=sys.stderr)
        return 1
    try:
        node = create()
        return (work or spin)(node)
    except KNOWN_ERRORS as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 1
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def spin(node: Node) -> int:
    """Handle a node's events until a signal.

    The executor: the default ones build their wait set anew at every wake, which costs 18 us per subscription
    and saturates a core at 50 robots. Of the EventsExecutor only `spin_once` with a timeout works in Jazzy;
    its `spin()` is busy for ever and delivers nothing.
    """
    executor = EventsExecutor()
    executor.add_node(node)
    try:
        while node.context.ok():
            executor.spin_once(timeout_sec=_WAKE_S)
    finally:
        executor.remove_node(node)
        executor.shutdown()
    return 0
