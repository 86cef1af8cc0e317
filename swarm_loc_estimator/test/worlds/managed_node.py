"""A client of the lifecycle services of a node, as a lifecycle manager is."""

from typing import Any

from lifecycle_msgs.msg import Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetAvailableStates, GetAvailableTransitions, GetState
from node_world import Ros
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter

CONFIGURE = Transition.TRANSITION_CONFIGURE
CLEANUP = Transition.TRANSITION_CLEANUP
ACTIVATE = Transition.TRANSITION_ACTIVATE
DEACTIVATE = Transition.TRANSITION_DEACTIVATE
SHUTDOWN = Transition.TRANSITION_ACTIVE_SHUTDOWN


class Manager:
    """Changes the state of a node by its services, by number as Nav2 does."""

    def __init__(self, ros: Ros, node: str) -> None:
        self._ros = ros
        self._node = node
        self._client = ros.tester.create_client(ChangeState, f"{node}/change_state")
        self._wait_for_answers()
        self.events: list[TransitionEvent] = ros.listen(TransitionEvent, f"{node}/transition_event")

    def change(self, transition: int) -> bool:
        """Whether a transition succeeded."""
        future = self._client.call_async(ChangeState.Request(transition=Transition(id=transition)))
        self._ros.until(future.done)
        return bool(future.result().success)

    def _wait_for_answers(self) -> None:
        """Ask for a transition that no state has until the node answers: DDS may lose its first answers."""
        self._ros.until(self._client.service_is_ready)
        asked: list[Any] = []

        def is_answered() -> bool:
            asked.append(
                self._client.call_async(
                    ChangeState.Request(transition=Transition(id=Transition.TRANSITION_CREATE))
                )
            )
            return any(future.done() for future in asked)

        self._ros.until(is_answered)

    def changes(self, *transitions: int) -> str:
        """The state after transitions, which must succeed."""
        assert all(self.change(transition) for transition in transitions)
        return self.state()

    def state(self) -> str:
        """Name of the present state."""
        answer = self._ros.call(GetState, f"{self._node}/get_state", GetState.Request())
        return str(answer.current_state.label)

    def set_values(self, **values: Any) -> str:
        """Set a parameter; the reason of a refusal, "" if there was none."""
        request = SetParameters.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        )
        (result,) = self._ros.call(SetParameters, f"{self._node}/set_parameters", request).results
        return "" if result.successful else str(result.reason)

    def offers(self) -> tuple[set[str], set[str]]:
        """Names of all states, and of the transitions from the present one."""
        states = self._ros.call(
            GetAvailableStates, f"{self._node}/get_available_states", GetAvailableStates.Request()
        )
        transitions = self._ros.call(
            GetAvailableTransitions,
            f"{self._node}/get_available_transitions",
            GetAvailableTransitions.Request(),
        )
        return (
            {one.label for one in states.available_states},
            {one.transition.label for one in transitions.available_transitions},
        )
