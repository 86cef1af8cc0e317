"""The launch file starts what the `simulate` command starts, or says why not and ends with an error."""

import atexit
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest

from swarm_loc_drivers.sim.simulation import SimulationOptions, graph_of, simulated_swarm

pytest.importorskip("launch_ros.actions")
from launch_world import end_of, nodes_of

LAUNCH_FILE = Path(__file__).parents[2] / "launch" / "simulation.launch.py"
BAGS = Path(__file__).parents[3] / "bags"
SWARM_FILE = str(BAGS / "eight_one_robot_slow" / "swarm.yaml")


@pytest.fixture
def at_exit(monkeypatch: pytest.MonkeyPatch) -> list[Callable[[], object]]:
    """What is to be done when the launch ends."""
    asked: list[Callable[[], object]] = []
    monkeypatch.setattr(atexit, "register", asked.append)
    return asked


@pytest.fixture
def links(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Where folders for links are made."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_launch_arguments_become_the_simulations_nodes(
    links: Path, at_exit: list[Callable[[], object]]
) -> None:
    chosen = {"world": "w0", "seed": "3", "speed": "0.06", "rate": "1.0", "params_file": ""}
    started = nodes_of(LAUNCH_FILE, swarm_file=SWARM_FILE, **chosen)
    (folder,) = links.iterdir()
    options = SimulationOptions(SWARM_FILE)
    specs = graph_of(options, simulated_swarm(options), str(folder))
    assert started == [spec.executable for spec in specs]
    (clean_up,) = at_exit
    clean_up()
    assert not list(links.iterdir())


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"swarm_file": "missing.yaml"}, "missing.yaml"),
        ({"plan": "attic"}, "no floor plan 'attic'"),
        ({"params_file": "missing.yaml"}, "missing.yaml"),
        ({"rate": "abc"}, "argument rate = 'abc' must be a number in [0.01, 100]."),
        ({"rate": "0"}, "argument rate = '0' must be a number in [0.01, 100]."),
        ({"seed": "1.5"}, "argument seed = '1.5' must be a whole number in"),
        ({"speed": "7"}, "argument speed = '7' must be a number in [0.001, 0.12] m/s."),
    ],
)
def test_an_argument_that_cannot_be_used_ends_the_launch_with_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changed: dict[str, str], sentence: str
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    status, said = end_of(LAUNCH_FILE, **{"swarm_file": SWARM_FILE, **changed})
    assert status == 1
    assert sentence in said
    assert "process started" not in said
    assert not list(tmp_path.glob("swarm_loc-*"))
