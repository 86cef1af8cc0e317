"""From the command line to a node and back: start, work, and end cleanly however it ends."""

from __future__ import annotations

import gc
import signal
import sys
from collections.abc import Callable
from types import FrameType
from typing import TypeVar

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from swarm_loc_estimator.io.bag_file import BagError
from swarm_loc_estimator.io.swarm_file import SwarmFileError
from swarm_loc_estimator.nodes.parameter_table import ParameterError


class RosArgumentsError(ValueError):
    """ROS does not understand the command line; the message is one sentence."""


KNOWN_ERRORS = (BagError, ParameterError, ParameterException, RosArgumentsError, SwarmFileError)
"""Mistakes of a user, told in one sentence."""

_WAKE_S = 0.2
"""How long a signal may go unnoticed while nothing happens."""

SomeNode = TypeVar("SomeNode", bound=Node)


class Stop:
    """Whether SIGINT or SIGTERM has come.

    rclpy's own handlers take the ROS context away at once, and a callback that is just publishing fails. So
    while a node works the signal is only noted; before that it interrupts what is going on.
    """

    def __init__(self) -> None:
        self.requested = False
        self._noted_only = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def defer(self) -> None:
        """From now on only note signals."""
        self._noted_only = True

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self.requested = True
        if not self._noted_only:
            self._noted_only = True  # a launch sends it twice: once to all, once to each
            raise KeyboardInterrupt


def run_node(name: str, create: Callable[[], SomeNode], work: Callable[[SomeNode, Stop], int]) -> int:
    """Create a node, let it work, and end.

    Args:
        name: Name of the executable, for errors.
        create: Makes the node once ROS is up.
        work: What the node does until it is asked to stop, such as `spin`; returns the exit status.

    Returns:
        The exit status: that of `work`, 0 when stopped before, 1 after a mistake of the user.
    """
    node: SomeNode | None = None
    stop = Stop()
    try:
        _start_ros()
        node = create()
        stop.defer()
        return work(node, stop)
    except KNOWN_ERRORS as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 0
    finally:
        stop.defer()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def _start_ros() -> None:
    """Start rclpy by the arguments of the command line, without its signal handlers; see `Stop`."""
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except rclpy_implementation.UnknownROSArgsError as error:
        raise RosArgumentsError(f"ROS does not know the arguments {error}.") from error
    except rclpy_implementation.RCLError as error:
        raise RosArgumentsError(str(error).splitlines()[0]) from error


def spin(node: Node, stop: Stop, *companions: Node) -> int:
    """Handle the events of a node, and of others in its process, until it is asked to stop.

    The executor: the default ones build their wait set anew at every wake, which costs 18 us per subscription
    and saturates a core at 50 robots. The EventsExecutor's own `spin()` is busy for ever in Jazzy and
    delivers nothing, and its `spin_once` comes back after every message; waiting for what never comes does
    not.
    """
    executor, never = EventsExecutor(), Future()
    nodes = (node, *companions)
    for one in nodes:
        executor.add_node(one)
    gc.freeze()  # what is there now stays: the collector need not look at it again and again
    while not stop.requested:
        executor.spin_until_future_complete(never, timeout_sec=_WAKE_S)
    for one in nodes:
        executor.remove_node(one)
    executor.shutdown()
    return 0
