"""The simulated bags of the repository are what their own first line says that they were made by."""

from pathlib import Path

import pytest
from repository_bags import assert_same_messages, options_of, words_of

from bench.scenarios.generate_bag import main

SIMULATED = [
    "droplets_twenty",
    "eight_five_robots",
    "eight_five_robots_w2",
    "eight_one_robot_fast",
    "eight_one_robot_slow",
]


@pytest.mark.parametrize("name", SIMULATED)
def test_a_bag_comes_out_of_its_generator_again(name: str, tmp_path: Path) -> None:
    assert main([options_of(name)["swarm"], str(tmp_path / name), *words_of(name)]) == 0
    assert_same_messages(tmp_path / name, name)
