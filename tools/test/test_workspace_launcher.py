"""`./run` finds executables as `ros2 run` does."""

from pathlib import Path

import pytest

from workspace import launcher
from workspace.layout import WorkspaceError


@pytest.fixture
def env(tmp_path: Path) -> dict[str, str]:
    """An environment with a package of one executable and a file that is none, in a second prefix."""
    prefix = tmp_path / "a prefix"
    for folder in ("share/ament_index/resource_index/packages", "lib/swarm_loc_vision"):
        (prefix / folder).mkdir(parents=True)
    (prefix / "share/ament_index/resource_index/packages/swarm_loc_vision").touch()
    (prefix / "lib/swarm_loc_vision/detector_node").touch(mode=0o755)
    (prefix / "lib/swarm_loc_vision/notes.txt").touch(mode=0o644)
    return {"AMENT_PREFIX_PATH": f"{tmp_path / 'empty'}:{prefix}"}


def test_an_executable_gets_its_arguments_unchanged(env: dict[str, str], tmp_path: Path) -> None:
    program = tmp_path / "a prefix/lib/swarm_loc_vision/detector_node"
    arguments = ["--ros-args", "-p", "family:=a b", "--", "-x"]

    assert launcher.command(env, ["swarm_loc_vision", "detector_node", *arguments]) == [
        str(program),
        *arguments,
    ]


def test_any_command_runs_behind_two_dashes(env: dict[str, str]) -> None:
    assert launcher.command(env, ["--", "pytest", "--", "x"]) == ["pytest", "--", "x"]


def test_a_wrong_executable_is_told_the_right_ones(env: dict[str, str]) -> None:
    with pytest.raises(
        WorkspaceError, match=r"no executable 'play' in swarm_loc_vision; it has: detector_node\."
    ):
        launcher.command(env, ["swarm_loc_vision", "play"])


def test_a_wrong_package_is_told_the_right_ones(env: dict[str, str]) -> None:
    with pytest.raises(WorkspaceError, match=r"no package 'vision'; .* swarm_loc_vision"):
        launcher.command(env, ["vision", "play"])


def test_a_package_alone_lists_its_executables(env: dict[str, str]) -> None:
    assert launcher.describe(env, ["swarm_loc_vision"]) == "swarm_loc_vision detector_node"


def test_a_command_that_is_not_there_is_one_sentence(env: dict[str, str]) -> None:
    with pytest.raises(WorkspaceError, match=r"Cannot start 'no-such-command': No such file or directory\."):
        launcher.start(env, ["--", "no-such-command"])
