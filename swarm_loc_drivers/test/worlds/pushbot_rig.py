"""A session and an emulated PushBot in one world, without threads and without a clock."""

import math
from collections import Counter
from typing import Any

import numpy as np

from swarm_loc_drivers.common.odometry import OdometryState, WheelGeometry
from swarm_loc_drivers.common.robot_driver import SessionError
from swarm_loc_drivers.pushbot.driver import PushbotOdometry, PushbotSession, WheelTicks
from swarm_loc_drivers.pushbot.event_parser import EventPacket
from swarm_loc_drivers.pushbot.parameters import PushbotParameters
from swarm_loc_drivers.pushbot.protocol import SECOND_FIRMWARE, FirmwareGeneration
from swarm_loc_drivers.sim.pushbot.event_camera import CameraNoise
from swarm_loc_drivers.sim.pushbot.firmware import PushbotFirmware
from swarm_loc_drivers.sim.pushbot.floor_plan import FloorPlan, outline
from swarm_loc_drivers.sim.pushbot.world import PushbotWorld, PushbotWorldParameters, SimulatedPushbot
from swarm_loc_estimator.common import se2

GEOMETRY = WheelGeometry(metres_per_step=1e-4, wheel_separation=0.085)
HALL = FloorPlan("hall", outline([(-2.0, -2.0, 3.0, 2.0)], []), np.zeros((1, 2)))


def pushbot_params(**changed: Any) -> PushbotParameters:
    """Parameters for tests."""
    values: dict[str, Any] = {"address": "/dev/none", "wheel_noise": 2e-5, "reply_timeout_s": 0.3}
    return PushbotParameters(**(values | changed))


class PushbotWire:
    """The two ends, and what each has said.

    Attributes:
        velocities: What the robot is commanded [ticks per 21 ms].
        hears: Whether the robot's bytes arrive; `is_heard`: those of the host.
    """

    def __init__(
        self, params: PushbotParameters, generation: FirmwareGeneration = SECOND_FIRMWARE, seed: int = 1
    ) -> None:
        world_params = PushbotWorldParameters(
            seed=seed,
            metres_per_tick=GEOMETRY.metres_per_step,
            wheel_separation=GEOMETRY.wheel_separation,
            wheel_noise=0.0,
            turn_noise=0.0,
            turn_slip=0.0,
            camera=CameraNoise(noise_rate=0.5),
        )
        self.world = PushbotWorld([(0.0, 0.0, 0.0)], HALL, world_params)
        self.firmware = PushbotFirmware(SimulatedPushbot(self.world, 0), generation)
        self.world.firmwares[0] = self.firmware
        self.counts: Counter[str] = Counter()
        self.velocities = (0, 0)
        self.hears = self.is_heard = True
        self.sent = b""
        self.ticks: list[WheelTicks] = []
        self.packets: list[EventPacket] = []
        self.states: list[OdometryState] = []
        self.errors: list[str] = []
        self._params = params
        self._odometry = PushbotOdometry(GEOMETRY, params.wheel_noise, self.counts)
        self.session = self._begin()

    def _begin(self) -> PushbotSession:
        self._odometry.restart()
        return PushbotSession(self._params, lambda: self.velocities, self.counts)

    @property
    def speed(self) -> float:
        """How fast the wheels turn now, the faster one [share of full voltage]."""
        return float(np.abs(self.world.drivetrain.duties).max())

    def run(self, seconds: float) -> None:
        """Let time pass; a session that fails is followed by the next one."""
        end_ns = self.world.now_ns + round(seconds * 1e9)
        while self.world.now_ns < end_ns and not self.session.ended:
            self.step()

    def step(self) -> None:
        """A step of the world, and what comes of it."""
        self.world.step()
        data = self.firmware.stream()
        try:
            output = self.session.step(
                data if self.hears else b"", self.world.now_ns, self.world.now_ns * 1e-9
            )
        except SessionError as error:
            self.errors.append(str(error))
            is_ending, output = self.session.ending, b""
            self.session = self._begin()
            self.session.ending = is_ending
        self.sent += output
        if self.is_heard:
            self.firmware.receive(output)
        found, self.session.found = self.session.found, []
        for one in found:
            if isinstance(one, EventPacket):
                self.packets.append(one)
            else:
                self.ticks.append(one)
                state = self._odometry.update(one)
                self.states += [state] if state is not None else []

    def odometry_error(self) -> tuple[float, float]:
        """By how much the odometry is wrong at the end [m, rad]."""
        dx, dy, turn = se2.between(self.world.poses[0], self.states[-1].pose)
        return math.hypot(dx, dy), abs(turn)
