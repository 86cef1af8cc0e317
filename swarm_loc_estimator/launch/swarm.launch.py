"""Start the whole graph: ros2 launch swarm_loc_estimator swarm.launch.py swarm_file:=FILE [bag:=BAG]."""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch_ros.actions import Node

from swarm_loc_estimator.cli.graph import check_graph
from swarm_loc_estimator.common.launch import (
    GraphOptions,
    argument_texts,
    graph_nodes,
    node_action,
    options_from,
)


def generate_launch_description() -> LaunchDescription:
    """The graph's options as launch arguments, then its nodes."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("swarm_file", description="path of the swarm description"),
            DeclareLaunchArgument("bag", default_value="", description="bag to play into the graph"),
            DeclareLaunchArgument("rate", default_value="1.0", description="speed of the bag"),
            DeclareLaunchArgument("use_sim_time", default_value="false", choices=["true", "false"]),
            DeclareLaunchArgument("params_file", default_value="", description="ROS parameters of all nodes"),
            DeclareLaunchArgument("watch", default_value="false", choices=["true", "false"]),
            DeclareLaunchArgument("watch_port", default_value="8420", description="port of the page"),
            OpaqueFunction(function=start_nodes),
        ]
    )


def start_nodes(context: LaunchContext) -> list[Node]:
    """The actions that start the graph's nodes."""
    options = options_from(GraphOptions, argument_texts(context, GraphOptions))
    check_graph(options)  # here, and not by nodes, whose ends say nothing of why
    return [node_action(spec) for spec in graph_nodes(options)]
