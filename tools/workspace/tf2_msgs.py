"""A minimal tf2_msgs for machines without it: the one message type of /tf.

It is written under `.workspace`, which colcon does not search, so it never hides that of a full installation.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from workspace.stamps import write_whole

FILES = {
    "package.xml": """<?xml version="1.0"?>
<package format="3">
  <name>tf2_msgs</name>
  <version>0.36.0</version>
  <description>The message of tf2_msgs that /tf carries.</description>
  <maintainer email="maintainers@example.org">Swarm localization maintainers</maintainer>
  <license>Apache-2.0</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  <depend>geometry_msgs</depend>
  <exec_depend>rosidl_default_runtime</exec_depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
""",
    "CMakeLists.txt": """cmake_minimum_required(VERSION 3.20)
project(tf2_msgs)
find_package(ament_cmake REQUIRED)
find_package(geometry_msgs REQUIRED)
find_package(rosidl_default_generators REQUIRED)
rosidl_generate_interfaces(${PROJECT_NAME} "msg/TFMessage.msg" DEPENDENCIES geometry_msgs)
ament_export_dependencies(rosidl_default_runtime)
ament_package()
""",
    "msg/TFMessage.msg": "geometry_msgs/TransformStamped[] transforms\n",
}


def is_installed(env: Mapping[str, str]) -> bool:
    """Whether an environment has the original package."""
    prefixes = filter(None, env.get("AMENT_PREFIX_PATH", "").split(os.pathsep))
    return any(Path(prefix, "share/tf2_msgs/package.xml").is_file() for prefix in prefixes)


def write(folder: Path) -> None:
    """Write the package's sources."""
    for name, text in FILES.items():
        write_whole(folder / name, text)
