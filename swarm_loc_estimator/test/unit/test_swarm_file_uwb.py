"""The sections `uwb` and `anchors` of a swarm description."""

from pathlib import Path

import pytest

from swarm_loc_estimator.swarm.swarm import Anchor, UwbDevice
from swarm_loc_estimator.swarm.swarm_file import SwarmFileError, load_swarm, save_swarm

DOC = Path(__file__).parents[2] / "doc" / "uwb.md"
HUGE = 2**64 - 1
ADDRESS = "a whole number in [1, 18446744073709551615]"
DESCRIPTION = """\
fileversion: 1
types:
  rover: {camera: null, uwb: {x: 0.1, z: 0.4, range_sigma: 0.05}}
robots:
  a: {type: rover, uwb: {address: 0x1F, range_bias: -0.02}}
  b: {type: rover, uwb: {address: 18446744073709551615}}
  c: {type: rover, uwb: null}
anchors:
  - {address: 7, x: 0.0, y: 5.0, z: 2.5}
  - {address: 0x10, x: 5.0, y: 5.0, position_sigma: 0.05}
"""


def test_a_description_is_read_and_written_back(tmp_path: Path) -> None:
    path = tmp_path / "swarm.yaml"
    path.write_text(DESCRIPTION, encoding="utf-8")
    swarm = load_swarm(path)
    assert [robot.uwb for robot in swarm.robots] == [
        UwbDevice(31, 0.1, 0.0, 0.4, 0.05, range_bias=-0.02),
        UwbDevice(HUGE, 0.1, 0.0, 0.4, 0.05),
        None,
    ]
    assert swarm.anchors == (Anchor(7, 0.0, 5.0, 2.5), Anchor(16, 5.0, 5.0, position_sigma=0.05))
    save_swarm(swarm, path)
    assert load_swarm(path) == swarm


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("ess: 7", "ess: 31", "uwb.address 31 belongs to both robot 'a' and anchors[0]; ids must be unique."),
        ("address: 7, ", "", f"anchors[0] lacks address, {ADDRESS}."),
        ("address: 7", "address: 0", f"anchors[0].address is 0 but must be {ADDRESS}."),
        ("address: 7", "address: '0x0'", f"anchors[0].address is '0x0' but must be {ADDRESS}."),
        ("address: 7", "address: 1.5", f"anchors[0].address is 1.5 but must be {ADDRESS}."),
        ("address: 0x1F, ", "", f"robots.a.uwb lacks address, {ADDRESS}."),
        ("y: 5.0, z: 2.5", "z: 2.5", "anchors[0] lacks y, a number in [-1e+08, 1e+08] m."),
        ("x: 0.0", "x: .nan", "anchors[0].x is nan but must lie in [-1e+08, 1e+08] m."),
        ("sigma: 0.05", "sigma: 0", "types.rover.uwb.range_sigma is 0 but must lie in (0, 10] m."),
        (
            "{x: 0.1",
            "{address: 3, x: 0.1",
            "'types.rover.uwb.address' is not a known key; the nearest one is 'range_bias'.",
        ),
    ],
)
def test_a_mistake_is_named_in_one_sentence(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    path = tmp_path / "swarm.yaml"
    path.write_text(DESCRIPTION.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(SwarmFileError) as error:
        load_swarm(path)
    assert str(error.value) == f"{path}: {sentence}"


def test_the_example_of_the_page_is_a_description(tmp_path: Path) -> None:
    text = DOC.read_text(encoding="utf-8").split("```yaml\n")[1].partition("```")[0]
    path = tmp_path / "swarm.yaml"
    path.write_text(text, encoding="utf-8")
    swarm = load_swarm(path)
    assert all(robot.uwb for robot in swarm.robots)
    assert len(swarm.anchors) == 4
