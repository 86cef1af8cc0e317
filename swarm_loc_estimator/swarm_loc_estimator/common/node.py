"""Shared parts of all nodes: start and stop, diagnostics, ticks and clocks, publishers of topics."""

from __future__ import annotations

import faulthandler
import gc
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from importlib import import_module
from types import FrameType
from typing import Any, Generic, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, JumpThreshold
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Task
from rclpy.time import Time
from rclpy.time_source import TimeSource
from rosgraph_msgs.msg import Clock as ClockMessage

from swarm_loc_estimator.common.health import Health, Report
from swarm_loc_estimator.common.messages.cdr import EVENT_PACKETS
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.common.ros_parameters import declare_parameters, read_parameters

Parameters = TypeVar("Parameters")

BACKWARDS = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False)
"""Threshold for any backward jump of the clock."""
_EACH_CHANGE = JumpThreshold(
    min_forward=Duration(nanoseconds=1), min_backward=Duration(nanoseconds=-1), on_clock_change=False
)
_WAKE_S = 0.2  # Maximum time until a signal is noticed while the node is idle [s]
_LEAVE_S = 0.7
"""The process ends this long after a signal, even if it is busy. Destroying thousands of publishers takes DDS
20 s, since for each of them it announces all remaining ones."""
_SHUTDOWN_S = 60.0
"""A node that is being destroyed for so long never ends: Fast DDS may wait for a lock in shared memory that
a killed process held."""
_CLOCK_THROTTLE_S = 10.0
_DIAGNOSTICS_PERIOD_S = 1.0
_UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"
"""Name of a node that the middleware has not discovered yet, though its publisher."""


def message_class(message_type: str) -> Any:
    """The class of messages of a type, such as nav_msgs/msg/Odometry.

    Of either of `EVENT_PACKETS` it is the one that nodes use.

    Raises:
        MessageTypeError: It is not installed.
    """
    for candidate in EVENT_PACKETS if message_type in EVENT_PACKETS else (message_type,):
        package, _, name = candidate.replace("/msg/", "/").partition("/")
        with suppress(ImportError, AttributeError):
            return getattr(import_module(f"{package}.msg"), name)
    package = message_type.partition("/")[0]
    raise MessageTypeError(
        f"There is no message type {message_type} here: install ros-jazzy-{package.replace('_', '-')},"
        f" or build the package {package} and source its workspace."
    )


class MessageTypeError(UserError):
    """A message type that is not installed."""


class RosArgumentsError(UserError):
    """The command line has ROS arguments that rcl cannot parse."""


class Stop:
    """Whether SIGINT or SIGTERM has been received.

    rclpy's own handlers invalidate the ROS context at once, so a callback that is publishing would fail.
    Here a signal is only recorded while a node runs; before that it raises KeyboardInterrupt.
    """

    def __init__(self) -> None:
        self.requested = False
        self._is_deferred = False
        self._leaves_at_once = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def defer(self) -> None:
        """From now on only record signals."""
        self._is_deferred = True

    def leave_at_once(self) -> None:
        """From now on end the process soon after a signal, with status 0, whatever it is doing.

        Only for a node with nothing to finish: no robot to stop, no file to close.
        """
        self._leaves_at_once = True

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        if self._leaves_at_once and not self._is_deferred:
            os._exit(0)  # an exception might be swallowed where a compiler or ROS has called back
        if self._leaves_at_once and not self.requested:
            timer = threading.Timer(_LEAVE_S, os._exit, (0,))
            timer.daemon = True
            timer.start()
        self.requested = True
        if not self._is_deferred:
            self._is_deferred = True  # a launch sends the signal twice: to the group and to each process
            raise KeyboardInterrupt


