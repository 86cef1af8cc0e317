"""Run a node with parameters: start ROS, handle signals, shut down cleanly, return an exit status."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any, Generic

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from swarm_loc_estimator.common.errors import UserError
from swarm_loc_estimator.common.ros.clock_guard import drop_negative_clocks
from swarm_loc_estimator.common.ros.declare import Parameters, declare_parameters
from swarm_loc_estimator.common.ros.task_errors import end_at_task_errors


class RosArgumentsError(UserError):
    """ROS does not understand the command line; the message is one sentence."""


_WAKE_S = 0.2
"""How long a signal may go unnoticed while nothing happens."""
_LEAVE_S = 0.7
"""So long after a signal a process is gone, even if it is busy or its topics are many: for each of thousands
that is given up, DDS tells everyone of all that are left, which took 20 s for a thousand robots."""


class Stop:
    """Whether SIGINT or SIGTERM has come.

    rclpy's own handlers take the ROS context away at once, and a callback that is just publishing fails. So
    while a node works the signal is only noted; before that it interrupts what is going on.
    """

    def __init__(self) -> None:
        self.requested = False
        self._noted_only = False
        self._leaves_at_once = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def defer(self) -> None:
        """From now on only note signals."""
        self._noted_only = True

    def leave_at_once(self) -> None:
        """From now on end the process soon after a signal, whatever it does then, with status 0.

        Only for a node with nothing to finish: no robot to stop, no file to close.
        """
        self._leaves_at_once = True

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        if self._leaves_at_once and not self._noted_only:
            _leave()  # an exception might be swallowed where a compiler or ROS has called back
        if self._leaves_at_once and not self.requested:
            _leave_soon()
        self.requested = True
        if not self._noted_only:
            self._noted_only = True  # a launch sends it twice: once to all, once to each
            raise KeyboardInterrupt


def _leave_soon() -> None:
    last = threading.Timer(_LEAVE_S, _leave)
    last.daemon = True
    last.start()


def _leave() -> None:
    """End this process as it stands."""
    os._exit(0)


class ConfiguredNode(Node, Generic[Parameters]):
    """A node whose parameters are those of a dataclass.

    Args:
        name: Its name where nobody has chosen another one.
        parameters: The dataclass, see `declare_parameters`.
        node_arguments: Further arguments of `rclpy.node.Node`.

    Attributes:
        chosen: The parameters' values.

    Raises:
        UserError: A parameter, or what it names, cannot be used.
    """

    def __init__(self, name: str, parameters: type[Parameters], **node_arguments: Any) -> None:
        super().__init__(name, **node_arguments)
        self.chosen = declare_parameters(self, parameters)

    def run(self, stop: Stop) -> int:
        """Work until asked to stop; the exit status."""
        return spin(self, stop)


def run_node(name: str, create: Callable[[], ConfiguredNode[Any]], *, leaves_at_once: bool = False) -> int:
    """Create a node, let it work until SIGINT or SIGTERM, and end.

    Args:
        name: Name of the executable, for errors.
        create: Makes the node once ROS is up.
        leaves_at_once: Whether the process ends soon after a signal whatever it does, see `Stop`.

    Returns:
        The exit status: that of the node's `run`, 0 when stopped before, 1 after a mistake of the user.
    """
    node: ConfiguredNode[Any] | None = None
    stop = Stop()
    if leaves_at_once:
        stop.leave_at_once()
    try:
        _start_ros()
        node = create()
        stop.defer()
        return node.run(stop)
    except (UserError, ParameterException) as error:
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
        drop_negative_clocks()
        end_at_task_errors()
    except rclpy_implementation.UnknownROSArgsError as error:
        raise RosArgumentsError(f"ROS does not know the arguments {error}.") from error
    except rclpy_implementation.RCLError as error:
        raise RosArgumentsError(str(error).splitlines()[0]) from error


def spin(node: Node, stop: Stop, *companions: Node) -> int:
    """Handle the events of a node, and of others in its process, until it is asked to stop.

    The executor: the default ones build their wait set anew at every wake, which costs 18 us per subscription
    and saturates a core at 50 robots. The EventsExecutor's own `spin()` is busy for ever in Jazzy and
    delivers nothing, and waiting for a future comes back only when nothing is left to do, under overload
    never.
    """
    executor = EventsExecutor()
    nodes = (node, *companions)
    for one in nodes:
        executor.add_node(one)
    gc.freeze()  # what is there now stays: the collector need not look at it again and again
    while not stop.requested:
        executor.spin_once(timeout_sec=_WAKE_S)
    for one in nodes:
        executor.remove_node(one)
    executor.shutdown()
    return 0
