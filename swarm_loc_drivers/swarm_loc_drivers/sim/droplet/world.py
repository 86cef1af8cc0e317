"""A simulated world of Droplets: motion by vibration motors, infrared exchanges, an optional tracker.

The seed and the times of the robots' commands determine the result. A tracker above the table measures the
poses of some robots. The end of the file has the parameters of `droplet_world_node`. No ROS here.

A world of Droplets with the drivers' sessions at their consoles, in simulated time and one thread.

The bytes are those of the cable, without delay. So runs behave like live ones and are reproducible.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from swarm_loc_drivers.droplet.hardware import DIRECTIONS, ELEMENTS, WALKS, Gait, gait
from swarm_loc_drivers.sim.droplet.infrared import (
    DropletInfrared,
    DropletLight,
    ExchangeReadings,
    InfraredCommand,
    InfraredSettings,
)
from swarm_loc_drivers.sim.run import START_NS
from swarm_loc_drivers.sim.worlds import LinkedWorldParameters, WorldError, start_of
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.parameters import ParameterError, choice, number, text, texts
from swarm_loc_estimator.swarm.ir_board import IrPlatform, RobotIr
from swarm_loc_estimator.swarm.swarm import Pose2, Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm


@dataclass(frozen=True)
class Fix:
    """A pose measured by the tracker."""

    robot: int  # Its index
    stamp_ns: int  # When
    pose: FloatArray  # (3,) in map, with noise


class Tracker:
    """A tracker above the table: noisy absolute poses of some robots at a fixed rate of each.

    Sigmas are of a position along each axis [m], and of a heading [rad].
    """

    def __init__(
        self, robots: tuple[int, ...], rate_hz: float, sigma: float, heading_sigma: float, seed: int
    ) -> None:
        self._scale = np.array([sigma, sigma, heading_sigma])
        self._robots = robots
        self._period_ns = round(1e9 / rate_hz)
        self._rng = np.random.default_rng([seed, *robots])
        self._due_ns: int | None = None

    def look(self, now_ns: int, poses: FloatArray) -> list[Fix]:
        """The fixes that are due now, of robots at true poses (N, 3)."""
        if self._due_ns is None:
            self._due_ns = now_ns
        if now_ns < self._due_ns:
            return []
        self._due_ns += self._period_ns
        noisy = ((robot, poses[robot] + self._scale * self._rng.standard_normal(3)) for robot in self._robots)
        return [Fix(robot, now_ns, pose) for robot, pose in noisy]


STEP_NS = 5_000_000
NEAR_POWER = 40  # Of the emitters, at which the board's near model holds
_WALK_TRIMS, _TURN_TRIMS = (0, 5, -5), (5, 5, 5)
_WALK_MM, _TURN_DEG = 300, 1200  # Per 1000 steps: 2.4 mm/s and 6.4 deg/s, as real Droplets were logged
_MOTION, _GAINS, _INFRARED = range(3)  # Streams of random numbers


@dataclass(frozen=True)
class DropletErrors:
    """Errors of Droplets; all sigmas are one standard deviation."""

    scale_sigma: float  # Of each robot's and each direction's steps, relative
    veer_sigma: float  # Of each robot's and each direction's turn per metre walked [rad/m]
    walk_noise: float  # Variance along and across of a walk per metre [m^2/m]
    veer_noise: float  # Variance of the heading per metre walked [rad^2/m]
    turn_noise: float  # Variance of a turn per radian [rad^2/rad]
    gain_sigma: float  # Of each sensor and each emitter, relative
    infrared: InfraredSettings  # Losses and ambient light of infrared


_LINK = InfraredSettings(reach=0.30, loss=0.05, ambient=6.0, ambient_walk=0.1)
D0 = DropletErrors(0.0, 0.0, 1e-4, 0.02, 1e-3, 0.0, _LINK)  # White noise only
D1 = DropletErrors(0.08, 0.5, 1e-4, 0.02, 1e-3, 0.1, _LINK)
"""Robots that are not calibrated: steps of their own length, a drift to one side, elements of their own."""
DROPLET_WORLDS = {"d0": D0, "d1": D1}


@dataclass(frozen=True)
class DropletWorldSettings:
    """Settings of a world."""

    seed: int  # Seed of systematic errors and noise
    errors: DropletErrors  # Error model
    platform: IrPlatform  # The infrared board of all robots
    start_ns: int  # Start time
    boards: int | None = None  # Seed of the gains of the elements, instead of `seed`


class DropletWorld:
    """Droplets with ids (N,), 1 to 65535, each once, on a floor in map, where they begin at poses (N, 3).

    Raises WorldError if the robots cannot be simulated.
    """

    def __init__(self, ids: Sequence[int], start: FloatArray, settings: DropletWorldSettings) -> None:
        _check(ids, settings.platform)
        self._errors = settings.errors
        self._rng = self._random(settings.seed, _MOTION)
        count = len(ids)
        self.ids = np.array(ids, dtype=np.int64)
        self.now_ns = settings.start_ns
        self.poses: FloatArray = np.array(start, dtype=float)  # (N, 3) true poses of the robots in map
        self._twists = np.zeros((count, 3))
        self._true = self._true_velocities(count)
        rng = self._random(settings.seed if settings.boards is None else settings.boards, _GAINS)
        gains = np.exp(settings.errors.gain_sigma * rng.standard_normal((2, count, ELEMENTS)))
        self.gains: FloatArray = gains  # (2, N, n) true factors of sensors and emitters
        self.infrared = DropletInfrared(
            settings.platform,
            DropletLight(settings.platform, gains, NEAR_POWER),
            self.ids,
            settings.errors.infrared,
            self._random(settings.seed, _INFRARED),
            settings.start_ns,
        )

    def step(self) -> None:
        """Step by STEP_NS."""
        if self._twists.any():
            self._creep(STEP_NS * 1e-9)
        self.now_ns += STEP_NS
        self.infrared.step(self.now_ns, self.poses)

    def _creep(self, step_s: float) -> None:
        """Move the robots whose motors run."""
        path = step_s * np.hypot(self._twists[:, 0], self._twists[:, 1])
        walk = self._errors.walk_noise * path
        heading = self._errors.veer_noise * path
        heading += self._errors.turn_noise * step_s * np.abs(self._twists[:, 2])
        noise = np.sqrt(np.stack([walk, walk, heading], axis=-1))
        noise *= self._rng.standard_normal(noise.shape)
        self.poses = se2.compose(self.poses, se2.exp(self._twists * step_s + noise))

    def move(self, robot: int, direction: int | None) -> None:
        """Run a robot's motors in a direction, None: stop."""
        self._twists[robot] = 0.0 if direction is None else self._true[robot, direction]

    def _true_velocities(self, count: int) -> FloatArray:
        """(N, directions, 3) true velocities of the robots for each commanded direction."""
        scale = 1.0 + self._errors.scale_sigma * self._rng.standard_normal((count, len(DIRECTIONS)))
        veer = self._errors.veer_sigma * self._rng.standard_normal((count, len(DIRECTIONS)))
        nominal = np.array([nominal_gait(direction).velocity for direction in DIRECTIONS])
        true: FloatArray = scale[..., None] * nominal
        true[..., 2] += veer * np.hypot(true[..., 0], true[..., 1])
        return true

    @staticmethod
    def _random(seed: int, stream: int) -> np.random.Generator:
        return np.random.default_rng([seed, stream])


