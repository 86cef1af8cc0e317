"""The commands of tutorials, word by word, with simulated robots."""

import re
import shlex
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
from node_world import Program, Ros

from bench.shared.simulated_run import fitted_errors
from swarm_loc_estimator.common.launch import executable_path
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_msgs.msg import SwarmPose, SwarmPoses

DOC = Path(__file__).parents[3] / "swarm_loc_estimator" / "doc"
Poses = list[SwarmPoses]


def commands(page: str, title: str) -> dict[str, tuple[str, list[str]]]:
    """Executable -> its package and arguments, of a section of a page."""
    section = (DOC / page).read_text(encoding="utf-8").partition(f"## {title}\n")[2].partition("\n## ")[0]
    found = [shlex.split(line) for line in re.findall(r"^\./run (.+)$", section, re.MULTILINE)]
    return {name: (package, arguments) for package, name, *arguments in found}


def done(command: tuple[str, list[str]], name: str, status: int = 0) -> str:
    """What a command prints that ends with this status or a lower one."""
    package, arguments = command
    ended = subprocess.run(
        [executable_path(package, name), *arguments], capture_output=True, text=True, check=False
    )
    assert ended.returncode <= status, ended.stdout + ended.stderr
    return ended.stdout


def simulation_of(command: tuple[str, list[str]], folder: Path) -> Program:
    package, arguments = command
    return Program("simulate", folder / "log", {}, package=package, options=arguments)


def all_have(status: int, poses: Poses) -> bool:
    return bool(poses) and all(one.status == status for one in poses[-1].robots)


@pytest.mark.timeout(400)  # the renderer and the detector may have to be compiled first
def test_a_new_swarm_is_simulated_and_located(
    ros: Ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    page = commands("new_swarm.md", "Try it without robots")

    def run(name: str, status: int = 0) -> str:
        return done(page[name], name, status)

    assert list(page) == ["new", "print_markers", "simulate", "doctor", "survey", "watch"]
    assert "describes 3 robots and 20 landmarks" in run("new")
    run("print_markers")
    assert (tmp_path / "out" / "lab" / "markers.pdf").stat().st_size > 10_000
    swarm = load_swarm(tmp_path / "out" / "lab" / "swarm.yaml")
    poses: Poses = ros.listen(SwarmPoses, "swarm/poses")
    with simulation_of(page["simulate"], tmp_path) as simulation:
        ros.until(lambda: all_have(SwarmPose.STATUS_TRACKED, poses), 200.0)
        # on a busy machine messages may really pause, which is no fault of the page
        wrong = [line for line in run("doctor", 1).splitlines() if line.startswith("- ")]
        assert [line for line in wrong if "pauses for" not in line] == []
        assert "The origin is the first pose of one robot" in run("survey")
        assert simulation.end(signal.SIGTERM) == 0
    found = {mark.id: (mark.x, mark.y) for mark in load_swarm(tmp_path / "out/lab/surveyed.yaml").landmarks}
    true = {mark.id: (mark.x, mark.y) for mark in swarm.landmarks}
    assert len(found) >= 15
    errors = fitted_errors(np.array([*found.values()]), np.array([true[key] for key in found]))
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < 0.03
    assert (tmp_path / "out/lab/surveyed.png").stat().st_size > 10_000


@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("title", "status"),
    [
        ("E-pucks under a camera", SwarmPose.STATUS_TRACKED),
        ("Droplets", SwarmPose.STATUS_TRACKED),
        ("PushBots that map", SwarmPose.STATUS_UNCONFIRMED),
        ("TurtleBots in a map", SwarmPose.STATUS_TRACKED),
        ("Tags under ceiling cameras", SwarmPose.STATUS_TRACKED),
        ("Radios", SwarmPose.STATUS_TRACKED),
        ("Motion capture", SwarmPose.STATUS_TRACKED),
    ],
)
def test_robots_of_a_tutorial_are_located(
    ros: Ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, title: str, status: int
) -> None:
    monkeypatch.chdir(tmp_path)
    page = commands("tutorials.md", title)
    assert list(page) == ["new", "simulate", "watch"]
    done(page["new"], "new")
    poses: Poses = ros.listen(SwarmPoses, "swarm/poses")
    with simulation_of(page["simulate"], tmp_path) as simulation:
        ros.until(lambda: all_have(status, poses), 200.0)
        assert simulation.end(signal.SIGTERM) == 0
