"""The swarm description: layers, round trip, and one sentence for whatever is wrong with a file."""

import math
import string
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from swarm_loc_estimator.common.parameters import number_specs
from swarm_loc_estimator.swarm import ir_board
from swarm_loc_estimator.swarm.error_models import (
    ClockModel,
    FixModel,
    LidarModel,
    MotionResponse,
    OdometryModel,
    RandomWalk,
    SensorModel,
    SingleLidar,
)
from swarm_loc_estimator.swarm.ir_board import IrGains, RobotIr, load_ir_platform
from swarm_loc_estimator.swarm.swarm import (
    Anchor,
    CameraMount,
    Face,
    FixedCamera,
    Landmark,
    Robot,
    StartSigma,
    Swarm,
    SwarmError,
    UwbDevice,
)
from swarm_loc_estimator.swarm.swarm_file import RESERVED_NAMES, SwarmFileError, load_swarm, save_swarm

EXAMPLE = """\
fileversion: 1
defaults:
  sensor: {range_sigma: 0.2, gate_probability: 1}
  camera: {x: 0.01}
  landmark: {position_sigma: 0.02}
types:
  epuck:
    odometry: {wheel_separation: 0.053, wheel_noise: 2e-5}
    camera: {x: 0.035, z: 0.028}
    faces:
      front: {x: 0.035, yaw: 0}
      back: {x: -0.035, yaw: 3.1416}
  blind:
    camera: null
robots:
  one:
    type: epuck
    ids: {front: 1, back: 2}
    start: {x: 1, y: -2.5, theta: 0.5}
    sensor: {range_sigma: 0.3}
  two:
    type: epuck
    faces: {back: null, front: {z: 0.1, size: 0.03}}
    ids: {front: 3}
    start_sigma: {theta: 0.5}
  three: {type: blind}
  four:
landmarks:
  100: {x: 1.5, y: 0.25, yaw: -1.0, size: 0.08}
  101: {x: 0, y: 0, position_sigma: 0}
"""
RELAXED = settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])


WHEELS = "types.epuck.odometry.wheel_separation"
A_MARKER_ID = "a marker id, a whole number in [0, 4294967295]"


def load(folder: Path, text: str | bytes) -> Swarm:
    path = folder / "swarm.yaml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return load_swarm(path)


def read_back(folder: Path, swarm: Swarm) -> Swarm:
    save_swarm(swarm, folder / "again.yaml", "a comment\nof two lines")
    return load_swarm(folder / "again.yaml")


def error_of(folder: Path, text: str | bytes) -> str:
    with pytest.raises(SwarmFileError) as caught:
        load(folder, text)
    return sentence_of(folder, caught.value)


def sentence_of(folder: Path, error: SwarmFileError) -> str:
    sentence = str(error)
    assert sentence.startswith(str(folder / "swarm.yaml"))
    assert sentence.endswith(".")
    assert "\n" not in sentence
    return sentence.removeprefix(str(folder / "swarm.yaml")).removeprefix(": ")


def test_layers_fall_from_defaults_to_type_to_robot(tmp_path: Path) -> None:
    swarm = load(tmp_path, EXAMPLE)
    one, two, three, four = swarm.robots
    assert one.odometry == OdometryModel(wheel_separation=0.053, wheel_noise=2e-5)
    assert (one.sensor.range_sigma, two.sensor.range_sigma, one.sensor.gate_probability) == (0.3, 0.2, 1.0)
    assert one.camera == CameraMount(x=0.035, z=0.028)
    assert one.faces == (Face("front", 1, x=0.035, yaw=0.0), Face("back", 2, x=-0.035, yaw=3.1416))
    assert (one.start, two.start) == ((1.0, -2.5, 0.5), None)
    assert two.faces == (Face("front", 3, x=0.035, z=0.1, yaw=0.0, size=0.03),)
    assert two.start_sigma == StartSigma(theta=0.5)
    assert three.camera is None
    assert (four.camera, four.type) == (CameraMount(x=0.01), "")
    assert swarm.landmarks == (
        Landmark(100, 1.5, 0.25, yaw=-1.0, size=0.08, position_sigma=0.02),
        Landmark(101, 0.0, 0.0, yaw=None, size=0.05, position_sigma=0.0),
    )


