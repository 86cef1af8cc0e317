"""One world of PushBots, stepped in simulated time: motors, slipping wheels, walls, lasers, event cameras.

The seed and the times of the robots' commands determine the result. The parameters of `pushbot_world_node`
are at the end. No ROS here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from swarm_loc_drivers.pushbot.protocol import GENERATIONS, SECOND_FIRMWARE
from swarm_loc_drivers.sim.differential_drive import Drive, LastingNoise, roll
from swarm_loc_drivers.sim.pushbot.event_camera import Blinking, CameraNoise
from swarm_loc_drivers.sim.pushbot.firmware import PushbotFirmware
from swarm_loc_drivers.sim.pushbot.floor_plan import (
    FLOOR_PLANS,
    FloorPlan,
    floor_plan,
    is_blocked,
    kept_clear,
)
from swarm_loc_drivers.sim.pushbot.optics import BODY_RADIUS_M, HallSight, Lights, assembled_robots
from swarm_loc_drivers.sim.worlds import LinkedWorldParameters, WorldError, start_of
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.parameters import ParameterError, choice, number, text
from swarm_loc_estimator.swarm.swarm import Pose2, Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm

_FREE_RATE = 6000.0  # A wheel at full voltage [ticks/s]; the fastest velocity needs four fifths of it
_LAG_S = 0.02


class Drivetrain:
    """Two wheels of each of N robots, in steps of a time [s]."""

    def __init__(self, count: int, step_s: float) -> None:
        self.duties = np.zeros((count, 2))  # (N, 2) share of the battery's voltage, left and right
        self.ticks = np.zeros((count, 2))  # (N, 2) that the wheels have turned
        self._rates = np.zeros((count, 2))
        self._step_s = step_s
        self._kept = np.exp(-step_s / _LAG_S)

    def step(self) -> FloatArray:
        """Let time pass; the ticks (N, 2) done in it."""
        self._rates = _FREE_RATE * self.duties + self._kept * (self._rates - _FREE_RATE * self.duties)
        done = self._rates * self._step_s
        self.ticks += done
        return done


STEP_NS = 5_000_000
_MS_PER_STEP = 5
_START_NS = 1_000_000_000
_SLIP_S = 0.05
WHEEL_NOISE, TURN_NOISE = 1e-7, math.radians(0.64)
"""Headings err by .3 deg a root metre driven straight on, and by this for each root turn [m], [rad]."""


@dataclass(frozen=True)
class PushbotWorldParameters(LinkedWorldParameters):
    """Parameters of `pushbot_world_node`; the event cameras' are those of `CameraNoise`."""

    plan: str = text("corridor", f"the hall: {', '.join(FLOOR_PLANS)}, or the path of a floor plan")
    seed: int = number(1, "1", 0, 2**31 - 1, "fixes the assembly of the robots, and all noise")
    turn_slip: float = number(0.02, "1", 0.0, 0.5, "share of every turn that slips")
    wheel_noise: float = number(
        WHEEL_NOISE, "m", 0.0, 0.01, "variance of each wheel's path per metre it rolls [m^2/m]"
    )
    turn_noise: float = number(
        TURN_NOISE, "rad", 0.0, 1.0, "further error of a whole turn, one standard deviation"
    )
    first_port: int = number(0, "1", 0, 65000, "TCP port of the first robot, the others follow; 0: any")
    firmware: str = choice(SECOND_FIRMWARE.name, tuple(GENERATIONS), "generation of the robots' firmware")
    metres_per_tick: float = number(1e-4, "m", 1e-6, 1e-2, "path of a wheel per tick")
    wheel_separation: float = number(0.085, "m", 0.01, 1.0, "distance between the two wheels")
    camera: CameraNoise = field(default_factory=CameraNoise, metadata={"numbers_of": CameraNoise})


