"""The commands on the page of new swarms, word by word: from the description to surveyed places and poses."""

from __future__ import annotations

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

PAGE = Path(__file__).parents[3] / "swarm_loc_estimator" / "doc" / "new_swarm.md"


def commands() -> dict[str, tuple[str, list[str]]]:
    """Executable -> its package and arguments, of the section about simulated robots."""
    section = PAGE.read_text(encoding="utf-8").partition("## Try it without robots")[2]
    found = [shlex.split(line) for line in re.findall(r"^\./run (.+)$", section, re.MULTILINE)]
    return {name: (package, arguments) for package, name, *arguments in found}


@pytest.mark.timeout(400)  # the renderer and the detector may have to be compiled first
def test_a_new_swarm_is_simulated_and_located(
    ros: Ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    def run(name: str, status: int = 0) -> str:
        package, arguments = commands()[name]
        done = subprocess.run(
            [executable_path(package, name), *arguments], capture_output=True, text=True, check=False
        )
        assert done.returncode <= status, done.stdout + done.stderr
        return done.stdout

    assert list(commands()) == ["new", "print_markers", "simulate", "doctor", "survey", "watch"]
    assert "describes 3 robots and 20 landmarks" in run("new")
    run("print_markers")
    assert (tmp_path / "out" / "lab" / "markers.pdf").stat().st_size > 10_000
    swarm = load_swarm(tmp_path / "out" / "lab" / "swarm.yaml")
    poses: list[SwarmPoses] = ros.listen(SwarmPoses, "swarm/poses")
    package, arguments = commands()["simulate"]
    program = {"package": package, "options": arguments}
    with Program("simulate", tmp_path / "log", {}, **program) as simulation:  # type: ignore[arg-type]

        def are_tracked() -> bool:
            return bool(poses) and all(one.status == SwarmPose.STATUS_TRACKED for one in poses[-1].robots)

        ros.until(are_tracked, 200.0)
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
