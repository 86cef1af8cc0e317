"""The drivers of a fleet of Droplets, each at a cable, as one ROS 2 node.

    ./run swarm_loc_drivers droplet_fleet_node --ros-args -p swarm_file:=swarm.yaml -p link_folder:=/tmp/links

For every robot of the swarm description that has an infrared board it starts what `droplet_driver_node` is,
in the robot's namespace and at the port of `link_folder` that is named like it; they take turns to emit. What
Droplets share, such as their model and their noise, is set once for all of them.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from rclpy.parameter import Parameter

from swarm_loc_drivers.droplet.droplet_driver_node import DropletDriverNode
from swarm_loc_drivers.droplet.parameters import DropletFleetParameters
from swarm_loc_estimator.common.node import ConfiguredNode, Stop, run_node, spin
from swarm_loc_estimator.common.parameters import ParameterError
from swarm_loc_estimator.swarm.swarm_file import load_swarm


class DropletFleetNode(ConfiguredNode[DropletFleetParameters]):
    """Runs the nodes of the drivers."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("droplet_fleet", DropletFleetParameters, **node_arguments)
        parameters = self.params
        robots = load_swarm(Path(parameters.swarm_file)).robots
        names = [robot.name for robot in robots if robot.ir is not None]
        part, parts = parameters.part, parameters.parts
        if not names[part::parts]:
            raise ParameterError(f"parameter part = {part} of {parts} has none of the {len(names)} Droplets.")
        simulated = bool(self.get_parameter("use_sim_time").value)
        self._drivers: list[DropletDriverNode] = []
        for turn in range(part, len(names), parts):
            own = {
                **parameters.traits,
                "address": str(Path(parameters.link_folder) / names[turn]),
                "turns": len(names),
                "turn": turn,
                "use_sim_time": simulated,
            }
            self._drivers.append(_driver(names[turn], own))

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
    """Node of one robot; remappings on the command line apply to the fleet node only."""
    return DropletDriverNode(
        namespace=robot,
        parameter_overrides=[Parameter(name, value=value) for name, value in parameters.items()],
        use_global_arguments=False,
        start_parameter_services=False,
    )


main = partial(run_node, "droplet_fleet_node", DropletFleetNode)
