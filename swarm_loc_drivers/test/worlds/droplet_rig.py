"""What the Droplets' tests share: small worlds without errors, their robots' firmware and sessions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bench.scenarios.droplets_run import Cable, run
from swarm_loc_drivers.droplet.exchange import Brightness, PollingSettings, SessionSettings, TdmaSettings
from swarm_loc_drivers.droplet.hardware import DROPLET, ELEMENTS, FULL_POWER
from swarm_loc_drivers.droplet.odometry import MotionNoise
from swarm_loc_drivers.sim.droplet.firmware import DropletFirmware, _braces
from swarm_loc_drivers.sim.droplet.infrared import InfraredSettings
from swarm_loc_drivers.sim.droplet.world import (
    NEAR_POWER,
    STEP_NS,
    DropletErrors,
    DropletWorld,
    DropletWorldSettings,
    SimulatedDroplet,
)
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.swarm.ir_board import load_ir_platform

SECOND = 1_000_000_000
START_NS = 1_000 * SECOND
IDS = (0x0029, 0x6B6F, 0xDF64)
TRIANGLE = np.array([[0.0, 0.0, 0.3], [0.12, 0.02, 2.0], [0.03, 0.14, -1.0]])
LINK = InfraredSettings(reach=0.30, loss=0.0, ambient=0.0, ambient_walk=0.0)
IDEAL = DropletErrors(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, LINK)
QUIET = replace(load_ir_platform("droplet"), noise=1e-9)
POWERS = (FULL_POWER, NEAR_POWER)
NOISE = MotionNoise(walk_noise=1e-3, veer_noise=0.1, turn_noise=0.01)


def world_of(
    start: FloatArray = TRIANGLE,
    errors: DropletErrors = IDEAL,
    ids: Sequence[int] = IDS,
    seed: int = 1,
    **platform: float,
) -> DropletWorld:
    """A world whose sensors read exactly what they should unless `platform` says otherwise."""
    settings = DropletWorldSettings(seed, errors, replace(QUIET, **platform), START_NS)  # type: ignore[arg-type]
    return DropletWorld(ids[: len(start)], start, settings)


def read_by(world: DropletWorld, receiver: int, emitter: int) -> FloatArray:
    """What a board reads of another one without noise (modes, n, n), sensors by emitters."""
    seen = se2.between(world.poses[receiver], world.poses[emitter])
    pose = [np.hypot(seen[0], seen[1]), np.arctan2(seen[1], seen[0]), seen[2]]
    readings: FloatArray = expected_brightness(QUIET, pose)[0]
    return readings


def asking(
    *partners: int, period_s: float = 0.0, retries: int = 5, powers: Sequence[int] = POWERS
) -> PollingSettings:
    """Ask these partners."""
    return PollingSettings(partners, period_s, retries, tuple(powers), least_brightness=5)


def taking_turns(turn: int, turns: int = 3, powers: Sequence[int] = POWERS) -> TdmaSettings:
    """Emit in this turn."""
    return TdmaSettings(turn, turns, 1.0, tuple(powers), ())


class Lab:
    """Robots, the first of them at cables, in simulated time.

    Args:
        world: The robots.
        exchanges: Of each that has a cable.

    Attributes:
        cables: Of these.
        found: Per cable the matrices that came.
    """

    def __init__(self, world: DropletWorld, *exchanges: PollingSettings | TdmaSettings) -> None:
        self.world = world
        self.found: list[list[Brightness]] = [[] for _ in exchanges]
        self.cables = [
            Cable(world, robot, SessionSettings(DROPLET, ELEMENTS, 0.3, one), NOISE, self.found[robot].append)
            for robot, one in enumerate(exchanges)
        ]
        loose = [
            DropletFirmware(SimulatedDroplet(world, robot)) for robot in range(len(exchanges), len(world.ids))
        ]
        self._robots = [*(cable.step for cable in self.cables), *(one.stream for one in loose)]
        self.control: Callable[[], None] = lambda: None

    def run(self, seconds: float) -> None:
        """Let time pass."""
        run(self.world, self._robots, round(seconds * SECOND / STEP_NS), self.control)

    def until(self, condition: Callable[[], object], seconds: float = 60.0) -> None:
        """Let time pass until something is so."""
        end_ns = self.world.now_ns + seconds * SECOND
        while not condition():
            assert self.world.now_ns < end_ns, [cable.counts for cable in self.cables]
            self.run(STEP_NS / SECOND)

    def connected(self) -> Lab:
        """Itself, when all sessions know their robots."""
        self.until(lambda: all(cable.session.connected for cable in self.cables))
        return self


def print_2014(_emitter: int, _receiver: int, readings: NDArray[np.int64]) -> str:
    """The format of 2014: one line, unsigned."""
    return f"{_braces(np.maximum(readings, 0))};\r\n"


def print_2016(_emitter: int, _receiver: int, readings: NDArray[np.int64]) -> str:
    """The format of 2016: one line per emitter, and the sum."""
    rows = ["\t{" + ",".join(f"{cell:4d}" for cell in row) + "}" for row in readings.tolist()]
    return "{\r\n" + ",\r\n".join(rows) + f"\r\n}}; sum={readings.sum()}\r\n"
