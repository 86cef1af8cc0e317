"""Each package names in its package.xml what it imports; vision and drivers need little of the estimator."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterable
from configparser import ConfigParser
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
KEYS = {
    "PIL": "python3-pil",
    "cv2": "python3-opencv",
    "llvmlite": "python3-numba",  # which stands on it
    "rosbags": "python3-rosbags-pip",
    "ruamel": "python3-ruamel.yaml",
    # rosdep has no keys of these three: they come with this one
    **dict.fromkeys(("lz4", "mcap", "zstandard"), "mcap-ros2-support"),
} | {
    module: f"python3-{module.replace('_', '-')}"
    for module in (
        "aiohttp",
        "hypothesis",
        "matplotlib",
        "numba",
        "numpy",
        "pytest",
        "scipy",
        "serial",
        "typing_extensions",
    )
}
"""What rosdep calls modules that are no ROS packages."""
LOADED_BY_NAME = {"swarm_loc_estimator": {"event_camera_msgs"}}
"""Packages that `message_class` imports."""
HERE = {"_typeshed", "bench", "workspace"} | {path.stem for path in ROOT.glob("swarm_loc_*/test/**/*.py")}
"""Of the type checker, or of this workspace and in none of its packages."""


def imported(package: Path, folders: Iterable[str]) -> set[str]:
    """Dependencies of the code in some folders, but not on itself or the standard library."""
    files = [path for folder in folders for path in (package / folder).rglob("*.py")]
    names: set[str] = set()
    for node in (node for path in files for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))):
        if isinstance(node, ast.Import):
            names |= {one.name for one in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names.add(node.module or "")
    modules = {name.partition(".")[0] for name in names}
    return {KEYS.get(module, module) for module in modules - {package.name} - HERE - sys.stdlib_module_names}


def declared(package: Path, kind: str) -> set[str]:
    """Dependencies of one kind in package.xml."""
    return set(re.findall(f"<{kind}>(.+)</{kind}>", (package / "package.xml").read_text(encoding="utf-8")))


@pytest.mark.parametrize("name", ["swarm_loc_estimator", "swarm_loc_vision", "swarm_loc_drivers"])
def test_what_is_imported_is_declared(name: str) -> None:
    package = ROOT / name
    loaded = imported(package, [name, "launch"]) | LOADED_BY_NAME.get(name, set())
    assert loaded == declared(package, "exec_depend")
    assert imported(package, ["test"]) <= declared(package, "exec_depend") | declared(package, "test_depend")


@pytest.mark.parametrize("name", ["swarm_loc_estimator", "swarm_loc_vision", "swarm_loc_drivers"])
def test_colcon_runs_the_tests_by_pytest(name: str) -> None:
    config = ConfigParser()
    config.read(ROOT / name / "setup.cfg", encoding="utf-8")
    extras = config["options.extras_require"]["test"].split()
    assert "pytest" in extras  # else colcon looks for unittest, finds none, and reports success
    assert {f"python3-{extra}" for extra in extras} <= declared(ROOT / name, "test_depend")


@pytest.mark.parametrize("name", ["swarm_loc_vision", "swarm_loc_drivers"])
def test_of_the_estimator_others_import_only_common_swarm_and_the_public_api(name: str) -> None:
    allowed = re.compile(r"swarm_loc_estimator(\.(common|swarm)(\..+)?)?")
    for path in (ROOT / name).glob(f"{name}/**/*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("swarm_loc_estimator"):
                assert allowed.fullmatch(node.module or ""), f"{path} imports {node.module}"


@pytest.mark.parametrize(
    "node",
    ["epuck.epuck_driver", "droplet.droplet_driver", "droplet.droplet_fleet", "pushbot.pushbot_driver"],
)
def test_a_driver_loads_neither_the_filter_nor_what_pages_and_plots_need(node: str) -> None:
    module = f"swarm_loc_drivers.{node}_node"
    command = [sys.executable, "-c", f"import sys, {module}; print(*sys.modules)"]
    loaded = set(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split())
    assert module in loaded
    unwanted = {"aiohttp", "matplotlib", "swarm_loc_estimator.filter", "swarm_loc_estimator.timeline"}
    assert not unwanted & loaded
