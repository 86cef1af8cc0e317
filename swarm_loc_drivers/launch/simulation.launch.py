"""Start a complete simulation: ros2 launch swarm_loc_drivers simulation.launch.py swarm_file:=FILE."""

import atexit
from contextlib import ExitStack

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch_ros.actions import Node

from swarm_loc_drivers.sim.simulation import ROBOT_TYPES, SimulationOptions, graph_of, simulated_swarm
from swarm_loc_estimator.common.files import temporary_folder
from swarm_loc_estimator.common.launch import argument_texts, node_action, options_from


def generate_launch_description() -> LaunchDescription:
    """Declare the options of `simulate` as launch arguments and start its nodes."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("swarm_file", description="path of the swarm description"),
            DeclareLaunchArgument(
                "world",
                default_value="",
                choices=["", *(world for kind in ROBOT_TYPES.values() for world in kind.worlds)],
            ),
            DeclareLaunchArgument("seed", default_value="1", description="random seed of the world's errors"),
            DeclareLaunchArgument("speed", default_value="0.06", description="speed along the eight [m/s]"),
            DeclareLaunchArgument("rate", default_value="1.0", description="simulated seconds per second"),
            DeclareLaunchArgument("plan", default_value="corridor", description="hall of PushBots or a file"),
            DeclareLaunchArgument(
                "aerial", default_value="false", description="locate by an overhead camera alone"
            ),
            DeclareLaunchArgument("params_file", default_value="", description="ROS parameters of all nodes"),
            OpaqueFunction(function=start_nodes),
        ]
    )


def start_nodes(context: LaunchContext) -> list[Node]:
    """The actions that start the nodes; an argument that cannot be used ends the launch."""
    options = options_from(SimulationOptions, argument_texts(context, SimulationOptions))
    swarm = simulated_swarm(options)
    stack = ExitStack()
    links = str(stack.enter_context(temporary_folder("swarm_loc-")))
    atexit.register(stack.close)  # when the last process has ended
    return [node_action(spec) for spec in graph_of(options, swarm, links)]