SHARES = "speeds: [0, 0.1], turn_rates: [0.0], speed_share: [[1], [0.9]], turn_share: [[1], [0.8]]"


def test_motion_response_is_said_as_a_whole(tmp_path: Path) -> None:
    text = (
        "fileversion: 1\ntypes: {t: {response: {%s}}}\nrobots: {a: {type: t}, b: {type: t, response: null}}\n"
    )
    one, two = load(tmp_path, text % SHARES).robots
    assert one.response == MotionResponse((0.0, 0.1), (0.0,), ((1.0,), (0.9,)), ((1.0,), (0.8,)))
    assert two.response is None
    for old, new, sentence in (
        ("0.1]", "-1]", "types.t.response.speeds is [0.0, -1.0] but must ascend within [0, 1000]."),
        ("[0.9]", "[.nan]", "types.t.response.speed_share[1][0] is nan but must be a number."),
        ("[0.8]", "0.8", "types.t.response.turn_share[1] is 0.8 but must be a list."),
        (", turn_rates: [0.0]", "", "types.t.response lacks turn_rates, a list of numbers."),
        ("speeds", "speedz", "'types.t.response.speedz' is not a known key; the nearest one is 'speeds'."),
    ):
        assert old in SHARES
        assert error_of(tmp_path, text % SHARES.replace(old, new, 1)) == sentence


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (" 0.053", " -1", f"{WHEELS} is -1 but must lie in [0.001, 10] m."),
        (" 0.053", " .nan", f"{WHEELS} is nan but must lie in [0.001, 10] m."),
        (" 0.053", " -.inf", f"{WHEELS} is -inf but must lie in [0.001, 10] m."),
        (" 0.053", " true", f"{WHEELS} is True but must be a number in [0.001, 10] m."),
        (" 0.053", " '1'", f"{WHEELS} is '1' but must be a number in [0.001, 10] m."),
        ("range_sigma: 0.2", "range_sigma: 0", "defaults.sensor.range_sigma is 0 but must lie in (0, 10] m."),
        (
            "wheel_separation: 0.053",
            "wheel_seperation: 1",
            (
                "'types.epuck.odometry.wheel_seperation' is not a known key;"
                " the nearest one is 'wheel_separation'."
            ),
        ),
        ("landmarks:", "landmark:", "'landmark' is not a known key; the nearest one is 'landmarks'."),
        (
            "type: blind",
            "type: blnd",
            "robots.three.type is 'blnd' but must be one of the types; the nearest one is 'blind'.",
        ),
        (
            "front: 3",
            "front: 1",
            (
                "marker id 1 belongs to both face 'front' of robot 'one' and face 'front' of robot 'two';"
                " ids must be unique."
            ),
        ),
        (
            "front: 3",
            "front: 100",
            "marker id 100 belongs to both face 'front' of robot 'two' and landmark 100; ids must be unique.",
        ),
        ("front: 3", "front: 3.5", f"robots.two.ids.front is 3.5 but must be {A_MARKER_ID}."),
        ("front: 3", "frnt: 3", "'robots.two.ids.frnt' is not a known key; the nearest one is 'front'."),
        ("1, back: 2", "1", "robots.one.ids has no id for face 'back'; give one or set faces.back to null."),
        ("101", "abc", f"landmarks.abc is 'abc' but must be {A_MARKER_ID}."),
        ("  101: {x: 0, y: 0", "  100: {x: 0, y: 0", "'100' is given twice, again in line 30."),
        ("position_sigma", "x", "'defaults.landmark.x' is not a known key; the nearest one is 'yaw_sigma'."),
        (
            "position_sigma: 0.02",
            "yaw_sigma: -1",
            "defaults.landmark.yaw_sigma is -1 but must lie in [0, 10] rad.",
        ),
        ("size: 0.08", "size: 0.0", "landmarks.100.size is 0.0 but must lie in [0.001, 10] m."),
        ("  101: {x: 0, y: 0", "  101: {x: 0", "landmarks.101 lacks y, a number in [-1e+08, 1e+08] m."),
        ("y: -2.5, theta: 0.", "y: -2.", "robots.one.start lacks theta, a number in [-6.2832, 6.2832] rad."),
        (
            "  three:",
            "  2three:",
            (
                "a name in robots is '2three' but must be letters, digits and underscores"
                " and start with a letter."
            ),
        ),
        ("fileversion: 1", "fileversion: 2", "fileversion is 2 but must be 1."),
        ("fileversion: 1", "fileversion: true", "fileversion is True but must be 1."),
        ("fileversion: 1\n", "", "fileversion is None but must be 1."),
        ("camera: {x: 0.01}", "camera: 3", "defaults.camera is 3 but must be a mapping of keys to values."),
        (
            "camera: {x: 0.01}",
            "lidar: {others: {a b: {x: 1}}}",
            "a name in defaults.lidar.others is 'a b' but must be a topic other than scan, such as rear.",
        ),
        (
            "camera: {x: 0.01}",
            "lidar: {others: {rear: {z: 1}}}",
            "'defaults.lidar.others.rear.z' is not a known key; the nearest one is 'yaw'.",
        ),
        (
            "camera: {x: 0.01}",
            "lidar: {others: {rear: {x: 1}}}",
            "robots.one.lidar.range_sigma is 0 but must be greater, since there are others.",
        ),
        (
            "camera: {x: 0.01}",
            "lidar: {others: {rear: {x: 11}}}",
            "defaults.lidar.others.rear.x is 11 but must lie in [-10, 10] m.",
        ),
    ],
)
def test_one_sentence_names_key_value_and_range(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    assert error_of(tmp_path, EXAMPLE.replace(old, new, 1)) == sentence


@pytest.mark.parametrize("name", ["map", "swarm", "aerial", "estimator", "tf"])
def test_names_that_topics_and_frames_have_are_refused(tmp_path: Path, name: str) -> None:
    said = error_of(tmp_path, EXAMPLE.replace("\n  four:", f"\n  {name}:"))
    assert said.startswith(f"a name in robots is '{name}' but must be none of aerial, clock,")


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("", "fileversion is None"),
        ("fileversion: 1\n", "robots is empty but must name at least one robot"),
        ("[", "is not YAML"),
        (b"\xff\xfe\x00", "is not YAML"),
        ("a: &a [*a]", "contains itself"),
        ("? [1]\n: 2", "has a key that is no word or number"),
        ("1.5: 2", "neither a name nor a whole number"),
        ("[" * 500 + "]" * 500, "nested too deeply"),
        ("fileversion: !!python/name:os.system x", "tag"),
        (f"fileversion: 1\nrobots: {{a: {{start: {{x: {'9' * 400}, y: 0, theta: 0}}}}}}", "must lie in"),
        (f"fileversion: 1\nrobots: {{{'a' * 65}: }}", "must have at most 64 characters"),
        ("fileversion: 1\nrobots: {a: {}, A: {}}", "which must differ by more than capitals"),
        (
            "fileversion: 1\nrobots:\n" + "".join(f"  a{k}:\n" for k in range(5001)),
            "robots names 5001 robots but must name at most 5000",
        ),
        (
            "fileversion: 1\ndefaults: {landmark: {position_sigma: 0.01}}\nrobots: {a: {}}\nlandmarks:\n"
            + "".join(f"  {k}: {{x: {k}, y: 0}}\n" for k in range(3_334)),
            "what has a sigma makes 10002 states beside the poses but must make at most 10000",
        ),
        ("#" * 2_000_001, "has more than the 2000000 bytes that are allowed"),
        ("%YAML 1.1\n---\nfileversion: 010", "fileversion is 10 but must be 1"),
        ("fileversion: !!bool maybe", "is not YAML"),
        ("fileversion: !!int ''", "is not YAML"),
        ("fileversion: !!timestamp 2000-01-01", "tag"),
        ("fileversion: 1\n!!merge <<: {}", "tag"),
    ],
    ids=lambda one: repr(one)[:40],
)
def test_files_that_are_no_description(tmp_path: Path, text: str | bytes, part: str) -> None:
    assert part in error_of(tmp_path, text)


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SwarmFileError, match="cannot be read: No such file or directory"):
        load_swarm(tmp_path / "swarm.yaml")


