"""What is no node works on a machine without ROS."""

from __future__ import annotations

import subprocess
import sys

import pytest

IMPORT_ALL_WITHOUT_ROS = """
import importlib, pkgutil, sys

class NoRos:
    def find_spec(self, name, path=None, target=None):
        root = name.partition(".")[0]
        if root in {"rclpy", "ament_index_python", "launch", "launch_ros"} or root.endswith("_msgs"):
            raise ImportError(f"{name} is ROS")

sys.meta_path.insert(0, NoRos())
package = importlib.import_module(sys.argv[1])
for part in package.__path__:
    for folder in pkgutil.iter_modules([part]):
        if folder.ispkg and folder.name not in {"nodes", "cli"}:
            subpackage = importlib.import_module(f"{package.__name__}.{folder.name}")
            for module in pkgutil.walk_packages(subpackage.__path__, subpackage.__name__ + "."):
                importlib.import_module(module.name)
                print(module.name)
"""


@pytest.mark.parametrize(
    ("package", "module"),
    [
        ("swarm_loc_estimator", "swarm_loc_estimator.core.estimator"),
        ("swarm_loc_drivers", "swarm_loc_drivers.sim.trajectories"),
    ],
)
def test_all_but_nodes_and_commands_imports_without_ros(package: str, module: str) -> None:
    command = [sys.executable, "-c", IMPORT_ALL_WITHOUT_ROS, package]
    done = subprocess.run(command, capture_output=True, text=True, check=False)

    assert done.returncode == 0, done.stderr
    assert module in done.stdout.split()


def test_the_block_blocks() -> None:
    command = [sys.executable, "-c", IMPORT_ALL_WITHOUT_ROS, "rclpy"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)

    assert "rclpy is ROS" in done.stderr
