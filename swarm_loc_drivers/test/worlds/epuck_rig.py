"""What the e-puck's tests share: a drive, parameters, and a firmware that says nothing."""

import math

from epuck_body import GEOMETRY

from swarm_loc_drivers.epuck.parameters import EpuckParameters

SQUARE = [leg for _ in range(4) for leg in ((0.1, 0.0, 0.06), (0.0, 3.0, 0.5 * math.pi))]
"""Speed [m/s], turn rate [rad/s], and how far to go [m or rad]."""


class Mute:
    """A firmware that says nothing."""

    def receive(self, _data: bytes) -> bytes:
        """See `ConsoleFirmware`."""
        return b""

    def stream(self) -> bytes:
        """See `ConsoleFirmware`."""
        return b""

    def disconnect(self) -> None:
        """See `StreamFirmware`."""


def params_of(address: str, model: str = "epuck2") -> EpuckParameters:
    """A robot with the wheels of `DrivenBody`."""
    return EpuckParameters(
        address,
        model,
        reading_rate=50.0,
        reply_timeout_s=0.3,
        cmd_vel_timeout_s=0.3,
        wheel_separation=GEOMETRY.wheel_separation,
        wheel_noise=2e-4,
    )