def test_numbers_are_read_as_people_write_them(tmp_path: Path) -> None:
    start = "fileversion: 1\nrobots: {a: {start: {x: %s, y: 0, theta: 0}}}"
    for text, value in {"1e-4": 1e-4, "-.5": -0.5, "+3": 3.0, "2.": 2.0, "1E3": 1000.0, "010": 10.0}.items():
        assert load(tmp_path, start % text).robots[0].start == (value, 0.0, 0.0)
    for text in ("0x10", "1:30", "1_000", "yes"):
        assert "must be a number" in error_of(tmp_path, start % text)


def test_two_robots_of_one_name_are_refused() -> None:
    with pytest.raises(SwarmError, match="name 'a' is given to two robots or cameras"):
        Swarm((Robot("a"), Robot("a")))


@RELAXED
@given(data=st.data())
def test_mutated_files_load_or_say_one_sentence(tmp_path: Path, data: st.DataObject) -> None:
    text = EXAMPLE
    for _ in range(data.draw(st.integers(1, 4))):
        begin = data.draw(st.integers(0, len(text)))
        end = data.draw(st.integers(begin, min(len(text), begin + 12)))
        words = ("1e999", ".nan", "true", "null", "{", "}", ":", "- ", "&a ", "*a", "!!int ", "?", "''", "1")
        pieces = st.sampled_from([*words, "\n", "  ", "\t"])
        text = text[:begin] + data.draw(pieces | st.text(max_size=4)) + text[end:]
    try:
        swarm = load(tmp_path, text.encode("utf-8", "surrogatepass"))
    except SwarmFileError as error:
        sentence_of(tmp_path, error)
    else:
        assert all(math.isfinite(value) for robot in swarm.robots for value in robot.start or ())


