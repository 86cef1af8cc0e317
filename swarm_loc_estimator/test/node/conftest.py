"""Fixtures of the node tests."""

from pathlib import Path

import pytest
from node_world import SETTINGS, Robots, Ros, overrides, write_swarm

from swarm_loc_estimator.nodes.estimator_node import EstimatorNode


@pytest.fixture
def swarm_file(tmp_path: Path) -> Path:
    return write_swarm(tmp_path)


@pytest.fixture
def node(ros: Ros, swarm_file: Path) -> EstimatorNode:
    """An estimator node on simulated time, in this process."""
    parameters = overrides(swarm_file=str(swarm_file), use_sim_time=True, **SETTINGS)
    node: EstimatorNode = ros.add(EstimatorNode(parameter_overrides=parameters))
    return node


@pytest.fixture
def robots(ros: Ros, node: EstimatorNode) -> Robots:
    assert node.get_name() == "estimator"
    robots = Robots(ros)
    robots.wait_for_estimator()
    return robots
