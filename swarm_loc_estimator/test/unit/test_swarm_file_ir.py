"""Infrared boards in the swarm description: layers, round trip, and one sentence for what is wrong."""

from pathlib import Path

import pytest

from swarm_loc_estimator.swarm import ir_board
from swarm_loc_estimator.swarm.ir_board import IrGains, RobotIr, load_ir_platform
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import SwarmFileError, load_swarm, save_swarm

PACKAGED_DROPLET = Path(ir_board.__file__).parents[1] / "config" / "ir" / "droplet.yaml"
IR = """\
fileversion: 1
types:
  droplet:
    odometry: null
    camera: null
    ir: {platform: droplet, gate_probability: 0.99}
robots:
  one: {type: droplet, ir: {id: 0xDF64}}
  two:
    type: droplet
    odometry: {wheel_noise: 0.01}
    ir: {id: 7, gains: {sensor: [1, 1, 1, 1, 1, 2], emitter: [1, 1, 1, 1, 1, 0.5]}}
  three: {type: droplet, ir: null}
  four: {ir: {id: 8, platform: board.yaml}}
"""


def error_of(folder: Path, text: str) -> str:
    with pytest.raises(SwarmFileError) as caught:
        load(folder, text)
    sentence = str(caught.value)
    assert sentence.endswith(".")
    assert "\n" not in sentence
    return sentence.removeprefix(f"{folder / 'swarm.yaml'}: ")


def load(folder: Path, text: str) -> Swarm:
    (folder / "swarm.yaml").write_text(text)
    return load_swarm(folder / "swarm.yaml")


def load_ir(folder: Path, text: str) -> Swarm:
    (folder / "board.yaml").write_text(PACKAGED_DROPLET.read_text())
    return load(folder, text)


def test_infrared_boards_come_from_their_layers(tmp_path: Path) -> None:
    one, two, three, four = load_ir(tmp_path, IR).robots
    assert (one.stands, two.stands, four.stands) == (True, False, False)
    assert two.odometry.wheel_noise == 0.01
    platform = load_ir_platform("droplet")
    assert one.ir == RobotIr(0xDF64, platform, "droplet", gate_probability=0.99)
    assert two.ir is not None
    assert two.ir.gate_probability == 0.99
    assert two.ir.believed_gains == IrGains((1, 1, 1, 1, 1, 2), (1, 1, 1, 1, 1, 0.5))
    assert one.ir.believed_gains == IrGains.unknown(platform)
    assert three.ir is None
    assert four.ir == RobotIr(8, platform, str(tmp_path / "board.yaml"))


def test_infrared_boards_are_written_and_read_back_also_elsewhere(tmp_path: Path) -> None:
    swarm = load_ir(tmp_path, IR)
    for folder in (tmp_path, tmp_path / "deeper"):
        folder.mkdir(exist_ok=True)
        save_swarm(swarm, folder / "again.yaml")
        assert load_swarm(folder / "again.yaml") == swarm
    assert "platform: ../board.yaml" in (tmp_path / "deeper" / "again.yaml").read_text()


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("0xDF64", "0", "robots.one.ir.id is 0 but must be a whole number in [1, 65535]."),
        ("0xDF64", "0x1DF64", "robots.one.ir.id is '0x1DF64' but must be a whole number in [1, 65535]."),
        ("0xDF64", "true", "robots.one.ir.id is True but must be a whole number in [1, 65535]."),
        ("0xDF64", "7", "ir.id 7 belongs to both robot 'one' and robot 'two'; ids must be unique."),
        (": droplet, ir: {id: 0xDF64}", ": droplet", "robots.one.ir lacks id, a whole number in [1, 65535]."),
        (
            "platform: droplet, ",
            "",
            "robots.one.ir lacks platform, the name of a packaged one or the path of a file.",
        ),
        (
            "platform: droplet, ",
            "id: 3, ",
            "'types.droplet.ir.id' is not a known key; the nearest one is 'gains'.",
        ),
        (
            "platform: droplet",
            "platform: 5",
            "types.droplet.ir.platform is 5 but must be the name of a packaged one or the path of a file.",
        ),
        (
            "id: 7",
            "id: 7, estimator: closed_form",
            (
                "robots.two.ir.estimator is no longer an option:"
                " poses are always estimated by likelihood; remove it."
            ),
        ),
        ("bability: 0.99", "bability: 0", "types.droplet.ir.gate_probability is 0 but must lie in [0.5, 1]."),
        (", 1, 1, 2", ", 1, 1, 90", "robots.two.ir.gains.sensor has 90 but factors must lie in [0.05, 20]."),
        ("[1, 1, 1, 1, 1, 2]", "[1, a]", "robots.two.ir.gains.sensor[1] is 'a' but must be a number."),
        (
            "[1, 1, 1, 1, 1, 2], emitter: [1, 1, 1, 1, 1, 0.5]",
            "[1], emitter: [1]",
            "robots.two.ir.gains has 1 sensors and emitters but must have the 6 of its platform.",
        ),
        ("sensor: [1, 1, 1, 1, 1, 2], ", "", "robots.two.ir.gains lacks sensor."),
    ],
)
def test_one_sentence_says_what_is_wrong_with_a_board(
    tmp_path: Path, old: str, new: str, sentence: str
) -> None:
    assert old in IR
    (tmp_path / "board.yaml").write_text(PACKAGED_DROPLET.read_text())
    assert error_of(tmp_path, IR.replace(old, new, 1)) == sentence


def test_a_platform_file_that_is_missing_or_wrong_is_named(tmp_path: Path) -> None:
    assert "robots.four.ir.platform: " in (sentence := error_of(tmp_path, IR))
    assert "board.yaml cannot be read" in sentence
    (tmp_path / "board.yaml").write_text(PACKAGED_DROPLET.read_text().replace("radius: 0.022", "radius: -1"))
    assert "board.yaml: radius is -1 but must lie in" in error_of(tmp_path, IR)
    sentence = error_of(tmp_path, IR.replace("platform: droplet", "platform: dropet"))
    assert sentence.startswith("types.droplet.ir.platform: 'dropet' is no packaged infrared platform (")
