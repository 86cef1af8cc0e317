"""Commands of the page: reset the estimator, set a pose, drive a robot."""

from __future__ import annotations

import math
import queue
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from geometry_msgs.msg import Twist
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_srvs.srv import Trigger

from swarm_loc_estimator.nodes.parameters import WatchParameters
from swarm_loc_estimator.watch.server import Answer, Command
from swarm_loc_msgs.srv import SetRobotPose

_MAX_WAITING = 64
_DRIVEN_NS = 400_000_000  # Time without a command after which a driven robot is stopped


class RobotCommands:
    """Executes commands one after the other, in the node's thread.

    Args:
        node: Calls services and publishes.
        names: The robots.
        parameters: Allowed commands.
        now_ns: A steady clock [ns].

    Attributes:
        dropped: Number of commands dropped from the full queue.
    """

    def __init__(
        self, node: Node, names: Sequence[str], parameters: WatchParameters, now_ns: Callable[[], int]
    ) -> None:
        self._node = node
        self._names = names
        self._parameters = parameters
        self._now_ns = now_ns
        self.dropped = 0
        self._waiting: queue.Queue[tuple[Command, Answer]] = queue.Queue(_MAX_WAITING)
        self._reset = node.create_client(Trigger, f"{parameters.estimator}/reset")
        self._set_pose = node.create_client(SetRobotPose, f"{parameters.estimator}/set_robot_pose")
        self._velocity: dict[int, Publisher] = {}
        self._driven_until_ns: dict[int, int] = {}
        self._obey: Mapping[str, Callable[[Command, Answer], None]] = {
            "reset": self._on_reset,
            "set_pose": self._on_set_pose,
            "drive": self._on_drive,
        }

    def order(self, command: Command, answer: Answer) -> None:
        """Queue a command; may be called from any thread."""
        try:
            self._waiting.put_nowait((command, answer))
        except queue.Full:
            self.dropped += 1
            answer("Too many commands at once: this one was dropped.", ok=False)

    def work(self) -> None:
        """Execute queued commands, and stop robots whose last drive command is too old."""
        while True:
            try:
                command, answer = self._waiting.get_nowait()
            except queue.Empty:
                break
            refusal = self._refusal(command)
            if refusal:
                answer(refusal, ok=False)
            else:
                self._obey[command["do"]](command, answer)
        for robot, until_ns in tuple(self._driven_until_ns.items()):
            if self._now_ns() > until_ns:
                del self._driven_until_ns[robot]
                self._velocity[robot].publish(Twist())

    def _refusal(self, command: Command) -> str:
        """Reason to refuse a command, one sentence; "" if it is accepted."""
        todo = command["do"]
        if todo not in self._obey:
            return f"There is no command '{todo}'."
        if todo == "drive" and not self._parameters.teleop:
            return "Driving is not allowed: parameter teleop is false."
        if todo != "drive" and not self._parameters.commands:
            return "Commands are not allowed: parameter commands is false."
        return "" if command["robot"] >= 0 or todo == "reset" else "The command names no robot."

    def _on_reset(self, _command: Command, answer: Answer) -> None:
        self._call(self._reset, Trigger.Request(), answer)

    def _on_set_pose(self, command: Command, answer: Answer) -> None:
        pose = numbers(command.get("pose"), 3)
        if pose is None:
            answer("A pose is three finite numbers.", ok=False)
            return
        request = SetRobotPose.Request(robot=self._names[command["robot"]])
        where = request.pose.pose
        where.position.x, where.position.y = pose[:2]
        where.orientation.z, where.orientation.w = math.sin(pose[2] / 2.0), math.cos(pose[2] / 2.0)
        self._call(self._set_pose, request, answer)

    def _on_drive(self, command: Command, answer: Answer) -> None:
        ways = numbers([command.get("ahead"), command.get("left")], 2)
        if ways is None or max(map(abs, ways)) > 1.0:
            answer("Driving needs two shares from -1 to 1.", ok=False)
            return
        robot = command["robot"]
        if robot not in self._velocity:
            topic = f"{self._names[robot]}/cmd_vel"
            self._velocity[robot] = self._node.create_publisher(Twist, topic, 1)
        message = Twist()
        message.linear.x = ways[0] * self._parameters.teleop_speed
        message.angular.z = ways[1] * self._parameters.teleop_turn_rate
        self._velocity[robot].publish(message)
        self._driven_until_ns[robot] = self._now_ns() + _DRIVEN_NS

    def _call(self, client: Any, request: Any, answer: Answer) -> None:
        """Call a service whose response has `success` and `message`, and return these as answer."""
        if not client.service_is_ready():
            answer(f"Nobody offers {client.srv_name}: is the estimator running?", ok=False)
            return

        def on_done(future: Any) -> None:
            response = future.result()
            answer(response.message, ok=response.success)

        client.call_async(request).add_done_callback(on_done)


def numbers(values: object, count: int) -> list[float] | None:
    """The given number of finite numbers from a page; None if invalid."""
    if not isinstance(values, list) or len(values) != count:
        return None
    if not all(isinstance(one, int | float) and not isinstance(one, bool) for one in values):
        return None
    try:
        found = [float(one) for one in values]
    except OverflowError:  # a whole number of more than 308 digits
        return None
    return found if all(map(math.isfinite, found)) else None
