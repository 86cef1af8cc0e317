"""Parameters of drivers and worlds: pages have what the tables say, and wrong ones are one sentence."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.scenarios.eight_run import EightSettings, describe
from bench.shared.parameter_table import markdown_table
from swarm_loc_drivers.common.calibration_file import CalibrationFileError, load_calibration
from swarm_loc_drivers.common.link import Address, parse_address
from swarm_loc_drivers.droplet.exchange import PollingSettings, TdmaSettings
from swarm_loc_drivers.droplet.hardware import AUDIO_DROPLET
from swarm_loc_drivers.droplet.parameters import DropletFleetParameters, DropletParameters
from swarm_loc_drivers.epuck.parameters import EpuckParameters, camera_calibration
from swarm_loc_drivers.pushbot.parameters import ExplorationParameters, PushbotParameters
from swarm_loc_drivers.sim.droplet.world import DropletWorldParameters
from swarm_loc_drivers.sim.epuck.world import EpuckWorldParameters, make_world
from swarm_loc_drivers.sim.pushbot.wall_drive import calibrate_lasers
from swarm_loc_drivers.sim.pushbot.world import PushbotWorldParameters, make_pushbot_world
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.room.world import RoomWorldParameters
from swarm_loc_drivers.sim.scenarios.eight import EightSteering
from swarm_loc_drivers.sim.simulation import SimulationOptions, graph_of, simulated_swarm
from swarm_loc_drivers.sim.worlds import WORLDS, WorldError
from swarm_loc_estimator.common.parameters import ParameterError, parameter_specs
from swarm_loc_estimator.swarm.swarm_file import save_swarm
from swarm_loc_vision.laser.calibration import load_laser

DOC = Path(__file__).parents[2] / "doc"
CALIBRATION = """
image_width: 40
image_height: 30
camera_name: epuck
camera_matrix: {rows: 3, cols: 3, data: [45.5, 0, 20, 0, 45.0, 15, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.2, 0.001, 0, 0]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [44, 0, 20, 0, 0, 44, 15, 0, 0, 0, 1, 0]}
"""


@pytest.mark.parametrize(
    ("page", "parameters"),
    [
        ("epuck_driver_node.md", EpuckParameters),
        ("epuck_world_node.md", EpuckWorldParameters),
        ("droplet_driver_node.md", DropletParameters),
        ("droplet_fleet_node.md", DropletFleetParameters),
        ("droplet_world_node.md", DropletWorldParameters),
        ("pushbot_driver_node.md", PushbotParameters),
        ("pushbot_world_node.md", PushbotWorldParameters),
        ("exploration_node.md", ExplorationParameters),
        ("room_world_node.md", RoomWorldParameters),
    ],
)
def test_the_page_says_what_the_table_says(page: str, parameters: type) -> None:
    assert markdown_table(parameters) in (DOC / page).read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("text", "address", "shown"),
    [
        ("/dev/rfcomm0", Address(device="/dev/rfcomm0"), "/dev/rfcomm0"),
        ("tcp://192.168.1.1", Address(host="192.168.1.1", port=1000), "tcp://192.168.1.1:1000"),
        ("tcp://robot.local:7", Address(host="robot.local", port=7), "tcp://robot.local:7"),
        ("tcp://[::1]:7", Address(host="::1", port=7), "tcp://[::1]:7"),
    ],
)
def test_addresses(text: str, address: Address, shown: str) -> None:
    assert parse_address(text, 1000) == address
    assert str(address) == shown
    assert parse_address(shown, 1) == address


@pytest.mark.parametrize(
    "text",
    [
        "rfcomm0",
        "tcp://",
        "tcp://:1000",
        "tcp://a:0",
        "tcp://a:99999",
        "tcp://a:x",
        "http://a",
        "tcp://a/b",
        "tcp://[a",
    ],
)
def test_what_is_no_address(text: str) -> None:
    with pytest.raises(ParameterError, match="must be the path of a serial port"):
        parse_address(text, 1000)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "camera.yaml"
    path.write_text(CALIBRATION, encoding="utf-8")
    return path


def test_a_calibration_is_read(path: Path) -> None:
    calibration = load_calibration(path, 40, 30)
    assert calibration.matrix == (45.5, 0.0, 20.0, 0.0, 45.0, 15.0, 0.0, 0.0, 1.0)
    assert calibration.distortion == (0.1, -0.2, 0.001, 0.0, 0.0)
    assert calibration.projection[:3] == (44.0, 0.0, 20.0)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("age_width: 40", "age_width: 41", "is for images of 41 x 30 px, but the camera's have 40 x 30 px."),
        ("image_height: 30\n", "", "has no image_height."),
        ("plumb_bob", "fisheye", "distortion_model is 'fisheye' but must be one of plumb_bob,"),
        ("45.5", "0.0", "camera_matrix has the focal lengths 0 and 45 px, but they must be above 0 px."),
        ("45.5", ".nan", "camera_matrix.data must be a list of 9 finite numbers."),
        ("[0.1, ", "[", "distortion_coefficients.data must be a list of 5 finite numbers."),
        ("{rows: 1, cols: 5, data: [0.1, -0.2, 0.001, 0, 0]}", "5", "distortion_coefficients.data must be"),
        ("camera_name: epuck", "image_width: 5", "'image_width' is given twice"),
    ],
)
def test_a_wrong_calibration_is_named_in_one_sentence(path: Path, old: str, new: str, sentence: str) -> None:
    path.write_text(CALIBRATION.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(CalibrationFileError, match=rf"{path}.*{re.escape(sentence)}"):
        load_calibration(path, 40, 30)


def test_over_wifi_pictures_have_the_size_that_the_robot_sends(path: Path) -> None:
    parameters = EpuckParameters(address="tcp://robot", camera=True, camera_info_file=str(path))
    assert parameters.images is not None
    assert (parameters.images.width, parameters.images.height) == (160, 120)
    for file, words in (
        (str(path), "40 x 30 px, but the camera's have 160 x 120 px"),
        ("", "parameter camera_info_file is not set"),
        ("/nowhere.yaml", "parameter camera_info_file: /nowhere.yaml cannot be read"),
    ):
        with pytest.raises(ParameterError, match=words):
            camera_calibration(replace(parameters, camera_info_file=file), parameters.images)
    with pytest.raises(ParameterError, match="does not go with address = 'tcp://robot:1000'"):
        replace(parameters, model="epuck1")


def test_over_a_serial_port_pictures_fit_the_robots_buffer(path: Path) -> None:
    parameters = EpuckParameters(
        address="/dev/x", camera=True, camera_info_file=str(path), image_width=40, image_height=30
    )
    assert parameters.images is not None
    assert camera_calibration(parameters, parameters.images).width == 40
    with pytest.raises(ParameterError, match="epuck2 can send at most 4128"):
        replace(parameters, image_width=60, image_height=40)
    with pytest.raises(ParameterError, match=r"image_zoom = 8 must be one of 1, 2, 4 for an epuck2\.$"):
        replace(parameters, image_zoom=8)
    first = replace(parameters, model="epuck1", image_zoom=8)
    assert replace(first, image_width=41, image_height=42).images is not None
    with pytest.raises(ParameterError, match="images of 3456 bytes, but an epuck1 can send at most 3445"):
        replace(first, image_width=48, image_height=36)


PLAIN = DropletParameters(address="/dev/ttyUSB0")


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
    with pytest.raises(ParameterError, match=re.escape(sentence)):
        replace(PLAIN, **wrong)


SWARM = """
fileversion: 1
types:
  pushbot: {odometry: {wheel_separation: 0.085}, camera: null, fix: {systematic_share: 1.0}}