def nominal_gait(direction: int) -> Gait:
    """The gait by the robot's own calibration."""
    one = gait(direction, SimulatedDroplet.trims[direction], SimulatedDroplet.lengths[direction])
    assert one is not None  # noqa: S101 - motors turn in every direction
    return one


class SimulatedDroplet:
    """One robot of a world as seen by its firmware; see `DropletBody`."""

    trims = tuple(_WALK_TRIMS if direction in WALKS else _TURN_TRIMS for direction in DIRECTIONS)
    lengths = tuple(_WALK_MM if direction in WALKS else _TURN_DEG for direction in DIRECTIONS)

    def __init__(self, world: DropletWorld, robot: int) -> None:
        self._world, self._robot = world, robot
        self.robot_id = int(world.ids[robot])

    def move(self, direction: int | None) -> None:
        """Run the motors."""
        self._world.move(self._robot, direction)

    def infrared_status(self) -> int:
        """Status bits of infrared."""
        return self._world.infrared.status(self._robot)

    def send(self, line: str, target: int) -> None:
        """Send a command."""
        self._world.infrared.send(self._robot, line, target, self._world.poses)

    def emit(self, power: int) -> None:
        """Begin an exchange."""
        self._world.infrared.emit(self._robot, power, self._world.poses)

    def heard(self) -> Sequence[InfraredCommand | ExchangeReadings]:
        """Commands and readings since the last call."""
        everybody = self._world.infrared.heard
        heard = everybody[self._robot]
        if heard:
            everybody[self._robot] = []
        return heard

    def deaf_until_ns(self) -> int:
        """End of the current exchange [ns]."""
        return self._world.infrared.deaf_until_ns[self._robot]

    @property
    def now_ns(self) -> int:
        """The world's time [ns]."""
        return self._world.now_ns