def test_an_imu_needs_odometry(tmp_path: Path) -> None:
    text = "fileversion: 1\nrobots: {a: {odometry: null, camera: null, imu: {turn_noise_density: 0.01}}}\n"
    said = "robot 'a' has no odometry, so its imu.turn_noise_density must be 0"
    assert said in error_of(tmp_path, text)


EXAMPLE_CAMERAS = """\
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


def test_fixed_cameras_and_lying_faces_are_read_and_written(tmp_path: Path) -> None:
    swarm = load(tmp_path, EXAMPLE_CAMERAS)
    up = FixedCamera("up", 1.0, 2.0, 2.5, 0.1, math.pi / 2, sensor=SensorModel(residual_position_sigma=0.002))
    assert swarm.cameras == (up, FixedCamera("wall", 0.0, 2.0, 1.0, 0.0, 0.6, 0.1, 0.004, 0.01))
    assert swarm.robots[0].faces == (Face("top", 4, z=0.1, yaw=0.5, lies=True), Face("side", 5, yaw=0.0))
    assert swarm.robots[1].faces == (Face("top", 6, z=0.1, yaw=0.5),)
    assert read_back(tmp_path, swarm) == swarm


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
    assert said in error_of(tmp_path, EXAMPLE_CAMERAS.replace(old, new, 1))


A_PLATFORM = "the name of a packaged one or the path of a file"
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
        assert read_back(folder, swarm) == swarm
    assert "platform: ../board.yaml" in (tmp_path / "deeper" / "again.yaml").read_text()


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("0xDF64", "0", "robots.one.ir.id is 0 but must be a whole number in [1, 65535]."),
        ("0xDF64", "0x1DF64", "robots.one.ir.id is '0x1DF64' but must be a whole number in [1, 65535]."),
        ("0xDF64", "true", "robots.one.ir.id is True but must be a whole number in [1, 65535]."),
        ("0xDF64", "7", "ir.id 7 belongs to both robot 'one' and robot 'two'; ids must be unique."),
        (": droplet, ir: {id: 0xDF64}", ": droplet", "robots.one.ir lacks id, a whole number in [1, 65535]."),
        ("platform: droplet, ", "", f"robots.one.ir lacks platform, {A_PLATFORM}."),
        (
            "platform: droplet",
            "id: 3",
            "'types.droplet.ir.id' is not a known key; the nearest one is 'gains'.",
        ),
        ("platform: droplet", "platform: 5", f"types.droplet.ir.platform is 5 but must be {A_PLATFORM}."),
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
    (tmp_path / "board.yaml").write_text(PACKAGED_DROPLET.read_text())
    assert error_of(tmp_path, IR.replace(old, new, 1)) == sentence


def test_a_platform_file_that_is_missing_or_wrong_is_named(tmp_path: Path) -> None:
    assert "robots.four.ir.platform: " in (sentence := error_of(tmp_path, IR))
    assert "board.yaml cannot be read" in sentence
    (tmp_path / "board.yaml").write_text(PACKAGED_DROPLET.read_text().replace("radius: 0.022", "radius: -1"))
    assert "board.yaml: radius is -1 but must lie in" in error_of(tmp_path, IR)
    sentence = error_of(tmp_path, IR.replace("platform: droplet", "platform: dropet"))
    assert sentence.startswith("types.droplet.ir.platform: 'dropet' is no packaged infrared platform (")


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
    swarm = load(tmp_path, DESCRIPTION)
    assert [robot.uwb for robot in swarm.robots] == [
        UwbDevice(31, 0.1, 0.0, 0.4, 0.05, range_bias=-0.02),
        UwbDevice(HUGE, 0.1, 0.0, 0.4, 0.05),
        None,
    ]
    assert swarm.anchors == (Anchor(7, 0.0, 5.0, 2.5), Anchor(16, 5.0, 5.0, position_sigma=0.05))
    assert read_back(tmp_path, swarm) == swarm


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
    assert error_of(tmp_path, DESCRIPTION.replace(old, new, 1)) == sentence


NO_PAIRS = ["uwb/{from}", "{to}/{from}/{from}", "/uwb//{from}/{to}", "a b/{from}/{to}", "/{from}/{to}/"]
NO_PAIRS += ["1", 40 * "a" + "-{from}/{to}"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("topics: {odom: x}", "topics.odom must begin with <robot> or the name of a robot or camera, and /"),
        ("topics: {r9/odom: x}", "topics.r9/odom must begin with <robot>"),
        ("topics: {r1/odom: 'a b'}", "topics.r1/odom is 'a b' but must be a topic"),
        ("topics: {<robot>/odom: odom}", "must be the topic of only one robot"),
        ("topics: {r1/odom: odom, r2/odom: odom}", "must be the topic of only one robot"),
        ("localizer: {sorce: tf}", "'localizer.sorce' is not a known key; the nearest one is 'source'"),
        ("localizer: {source: ft}", "localizer.source = 'ft' must be one of pose,"),
        ("localizer: {latency_s: 3}", "localizer.latency_s = 3.0 must lie in [0, 2] s"),
        (f"localizer: {{latency_s: -{10**400}}}", "localizer.latency_s = -inf must lie in [0, 2] s"),
        *(
            (f"range_topic: '{topic}'", "must be a topic with {from} and {to} once each")
            for topic in NO_PAIRS
        ),
        ("anchors: [{address: 2, name: a/b, x: 0, y: 0}]", "anchors[0].name is 'a/b' but must be up to 64"),
        ("anchors: [{address: 2, name: 1, x: 0, y: 0}]", "anchors[0].name is 1 but must be up to 64 letters"),
        (
            "anchors: [{address: 1, x: 0, y: 0}, {address: 2, name: '1', x: 0, y: 0}]",
            "uwb.name 1 belongs to both anchors[0] and anchors[1]; ids must be unique",
        ),
    ],
)
def test_wrong_topics_localizers_and_names_of_radios_are_refused(
    tmp_path: Path, text: str, said: str
) -> None:
    assert said in error_of(tmp_path, f"fileversion: 1\nrobots: {{r1: {{}}, r2: {{}}}}\n{text}\n")


def test_the_example_of_the_page_is_a_description(tmp_path: Path) -> None:
    text = DOC.read_text(encoding="utf-8").split("```yaml\n")[1].partition("```")[0]
    swarm = load(tmp_path, text)
    assert all(robot.uwb for robot in swarm.robots)
    assert len(swarm.anchors) == 4


RESPONSE = MotionResponse(
    (0.0, 0.1), (0.0, 0.5, 1.0), ((1.0, 0.9, 0.9), (1.0, 0.8, 0.7)), ((1.0, 0.9, 0.8),) * 2
)
DROPLET = load_ir_platform("droplet")


def numbers(cls: type) -> st.SearchStrategy[dict[str, Any]]:
    options = {
        name: st.floats(spec.low, min(spec.high, 1e6), exclude_min=spec.above)
        | (st.none() if spec.optional else st.nothing())
        for name, spec in number_specs(cls).items()
    }
    return st.fixed_dictionaries({}, optional=options)


def build(cls: type) -> st.SearchStrategy[Any]:
    return numbers(cls).map(lambda values: cls(**values))


def boards(board_id: int) -> st.SearchStrategy[RobotIr]:
    gain = st.tuples(*[st.floats(0.05, 20.0)] * 6)
    return st.builds(
        RobotIr,
        st.just(board_id),
        st.just(DROPLET),
        st.just("droplet"),
        st.none() | st.builds(IrGains, gain, gain, st.floats(0.0, 1.0), st.floats(0.0, 1.0)),
        gate_probability=st.floats(0.5, 1.0),
    )


@st.composite
def swarms(draw: st.DrawFn) -> Swarm:
    ids = iter(draw(st.lists(st.integers(0, 2**32 - 1), unique=True, min_size=40, max_size=40)))
    names = draw(
        st.lists(
            st.text(string.ascii_letters, min_size=1, max_size=6).filter(lambda n: n not in RESERVED_NAMES),
            unique_by=str.lower,
            min_size=1,
            max_size=4,
        )
    )
    robots: list[Robot] = []
    kinds = (OdometryModel, RandomWalk, CameraMount, SensorModel, FixModel, ClockModel, StartSigma)
    pool = {cls: [cls(), draw(build(cls))] for cls in kinds}
    others = draw(st.dictionaries(st.sampled_from(["rear", "scan/left"]), numbers(SingleLidar)))
    lidars = [LidarModel(), replace(draw(build(LidarModel)), range_sigma=0.01, others=others)]
    face_numbers = draw(st.lists(numbers(Face), max_size=3))
    for name in names:
        faces = tuple(Face(f"f{k}", next(ids), **values) for k, values in enumerate(face_numbers))
        stands = draw(st.booleans())
        robots.append(
            Robot(
                name,
                draw(st.sampled_from(["", "typ", "other"])),
                odometry=OdometryModel() if stands else draw(st.sampled_from(pool[OdometryModel])),
                response=draw(st.sampled_from([None, RESPONSE])),
                camera=draw(st.sampled_from([*pool[CameraMount], None])),
                lidar=draw(st.sampled_from(lidars)),
                sensor=draw(st.sampled_from(pool[SensorModel])),
                faces=faces[: draw(st.integers(0, 3))],
                start=draw(
                    st.none() | st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.floats(-6.28, 6.28))
                ),
                fix=draw(st.sampled_from(pool[FixModel])),
                clock=draw(st.sampled_from(pool[ClockModel])),
                start_sigma=draw(st.sampled_from(pool[StartSigma])),
                stands=stands,
                random_walk=draw(st.sampled_from(pool[RandomWalk])) if stands else RandomWalk(),
                ir=draw(st.none() | boards(len(robots) + 1)),
            )
        )
    landmarks = tuple(
        Landmark(next(ids), **values) for values in draw(st.lists(numbers(Landmark), max_size=4))
    )
    return Swarm(tuple(robots), landmarks)


@RELAXED
@given(swarm=swarms())
def test_what_is_written_is_read_back(tmp_path: Path, swarm: Swarm) -> None:
    assert read_back(tmp_path, swarm) == swarm


def test_written_file_says_shared_things_once(tmp_path: Path) -> None:
    model = OdometryModel(distance_scale=0.9)
    robots = tuple(
        Robot(name, "typ", model, sensor=SensorModel(bearing_offset=k)) for k, name in enumerate("ab")
    )
    save_swarm(Swarm(robots), tmp_path / "swarm.yaml")
    text = (tmp_path / "swarm.yaml").read_text()
    assert text.count("distance_scale: 0.9") == 1
    assert "bearing_offset [rad]" in text
