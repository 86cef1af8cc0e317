"""Each package names in its package.xml what it imports; vision and drivers need little of the estimator."""

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
    "ruamel": "python3-ruamel.yaml",
} | {
    module: f"python3-{module.replace('_', '-')}"
    for module in (
        "aiohttp",
        "hypothesis",
        "joblib",
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
FOR_BAGS = {"lz4", "mcap", "rosbags", "zstandard"}
"""rosdep knows no packages of them but by pip, and bloom refuses a package that depends on such ones."""
FOR_SWEEPS = {"distributed", "optuna", "ray"}
"""For sweeps on clusters and fits, imported by name: rosdep knows no packages of them, benchmarks do."""
PIP_NAMES = {"python3-pil": "pillow"}  # What pip calls packages in which rosdep's name is another one
LOADED_BY_NAME = {"swarm_loc_estimator": {"event_camera_msgs", "sensor_msgs"}}
"""Packages that `message_class` imports."""
HERE = {"_typeshed", "bench", "workspace"} | {
    path.stem for folder in ("test", "examples") for path in ROOT.glob(f"swarm_loc_*/{folder}/**/*.py")
}
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
    modules -= {package.name} | HERE | sys.stdlib_module_names
    return {KEYS.get(module, module) for module in modules - FOR_BAGS}


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


def least_versions(*lines: str) -> dict[str, str]:
    """Package -> its lower bound, of lines such as numpy>=1.24,<3."""
    found = (re.match(r"([\w.-]+)>=([\w.]+)", line) for line in lines)
    return {one[1]: one[2] for one in found if one}


def test_a_wheel_of_the_estimator_requires_what_it_imports_as_the_workspace_does() -> None:
    config = ConfigParser()
    config.read(ROOT / "swarm_loc_estimator" / "setup.cfg", encoding="utf-8")
    required = config["options"]["install_requires"].splitlines()
    required += [line for lines in config["options.extras_require"].values() for line in lines.splitlines()]
    of_wheel = least_versions(*required)
    files = [ROOT / "requirements" / f"{name}.txt" for name in ("workspace", "bench")]
    workspace = least_versions(*(line for file in files for line in file.read_text("utf-8").splitlines()))
    assert {name: workspace[name] for name in of_wheel} == of_wheel
    keys = imported(ROOT / "swarm_loc_estimator", ["swarm_loc_estimator"])
    from_pip = {
        PIP_NAMES.get(key, key.removeprefix("python3-")) for key in keys if key.startswith("python3-")
    }
    assert {name.replace("_", "-") for name in of_wheel} == from_pip | FOR_BAGS | FOR_SWEEPS


@pytest.mark.parametrize("name", ["swarm_loc_vision", "swarm_loc_drivers"])
def test_of_the_estimator_others_import_only_common_swarm_and_the_public_api(name: str) -> None:
    allowed = re.compile(r"swarm_loc_estimator(\.(common|swarm)(\..+)?)?")
    for path in (ROOT / name).glob(f"{name}/**/*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("swarm_loc_estimator"):
                assert allowed.fullmatch(node.module or ""), f"{path} imports {node.module}"


@pytest.mark.parametrize(
    "module", ["epuck.epuck_driver_node", "droplet.droplet_nodes", "pushbot.pushbot_driver_node"]
)
def test_a_driver_loads_neither_the_filter_nor_what_pages_and_plots_need(module: str) -> None:
    module = f"swarm_loc_drivers.{module}"
    command = [sys.executable, "-c", f"import sys, {module}; print(*sys.modules)"]
    loaded = set(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split())
    assert module in loaded
    unwanted = {"aiohttp", "matplotlib", "swarm_loc_estimator.filter", "swarm_loc_estimator.timeline"}
    assert not unwanted & loaded


NODES = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts[1:])
    for path in sorted(ROOT.glob("swarm_loc_*/swarm_loc_*/**/*_node*.py"))
]
LIVE = {
    *NODES,
    "swarm_loc_estimator.cli.graph",
    "swarm_loc_estimator.cli.watch",
    "swarm_loc_drivers.sim.simulate",
}
LIVE -= {"swarm_loc_estimator.nodes.play_node"}
IMPORT_WITHOUT_BAGS = f"""
import importlib, sys

class Refused:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {FOR_BAGS}:
            raise ImportError(f"{{name}} is refused")

sys.meta_path.insert(0, Refused())
for module in sys.argv[1:]:
    importlib.import_module(module)
"""


def import_without_bags(*modules: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", IMPORT_WITHOUT_BAGS, *modules]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_live_nodes_need_nothing_that_only_bags_need() -> None:
    assert len(LIVE) > 20
    done = import_without_bags(*sorted(LIVE))
    assert done.returncode == 0, done.stderr


def test_the_refusal_refuses() -> None:
    assert "rosbags is refused" in import_without_bags("swarm_loc_estimator.nodes.play_node").stderr
