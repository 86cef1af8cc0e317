"""The swarm description: layers, round trip, and one sentence for whatever is wrong with a file."""

import math
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from swarm_loc_estimator.swarm.error_models import MotionResponse, OdometryModel
from swarm_loc_estimator.swarm.swarm import CameraMount, Face, Landmark, Robot, StartSigma, Swarm, SwarmError
from swarm_loc_estimator.swarm.swarm_file import SwarmFileError, load_swarm

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


def load(folder: Path, text: str | bytes) -> Swarm:
    path = folder / "swarm.yaml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return load_swarm(path)


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


def test_owners_of_marker_ids(tmp_path: Path) -> None:
    swarm = load(tmp_path, EXAMPLE)
    assert swarm.index_of["three"] == 2
    assert (swarm.owner_of[3].robot_index, swarm.owner_of[3].landmark_index) == (1, -1)
    assert (swarm.owner_of[101].robot_index, swarm.owner_of[101].landmark_index) == (-1, 1)
    assert swarm.owner_of[2].marker == swarm.robots[0].faces[1]


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("on: 0.053", "on: -1", "types.epuck.odometry.wheel_separation is -1 but must lie in [0.001, 10] m."),
        (": 0.053", ": .nan", "types.epuck.odometry.wheel_separation is nan but must lie in [0.001, 10] m."),
        (" 0.053", " -.inf", "types.epuck.odometry.wheel_separation is -inf but must lie in [0.001, 10] m."),
        (
            "wheel_separation: 0.053",
            "wheel_separation: true",
            "types.epuck.odometry.wheel_separation is True but must be a number in [0.001, 10] m.",
        ),
        (
            "wheel_separation: 0.053",
            "wheel_separation: '1'",
            "types.epuck.odometry.wheel_separation is '1' but must be a number in [0.001, 10] m.",
        ),
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
        (
            "front: 3",
            "front: 3.5",
            "robots.two.ids.front is 3.5 but must be a marker id, a whole number in [0, 4294967295].",
        ),
        ("front: 3", "frnt: 3", "'robots.two.ids.frnt' is not a known key; the nearest one is 'front'."),
        ("1, back: 2", "1", "robots.one.ids has no id for face 'back'; give one or set faces.back to null."),
        ("101", "abc", "landmarks.abc is 'abc' but must be a marker id, a whole number in [0, 4294967295]."),
        ("  101: {x: 0, y: 0", "  100: {x: 0, y: 0", "'100' is given twice, again in line 30."),
        ("position_sigma", "x", "'defaults.landmark.x' is not a known key; the nearest one is 'yaw_sigma'."),
        (
            "{position_sigma: 0.02}",
            "{yaw_sigma: -1}",
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
    ],
)
def test_one_sentence_names_key_value_and_range(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    assert old in EXAMPLE
    assert error_of(tmp_path, EXAMPLE.replace(old, new, 1)) == sentence


@pytest.mark.parametrize("name", ["map", "swarm", "aerial", "estimator", "tf"])
def test_names_that_topics_and_frames_have_are_refused(tmp_path: Path, name: str) -> None:
    assert "\n  four:" in EXAMPLE
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
        (
            "fileversion: 1\nrobots:\n" + "".join(f"  a{k}:\n" for k in range(5001)),
            "robots names 5001 robots but must name at most 5000",
        ),
        (
            "fileversion: 1\nrobots:\n" + "".join(f"  a{k}: {{}}\n" for k in range(10_000)),
            "robots names 10000 robots but must name at most 5000",
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
        pieces = st.sampled_from(
            [
                "1e999",
                ".nan",
                "true",
                "null",
                "{",
                "}",
                "\n",
                "  ",
                ":",
                "- ",
                "&a ",
                "*a",
                "!!int ",
                "?",
                "''",
                "1",
                "\t",
            ]
        )
        text = text[:begin] + data.draw(pieces | st.text(max_size=4)) + text[end:]
    try:
        swarm = load(tmp_path, text.encode("utf-8", "surrogatepass"))
    except SwarmFileError as error:
        sentence_of(tmp_path, error)
    else:
        assert all(math.isfinite(value) for robot in swarm.robots for value in robot.start or ())


def test_an_imu_needs_odometry(tmp_path: Path) -> None:
    path = tmp_path / "swarm.yaml"
    path.write_text(
        "fileversion: 1\nrobots: {a: {odometry: null, camera: null, imu: {turn_noise_density: 0.01}}}\n"
    )
    with pytest.raises(
        SwarmFileError, match=r"robot 'a' has no odometry, so its imu.turn_noise_density must be 0"
    ):
        load_swarm(path)
