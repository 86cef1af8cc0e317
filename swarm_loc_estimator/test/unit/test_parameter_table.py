"""One table of parameters makes the node's parameters and those of its page under doc/."""

from dataclasses import dataclass, fields
from pathlib import Path

import pytest

from bench.shared.parameter_table import markdown_table
from swarm_loc_estimator.common.command_line import parameters_of
from swarm_loc_estimator.common.parameters import (
    ParameterError,
    ParameterSpec,
    choice,
    from_values,
    parameter_specs,
)
from swarm_loc_estimator.nodes.parameters import (
    EstimatorParameters,
    MapperParameters,
    MarkersParameters,
    PlayerParameters,
    WatchParameters,
)
from swarm_loc_estimator.sensors.localizers import BridgeParameters
from swarm_loc_estimator.timeline.settings import Settings

DOC = Path(__file__).parents[2] / "doc"


@pytest.mark.parametrize(
    ("page", "cls"),
    [
        ("estimator_node.md", EstimatorParameters),
        ("motion_capture.md", BridgeParameters),
        ("play.md", PlayerParameters),
        ("mapper_node.md", MapperParameters),
        ("watch.md", WatchParameters),
        ("watch.md", MarkersParameters),
    ],
)
def test_the_page_says_what_the_table_says(page: str, cls: type) -> None:
    assert markdown_table(cls) in (DOC / page).read_text(encoding="utf-8")


def test_defaults_make_the_default_object() -> None:
    defaults = {spec.name: spec.default for spec in parameter_specs(EstimatorParameters)}
    assert from_values(EstimatorParameters, defaults) == EstimatorParameters()


def test_every_setting_of_the_estimator_is_a_parameter() -> None:
    names = {spec.name for spec in parameter_specs(EstimatorParameters)}
    public = {field.name for field in fields(Settings) if not field.metadata.get("is_internal")}
    assert public <= names


def test_settings_from_texts_are_whole_numbers_where_the_setting_is_one() -> None:
    read = parameters_of(Settings, ["horizon_s=3", "lost_after=5"])
    assert (read.horizon_s, type(read.horizon_s), read.lost_after, type(read.lost_after)) == (
        3.0,
        float,
        5,
        int,
    )
    for pair, said in (
        ("lost_after=2.9", r"parameter lost_after = '2\.9' must be a whole number"),
        ("horizon_s=x", "parameter horizon_s = 'x' must be a number"),
        ("horizon_s=1e9", r"parameter horizon_s = 1000000000\.0 must lie in \[0\.05, 60\] s"),
        ("nothing=1", "--set nothing=1: 'nothing' is no parameter; there are horizon_s, "),
    ):
        with pytest.raises(ParameterError, match=said):
            parameters_of(Settings, [pair])
    with pytest.raises(ParameterError, match="'loop' is no parameter"):
        parameters_of(PlayerParameters, ["loop=true"], {"bag": "x", "loop": True})
    assert parameters_of(PlayerParameters, ["loop=true", "topics=a,b"], {"bag": "x"}) == PlayerParameters(
        bag="x", loop=True, topics=("a", "b")
    )
    with pytest.raises(ParameterError, match=r"lost_after = 2\.9 must be a whole number"):
        spec_of(EstimatorParameters, "lost_after").checked(2.9)


def spec_of(cls: type, name: str) -> ParameterSpec:
    (spec,) = [spec for spec in parameter_specs(cls) if spec.name == name]
    return spec


def test_whole_numbers_will_do_for_real_ones_but_not_the_other_way_round() -> None:
    rate = spec_of(PlayerParameters, "rate").checked(4)
    assert (rate, type(rate)) == (4.0, float)
    with pytest.raises(ParameterError, match=r"wait_for_subscribers = 4\.0 must be a whole number"):
        spec_of(PlayerParameters, "wait_for_subscribers").checked(4.0)
    with pytest.raises(ParameterError, match="rate = True must be a number"):
        spec_of(PlayerParameters, "rate").checked(True)


def test_lists_come_as_lists_or_tuples() -> None:
    topics = spec_of(PlayerParameters, "topics")
    assert topics.checked(["a", "b"]) == topics.checked(("a", "b")) == ("a", "b")
    with pytest.raises(ParameterError, match="topics = 'a' must be a list of texts"):
        topics.checked("a")


@dataclass(frozen=True)
class Choosing:
    """One parameter."""

    colour: str = choice("red", ("red", "blue"), "of the wall")


def test_a_choice_is_one_of_its_texts() -> None:
    colour = spec_of(Choosing, "colour")
    assert colour.checked("blue") == "blue"
    for wrong in ("", "green"):
        with pytest.raises(ParameterError, match=f"parameter colour = '{wrong}' must be one of red, blue"):
            colour.checked(wrong)
    assert '| `colour` | `"red"` | red, blue | of the wall |' in markdown_table(Choosing)
