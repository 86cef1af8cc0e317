"""The wheel of the package works without ROS and without the source tree; its one program is `swarm-loc`."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest

PACKAGE = Path(__file__).parents[2]
BAG = PACKAGE.parent / "bags" / "eight_one_robot_fast"
BUILD = "import sys; from setuptools.build_meta import build_wheel; build_wheel(sys.argv[1])"
SWARM_LOC = """
import sys

class Refused:
    def find_spec(self, name, path=None, target=None):
        package = name.partition(".")[0]
        if package.endswith("_msgs") or package in {"ament_index_python", "launch", "rclpy", *REFUSED}:
            raise ModuleNotFoundError(f"{name} is refused", name=name)

sys.meta_path.insert(0, Refused())
from swarm_loc_estimator.start import swarm_loc

def run(*arguments):
    sys.argv[:] = ["/somewhere/bin/swarm-loc", *arguments]
    try:
        return swarm_loc()
    except SystemExit as end:
        return end.code
"""
COMMANDS = {
    *("calibrate", "calibrate_ir", "doctor", "import_droplets", "import_mrclam", "new"),
    *("replay", "replay_map", "schema", "survey", "sweep"),
}
NODES = {"estimator_node", "localizer_bridge", "mapper_node", "markers_node", "play", "watch_node"}
STARTERS = {"demo", "graph", "watch"}  # Commands that start nodes


def python(
    code: str, *arguments: str, path: Path = PACKAGE, refused: str = ""
) -> subprocess.CompletedProcess[str]:
    """Run code after `SWARM_LOC` where nothing of ROS can be imported, with a package from a folder."""
    env = {name: value for name, value in os.environ.items() if name != "AMENT_PREFIX_PATH"}
    program = f"REFUSED = {refused.split()}\n{SWARM_LOC}\n{code}"
    command = [sys.executable, "-c", program, *arguments]
    return subprocess.run(
        command, env={**env, "PYTHONPATH": str(path)}, capture_output=True, text=True, check=False, cwd=path
    )


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> ZipFile:
    """The wheel, built of a copy of the package that has nothing beside it."""
    folder = tmp_path_factory.mktemp("wheel")
    copy = folder / "package"
    shutil.copytree(
        PACKAGE, copy, ignore=shutil.ignore_patterns("test", "__pycache__", "*.egg-info", "build")
    )
    subprocess.run([sys.executable, "-c", BUILD, folder], cwd=copy, check=True, capture_output=True)
    (built,) = folder.glob("swarm_loc_estimator-*-py3-none-any.whl")
    return ZipFile(built)


def test_a_wheel_has_all_files_of_the_package(wheel: ZipFile) -> None:
    root = PACKAGE / "swarm_loc_estimator"
    files = {path for path in root.rglob("*") if path.is_file() and "__pycache__" not in path.parts}
    files |= set((root / "common" / "messages" / "msg").iterdir())
    names = {str(path.relative_to(PACKAGE)) for path in files}
    assert names == {name for name in wheel.namelist() if name.startswith("swarm_loc_estimator/")}
    assert "swarm_loc_estimator/common/messages/msg/SwarmPose.msg" in names


def test_it_has_one_program_and_the_license(wheel: ZipFile) -> None:
    (entries,) = [name for name in wheel.namelist() if name.endswith("/entry_points.txt")]
    assert wheel.read(entries).decode().split() == [
        *("[console_scripts]", "swarm-loc", "=", "swarm_loc_estimator.start:swarm_loc")
    ]
    assert [name for name in wheel.namelist() if name.endswith("/LICENSE")]


def test_it_replays_a_bag_with_its_plots_without_ros(wheel: ZipFile, tmp_path: Path) -> None:
    wheel.extractall(tmp_path / "site")
    shutil.copytree(BAG, tmp_path / "bag")
    out = tmp_path / "out"
    code = "status = run('replay', *sys.argv[1:]); print(swarm_loc.__globals__['__file__']); sys.exit(status)"
    done = python(code, str(tmp_path / "bag"), "--out", str(out), path=tmp_path / "site")
    assert done.returncode == 0, done.stderr
    assert "NEES" in done.stdout
    assert done.stdout.splitlines()[-1] == str(tmp_path / "site" / "swarm_loc_estimator" / "start.py")
    made = {"errors.png", "overview.png", "poses.csv", "report.html", "report.txt"}
    assert {path.name for path in out.iterdir()} == made


def test_swarm_loc_lists_all_commands_and_loads_little() -> None:
    code = "run(*sys.argv[1:]); print(*sys.modules, file=sys.stderr)"
    listed, asked = python(code), python(code, "--help")
    assert listed.stdout == asked.stdout
    without, _, with_ros = listed.stdout.partition("With ROS 2:")
    assert {line.split()[0] for line in without.splitlines() if line.startswith("  ")} == COMMANDS
    assert {line.split()[0] for line in with_ros.splitlines() if line} == NODES | STARTERS
    assert "  replay           Replay a bag through the estimator: poses, " in without
    assert not {"numpy", "swarm_loc_estimator.cli"} & set(listed.stderr.split())


def test_commands_run_without_ros_and_the_others_say_that_they_need_it() -> None:
    names = sorted(COMMANDS | NODES | STARTERS)
    code = "print(*[name for name in sys.argv[1:] if run(name, '--help') == 1], file=sys.stderr)"
    done = python(code, *names)
    *sentences, failed = done.stderr.splitlines()
    assert set(failed.split()) == NODES | {"demo"}
    assert [one.split(":")[0] for one in sentences] == [
        f"swarm-loc {name} needs ROS 2 and this workspace, built and sourced" for name in failed.split()
    ]
    for name in COMMANDS:
        assert f"usage: swarm-loc {name} [-h]" in done.stdout


@pytest.mark.parametrize("name", ["graph", "watch"])
def test_commands_that_start_nodes_say_so_once_they_start_them(name: str) -> None:
    done = python("sys.exit(run(*sys.argv[1:]))", name, str(BAG / "swarm.yaml"))
    assert done.returncode == 1
    (sentence,) = done.stderr.splitlines()
    assert sentence.startswith(f"swarm-loc {name} needs ROS 2")


def test_a_bag_without_the_libraries_for_bags_ends_with_one_sentence() -> None:
    done = python("sys.exit(run(*sys.argv[1:]))", "replay", str(BAG), refused="rosbags mcap")
    assert done.returncode == 1
    assert done.stderr == (
        "swarm-loc replay needs the Python package rosbags, which is not installed:"
        " pip install lz4 mcap rosbags zstandard.\n"
    )


def test_an_unknown_command_is_one_sentence() -> None:
    done = python("sys.exit(run(*sys.argv[1:]))", "reply")
    assert (done.returncode, done.stderr) == (
        2,
        "swarm-loc has no command 'reply'; swarm-loc --help lists them.\n",
    )
