"""Managed nodes: the states, services and events of ROS 2's lifecycle, see `doc/lifecycle.md`."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rclpy.exceptions import ParameterException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter

from swarm_loc_estimator.common.health import Health, Level, Report
from swarm_loc_estimator.common.node import ConfiguredNode, Parameters
from swarm_loc_estimator.common.parameters import ParameterError, UserError, parameter_specs
from swarm_loc_estimator.common.ros_parameters import read_parameter, read_parameters


class ManagedNode(LifecycleNodeMixin, ConfiguredNode[Parameters]):
    """A node that reads its parameters when it is configured, and works while it is active.

    What a transition has made, attributes as well as publishers, subscriptions and timers, exists until the
    opposite transition. So an activation starts from scratch. An executor may still handle events that it
    had queued before: callbacks that need what is gone ask `is_active`.

    Args:
        name: Default name of the node.
        parameters: The dataclass, which has the flag `autostart`.
        node_arguments: Further arguments of `rclpy.node.Node`.

    Raises:
        UserError: The parameter `autostart` cannot be used.
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
        """Configure and activate, unless the parameter says to wait.

        Raises:
            UserError: A parameter, or a file that it names, cannot be used.
            ParameterException: A parameter of rclpy cannot be used.
        """
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

    def on_shutdown(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Take back everything."""
        return self._take_back(0)

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
        except (UserError, ParameterException) as error:
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
        """Undo all steps but so many."""
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
