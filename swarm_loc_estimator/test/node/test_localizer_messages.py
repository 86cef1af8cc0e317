"""The bridge over DDS with messages of motion_capture_tracking, built here where they are not installed."""

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from workspace import install, shared
from workspace.build import PYTHON_ONLY
from workspace.stamps import digest

PACKAGE = "motion_capture_tracking_interfaces"
SOURCES = {
    "msg/NamedPose.msg": "string name\ngeometry_msgs/Pose pose\n",
    "msg/NamedPoseArray.msg": "std_msgs/Header header\nNamedPose[] poses\n",
    "package.xml": f"""<?xml version="1.0"?>
<package format="3">
  <name>{PACKAGE}</name>
  <version>1.0.0</version>
  <description>Two messages, with the fields of the package of this name.</description>
  <maintainer email="maintainers@example.org">Swarm localization maintainers</maintainer>
  <license>Apache-2.0</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  <depend>geometry_msgs</depend>
  <depend>std_msgs</depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
""",
    "CMakeLists.txt": f"""cmake_minimum_required(VERSION 3.20)
project({PACKAGE})
find_package(ament_cmake REQUIRED)
find_package(geometry_msgs REQUIRED)
find_package(std_msgs REQUIRED)
find_package(rosidl_default_generators REQUIRED)
rosidl_generate_interfaces({PACKAGE} msg/NamedPose.msg msg/NamedPoseArray.msg
  DEPENDENCIES geometry_msgs std_msgs)
ament_package()
""",
}
EXCHANGE = """
import json, sys
from geometry_msgs.msg import PoseWithCovarianceStamped
from motion_capture_tracking_interfaces.msg import NamedPose, NamedPoseArray
from node_world import Ros, overrides
from rclpy.qos import qos_profile_sensor_data
from swarm_loc_estimator.nodes.localizer_bridge import LocalizerBridge

ros = Ros()
parameters = overrides(swarm_file=sys.argv[1], source="named_poses", bodies=["cf1=alpha", "cf2=beta"])
ros.add(LocalizerBridge(parameter_overrides=parameters))
fixes = {name: ros.listen(PoseWithCovarianceStamped, f"{name}/fix") for name in ("alpha", "beta")}
publisher = ros.tester.create_publisher(NamedPoseArray, "/poses", qos_profile_sensor_data)
message = NamedPoseArray(poses=[NamedPose(name=name) for name in ("cf1", "cf2", "cf3")])
message.header.frame_id, message.header.stamp.sec = "world", 7
for place, one in enumerate(message.poses):
    one.pose.position.x, one.pose.orientation.w = float(place), 1.0

def heard():
    publisher.publish(message)
    return all(fixes.values())

ros.until(heard)
print(json.dumps([fixes[name][0].pose.pose.position.x for name in ("alpha", "beta")]))
ros.close()
"""


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """The environment with the package in it, which is built once for all clones, as the workspace's own."""
    if find_spec(PACKAGE):
        return dict(os.environ)
    pytest.importorskip("colcon_core")
    built, versions = tmp_path / "install", install.versions()
    key = f"{PACKAGE}-{digest([], versions, PYTHON_ONLY.read_text(encoding='utf-8'), *SOURCES.values())}"
    if not versions or not shared.take(key, built):
        for name, text in SOURCES.items():
            path = tmp_path / "src" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        command = [sys.executable, "-m", "colcon", "--log-base", "log", "build"]
        command += ["--merge-install", "--paths", "src"]
        if versions:
            command += ["--cmake-args", f"-Drosidl_default_generators_DIR={PYTHON_ONLY.parent}"]
        done = subprocess.run(command, cwd=tmp_path, check=False, capture_output=True)
        assert done.returncode == 0, done.stderr.decode()
        if versions:
            shared.keep(key, built)
    (python,) = [path.parent for path in built.glob("lib/python*/*-packages/*") if path.name == PACKAGE]
    added = {"AMENT_PREFIX_PATH": built, "LD_LIBRARY_PATH": built / "lib", "PYTHONPATH": python}
    return {**os.environ, **{name: f"{path}:{os.environ.get(name, '')}" for name, path in added.items()}}


@pytest.mark.timeout(300)  # a build of C and Python code
def test_named_poses_become_fixes(environment: dict[str, str], swarm_file: Path) -> None:
    paths = [str(Path(__file__).parents[1] / "worlds"), environment["PYTHONPATH"]]
    run = subprocess.run(
        [sys.executable, "-c", EXCHANGE, str(swarm_file)],
        env={**environment, "PYTHONPATH": os.pathsep.join(paths)},
        check=False,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    assert json.loads(run.stdout.splitlines()[-1]) == [0.0, 1.0]
