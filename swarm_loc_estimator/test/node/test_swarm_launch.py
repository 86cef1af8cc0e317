"""The launch file starts the list of the `graph` command, or says why not and ends with an error."""

from pathlib import Path

import pytest

from swarm_loc_estimator.common.launch import GraphOptions, graph_nodes

pytest.importorskip("launch_ros.actions")
from launch_world import end_of, nodes_of

LAUNCH_FILE = Path(__file__).parents[2] / "launch" / "swarm.launch.py"
BAG = Path(__file__).parents[3] / "bags" / "eight_one_robot_slow"
USED = {"swarm_file": str(BAG / "swarm.yaml"), "bag": str(BAG)}


def test_launch_arguments_become_the_graphs_nodes() -> None:
    started = nodes_of(LAUNCH_FILE, **USED, rate="2.0", use_sim_time="false", params_file="")
    specs = graph_nodes(GraphOptions(USED["swarm_file"], bag=USED["bag"], rate=2.0))
    assert started == [spec.executable for spec in specs]


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"swarm_file": "missing.yaml"}, "missing.yaml"),
        ({"bag": "missing"}, "missing"),
        ({"params_file": "missing.yaml"}, "missing.yaml"),
        ({"rate": "abc"}, "argument rate = 'abc' must be a number in [0.01, 1000]."),
        ({"rate": "0"}, "argument rate = '0' must be a number in [0.01, 1000]."),
    ],
)
def test_an_argument_that_cannot_be_used_ends_the_launch_with_an_error(
    changed: dict[str, str], sentence: str
) -> None:
    status, said = end_of(LAUNCH_FILE, **{**USED, **changed})
    assert status == 1
    assert sentence in said
    assert "process started" not in said
