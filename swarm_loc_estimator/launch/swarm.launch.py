"""Start the whole graph: ros2 launch swarm_loc_estimator swarm.launch.py swarm_file:=FILE [bag:=BAG]."""

from launch import LaunchContext, LaunchDescription
from launch.actions import OpaqueFunction
from launch_ros.actions import Node

from swarm_loc_estimator.cli.graph import check_graph
from swarm_loc_estimator.common.launch import (
    GraphOptions,
    graph_nodes,
    launch_arguments,
    node_action,
    options_from,
)


def generate_launch_description() -> LaunchDescription:
    """The graph's options as launch arguments, then its nodes."""
    return LaunchDescription([*launch_arguments(GraphOptions), OpaqueFunction(function=start_nodes)])


def start_nodes(context: LaunchContext) -> list[Node]:
    """The actions that start the graph's nodes."""
    options = options_from(GraphOptions, context.launch_configurations)
    check_graph(options)  # here, and not by nodes, whose ends say nothing of why
    return [node_action(spec) for spec in graph_nodes(options)]
