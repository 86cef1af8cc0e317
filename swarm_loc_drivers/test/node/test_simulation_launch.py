"""The launch file starts what the `simulate` command starts; runs where launch_ros is installed."""

from __future__ import annotations

import atexit
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from node_world import module_at

from swarm_loc_drivers.sim.world_error import WorldError
from swarm_loc_drivers.simulation import SimulationOptions, simulation_nodes

launch = pytest.importorskip("launch")
pytest.importorskip("launch_ros")

LAUNCH_FILE = Path(__file__).parents[2] / "launch" / "simulation.launch.py"
BAGS = Path(__file__).parents[3] / "bags"


@pytest.fixture
def at_exit(monkeypatch: pytest.MonkeyPatch) -> list[Callable[[], object]]:
    """What is to be done when the launch ends."""
    asked: list[Callable[[], object]] = []
    monkeypatch.setattr(atexit, "register", lambda *call, **options: asked.append(partial(*call, **options)))
    return asked


@pytest.fixture
def links(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Where folders for links are made."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def context_of(bag: str) -> Any:
    """A launch with a bag's swarm."""
    context = launch.LaunchContext()
    chosen = {"world": "w0", "seed": "3", "speed": "0.06", "rate": "1.0", "params_file": ""}
    context.launch_configurations.update(chosen, swarm_file=str(BAGS / bag / "swarm.yaml"))
    return context


def test_launch_arguments_become_the_simulations_nodes(
    links: Path, at_exit: list[Callable[[], object]]
) -> None:
    actions = module_at(LAUNCH_FILE).start_nodes(context_of("eight_one_robot_slow"))
    (folder,) = links.iterdir()
    specs = simulation_nodes(SimulationOptions("swarm.yaml", str(folder)), ["epuck1"])
    assert [action.node_executable for action in actions] == [spec.executable for spec in specs]
    (clean_up,) = at_exit
    clean_up()
    assert not list(links.iterdir())


def test_a_swarm_that_cannot_be_simulated_starts_nothing(links: Path) -> None:
    with pytest.raises(WorldError, match="robot 'droplet1' has no start pose"):
        module_at(LAUNCH_FILE).start_nodes(context_of("droplets_twenty"))
    assert not list(links.iterdir())
