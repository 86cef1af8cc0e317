"""What a user sets about a Droplet's driver."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from bench.shared.parameter_table import markdown_table
from swarm_loc_drivers.droplet.exchange import PollingSettings, TdmaSettings
from swarm_loc_drivers.droplet.hardware import AUDIO_DROPLET
from swarm_loc_drivers.droplet.parameters import DropletFleetParameters, DropletParameters
from swarm_loc_drivers.sim.droplet.world import DropletWorldParameters
from swarm_loc_estimator.common.parameters import ParameterError

DOC = Path(__file__).parents[2] / "doc"
PLAIN = DropletParameters(address="/dev/ttyUSB0")


@pytest.mark.parametrize(
    ("page", "parameters"),
    [
        ("droplet_driver_node.md", DropletParameters),
        ("droplet_fleet_node.md", DropletFleetParameters),
        ("droplet_world_node.md", DropletWorldParameters),
    ],
)
def test_the_page_says_what_the_table_says(page: str, parameters: type) -> None:
    assert markdown_table(parameters) in (DOC / page).read_text(encoding="utf-8")


def test_partners_are_asked_unless_turns_are_taken() -> None:
    parameters = replace(PLAIN, model="audio_droplet", partners=("6B6F", "0x0029", "df64"), exchange_rate=0.5)
    session = parameters.session
    assert session.model is AUDIO_DROPLET
    assert isinstance(session.exchanges, PollingSettings)
    assert session.exchanges.partners == (0x6B6F, 0x29, 0xDF64)
    assert session.exchanges.period_s == 2.0
    assert session.exchanges.powers == (256, 40)
    turns = replace(parameters, turns=20, turn=19).session.exchanges
    assert isinstance(turns, TdmaSettings)
    assert (turns.turn, turns.turns, turns.known) == (19, 20, (0x6B6F, 0x29, 0xDF64))


def test_without_a_rate_or_a_near_power() -> None:
    exchanges = replace(PLAIN, exchange_rate=0.0, near_power=0).session.exchanges
    assert isinstance(exchanges, PollingSettings)
    assert exchanges.period_s == 0.0
    assert exchanges.powers == (256,)


def test_robots_without_a_cable_have_names_and_ids() -> None:
    parameters = replace(PLAIN, relayed=("droplet2=6B6F", "b=29"))
    assert parameters.relayed_ids == {"droplet2": 0x6B6F, "b": 0x29}


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"address": "tcp://robot"}, "parameter address = 'tcp://robot' must be the path of a serial port"),
        ({"partners": ("6B6F", "G")}, "parameter partners has the id 'G' but ids lie in [1, FFFF]."),
        ({"partners": ("0",)}, "parameter partners has the id '0'"),
        ({"relayed": ("6B6F",)}, "parameter relayed has '6B6F' but must have entries as droplet2=6B6F."),
        ({"relayed": ("a=12345",)}, "parameter relayed has the id '12345'"),
        ({"relayed": ("a=29", "b=2A", "a=2B")}, "parameter relayed has 'a=2B', but each name and each id"),
        ({"relayed": ("a=29", "b=0x0029")}, "parameter relayed has 'b=0x0029', but each name and each id"),
        ({"partners": ("6B6F", "29", "6b6f")}, "parameter partners has '6b6f', but each id may stand once."),
        ({"far_power": 30}, "parameter near_power = 40 must be below far_power = 30."),
        ({"turns": 3, "turn": 3}, "parameter turn = 3 must be below turns = 3."),
    ],
)
def test_what_cannot_be_is_told_in_one_sentence(wrong: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ParameterError) as caught:
        replace(PLAIN, **wrong)
    assert sentence in str(caught.value)
