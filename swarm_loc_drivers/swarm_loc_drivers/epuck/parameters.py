"""Parameters of `epuck_driver_node`, and the driver's settings that follow from them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from swarm_loc_drivers.common.calibration_file import (
    CalibrationFileError,
    CameraCalibration,
    load_calibration,
)
from swarm_loc_drivers.common.link import Address, parse_address
from swarm_loc_drivers.epuck import wifi_protocol as epuck_wifi
from swarm_loc_drivers.epuck.hardware import EPUCK2, EPUCK_MODELS, EpuckModel, wheel_geometry
from swarm_loc_drivers.epuck.session import CameraSettings, EpuckSettings
from swarm_loc_estimator.common.parameters import ParameterError, choice, flag, number, text
from swarm_loc_estimator.swarm.swarm import OdometryModel

_ODOMETRY = OdometryModel()


@dataclass(frozen=True)
class EpuckParameters:
    """Parameters of `epuck_driver_node`."""

    address: str = text(
        "",
        "a serial port such as /dev/rfcomm0, or tcp://HOST[:1000] for the WiFi firmware of an e-puck2",
        required=True,
    )
    model: str = choice("epuck2", tuple(EPUCK_MODELS), "generation of the robot; only epuck2 has WiFi")
    baud_rate: int = number(115_200, "bit/s", 1200, 12_000_000, "of a serial port")
    reading_rate: float = number(
        20.0,
        "1/s",
        0.1,
        200.0,
        "readings that are wanted; a serial robot is asked so often and at each cmd_vel,"
        " of a stream's 50 some are used",
    )
    reply_timeout_s: float = number(
        0.5, "s", 0.01, 10.0, "how long an answer may take; a stream may be silent 1.5 s longer"
    )
    cmd_vel_timeout_s: float = number(0.5, "s", 0.02, 10.0, "without cmd_vel for so long the robot stops")
    wheel_diameter: float = number(0.041, "m", 0.001, 1.0, "diameter of the wheels")
    wheel_separation: float = number(
        _ODOMETRY.wheel_separation, "m", 0.001, 10.0, "distance between the two wheels"
    )
    wheel_noise: float = number(
        _ODOMETRY.wheel_noise, "m", 0.0, 1.0, "variance of each wheel's path per metre it rolls [m^2/m]"
    )
    odom_frame: str = text("odom", "the pose is in <robot>/odom_frame", required=True)
    base_frame: str = text("base_link", "the pose is that of <robot>/base_frame", required=True)
    publish_tf: bool = flag(True, "publish the transform from odom to base_link")
    camera: bool = flag(False, "publish images; needs camera_info_file")
    camera_info_file: str = text("", "calibration of the camera, as camera_calibration writes it")
    image_width: int = number(
        40, "px", 1, 255, "of images over a serial port; over WiFi they have 160 x 120 px"
    )
    image_height: int = number(40, "px", 1, 255, "of images over a serial port")
    image_zoom: int = number(
        4, "1", 1, 8, "camera pixels per pixel over a serial port; of an epuck2 1, 2 or 4"
    )
    image_period_s: float = number(1.0, "s", 0.05, 60.0, "time between two images over a serial port")


def epuck_settings(parameters: EpuckParameters) -> EpuckSettings:
    """Settings from the parameters.

    Raises:
        ParameterError: A parameter is invalid, or conflicts with another one.
    """
    address, model = parse_address(parameters.address, epuck_wifi.PORT), EPUCK_MODELS[parameters.model]
    if address.host and model is not EPUCK2:
        raise ParameterError(
            f"parameter model = '{model.name}' does not go with address = '{address}': only epuck2 has WiFi."
        )
    return EpuckSettings(
        address=address,
        model=model,
        geometry=wheel_geometry(parameters.wheel_diameter, parameters.wheel_separation),
        wheel_noise=parameters.wheel_noise,
        command_timeout_s=parameters.cmd_vel_timeout_s,
        baud_rate=parameters.baud_rate,
        reading_period_s=1.0 / parameters.reading_rate,
        reply_timeout_s=parameters.reply_timeout_s,
        camera=_camera(parameters, address, model) if parameters.camera else None,
    )


def camera_calibration(parameters: EpuckParameters, camera: CameraSettings) -> CameraCalibration:
    """Calibration of the camera's images.

    Raises:
        ParameterError: The file is not set or cannot be used.
    """
    if not parameters.camera_info_file:
        raise ParameterError(
            "parameter camera_info_file is not set: a camera without calibration cannot be published."
        )
    try:
        return load_calibration(Path(parameters.camera_info_file), camera.width, camera.height)
    except CalibrationFileError as error:
        raise ParameterError(f"parameter camera_info_file: {error}") from error


def _camera(parameters: EpuckParameters, address: Address, model: EpuckModel) -> CameraSettings:
    """Size of the images; the robot would silently refuse one that exceeds its buffer."""
    if address.host:
        return CameraSettings(epuck_wifi.WIDTH, epuck_wifi.HEIGHT, zoom=1, period_s=parameters.image_period_s)
    width, height = parameters.image_width, parameters.image_height
    size = 2 * width * height
    if size > model.largest_image:
        raise ParameterError(
            f"parameters image_width = {width} and image_height = {height} make"
            f" images of {size} bytes, but an {model.name} can send at most {model.largest_image}."
        )
    if parameters.image_zoom not in model.zooms:
        raise ParameterError(
            f"parameter image_zoom = {parameters.image_zoom} must be one of"
            f" {', '.join(map(str, model.zooms))} for an {model.name}."
        )
    return CameraSettings(width, height, parameters.image_zoom, parameters.image_period_s)
