"""Shared parts of all nodes: parameters, start and stop, diagnostics, clocks, and doc/lifecycle.md."""

from __future__ import annotations

import faulthandler
import gc
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from importlib import import_module
from types import FrameType
from typing import Any, Generic, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, JumpThreshold
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Task
from rclpy.time import Time
from rclpy.time_source import TimeSource
from rosgraph_msgs.msg import Clock as ClockMessage

from swarm_loc_estimator.common.health import Health, Level, Report
from swarm_loc_estimator.common.messages.cdr import EVENT_PACKETS
from swarm_loc_estimator.common.parameters import (
    ParameterError,
    ParameterSpec,
    UserError,
    Value,
    from_values,
    parameter_specs,
)

Parameters = TypeVar("Parameters")


def read_parameters(node: Node, cls: type[Parameters], *, read_only: bool = True) -> Parameters:
    """The values of declared parameters, which are checked; see `read_parameter`."""
    values = {spec.name: read_parameter(node, spec, read_only=read_only) for spec in parameter_specs(cls)}
    return from_values(cls, values)


def _refuse_clock_change(parameters: Sequence[Parameter]) -> SetParametersResult:
    """Refuse a change of use_sim_time: stamps of the two clocks are not comparable."""
    changed = any(parameter.name == "use_sim_time" for parameter in parameters)
    reason = "use_sim_time is read at the start only: restart the node." if changed else ""
    return SetParametersResult(successful=not changed, reason=reason)


def read_parameter(node: Node, spec: ParameterSpec, *, read_only: bool) -> Value:
    """The value of a declared parameter, which has its type and descriptor from now on.

    rclpy would refuse a value with a traceback that lacks the unit, so it is checked while the parameter has
    a dynamic type; raises ParameterError.
    """
    value = spec.checked(node.get_parameter(spec.name).value)
    kind, number = _TYPES[type(spec.default)], spec.number
    node.set_parameters([Parameter(spec.name, kind, value)])
    about = ParameterDescriptor(type=kind.value, description=spec.doc, read_only=read_only)
    about.additional_constraints = spec.range_text
    if number is not None and isinstance(spec.default, int):
        about.integer_range = [IntegerRange(from_value=int(number.low), to_value=int(number.high))]
    elif number is not None:
        about.floating_point_range = [FloatingPointRange(from_value=number.low, to_value=number.high)]
    node.set_descriptor(spec.name, about)
    return value


_TYPES = {
    bool: Parameter.Type.BOOL,
    int: Parameter.Type.INTEGER,
    float: Parameter.Type.DOUBLE,
    str: Parameter.Type.STRING,
    tuple: Parameter.Type.STRING_ARRAY,
}


BACKWARDS = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False)
"""Threshold for any backward jump of the clock."""
_EACH_CHANGE = JumpThreshold(
    min_forward=Duration(nanoseconds=1), min_backward=Duration(nanoseconds=-1), on_clock_change=False
)
_WAKE_S = 0.2  # Maximum time until a signal is noticed while the node is idle [s]
_LEAVE_S = 0.7  # After a signal, even if busy: to destroy thousands of publishers takes DDS 20 s
_SHUTDOWN_S = 60.0  # Then it never ends: Fast DDS may wait for a lock of a killed process
_CLOCK_THROTTLE_S = 10.0
_DIAGNOSTICS_PERIOD_S = 1.0
_UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"  # Of a node not discovered yet, though its publisher was


def message_class(message_type: str) -> Any:
    """The class of messages of a type; of `EVENT_PACKETS` that which nodes use. Raises MessageTypeError."""
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


