"""The launch file starts the list of the `graph` command; runs where launch_ros is installed."""

from __future__ import annotations

from pathlib import Path

import pytest
from node_world import module_at

from swarm_loc_estimator.graph import GraphOptions, graph_nodes

launch = pytest.importorskip("launch")
pytest.importorskip("launch_ros")

LAUNCH_FILE = Path(__file__).parents[2] / "launch" / "swarm.launch.py"


def test_launch_arguments_become_the_graphs_nodes() -> None:
    module = module_at(LAUNCH_FILE)
    context = launch.LaunchContext()
    chosen = {
        "swarm_file": "swarm.yaml",
        "bag": "eight",
        "rate": "2.0",
        "use_sim_time": "false",
        "params_file": "",
    }
    context.launch_configurations.update(chosen)

    actions = module.start_nodes(context)

    specs = graph_nodes(GraphOptions("swarm.yaml", bag="eight", rate=2.0))
    assert [action.node_executable for action in actions] == [spec.executable for spec in specs]
