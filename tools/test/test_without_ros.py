"""Only nodes need ROS; all other modules can be imported without it.

These may need it: modules named `*_node.py` or `*_nodes.py`; in the estimator `common/node.py`, all of
`nodes/` and `watch/`, `offline/live_run.py`, `doctor/listener.py`, and the command `demo`; in the drivers
what publishes for nodes, named `*_diagnostics.py`, `*_messages.py` or `*_output.py`.
"""

import subprocess
import sys

import pytest

IMPORT_ALL_WITHOUT_ROS = """
import importlib, pathlib, re, sys

WITH_ROS = re.compile(
    r"_nodes?$|^swarm_loc_estimator\\.(common\\.node$|nodes\\.|watch\\.)"
    r"|^swarm_loc_estimator\\.(offline\\.live_run$|doctor\\.listener$|cli\\.demo$)"
    r"|^swarm_loc_drivers\\..*_(diagnostics|messages|output)$"
)

class NoRos:
    def find_spec(self, name, path=None, target=None):
        root = name.partition(".")[0]
        if root in {"rclpy", "ament_index_python", "launch", "launch_ros"} or root.endswith("_msgs"):
            raise ImportError(f"{name} is ROS")

sys.meta_path.insert(0, NoRos())
package = importlib.import_module(sys.argv[1])
for file in sorted(pathlib.Path(package.__path__[0]).rglob("*.py")):
    parts = file.relative_to(package.__path__[0]).with_suffix("").parts
    module = ".".join((package.__name__, *parts)).removesuffix(".__init__")
    if not WITH_ROS.search(module):
        importlib.import_module(module)
        print(module)
"""


@pytest.mark.parametrize(
    ("package", "modules"),
    [
        ("swarm_loc_estimator", {"timeline.estimator", "cli.replay"}),
        ("swarm_loc_drivers", {"sim.run", "sim.epuck.world"}),
        ("swarm_loc_vision", {"markers.detector"}),
    ],
)
def test_all_but_nodes_and_graphs_imports_without_ros(package: str, modules: set[str]) -> None:
    command = [sys.executable, "-c", IMPORT_ALL_WITHOUT_ROS, package]
    done = subprocess.run(command, capture_output=True, text=True, check=False)

    assert done.returncode == 0, done.stderr
    assert {f"{package}.{module}" for module in modules} <= set(done.stdout.split())


def test_the_block_blocks() -> None:
    command = [sys.executable, "-c", IMPORT_ALL_WITHOUT_ROS, "rclpy"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)

    assert "rclpy is ROS" in done.stderr
