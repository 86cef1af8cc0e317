"""A swarm of Droplets on a table: who they are, where they begin, and how some of them wander."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swarm_loc_drivers.sim.scenarios.eight import rounded
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.ir_board import IrGains, IrPlatform
from swarm_loc_estimator.swarm.robot_ir import RobotIr
from swarm_loc_estimator.swarm.swarm import OdometryModel, Robot, Swarm

PITCH = 0.13
_JITTER = 0.02
_FIRST_ID = 0x1001
_WANDER_RADIUS = 0.03
_ARRIVED, _TURNED = 0.004, 0.1
_PATIENCE_NS = 30_000_000_000
_FAST, _FAST_TURN = 0.02, 0.5
"""Faster than any Droplet: the direction counts."""

MOTION = OdometryModel(
    wheel_separation=0.044,
    wheel_noise=5e-5,
    distance_noise=5e-4,
    lateral_noise=5e-4,
    turn_noise=0.01,
    max_speed=0.05,
    max_turn_rate=0.3,
    speed_change=0.003,
    turn_rate_change=0.15,
)
"""What is honest for commanded motion of robots that err as in `droplet_world.D1`.

Their steps are 8 % too long or short and lead aside, in every direction differently: a stretch of 5 cm goes
4 mm and 0.03 rad wrong.
"""


@dataclass(frozen=True)
class DropletSwarmSettings:
    """Which swarm.

    Attributes:
        seed: Two swarms with the same settings are identical.
        robots: How many, on a grid of which no row is much longer than a column.
        start_known: Whether the description tells where each robot begins.
    """

    seed: int = 1
    robots: int = 20
    start_known: bool = False


def starts(settings: DropletSwarmSettings) -> FloatArray:
    """(N, 3) where the robots begin: near the places of a grid, looking anywhere."""
    rng = np.random.default_rng([settings.seed, settings.robots])
    columns = math.ceil(math.sqrt(1.25 * settings.robots))
    places = np.stack(np.divmod(np.arange(settings.robots), columns), axis=-1)[:, ::-1] * PITCH
    places = places - places.mean(axis=0) + rng.uniform(-_JITTER, _JITTER, places.shape)
    headings = rng.uniform(-math.pi, math.pi, settings.robots)
    return np.array([rounded(pose) for pose in np.column_stack([places, headings])])


def describe_droplets(
    settings: DropletSwarmSettings,
    start: FloatArray,
    platform: IrPlatform,
    gains: tuple[IrGains | None, ...],
) -> Swarm:
    """The swarm as its owner would describe it.

    Args:
        settings: Which swarm.
        start: (N, 3) in map.
        platform: The board of all robots, the packaged one of the Droplet.
        gains: What is known of each robot's elements.
    """
    return Swarm(
        tuple(
            Robot(
                name=f"droplet{index + 1}",
                type="droplet",
                odometry=MOTION,
                camera=None,
                start=rounded(pose) if settings.start_known else None,
                ir=RobotIr(_FIRST_ID + index, platform, "droplet", gains=gains[index]),
            )
            for index, pose in enumerate(start)
        )
    )


class Wander:
    """Steers robots to places around their homes, one after the other, and in between lets them turn.

    Args:
        homes: (N, 3) around which they wander, in map.
        walking: (N,) which of them do; the others stand.
        seed: Fixes the places.
    """

    def __init__(self, homes: FloatArray, walking: FloatArray, seed: int) -> None:
        self._homes, self._walking, self._seed = homes, walking, seed
        self._leg = np.full(len(homes), -1)
        self._since_ns = np.zeros(len(homes), dtype=np.int64)

    def command(self, robot: int, stamp_ns: int, pose: FloatArray) -> tuple[float, float, float]:
        """What a robot should do now: forward [m/s], to the left [m/s], turning to the left [rad/s].

        Args:
            robot: Its index.
            stamp_ns: When it was at `pose`.
            pose: (3,) in map.
        """
        if not self._walking[robot]:
            return 0.0, 0.0, 0.0
        if not 0 <= stamp_ns - self._since_ns[robot] <= _PATIENCE_NS:
            self._next_leg(robot, stamp_ns)
        velocity = self._toward(robot, pose)
        if not any(velocity):
            self._next_leg(robot, stamp_ns)
        return velocity

    def _next_leg(self, robot: int, stamp_ns: int) -> None:
        self._leg[robot] += 1
        self._since_ns[robot] = stamp_ns

    def _toward(self, robot: int, pose: FloatArray) -> tuple[float, float, float]:
        """The velocity to the end of the leg; still when it is reached."""
        leg = int(self._leg[robot])
        rng = np.random.default_rng([self._seed, robot, leg // 2])
        radius, angle, aside = rng.uniform((0.0, -math.pi, -1.0), (_WANDER_RADIUS, math.pi, 1.0))
        if leg % 2:
            left = float(se2.wrap_angle(self._homes[robot, 2] + aside - pose[2]))
            return 0.0, 0.0, math.copysign(_FAST_TURN, left) if abs(left) > _TURNED else 0.0
        there = self._homes[robot, :2] + radius * np.array([math.cos(angle), math.sin(angle)])
        seen = se2.between(pose, [*there, 0.0])
        distance = math.hypot(seen[0], seen[1])
        if distance <= _ARRIVED:
            return 0.0, 0.0, 0.0
        return _FAST * seen[0] / distance, _FAST * seen[1] / distance, 0.0
