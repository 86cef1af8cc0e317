"""Start a complete simulation: ros2 launch swarm_loc_drivers simulation.launch.py swarm_file:=FILE."""

import atexit
from contextlib import ExitStack

from launch import LaunchContext, LaunchDescription
from launch.actions import OpaqueFunction
from launch_ros.actions import Node

from swarm_loc_drivers.sim.simulation import WORLD_NAMES, SimulationOptions, graph_of, simulated_swarm
from swarm_loc_estimator.common.files import temporary_folder
from swarm_loc_estimator.common.launch import launch_arguments, node_action, options_from


def generate_launch_description() -> LaunchDescription:
    """Declare the options of `simulate` as launch arguments and start its nodes."""
    arguments = launch_arguments(SimulationOptions, {"world": WORLD_NAMES})
    return LaunchDescription([*arguments, OpaqueFunction(function=start_nodes)])


def start_nodes(context: LaunchContext) -> list[Node]:
    """The actions that start the nodes; an argument that cannot be used ends the launch."""
    options = options_from(SimulationOptions, context.launch_configurations)
    swarm = simulated_swarm(options)
    stack = ExitStack()
    links = str(stack.enter_context(temporary_folder("swarm_loc-")))
    atexit.register(stack.close)  # when the last process has ended
    return [node_action(spec) for spec in graph_of(options, swarm, links)]
