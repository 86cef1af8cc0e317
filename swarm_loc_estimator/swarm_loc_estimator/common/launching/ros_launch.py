"""Launch actions for `ros2 launch`; they need `launch_ros`, which a full ROS 2 installation has."""

from __future__ import annotations

from dataclasses import fields

from launch import LaunchContext
from launch.actions import Shutdown
from launch_ros.actions import Node

from swarm_loc_estimator.common.launching.graph import NodeSpec

_ARGUMENTS = {"parameter_file": "params_file"}


def argument_texts(context: LaunchContext, kind: type) -> dict[str, str]:
    """The launch arguments by the fields of a dataclass of options; `params_file` is `parameter_file`."""
    arguments = context.launch_configurations
    return {one.name: arguments[_ARGUMENTS.get(one.name, one.name)] for one in fields(kind)}


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