class Stop:
    """Whether SIGINT or SIGTERM has been received; before a node runs they raise KeyboardInterrupt.

    rclpy's own handlers invalidate the ROS context at once, so a callback that is publishing would fail.
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
        """From now on end the process soon after a signal, with status 0: a node with nothing to finish."""
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

    Without `reads_parameters` they are not read, and `params` is not set. The name is the default one; other
    arguments are those of `rclpy.node.Node`. Raises UserError if a parameter or its file cannot be used.
    """

    def __init__(
        self, name: str, parameters: type[Parameters], *, reads_parameters: bool = True, **node_arguments: Any
    ) -> None:
        Node.__init__(self, name, **node_arguments)
        self.add_on_set_parameters_callback(_refuse_clock_change)
        for spec in parameter_specs(parameters):  # any value is taken until they are read
            self.declare_parameter(spec.name, spec.default, ParameterDescriptor(dynamic_typing=True))
        if reads_parameters:
            self.params = read_parameters(self, parameters)  # Values of the parameters
        self.health = Health(self.get_logger().warning)  # Drops and problems for the log and /diagnostics

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
    """Create a node once ROS is initialized, run it until SIGINT or SIGTERM, and destroy it.

    Errors have the name, that of the executable; `leaves_at_once`: see `Stop`. Returns the exit status: that
    of the node's `run`, 0 when stopped before, 1 after a mistake of the user.
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
    except (UserError, ParameterException, NameValidationException) as error:
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
        raise UserError(f"ROS does not know the arguments {error}.") from error
    except rclpy_implementation.RCLError as error:
        raise UserError(str(error).splitlines()[0]) from error


def spin(node: Node, stop: Stop, *companions: Node) -> int:
    """Handle the events of a node, and of others in its process, until it is asked to stop; returns 0.

    The default executors rebuild their wait set at every wake: 18 us per subscription. The EventsExecutor's
    `spin()` never returns in Jazzy, and waiting for a future returns only when nothing is left to do.
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
    """Calls back once per period [s] of a node's clock; missed periods are skipped, never queued.

    In simulated time, ticks are at multiples of the period. For each /clock that finds one of rclpy's timers
    due, the EventsExecutor queues it without bound, and each reset that brings it back queues two more.
    """

    def __init__(self, node: Node, period_s: float, on_tick: Callable[[], None]) -> None:
        self._node = node
        self._on_tick = on_tick
        self._period_ns = round(period_s * 1e9)
        self._ticked = 0
        self._is_due = False
        if node.get_clock().ros_time_is_active:
            jumps = node.get_clock().create_jump_callback(_EACH_CHANGE, post_callback=self._on_time)
            # Ends the ticks, but for one that the executor has queued
            self.stop: Callable[[], object] = jumps.unregister
        else:  # a timer by a clock that nobody sets
            timer = node.create_timer(period_s, on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
            self.stop = partial(node.destroy_timer, timer)

    @property
    def _number(self) -> int:
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
    """Make all nodes of this process drop a /clock before zero; an error of rclpy would end them."""
    take = TimeSource.clock_callback

    def checked(source: TimeSource, message: ClockMessage) -> None:
        node = source._get_node()  # noqa: SLF001 - the node of a time source is not public
        if message.clock.sec >= 0:
            take(source, message)
        elif node is not None:
            said = f"dropped a /clock of {message.clock.sec} s, before zero"
            node.get_logger().warning(said, throttle_duration_sec=_CLOCK_THROTTLE_S)

    TimeSource.clock_callback = checked


def end_at_task_errors() -> None:
    """Make an error in a task of an executor, as of ticks and QoS events, end the process with a traceback.

    The EventsExecutor of Jazzy crashes while it reports such an error, which is lost (ros2/rclpy#1641).
    """

    def end(_task: Task, error: Exception) -> None:
        traceback.print_exception(error)
        raise SystemExit(1) from error

    Task.set_exception = end


class ManagedNode(LifecycleNodeMixin, ConfiguredNode[Parameters]):
    """A node that reads its parameters when it is configured, and works while it is active.

    What a transition has made, attributes as well as publishers, subscriptions and timers, exists until the
    opposite transition. An executor may still handle events that it had queued before: callbacks that need
    what is gone ask `is_active`. The parameters have the flag `autostart`; if it cannot be used, the
    constructor raises UserError.
    """

    def __init__(self, name: str, parameters: type[Parameters], **node_arguments: Any) -> None:
        ConfiguredNode.__init__(self, name, parameters, reads_parameters=False, **node_arguments)
        self._cls = parameters
        self._specs = {spec.name: spec for spec in parameter_specs(parameters)}
        self._starts_itself = read_parameter(self, self._specs["autostart"], read_only=False)
        LifecycleNodeMixin.__init__(self)
        self._made: list[ExitStack] = []
        self._mistake: Exception | None = None
        self._answer = self._service_change_state.callback
        self._service_change_state.callback = self._on_change_state
        self.add_on_set_parameters_callback(self._check_parameters)
        self.start_diagnostics(self._on_diagnostics)

    def prepare(self) -> None:
        """Read what the parameters name, and compile; called when the node is configured."""
        raise NotImplementedError

    def begin(self) -> None:
        """Subscribe and publish; called when the node is activated."""
        raise NotImplementedError

    def report(self) -> None:
        """Publish diagnostics; called once per second while the node is active."""
        raise NotImplementedError

    def at_end(self, callback: Callable[[], object]) -> None:
        """Call back when what the present transition makes is taken back."""
        self._made[-1].callback(callback)

    @property
    def state(self) -> str:
        """Name of the present state."""
        return str(self._state_machine.current_state[1])

    @property
    def is_active(self) -> bool:
        """Whether the node works."""
        return self.state == "active"

    def autostart(self) -> None:
        """Configure and activate, unless the parameter says to wait; raises what is wrong with parameters."""
        if not self._starts_itself:
            self.get_logger().info("unconfigured: waiting for a lifecycle manager")
            return
        for change in (self.trigger_configure, self.trigger_activate):
            change()
            if self._mistake is not None:
                self.destroy_node()  # nobody else can: there is no node to the caller
                raise self._mistake
        self._starts_itself = False

    def destroy_node(self) -> None:
        """Destroy the node; its state machine, which rclpy leaves, would keep its name for `/rosout`."""
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()

    def on_configure(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Read the parameters and prepare."""
        return self._make(self._configure)

    def on_activate(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Begin with nothing from before."""
        self.health = Health(self.get_logger().warning)
        return self._make(self.begin)

    def on_deactivate(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Take back what the activation has made."""
        return self._take_back(1)

    def on_cleanup(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Take back what the configuration has made."""
        return self._take_back(0)

    on_shutdown = on_cleanup  # which takes back everything

    def _configure(self) -> None:
        self.params = read_parameters(self, self._cls, read_only=False)
        self.prepare()

    def _make(self, step: Callable[[], None]) -> TransitionCallbackReturn:
        """Run a step, and undo it where it fails by a mistake of the user."""
        level = len(self._made)
        self._made.append(ExitStack())
        self.at_end(self._removal())
        try:
            step()
        except (UserError, ParameterException, NameValidationException) as error:
            self._take_back(level)
            self._mistake = error
            if not self._starts_itself:
                self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            traceback.print_exception(error)
            raise SystemExit(1) from error  # rclpy would swallow the error itself
        self._mistake = None
        return TransitionCallbackReturn.SUCCESS

    def _take_back(self, level: int) -> TransitionCallbackReturn:
        """Undo all steps except the first `level`."""
        while len(self._made) > level:
            self._made.pop().close()
        return TransitionCallbackReturn.SUCCESS

    def _removal(self) -> Callable[[], None]:
        """Removes what the node has got since now."""
        names, entities = set(vars(self)), set(self._entities())

        def remove() -> None:
            for entity in set(self._entities()) - entities:
                for destroy in (self.destroy_publisher, self.destroy_subscription, self.destroy_timer):
                    destroy(entity)  # which ignores those of other kinds
            for name in set(vars(self)) - names:
                delattr(self, name)

        return remove

    def _entities(self) -> Iterator[Any]:
        yield from self.publishers
        yield from Node.subscriptions.__get__(self)  # a node may keep some of them from its executor
        yield from self.timers

    def _check_parameters(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Refuse wrong values, and any while the node would not read them."""
        known = [parameter for parameter in parameters if parameter.name in self._specs]
        if known and self.state not in {"unconfigured", "configuring"}:
            reason = f"parameter {known[0].name} cannot be set while the node is {self.state}."
            return SetParametersResult(successful=False, reason=reason)
        try:
            for parameter in known:
                self._specs[parameter.name].checked(parameter.value)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _on_change_state(
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        """Refuse a transition that the present state does not have; rclpy lets its error end the node."""
        try:
            return self._answer(request, response)
        except rclpy_implementation.RCLError as error:
            self.get_logger().error(f"{self.state}: {str(error).splitlines()[0]}")
            response.success = False
            return response

    def _on_diagnostics(self) -> None:
        if self.is_active:
            self.report()
        else:
            self.publish_reports(Report(self.status_name, f"{self.state}: nothing is published", Level.WARN))
