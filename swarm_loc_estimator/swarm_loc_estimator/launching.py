"""What the launch files of all packages share; it needs `launch_ros`, which a full ROS 2 installation has."""

from __future__ import annotations

from launch.actions import Shutdown
from launch_ros.actions import Node

from swarm_loc_estimator.graph import NodeSpec


def node_action(spec: NodeSpec) -> Node:
    """The launch action of one node of a graph."""
    files = [] if spec.parameter_file is None else [spec.parameter_file]
    return Node(
        package=spec.package,
        executable=spec.executable,
        name=spec.name,
        namespace=spec.namespace,
        parameters=[*files, dict(spec.parameters)],
        remappings=list(spec.remappings),
        output="screen",
        on_exit=[Shutdown(reason=f"{spec.full_name} ended")] if spec.required else [],
    )