class PushbotWorld:
    """Robots in a hall; of the parameters, files, links and the plan's name are not used.

    Raises WorldError if a robot starts within a wall or another robot.
    """

    def __init__(self, starts: list[Pose2], plan: FloorPlan, params: PushbotWorldParameters) -> None:
        self._plan, self._params = plan, params
        rng = np.random.default_rng(params.seed)
        count = len(starts)
        self.now_ns = _START_NS
        self.poses: FloatArray = np.array(starts, dtype=float).reshape(count, 3)
        """(N, 3) true poses of the robots in map."""
        self.drivetrain = Drivetrain(count, 1e-3)
        self.optics = assembled_robots(params.seed, count)  # Optics of the robots, for evaluation
        self.lights: list[Lights] = [(Blinking(), Blinking(), Blinking()) for _ in range(count)]
        """Laser, rear and front LED of each robot."""
        self.firmwares: list[PushbotFirmware | None] = [None] * count
        self.sight = HallSight(plan.walls, self.optics, params.camera, rng)  # The event cameras of the robots
        self._slip = LastingNoise(rng, (count, 3), STEP_NS * 1e-9, _SLIP_S)
        self._drive = Drive(params.wheel_separation, params.wheel_noise, params.turn_slip)
        self._radii = np.full(count, BODY_RADIUS_M)
        for robot in range(count):
            if is_blocked(plan.walls, self._radii, self.poses, robot):
                raise WorldError(f"robot {robot + 1} of the swarm begins within a wall or another robot.")

    def step(self) -> None:
        """Step by STEP_NS."""
        done = np.zeros_like(self.drivetrain.ticks)
        for _ in range(_MS_PER_STEP):
            self.now_ns += STEP_NS // _MS_PER_STEP
            for firmware in self.firmwares:
                if firmware is not None:
                    firmware.millisecond()
            done += self.drivetrain.step()
        before = self.poses
        self.poses = self._rolled(done)
        for robot in range(len(self.poses)):
            self._look(robot, before)

    def _rolled(self, ticks: FloatArray) -> FloatArray:
        """Poses after the wheels' ticks; a robot that would hit something only turns."""
        step_s = STEP_NS * 1e-9
        left, right = (self._params.metres_per_tick * ticks / step_s).T
        slip = self._slip.next()
        noise = np.sqrt(self._drive.wheel_noise) * slip[:, :2]
        turn_rate = (right - left) / self._drive.wheel_separation
        turns = np.abs(turn_rate) * step_s / (2.0 * np.pi)
        turn_rate += self._params.turn_noise * np.sqrt(turns) * slip[:, 2] / step_s
        poses = roll(self.poses, 0.5 * (left + right), turn_rate, self._drive, step_s, noise)
        return kept_clear(self._plan.walls, self._radii, self.poses, poses)

    def _look(self, robot: int, before: FloatArray) -> None:
        """Pass the events of a robot's camera since poses `before` (N, 3) to its firmware."""
        firmware = self.firmwares[robot]
        if firmware is None:
            return
        span_us = (self.now_ns - STEP_NS) // 1000, self.now_ns // 1000
        seen = self.sight.look(robot, before, self.poses, span_us, self.lights)
        firmware.see(seen.words(), seen.time_us)


class SimulatedPushbot:
    """One robot of a world as seen by its firmware; see `PushbotBody`."""

    def __init__(self, world: PushbotWorld, robot: int) -> None:
        self._world, self._robot = world, robot

    def set_duties(self, left: float, right: float) -> None:
        """See `PushbotBody.set_duties`."""
        self._world.drivetrain.duties[self._robot] = left, right

    def wheel_ticks(self) -> tuple[int, int]:
        """See `PushbotBody.wheel_ticks`."""
        left, right = np.floor(self._world.drivetrain.ticks[self._robot]).tolist()
        return int(left), int(right)

    def set_lights(self, laser: Blinking, rear: Blinking, front: Blinking) -> None:
        """See `PushbotBody.set_lights`."""
        self._world.lights[self._robot] = laser, rear, front

    @property
    def now_ns(self) -> int:
        """The world's time [ns]."""
        return self._world.now_ns


def make_pushbot_world(params: PushbotWorldParameters) -> tuple[Swarm, PushbotWorld]:
    """The swarm as described, and its world.

    Raises UserError if a parameter, the swarm description or the floor plan cannot be used.
    """
    swarm = load_swarm(Path(params.swarm_file))
    try:
        starts = [start_of(robot) for robot in swarm.robots]
        return swarm, PushbotWorld(starts, floor_plan(params.plan), params)
    except WorldError as error:
        raise ParameterError(f"parameter swarm_file = '{params.swarm_file}': {error}") from error