def _check(ids: Sequence[int], platform: IrPlatform) -> None:
    """Raise a WorldError for robots that cannot be simulated."""
    wrong = [robot for robot in ids if not 0 < robot <= 0xFFFF]
    if wrong:
        raise WorldError(f"id {wrong[0]} must lie in [1, 65535].")
    if len(set(ids)) < len(ids):
        raise WorldError("two robots have one id.")
    if platform.n != ELEMENTS:
        raise WorldError(f"the board has {platform.n} elements, but a Droplet has {ELEMENTS}.")


@dataclass(frozen=True)
class DropletWorldParameters(LinkedWorldParameters):
    """Parameters of `droplet_world_node`."""

    swarm_file: str = text(
        "", "path of the swarm description; every robot needs a start and an infrared board", required=True
    )
    world: str = choice("d1", tuple(DROPLET_WORLDS), "how the robots err; see sim/droplet/world.py")
    link_folder: str = text("", "where each robot's serial port appears under its name", required=True)
    truth_rate: float = number(10.0, "1/s", 0.1, 200.0, "published true poses of each robot")
    fixed: tuple[str, ...] = texts("robots that a tracker above the table sees; it publishes <robot>/fix")
    fix_rate: float = number(1.0, "1/s", 0.01, 100.0, "fixes of each of these robots")
    fix_sigma: float = number(0.003, "m", 1e-6, 1.0, "noise of a fix along each axis, one standard deviation")
    fix_heading_sigma: float = number(
        0.02, "rad", 1e-6, 1.0, "noise of the heading of a fix, one standard deviation"
    )


def make_droplet_world(parameters: DropletWorldParameters) -> tuple[Swarm, DropletWorld]:
    """The swarm as described, and its world.

    Raises:
        ParameterError: A parameter cannot be used.
        SwarmFileError: The swarm description cannot be used.
    """
    swarm = load_swarm(Path(parameters.swarm_file))
    for name in parameters.fixed:
        if name not in swarm.index_of:
            raise ParameterError(f"parameter fixed has '{name}', who is not in the swarm description.")
    try:
        boards, starts = zip(*(_needed(robot) for robot in swarm.robots), strict=True)
        settings = DropletWorldSettings(
            parameters.seed, DROPLET_WORLDS[parameters.world], boards[0].platform, START_NS
        )
        return swarm, DropletWorld([board.id for board in boards], np.array(starts), settings)
    except WorldError as error:
        raise ParameterError(f"parameter swarm_file = '{parameters.swarm_file}': {error}") from error


def check_droplets(swarm: Swarm) -> None:
    """Check that every robot has a start and an infrared board.

    Raises WorldError if a robot lacks one of them.
    """
    for robot in swarm.robots:
        _needed(robot)


def _needed(robot: Robot) -> tuple[RobotIr, Pose2]:
    """The board and the start of a robot; raises WorldError if it has none."""
    start = start_of(robot)
    if robot.ir is None:
        raise WorldError(f"robot '{robot.name}' has no infrared board, and a Droplet needs one.")
    return robot.ir, start
