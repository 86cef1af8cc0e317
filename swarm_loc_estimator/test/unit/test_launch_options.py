"""Launch options from texts, and files that cannot be used, told before anything starts."""

import re
from pathlib import Path

import pytest

from swarm_loc_estimator.cli.graph import check_graph
from swarm_loc_estimator.common.launch import GraphOptions, options_from
from swarm_loc_estimator.common.parameters import ParameterError, UserError

BAG = Path(__file__).parents[3] / "bags" / "eight_one_robot_slow"
SWARM_FILE = str(BAG / "swarm.yaml")


def test_texts_become_options() -> None:
    texts = {"swarm_file": "swarm.yaml", "bag": "", "rate": "2", "use_sim_time": "true", "parameter_file": ""}
    assert options_from(GraphOptions, texts) == GraphOptions("swarm.yaml", rate=2.0, use_sim_time=True)


@pytest.mark.parametrize("rate", ["abc", "0", "-1", "nan", "inf", "1e9"])
def test_a_number_that_cannot_be_is_told_with_its_name_and_range(rate: str) -> None:
    sentence = re.escape(f"argument rate = '{rate}' must be a number in [0.01, 1000].")
    with pytest.raises(ParameterError, match=sentence):
        options_from(GraphOptions, {"swarm_file": "swarm.yaml", "rate": rate})


def test_an_option_that_must_be_set_is_named() -> None:
    with pytest.raises(ParameterError, match="argument swarm_file is not set"):
        options_from(GraphOptions, {"swarm_file": ""})


def test_files_that_can_be_used_pass(tmp_path: Path) -> None:
    parameters = tmp_path / "parameters.yaml"
    parameters.write_text("/**: {estimator: {ros__parameters: {window_s: 1.0}}}\n", encoding="utf-8")
    check_graph(GraphOptions(SWARM_FILE, bag=str(BAG), parameter_file=str(parameters)))


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (GraphOptions("missing.yaml"), "missing.yaml"),
        (GraphOptions(SWARM_FILE, bag="missing_bag"), "missing_bag"),
        (GraphOptions(SWARM_FILE, parameter_file="missing_parameters.yaml"), "missing_parameters.yaml"),
        (GraphOptions(SWARM_FILE, parameter_file=SWARM_FILE), "has no ros__parameters"),
    ],
)
def test_a_file_that_cannot_be_used_is_named_in_one_sentence(options: GraphOptions, named: str) -> None:
    with pytest.raises((UserError, OSError), match=named) as told:
        check_graph(options)
    assert "\n" not in str(told.value)
