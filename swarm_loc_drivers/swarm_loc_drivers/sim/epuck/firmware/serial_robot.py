"""What the commands of the serial firmware act on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.epuck.hardware import EPUCK1, EpuckModel
from swarm_loc_drivers.epuck.rgb565 import encode_rgb565
from swarm_loc_drivers.epuck.serial_protocol import RGB565_MODE
from swarm_loc_drivers.sim.common.body import EpuckBody
from swarm_loc_drivers.sim.epuck.firmware.parts import GRAVITY_EPUCK2, Motors, camera_image, sensor_values

GREY_MODE = 0
_ZERO_G = 2048
_GRAVITY_EPUCK1 = 800


@dataclass(frozen=True)
class CameraSetting:
    """How images are taken: mode (0 grey, 1 RGB565), size [px], zoom."""

    mode: int = RGB565_MODE
    width: int = 40
    height: int = 40
    zoom: int = 8

    @property
    def size(self) -> int:
        """Bytes of an image."""
        return self.width * self.height * (1 if self.mode == GREY_MODE else 2)


class SerialRobot:
    """An e-puck as its serial firmware sees it.

    Args:
        body: The robot.
        model: Its generation.
    """

    def __init__(self, body: EpuckBody, model: EpuckModel) -> None:
        self.body = body
        self.model = model
        self.motors = Motors(body, model)
        self.camera = CameraSetting()
        self.reset_wanted = False

    @property
    def is_first(self) -> bool:
        """Whether it is an e-puck of the first generation."""
        return self.model is EPUCK1

    def reset(self) -> None:
        """Begin anew as after power-on."""
        self.motors.set_speeds(0, 0)
        self.motors.preset(0, 0)
        self.camera = CameraSetting()
        self.reset_wanted = False

    def set_camera(self, setting: CameraSetting) -> None:
        """Use a setting; one that the buffer cannot hold becomes the default, silently."""
        sensible = setting.width > 0 and setting.height > 0 and setting.zoom > 0
        fits = sensible and setting.size <= self.model.largest_setting
        self.camera = setting if fits else CameraSetting()

    def pixels(self) -> bytes:
        """An image by the camera's setting; of a zoom that it does not have the camera makes its last one."""
        zooms, zoom = self.model.zooms, self.camera.zoom
        zoom = zoom if zoom in zooms else zooms[-1]
        shown = camera_image(self.body, self.camera.width, self.camera.height, zoom)
        if self.camera.mode == GREY_MODE:
            grey: NDArray[np.uint8] = shown.mean(axis=2).astype(np.uint8)
            return grey.tobytes()
        return encode_rgb565(shown)

    def acceleration(self) -> tuple[int, int, int]:
        """Raw values, level."""
        return _ZERO_G, _ZERO_G, _ZERO_G + (_GRAVITY_EPUCK1 if self.is_first else GRAVITY_EPUCK2)

    def values(self) -> NDArray[np.void]:
        """All sensors, () of SENSORS_DTYPE."""
        return sensor_values(self.body, self.motors)