class ConfiguredNode(Node, Generic[Parameters]):
    """A node whose parameters are those of a dataclass.

    Args:
        name: Default name of the node.
        parameters: The dataclass, see `declare_parameters`.
        reads_parameters: Whether to read them now; else `params` is not set.
        node_arguments: Further arguments of `rclpy.node.Node`.

    Attributes:
        params: Values of the parameters.
        health: Drops and problems for the log and /diagnostics.

    Raises:
        UserError: A parameter, or a file that it names, cannot be used.
    """

    def __init__(
        self, name: str, parameters: type[Parameters], *, reads_parameters: bool = True, **node_arguments: Any
    ) -> None:
        Node.__init__(self, name, **node_arguments)
        declare_parameters(self, parameters)
        if reads_parameters:
            self.params = read_parameters(self, parameters)
        self.health = Health(self.get_logger().warning)

    @property
    def status_name(self) -> str:
        """Name of the node with its namespace, as robots' nodes are called in /diagnostics."""
        return f"{self.get_namespace().strip('/')}/{self.get_name()}".lstrip("/")

    def start_diagnostics(self, report: Callable[[], None]) -> None:
        """Advertise /diagnostics and call `report` once per second, which calls `publish_reports`."""
        qos = QoSProfile(depth=10)
        self._diagnostics_publisher = self.create_publisher(DiagnosticArray, "/diagnostics", qos)
        self.create_steady_timer(_DIAGNOSTICS_PERIOD_S, report)

    def publish_reports(self, *reports: Report, stamp: Time | None = None) -> None:
        """Publish reports on /diagnostics, stamped with the node's time unless another one is given."""
        message = DiagnosticArray()
        message.header.stamp = (stamp or self.get_clock().now()).to_msg()
        message.status = [
            DiagnosticStatus(
                level=bytes([report.level]),
                name=report.name,
                message=report.message,
                hardware_id=report.hardware_id,
                values=[KeyValue(key=key, value=str(value)) for key, value in report.values.items()],
            )
            for report in reports
        ]
        self._diagnostics_publisher.publish(message)

    def create_steady_timer(self, period_s: float, callback: Callable[[], None]) -> None:
        """Call back once per period of a clock that runs also while simulated time stands still."""
        self.create_timer(period_s, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def duplicate_publishers(self, topic: str) -> list[str]:
        """Full names of the nodes that publish a topic, one per publisher, if there are several."""
        if self.count_publishers(topic) < 2:  # asking for the names takes four times as long
            return []
        found = self.get_publishers_info_by_topic(topic)
        names = sorted(f"{one.node_namespace.rstrip('/')}/{one.node_name}" for one in found)
        known = not any(name.endswith(_UNKNOWN_NODE) for name in names)
        return names if len(names) > 1 and known else []

    def why_missing(self, topic: str, message_type: str) -> str:
        """Why a topic has no messages, such as " (no publisher)"; "" if it has publishers of its type."""
        types = {one.topic_type for one in self.get_publishers_info_by_topic(topic)}
        if not types:
            return " (no publisher)"
        return "" if message_type in types else f" (published as {', '.join(sorted(types))})"

    def run(self, stop: Stop) -> int:
        """Spin until asked to stop; returns the exit status."""
        return spin(self, stop)


def run_node(name: str, create: Callable[[], ConfiguredNode[Any]], *, leaves_at_once: bool = False) -> int:
    """Create a node, run it until SIGINT or SIGTERM, and destroy it.

    Args:
        name: Name of the executable, for errors.
        create: Creates the node once ROS is initialized.
        leaves_at_once: Whether the process ends soon after a signal whatever it is doing, see `Stop`.

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
        faulthandler.dump_traceback_later(_SHUTDOWN_S, exit=True)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        faulthandler.cancel_dump_traceback_later()


def _start_ros() -> None:
    """Initialize rclpy from the command line, without its signal handlers; see `Stop`."""
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        drop_negative_clocks()
        end_at_task_errors()
    except rclpy_implementation.UnknownROSArgsError as error:
        raise RosArgumentsError(f"ROS does not know the arguments {error}.") from error
    except rclpy_implementation.RCLError as error:
        raise RosArgumentsError(str(error).splitlines()[0]) from error


def spin(node: Node, stop: Stop, *companions: Node) -> int:
    """Handle the events of a node, and of others in its process, until it is asked to stop; returns 0.

    The default executors rebuild their wait set at every wake, which costs 18 us per subscription and
    saturates a core at 50 robots. The EventsExecutor's own `spin()` never returns in Jazzy and delivers
    nothing, and waiting for a future returns only when nothing is left to do, under overload never.
    """
    executor = EventsExecutor()
    nodes = (node, *companions)
    for one in nodes:
        executor.add_node(one)
    gc.freeze()  # what exists now stays: the collector need not scan it again and again
    while not stop.requested:
        executor.spin_once(timeout_sec=_WAKE_S)
    for one in nodes:
        executor.remove_node(one)
    executor.shutdown()
    return 0


class Ticks:
    """Calls back once per period of a node's clock; missed periods are skipped, never queued.

    In simulated time, ticks are at the multiples of the period. rclpy's timers fail there on a busy machine:
    for each /clock that finds a timer due, the EventsExecutor queues the timer without bound, each entry
    advances the timer by a period, and each reset that brings it back queues two more.

    Args:
        node: Has the clock; its executor calls back.
        period_s: Period [s].
        on_tick: The callback.

    Attributes:
        stop: Ends the ticks, but for one that the executor has queued.
    """

    def __init__(self, node: Node, period_s: float, on_tick: Callable[[], None]) -> None:
        self._node = node
        self._on_tick = on_tick
        self._period_ns = round(period_s * 1e9)
        self._ticked = 0
        self._is_due = False
        if node.get_clock().ros_time_is_active:
            jumps = node.get_clock().create_jump_callback(_EACH_CHANGE, post_callback=self._on_time)
            self.stop: Callable[[], object] = jumps.unregister
        else:  # a timer by a clock that nobody sets
            timer = node.create_timer(period_s, on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
            self.stop = partial(node.destroy_timer, timer)

    @property
    def _number(self) -> int:
        """Number of the current period."""
        return int(self._node.get_clock().now().nanoseconds) // self._period_ns

    def _on_time(self, _jump: object) -> None:
        """Let the executor tick once, soon; this callback itself runs inside the setting of the clock."""
        if self._number != self._ticked and not self._is_due and self._node.executor is not None:
            self._is_due = True
            self._node.executor.create_task(self._tick)

    def _tick(self) -> None:
        self._is_due = False
        if self._number == self._ticked:
            return
        self._on_tick()
        self._ticked = self._number  # the callback may have read a newer time


def drop_negative_clocks() -> None:
    """Make all nodes of this process drop a /clock before zero, with a warning.

    rclpy's own callback raises an error for such a message, which ends the node.
    """
    take = TimeSource.clock_callback

    def checked(source: TimeSource, message: ClockMessage) -> None:
        node = source._get_node()  # noqa: SLF001 - the node of a time source is not public
        if message.clock.sec >= 0:
            take(source, message)
        elif node is not None:
            node.get_logger().warning(
                f"dropped a /clock of {message.clock.sec} s, before zero",
                throttle_duration_sec=_CLOCK_THROTTLE_S,
            )

    TimeSource.clock_callback = checked


def end_at_task_errors() -> None:
    """Make an error in a task of an executor print its traceback and end the process with status 1.

    Ticks in simulated time and QoS events are tasks. The EventsExecutor of Jazzy crashes while it reports
    such an error, and the error is lost (ros2/rclpy#1641).
    """
    Task.set_exception = _end


def _end(_task: Task, error: Exception) -> None:
    traceback.print_exception(error)
    raise SystemExit(1) from error
