"""What a user sets about the driver, and the calibration that he gives it."""

from dataclasses import replace
from pathlib import Path

import pytest

from bench.shared.parameter_table import markdown_table
from swarm_loc_drivers.common.calibration_file import CalibrationFileError, load_calibration
from swarm_loc_drivers.common.link import Address, parse_address
from swarm_loc_drivers.epuck.parameters import EpuckParameters, camera_calibration
from swarm_loc_estimator.common.parameters import ParameterError

PAGE = Path(__file__).parents[2] / "doc" / "epuck_driver_node.md"
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


def test_the_page_says_what_the_table_says() -> None:
    assert markdown_table(EpuckParameters) in PAGE.read_text(encoding="utf-8")


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
    ["rfcomm0", "tcp://", "tcp://:1000", "tcp://a:0", "tcp://a:x", "http://a", "tcp://a/b", "tcp://[a"],
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
    with pytest.raises(CalibrationFileError) as caught:
        load_calibration(path, 40, 30)
    assert str(path) in str(caught.value)
    assert sentence in str(caught.value)


def test_over_wifi_pictures_have_the_size_that_the_robot_sends(path: Path) -> None:
    parameters = EpuckParameters(address="tcp://robot", camera=True, camera_info_file=str(path))
    assert parameters.images is not None
    assert (parameters.images.width, parameters.images.height) == (160, 120)
    with pytest.raises(ParameterError, match="40 x 30 px, but the camera's have 160 x 120 px"):
        camera_calibration(parameters, parameters.images)


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
