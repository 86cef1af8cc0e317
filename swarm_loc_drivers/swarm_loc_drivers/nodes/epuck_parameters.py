"""What a user may set about `epuck_driver_node`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from swarm_loc_drivers.core.epuck_driver import EpuckSettings
from swarm_loc_drivers.core.epuck_serial_session import SerialCamera
from swarm_loc_drivers.core.wheels import WheelGeometry
from swarm_loc_drivers.io.calibration_file import CalibrationError, CameraCalibration, load_calibration
from swarm_loc_drivers.protocols import epuck_wifi
from swarm_loc_drivers.protocols.epuck import EPUCK2, EPUCK_MODELS, EpuckModel
from swarm_loc_drivers.transports.link import Address, AddressError, parse_address
from swarm_loc_estimator.core.number_spec import number
from swarm_loc_estimator.core.swarm import OdometryModel
from swarm_loc_estimator.nodes.parameter_table import ParameterError, choice, flag, text

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
        " of a stream's 62 some are used",
    )
    reply_timeout_s: float = number(
        0.5, "s", 0.01, 10.0, "how long an answer may take; a stream may be silent twice as long"
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
    camera: bool = flag(False, "publish pictures; needs camera_info_file")
    camera_info_file: str = text("", "calibration of the camera, as camera_calibration writes it")
    image_width: int = number(
        40, "px", 1, 255, "of pictures over a serial port; over WiFi they have 160 x 120 px"
    )
    image_height: int = number(40, "px", 1, 255, "likewise")
    image_zoom: int = number(8, "1", 1, 8, "likewise, camera pixels per pixel")
    image_period_s: float = number(1.0, "s", 0.05, 60.0, "likewise, time between two pictures")


def epuck_settings(wishes: EpuckParameters) -> EpuckSettings:
    """What the parameters mean together.

    Raises:
        ParameterError: One cannot be used, or does not go with another.
    """
    address, model = _address(wishes), EPUCK_MODELS[wishes.model]
    if address.host and model is not EPUCK2:
        raise ParameterError(
            f"parameter model = '{model.name}' does not go with address = '{address}': only epuck2 has WiFi."
        )
    return EpuckSettings(
        address=address,
        model=model,
        geometry=WheelGeometry(wishes.wheel_diameter, wishes.wheel_separation),
        wheel_noise=wishes.wheel_noise,
        command_timeout_s=wishes.cmd_vel_timeout_s,
        baud_rate=wishes.baud_rate,
        reading_period_s=1.0 / wishes.reading_rate,
        reply_timeout_s=wishes.reply_timeout_s,
        camera=_camera(wishes, address, model) if wishes.camera else None,
    )


def camera_calibration(wishes: EpuckParameters, camera: SerialCamera) -> CameraCalibration:
    """The calibration of the pictures that will come.

    Raises:
        ParameterError: There is none, or it cannot be used.
    """
    if not wishes.camera_info_file:
        raise ParameterError(
            "parameter camera_info_file is not set: a camera without calibration cannot be published."
        )
    try:
        return load_calibration(Path(wishes.camera_info_file), camera.width, camera.height)
    except CalibrationError as error:
        raise ParameterError(f"parameter camera_info_file: {error}") from error


def _address(wishes: EpuckParameters) -> Address:
    try:
        return parse_address(wishes.address, epuck_wifi.PORT)
    except AddressError as error:
        raise ParameterError(f"parameter address = {error}") from error


def _camera(wishes: EpuckParameters, address: Address, model: EpuckModel) -> SerialCamera:
    """The size of the pictures; what does not fit the robot's buffer it would refuse silently."""
    if address.host:
        return SerialCamera(epuck_wifi.WIDTH, epuck_wifi.HEIGHT, zoom=1, period_s=wishes.image_period_s)
    size = 2 * wishes.image_width * wishes.image_height
    if size > model.largest_image:
        raise ParameterError(
            f"parameters image_width = {wishes.image_width} and image_height = {wishes.image_height} make"
            f" pictures of {size} bytes, but an {model.name} can send at most {model.largest_image}."
        )
    return SerialCamera(wishes.image_width, wishes.image_height, wishes.image_zoom, wishes.image_period_s)
