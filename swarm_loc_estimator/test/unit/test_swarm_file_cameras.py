"""Fixed cameras and lying faces in a swarm description, and one sentence for whatever is wrong with them."""

import math
from pathlib import Path

import pytest

from swarm_loc_estimator.swarm.error_models import SensorModel
from swarm_loc_estimator.swarm.swarm import Face, FixedCamera
from swarm_loc_estimator.swarm.swarm_file import SwarmFileError, load_swarm, save_swarm

EXAMPLE = """\
fileversion: 1
types:
  puck: {faces: {top: {z: 0.1, yaw: 0.5, lies: true}, side: {yaw: 0.0}}}
robots:
  a: {type: puck, ids: {top: 4, side: 5}}
  b: {type: puck, faces: {side: null, top: {lies: false}}, ids: {top: 6}}
cameras:
  up: {x: 1.0, y: 2.0, z: 2.5, yaw: 0.1, sensor: {residual_position_sigma: 0.002}}
  wall: {x: 0.0, y: 2.0, z: 1.0, pitch: 0.6, roll: 0.1, position_sigma: 0.004, yaw_sigma: 0.01}
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "swarm.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_fixed_cameras_and_lying_faces_are_read_and_written(tmp_path: Path) -> None:
    swarm = load_swarm(written(tmp_path, EXAMPLE))
    up = FixedCamera("up", 1.0, 2.0, 2.5, 0.1, math.pi / 2, sensor=SensorModel(residual_position_sigma=0.002))
    assert swarm.cameras == (up, FixedCamera("wall", 0.0, 2.0, 1.0, 0.0, 0.6, 0.1, 0.004, 0.01))
    assert swarm.robots[0].faces == (Face("top", 4, z=0.1, yaw=0.5, lies=True), Face("side", 5, yaw=0.0))
    assert swarm.robots[1].faces == (Face("top", 6, z=0.1, yaw=0.5),)
    save_swarm(swarm, tmp_path / "again.yaml")
    assert load_swarm(tmp_path / "again.yaml") == swarm


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (", z: 2.5", "", "cameras.up lacks z"),
        ("z: 2.5", "z: .nan", "cameras.up.z is nan but must lie in [-10000, 10000] m"),
        ("osition_sigma: 0.004", "osition_sigma: 0.0", "cameras.wall.position_sigma is 0.0 but must lie in"),
        ("z: 2.5", "height: 2.5", "'cameras.up.height' is not a known key"),
        ("residual_position_sigma", "noise", "'cameras.up.sensor.noise' is not a known key"),
        ("  wall:", "  up:", "'up' is given twice"),
        ("  wall:", "  aerial:", "a name in cameras is 'aerial' but must be none of"),
        ("  wall:", "  a b:", "a name in cameras is 'a b' but must be letters"),
        ("  wall:", "  a:", "name 'a' is given to two robots or cameras, which must differ by more"),
        ("  wall:", "  UP:", "name 'up' is given to two robots or cameras"),
        ("  wall:", "  A:", "name 'a' is given to two robots or cameras"),
        ("lies: true", "lies: 1", "types.puck.faces.top.lies is 1 but must be true or false"),
        ("  up: {", "  up: 3 # {", "cameras.up is 3 but must be a mapping"),
    ],
)
def test_a_wrong_camera_is_named_in_one_sentence(old: str, new: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(SwarmFileError) as caught:
        load_swarm(written(tmp_path, EXAMPLE.replace(old, new, 1)))
    assert said in str(caught.value)
    assert str(caught.value).count(".\n") == 0
