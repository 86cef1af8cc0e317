"""The drivers of a whole table of Droplets, each at a cable, in one process.

    ./run swarm_loc_drivers droplet_table_node --ros-args -p swarm_file:=swarm.yaml -p link_folder:=/tmp/links

For every robot of the swarm description that has an infrared board it starts what `droplet_driver_node` is,
in the robot's namespace and at the port of `link_folder` that is named like it; they take turns to emit. What
Droplets share, such as their model and their noise, is set once for all of them.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.parameter import Parameter

from swarm_loc_drivers.nodes.droplet_driver_node import DropletDriverNode
from swarm_loc_drivers.nodes.droplet_parameters import DropletTableParameters
from swarm_loc_estimator.io.swarm_file import load_swarm
from swarm_loc_estimator.nodes.declare import declare_parameters
from swarm_loc_estimator.nodes.parameter_table import ParameterError
from swarm_loc_estimator.nodes.running import Stop, run_node, spin


class DropletTableNode(Node):
    """Holds the drivers' nodes.

    Args:
        node_arguments: Further arguments of `rclpy.node.Node`.

    Raises:
        ParameterError: A parameter cannot be used.
        SwarmFileError: The swarm description cannot be used.
    """

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("droplet_table", **node_arguments)
        wishes = declare_parameters(self, DropletTableParameters)
        names = [robot.name for robot in load_swarm(Path(wishes.swarm_file)).robots if robot.ir is not None]
        if not names[wishes.part :: wishes.parts]:
            raise ParameterError(
                f"parameter part = {wishes.part} of {wishes.parts} has none of the {len(names)} Droplets."
            )
        simulated = bool(self.get_parameter("use_sim_time").value)
        self._drivers: list[DropletDriverNode] = []
        for turn in range(wishes.part, len(names), wishes.parts):
            parameters = {
                **wishes.traits,
                "address": str(Path(wishes.link_folder) / names[turn]),
                "turns": len(names),
                "turn": turn,
                "use_sim_time": simulated,
            }
            self._drivers.append(_driver(names[turn], parameters))

    def run(self, stop: Stop) -> int:
        """Drive all robots until asked to stop; the exit status."""
        for driver in self._drivers:
            driver.start()
        return spin(self, stop, *self._drivers)

    def destroy_node(self) -> None:
        """Stop all robots first."""
        for driver in self._drivers:
            driver.begin_to_stop()
        for driver in self._drivers:
            driver.destroy_node()
        super().destroy_node()


def _driver(robot: str, parameters: dict[str, Any]) -> DropletDriverNode:
    """The node of one robot; the command line's names are for the table's own node only."""
    return DropletDriverNode(
        namespace=robot,
        parameter_overrides=[Parameter(name, value=value) for name, value in parameters.items()],
        use_global_arguments=False,
        start_parameter_services=False,
    )


def main() -> int:
    """Run until SIGINT or SIGTERM; 1 when a parameter cannot be used."""
    return run_node("droplet_table_node", DropletTableNode, DropletTableNode.run)


if __name__ == "__main__":
    sys.exit(main())
