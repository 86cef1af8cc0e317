"""Parameters of `pushbot_world_node`, and the world made of them. No ROS here."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from swarm_loc_drivers.common.odometry import WheelGeometry
from swarm_loc_drivers.pushbot.hardware import GENERATIONS, SECOND_FIRMWARE
from swarm_loc_drivers.sim.pushbot.event_camera import CameraNoise
from swarm_loc_drivers.sim.pushbot.floor_plan import FLOOR_PLANS, floor_plan
from swarm_loc_drivers.sim.pushbot.world import (
    TURN_NOISE,
    WHEEL_NOISE,
    PushbotWorld,
    PushbotWorldSettings,
)
from swarm_loc_drivers.sim.worlds import WorldError, start_of
from swarm_loc_estimator.common.parameters import ParameterError, choice, number, text
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm


@dataclass(frozen=True)
class PushbotWorldParameters:
    """Parameters of `pushbot_world_node`; the event cameras' are those of `CameraNoise`."""

    swarm_file: str = text("", "path of the swarm description; every robot needs a start", required=True)
    plan: str = choice("corridor", tuple(FLOOR_PLANS), "the hall")
    seed: int = number(1, "1", 0, 2**31 - 1, "fixes the assembly of the robots, and all noise")
    rate: float = number(
        1.0, "1", 0.01, 100.0, "simulated seconds per second, as far as the machine keeps up"
    )
    turn_slip: float = number(0.02, "1", 0.0, 0.5, "share of every turn that slips")
    wheel_noise: float = number(
        WHEEL_NOISE, "m", 0.0, 0.01, "variance of each wheel's path per metre it rolls [m^2/m]"
    )
    turn_noise: float = number(
        TURN_NOISE, "rad", 0.0, 1.0, "further error of a whole turn, one standard deviation"
    )
    link_folder: str = text("", "where each robot's serial port appears under its name; empty: TCP")
    first_port: int = number(0, "1", 0, 65000, "TCP port of the first robot, the others follow; 0: any")
    firmware: str = choice(SECOND_FIRMWARE.name, tuple(GENERATIONS), "generation of the robots' firmware")
    metres_per_tick: float = number(1e-4, "m", 1e-6, 1e-2, "path of a wheel per tick")
    wheel_separation: float = number(0.085, "m", 0.01, 1.0, "distance between the two wheels")
    truth_rate: float = number(20.0, "1/s", 0.1, 200.0, "published true poses of each robot")
    camera: CameraNoise = field(default_factory=CameraNoise, metadata={"numbers_of": CameraNoise})


def make_pushbot_world(parameters: PushbotWorldParameters) -> tuple[Swarm, PushbotWorld]:
    """The swarm as described, and its world.

    Raises:
        ParameterError: A parameter cannot be used.
        SwarmFileError: The swarm description cannot be used.
    """
    swarm = load_swarm(Path(parameters.swarm_file))
    settings = PushbotWorldSettings(
        seed=parameters.seed,
        plan=floor_plan(parameters.plan),
        wheels=WheelGeometry(parameters.metres_per_tick, parameters.wheel_separation),
        wheel_noise=parameters.wheel_noise,
        turn_noise=parameters.turn_noise,
        turn_slip=parameters.turn_slip,
        camera=parameters.camera,
    )
    try:
        return swarm, PushbotWorld([start_of(robot) for robot in swarm.robots], settings)
    except WorldError as error:
        raise ParameterError(f"parameter swarm_file = '{parameters.swarm_file}': {error}") from error
