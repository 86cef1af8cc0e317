"""The pages under doc/ have the parameters of the steering nodes, which stand in the nodes' own modules."""

from pathlib import Path

import pytest

from bench.shared.parameter_table import markdown_table
from swarm_loc_drivers.sim.scenarios.steering_nodes import DropletSteeringParameters, SteeringParameters

DOC = Path(__file__).parents[2] / "doc"


@pytest.mark.parametrize(
    ("page", "parameters"),
    [("epuck_world_node.md", SteeringParameters), ("droplet_world_node.md", DropletSteeringParameters)],
)
def test_the_page_says_what_the_table_says(page: str, parameters: type) -> None:
    assert markdown_table(parameters) in (DOC / page).read_text(encoding="utf-8")
