"""Parameters of `epuck_driver_node`, and what follows from them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from swarm_loc_drivers.common.calibration_file import (
    CalibrationFileError,
    CameraCalibration,
    load_calibration,
)
from swarm_loc_drivers.common.link import Address, parse_address
from swarm_loc_drivers.common.odometry import WheelGeometry
from swarm_loc_drivers.common.robot_driver import DriverParameters
from swarm_loc_drivers.epuck.hardware import (
    EPUCK2,
    EPUCK_MODELS,
    WIFI_HEIGHT,
    WIFI_PORT,
    WIFI_WIDTH,
    CameraSettings,
    EpuckModel,
    wheel_geometry,
)
from swarm_loc_estimator.common.parameters import ParameterError, choice, flag, number, text
from swarm_loc_estimator.swarm.error_models import OdometryModel

_ODOMETRY = OdometryModel()


@dataclass(frozen=True)
class EpuckParameters(DriverParameters):
    """Parameters of `epuck_driver_node`.

    Raises ParameterError if a parameter is invalid, or conflicts with another one.
    """

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
        "rate of used readings: a serial robot is polled at it and at each cmd_vel,"
        " of a stream's 50 the others are skipped",
    )
    reply_timeout_s: float = number(
        0.5, "s", 0.01, 10.0, "how long an answer may take; a stream may be silent 1.5 s longer"
    )
    wheel_diameter: float = number(0.041, "m", 0.001, 1.0, "diameter of the wheels")
    wheel_separation: float = number(
        _ODOMETRY.wheel_separation, "m", 0.001, 10.0, "distance between the two wheels"
    )
    wheel_noise: float = number(
        _ODOMETRY.wheel_noise, "m", 0.0, 1.0, "variance of each wheel's path per metre it rolls [m^2/m]"
    )
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

    def __post_init__(self) -> None:
        if self.link_address.host and self.epuck_model is not EPUCK2:
            raise ParameterError(
                f"parameter model = '{self.model}' does not go with address = '{self.link_address}':"
                " only epuck2 has WiFi."
            )
        if self.camera and not self.link_address.host:
            # over a serial port the robot would silently refuse images beyond its buffer
            model, size = self.epuck_model, 2 * self.image_width * self.image_height
            if size > model.largest_image:
                raise ParameterError(
                    f"parameters image_width = {self.image_width} and image_height = {self.image_height} make"
                    f" images of {size} bytes, but an {model.name} can send at most {model.largest_image}."
                )
            if self.image_zoom not in model.zooms:
                raise ParameterError(
                    f"parameter image_zoom = {self.image_zoom} must be one of"
                    f" {', '.join(map(str, model.zooms))} for an {model.name}."
                )

    @property
    def link_address(self) -> Address:
        """The parsed address; over TCP the robot is an e-puck2 with the WiFi firmware."""
        return parse_address(self.address, WIFI_PORT)

    @property
    def epuck_model(self) -> EpuckModel:
        """Generation of the robot."""
        return EPUCK_MODELS[self.model]

    @property
    def geometry(self) -> WheelGeometry:
        """Geometry of the wheels."""
        return wheel_geometry(self.wheel_diameter, self.wheel_separation)

    @property
    def images(self) -> CameraSettings | None:
        """Images to request, or None; over TCP they have a fixed size."""
        if not self.camera:
            return None
        if self.link_address.host:
            return CameraSettings(WIFI_WIDTH, WIFI_HEIGHT, zoom=1, period_s=self.image_period_s)
        return CameraSettings(self.image_width, self.image_height, self.image_zoom, self.image_period_s)


def camera_calibration(parameters: EpuckParameters, camera: CameraSettings) -> CameraCalibration:
    """Calibration of the camera's images; raises ParameterError if the file is not set or cannot be used."""
    if not parameters.camera_info_file:
        raise ParameterError(
            "parameter camera_info_file is not set: a camera without calibration cannot be published."
        )
    try:
        return load_calibration(Path(parameters.camera_info_file), camera.width, camera.height)
    except CalibrationFileError as error:
        raise ParameterError(f"parameter camera_info_file: {error}") from error
