"""Parameters of `pushbot_driver_node` and `exploration_node`, and what follows from them."""

from __future__ import annotations

from dataclasses import dataclass, field

from swarm_loc_drivers.common.link import Address, parse_address
from swarm_loc_drivers.common.odometry import WheelGeometry
from swarm_loc_drivers.common.robot_driver import DriverParameters
from swarm_loc_drivers.pushbot.protocol import BAUD_RATE, TIMESTAMPS, Lights
from swarm_loc_drivers.pushbot.stop_and_go import StopAndGoSettings
from swarm_loc_estimator.common.parameters import ParameterError, choice, flag, number, text, texts
from swarm_loc_estimator.swarm.swarm import Swarm

TCP_PORT = 56000  # TCP port of the radio's transparent link
_MIN_FREQUENCY = 10.0  # Lowest blink frequency that the tracker detects [Hz]; 0 is off


@dataclass(frozen=True)
class PushbotParameters(DriverParameters):
    """Parameters of `pushbot_driver_node`.

    Raises:
        ParameterError: The address, or the frequency of a light, is invalid.
    """

    address: str = text("", "a serial port such as /dev/ttyUSB0, or tcp://HOST[:56000]", required=True)
    baud_rate: int = number(BAUD_RATE, "bit/s", 9600, 12_000_000, "of a serial port")
    timestamps: str = choice("24bit", tuple(TIMESTAMPS), "timestamps of events: their bits, or differences")
    events: bool = flag(True, "publish what the event camera sees")
    on_bit: int = number(0, "1", 0, 1, "polarity bit of pixels that became brighter")
    packet_period: float = number(0.005, "s", 0.001, 0.1, "of packets of events")
    laser_frequency: float = number(450.0, "Hz", 0.0, 5000.0, "at which the laser pointer blinks; 0: off")
    led_frequency: float = number(1000.0, "Hz", 0.0, 5000.0, "at which both LEDs blink; 0: off")
    tick_rate: float = number(50.0, "1/s", 1.0, 200.0, "readings of the wheel ticks")
    reply_timeout_s: float = number(
        0.5, "s", 0.05, 10.0, "how long an answer, or the next wheel ticks, may take"
    )
    metres_per_tick: float = number(1e-4, "m", 1e-6, 1e-2, "path of a wheel per tick")
    wheel_separation: float = number(0.085, "m", 0.01, 1.0, "distance between the two wheels")
    wheel_noise: float = number(
        2e-4, "m", 0.0, 1.0, "variance of each wheel's path per metre it rolls [m^2/m]"
    )

    def __post_init__(self) -> None:
        parse_address(self.address, TCP_PORT)
        for name in ("laser_frequency", "led_frequency"):
            if 0.0 < (value := getattr(self, name)) < _MIN_FREQUENCY:
                raise ParameterError(
                    f"parameter {name} = {value} must be 0, or at least {_MIN_FREQUENCY:g} Hz."
                )

    @property
    def link_address(self) -> Address:
        """The parsed address."""
        return parse_address(self.address, TCP_PORT)

    @property
    def geometry(self) -> WheelGeometry:
        """Geometry of the wheels."""
        return WheelGeometry(self.metres_per_tick, self.wheel_separation)

    @property
    def lights(self) -> Lights:
        """Frequencies of laser and LEDs."""
        return Lights(self.laser_frequency, self.led_frequency)

    @property
    def event_timestamps(self) -> str:
        """Timestamps of events; "" for no events at all."""
        return self.timestamps if self.events else ""

    @property
    def tick_period_s(self) -> float:
        """Time between two readings of the wheel ticks [s]."""
        return 1.0 / self.tick_rate


@dataclass(frozen=True)
class ExplorationParameters:
    """Parameters of `exploration_node`; how the robots move is in its settings."""

    swarm_file: str = text("", "path of the swarm description", required=True)
    robots: tuple[str, ...] = texts("robots that are driven; empty: all of the description")
    wait_for_poses: bool = flag(False, "begin only when swarm/poses is announced, too")
    settings: StopAndGoSettings = field(
        default_factory=StopAndGoSettings, metadata={"numbers_of": StopAndGoSettings}
    )


def driven_robots(parameters: ExplorationParameters, swarm: Swarm) -> list[str]:
    """Names of the driven robots, in the order of the description.

    Raises:
        ParameterError: A robot is not in the description.
    """
    known = [robot.name for robot in swarm.robots]
    for name in parameters.robots:
        if name not in known:
            raise ParameterError(f"parameter robots: there is no robot '{name}' in the swarm description.")
    return [name for name in known if not parameters.robots or name in parameters.robots]
