"""A node around the driver of one robot: talks to it while it runs, and has it stand at the end."""

from __future__ import annotations

from typing import Any

from swarm_loc_drivers.common.robot_driver import RobotDriver
from swarm_loc_estimator.common.node import ConfiguredNode, Parameters, Stop


class RobotDriverNode(ConfiguredNode[Parameters]):
    """A node in a robot's namespace, with the robot's driver; arguments as of `ConfiguredNode`.

    A subclass creates the driver as `_driver`, with `_now_ns` for a clock.
    """

    _driver: RobotDriver[Any]

    def start(self) -> None:
        """Begin to talk to the robot; not when constructed, since who is interrupted there is not stopped."""
        self._driver.start()

    def run(self, stop: Stop) -> int:
        """Drive the robot until asked to stop; the exit status."""
        self.start()
        return super().run(stop)

    def begin_to_stop(self) -> None:
        """Have the robot stand; `destroy_node` waits until it does."""
        self._driver.begin_to_stop()

    def destroy_node(self) -> None:
        """Stop the robot first."""
        self._driver.stop()
        super().destroy_node()

    @property
    def _prefix(self) -> str:
        """What begins the names of the robot's frames and status: its namespace."""
        robot = self.get_namespace().strip("/")
        return f"{robot}/" if robot else ""

    def _now_ns(self) -> int:
        return int(self.get_clock().now().nanoseconds)
