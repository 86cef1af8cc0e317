"""The simulated bags of the repository are what their own first line says that they were made by."""

import re
from pathlib import Path

import pytest

from swarm_loc_drivers.cli.generate_bag import main

BAGS = Path(__file__).parents[3] / "bags"
SIMULATED = ["eight_five_robots", "eight_five_robots_w2", "eight_one_robot_fast", "eight_one_robot_slow"]


@pytest.mark.parametrize("name", SIMULATED)
def test_a_bag_comes_out_of_its_generator_again(name: str, tmp_path: Path) -> None:
    first_line = (BAGS / name / "swarm.yaml").read_text(encoding="utf-8").splitlines()[0]
    said = dict(re.findall(r"(\w+)=([^,\s]+?)[,.]?(?=\s|$)", first_line))
    swarm, unknown = said.pop("swarm"), said.pop("start_unknown")
    assert unknown == "False"
    options = [word for key, value in said.items() for word in (f"--{key}", value)]
    assert main([swarm, str(tmp_path / name), *options]) == 0
    again, kept = ((folder / name / f"{name}.mcap").read_bytes() for folder in (tmp_path, BAGS))
    assert again == kept