robots:
  a: {type: pushbot, start: {x: 1.5, y: 1.5, theta: 0.0}}
  b: {type: pushbot, start: {x: 2.4, y: 1.1, theta: 0.0}}
"""


@pytest.fixture
def swarm_file(tmp_path: Path) -> Path:
    path = tmp_path / "swarm.yaml"
    path.write_text(SWARM, encoding="utf-8")
    return path


def test_tcp_goes_to_the_radios_port() -> None:
    params = PushbotParameters(address="tcp://10.0.0.1")
    assert (params.link_address.host, params.link_address.port) == ("10.0.0.1", 56000)
    assert params.event_timestamps == "24bit"
    assert PushbotParameters(address="/dev/x", events=False).event_timestamps == ""


@pytest.mark.parametrize("name", ["laser_frequency", "led_frequency"])
def test_a_light_that_hardly_blinks_is_refused(name: str) -> None:
    slow: dict[str, Any] = {name: 2.0}
    with pytest.raises(ParameterError, match=f"{name} = 2.0 must be 0, or at least 10 Hz"):
        replace(PushbotParameters(address="/dev/x"), **slow)


def test_robots_run_into_walls_and_not_through(swarm_file: Path) -> None:
    _, world = make_pushbot_world(PushbotWorldParameters(swarm_file=str(swarm_file)))
    world.drivetrain.duties[:] = 0.8
    for _ in range(800):
        world.step()
    assert world.poses[0, 0] < world.poses[1, 0] < 12.0


def test_a_swarm_of_pushbots_gets_a_hall_drivers_and_calibrated_trackers(
    swarm_file: Path, tmp_path: Path
) -> None:
    options = SimulationOptions(str(swarm_file), seed=4, plan="office", rate=0.5)
    nodes = {node.full_name: node for node in graph_of(options, simulated_swarm(options), str(tmp_path))}
    assert list(nodes) == [
        *("estimator", "mapper", "pushbot_world", "exploration"),
        *("a/pushbot_driver", "a/event_tracker", "b/pushbot_driver", "b/event_tracker"),
    ]
    world = nodes["pushbot_world"].parameters
    assert (world["plan"], world["seed"], world["rate"]) == ("office", 4, 0.5)
    frequencies = {
        nodes[f"{name}/{kind}"].parameters["laser_frequency"]
        for name in "ab"
        for kind in ("pushbot_driver", "event_tracker")
    }
    assert len(frequencies) == 2
    leds = {name: nodes[f"{name}/pushbot_driver"].parameters["led_frequency"] for name in "ab"}
    assert nodes["mapper"].parameters["led_frequencies"] == [f"{name}={hz}" for name, hz in leds.items()]
    assert nodes["a/event_tracker"].parameters["light_frequencies"] == [str(leds["b"])]
    for name, node in nodes.items():
        assert node.parameters.get("use_sim_time", False) is (name != "pushbot_world")  # which makes the time
    described = {nodes[name].parameters["swarm_file"] for name in list(nodes)[:4]}
    assert described == {str(swarm_file)}
    for name in "ab":
        assert nodes[f"{name}/pushbot_driver"].parameters["address"] == f"{tmp_path}/{name}"
        calibration = str(nodes[f"{name}/event_tracker"].parameters["calibration"])
        assert load_laser(Path(calibration)).focal_base > 0.0


def test_calibrations_are_those_of_the_worlds_robots(swarm_file: Path, tmp_path: Path) -> None:
    _, world = make_pushbot_world(PushbotWorldParameters(swarm_file=str(swarm_file), seed=7))
    calibrate_lasers(["a", "b"], 7, tmp_path)
    depths = np.linspace(0.2, 2.0, 50)
    for name, built in zip("ab", world.optics, strict=True):
        found = load_laser(tmp_path / f"{name}.yaml")
        read = [found.focal_base / (built.spot(depth)[1] - found.row_at_infinity) for depth in depths]
        assert np.abs(read - depths).max() < 0.05


def test_a_swarm_that_is_not_one_of_pushbots_is_named(swarm_file: Path) -> None:
    swarm_file.write_text(SWARM.replace("b: {type: pushbot, ", "b: {"))
    with pytest.raises(WorldError, match="robot 'b' is no pushbot, and others are"):
        simulated_swarm(SimulationOptions(str(swarm_file)))


START = np.array([[0.1, 0.2, 0.3], [0.5, -0.2, 1.0]])


@pytest.fixture
def parameters(tmp_path: Path) -> EpuckWorldParameters:
    save_swarm(describe(EightSettings(robots=2), START), tmp_path / "swarm.yaml")
    return EpuckWorldParameters(
        swarm_file=str(tmp_path / "swarm.yaml"), camera=CameraModel(width=64, height=48), world="w0"
    )


def test_robots_begin_where_the_description_says(parameters: EpuckWorldParameters) -> None:
    swarm, world = make_world(parameters)
    assert [robot.name for robot in swarm.robots] == ["epuck1", "epuck2"]
    np.testing.assert_allclose(world.poses, START)


def test_the_worlds_that_there_are_can_be_chosen() -> None:
    (spec,) = (spec for spec in parameter_specs(EpuckWorldParameters) if spec.name == "world")
    assert [spec.checked(name) for name in WORLDS] == list(WORLDS)
    with pytest.raises(ParameterError, match=r"parameter world = 'w9' must be one of w0, w2, w2fast\."):
        spec.checked("w9")


def test_robots_without_wifi_need_serial_ports(parameters: EpuckWorldParameters) -> None:
    with pytest.raises(ParameterError, match="parameter model = 'epuck1' needs the parameter link_folder"):
        make_world(replace(parameters, model="epuck1"))


def test_a_family_without_a_markers_id_is_named(parameters: EpuckWorldParameters) -> None:
    save_swarm(describe(EightSettings(robots=2), START, first_face_id=250), Path(parameters.swarm_file))
    with pytest.raises(ParameterError, match=r"parameter family = 'aruco_mip_36h12': .* has ids 0 to 249"):
        make_world(replace(parameters, family="aruco_mip_36h12"))


def test_a_robot_without_a_start_is_named(parameters: EpuckWorldParameters) -> None:
    save_swarm(describe(EightSettings(robots=2, start_known=False), START), Path(parameters.swarm_file))
    with pytest.raises(ParameterError, match=r"parameter swarm_file = .* robot 'epuck1' has no start pose"):
        make_world(parameters)


def test_steering_brings_a_robot_back_onto_the_eight() -> None:
    steering = EightSteering(2, 0.06)
    pose = np.array([0.63, -0.01, 1.3])
    step_ns = 50_000_000
    for step in range(400):
        speed, _, turn_rate = steering.command(0, 10**12 + step * step_ns, pose)
        heading = pose[2] + 0.5 * 0.05 * turn_rate
        pose = pose + 0.05 * np.array([speed * np.cos(heading), speed * np.sin(heading), turn_rate])
    r2 = float(pose[:2] @ pose[:2])
    assert abs(r2**2 - 0.36 * (pose[0] ** 2 - pose[1] ** 2)) < 2e-3
    assert speed == pytest.approx(0.06, rel=0.05)
