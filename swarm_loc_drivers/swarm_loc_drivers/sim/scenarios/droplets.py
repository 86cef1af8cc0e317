"""A swarm of Droplets on a table that take turns to emit, half of them wandering.

Robots, consoles and conversations are those of the live graph (see `droplet/world.py`). A tracker above
the table sees two robots, all others are to be located by infrared alone.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from swarm_loc_drivers.droplet.exchange import Brightness, SessionSettings, TdmaSettings
from swarm_loc_drivers.droplet.hardware import DROPLET, ELEMENTS, FULL_POWER
from swarm_loc_drivers.droplet.odometry import MotionNoise
from swarm_loc_drivers.sim.droplet.world import (
    DROPLET_WORLDS,
    NEAR_POWER,
    STEP_NS,
    Cable,
    DropletWorld,
    DropletWorldSettings,
    Fix,
    Tracker,
    run,
)
from swarm_loc_drivers.sim.run import (
    ODOMETRY_DTYPE,
    ODOMETRY_LATENESS,
    START_NS,
    LivedRun,
    Trajectories,
    arrival_ns,
    in_order_of_arrival,
)
from swarm_loc_drivers.sim.scenarios.eight import rounded
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.ir_board import IrGains, RobotIr, load_ir_platform
from swarm_loc_estimator.swarm.new_swarm import DROPLET_ODOMETRY
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

PITCH = 0.13
_JITTER = 0.02
_FIRST_ID = 0x1001
_WANDER_RADIUS = 0.03
_ARRIVED, _TURNED = 0.004, 0.1
_PATIENCE_NS = 30_000_000_000
_FAST, _FAST_TURN = 0.02, 0.5  # Faster than any Droplet: the direction counts


@dataclass(frozen=True)
class DropletRunSettings:
    """Settings of a run."""

    seed: int = 1  # Two runs with the same settings are identical
    duration_s: float = 90.0  # [s]
    robots: int = 20  # How many, on a grid of which no row is much longer than a column
    world: str = "d1"  # Their errors, of `DROPLET_WORLDS`
    calibrated: bool = False  # Whether the description has the gains of the elements, to 2 %
    start_known: bool = False  # Whether it has the start poses
    boards: int | None = None  # Seed of the gains of the elements; None: that of the run


def starts(settings: DropletRunSettings) -> FloatArray:
    """(N, 3) where the robots begin: near the places of a grid, looking anywhere."""
    rng = np.random.default_rng([settings.seed, settings.robots])
    columns = math.ceil(math.sqrt(1.25 * settings.robots))
    places = np.stack(np.divmod(np.arange(settings.robots), columns), axis=-1)[:, ::-1] * PITCH
    places = places - places.mean(axis=0) + rng.uniform(-_JITTER, _JITTER, places.shape)
    headings = rng.uniform(-math.pi, math.pi, settings.robots)
    return np.array([rounded(pose) for pose in np.column_stack([places, headings])])


def describe_droplets(
    settings: DropletRunSettings, start: FloatArray, gains: Sequence[IrGains] = ()
) -> Swarm:
    """The swarm description of robots that begin at poses (N, 3) in map.

    Gains are what is known of each robot's elements; empty: nothing.
    """
    platform = load_ir_platform("droplet")
    return Swarm(
        tuple(
            Robot(
                name=f"droplet{index + 1}",
                type="droplet",
                odometry=DROPLET_ODOMETRY,
                camera=None,
                start=rounded(pose) if settings.start_known else None,
                ir=RobotIr(_FIRST_ID + index, platform, "droplet", gains=gains[index] if gains else None),
            )
            for index, pose in enumerate(start)
        )
    )


class Wander:
    """Steers each robot to places around its home (N, 3) in map, one after the other, with turns in between.

    Only those that are `walking` (N,) wander; the others stand. The seed fixes the places.
    """

    def __init__(self, homes: FloatArray, walking: FloatArray, seed: int) -> None:
        self._homes, self._walking, self._seed = homes, walking, seed
        self._leg = np.full(len(homes), -1)
        self._since_ns = np.zeros(len(homes), dtype=np.int64)

    def command(self, robot: int, stamp_ns: int, pose: FloatArray) -> tuple[float, float, float]:
        """The velocity of a robot: forward [m/s], to the left [m/s], turning to the left [rad/s].

        At `stamp_ns` it was at the pose (3,) in map.
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


TURN_S = 0.9
FIXED = (0, -1)  # The robots in two opposite corners
FIX_SIGMA, FIX_HEADING_SIGMA = 0.003, 0.02
FIX_RATE_HZ = 1.0
ODOMETRY_NS, CONTROL_NS = 200_000_000, 100_000_000
NOISE = MotionNoise(walk_noise=5e-4, veer_noise=0.05, turn_noise=0.01)
_GAINS_SIGMA = 0.02
_GAINS, _LATENESS = range(2)


@dataclass(frozen=True)
class PublishedBrightness:
    """A brightness matrix as it was published."""

    receiver: int  # Index of the robot
    published_ns: int  # When
    brightness: Brightness  # What


@dataclass(frozen=True)
class DropletRun(LivedRun):
    """A simulated swarm with infrared boards from start to end."""

    matrices: tuple[PublishedBrightness, ...]  # In order of publication
    fixes: tuple[Fix, ...]  # In order of their stamps
    counts: Counter[str]  # Events of all sessions together


@dataclass
class _Recorder:
    """What is recorded of a run."""

    stamps: list[int] = field(default_factory=list)
    poses: list[FloatArray] = field(default_factory=list)
    odometry: list[tuple[int, int, int, FloatArray]] = field(default_factory=list)
    matrices: list[PublishedBrightness] = field(default_factory=list)
    fixes: list[Fix] = field(default_factory=list)


def simulate_droplets(settings: DropletRunSettings) -> DropletRun:
    """Simulate and record a swarm of Droplets."""
    start = starts(settings)
    errors = DROPLET_WORLDS[settings.world]
    world_settings = DropletWorldSettings(
        settings.seed, errors, load_ir_platform("droplet"), START_NS, settings.boards
    )
    plain = describe_droplets(settings, start)
    ids = [robot.ir.id for robot in plain.robots if robot.ir is not None]
    world = DropletWorld(ids, start, world_settings)
    recorder = _Recorder()
    cables = [_cable(world, robot, settings, recorder) for robot in range(settings.robots)]
    _live(world, cables, settings, recorder)
    odometry = np.array(recorder.odometry, dtype=ODOMETRY_DTYPE)
    rng = np.random.default_rng([settings.seed, _LATENESS])
    odometry["arrival_ns"] = arrival_ns(rng, odometry["stamp_ns"], ODOMETRY_LATENESS)
    return DropletRun(
        describe_droplets(settings, start, _gains(world, settings)),
        Trajectories(np.array(recorder.stamps, dtype=np.int64), np.array(recorder.poses)),
        in_order_of_arrival(odometry, recorder.stamps[-1]),
        tuple(recorder.matrices),
        tuple(recorder.fixes),
        sum((cable.counts for cable in cables), Counter()),
    )


def _cable(world: DropletWorld, robot: int, settings: DropletRunSettings, recorder: _Recorder) -> Cable:
    """A robot at a cable, with the session of its driver."""
    turns = TdmaSettings(robot, settings.robots, TURN_S, (FULL_POWER, NEAR_POWER), ())
    session = SessionSettings(DROPLET, ELEMENTS, reply_timeout_s=0.3, exchanges=turns)

    def publish(one: Brightness) -> None:
        recorder.matrices.append(PublishedBrightness(robot, world.now_ns, one))

    return Cable(world, robot, session, NOISE, publish)


def _live(
    world: DropletWorld, cables: list[Cable], settings: DropletRunSettings, recorder: _Recorder
) -> None:
    """Step the world; every other robot wanders."""
    robots = len(cables)
    wander = Wander(world.poses.copy(), np.arange(robots) % 2 == 1, settings.seed)
    fixed = tuple(sorted({robot % robots for robot in FIXED}))
    tracker = Tracker(fixed, FIX_RATE_HZ, FIX_SIGMA, FIX_HEADING_SIGMA, settings.seed)

    def control() -> None:
        now_ns = world.now_ns
        recorder.fixes += tracker.look(now_ns, world.poses)
        if now_ns % CONTROL_NS == 0:
            recorder.stamps.append(now_ns)
            recorder.poses.append(world.poses)
            for robot, cable in enumerate(cables):
                cable.set_velocity(wander.command(robot, now_ns, world.poses[robot]))
        if now_ns % ODOMETRY_NS == 0:
            for robot, cable in enumerate(cables):
                state = cable.odometry()
                recorder.odometry.append((robot, state.stamp_ns, 0, state.pose))

    control()
    run(world, [cable.step for cable in cables], round(settings.duration_s * 1e9) // STEP_NS, control)


def _gains(world: DropletWorld, settings: DropletRunSettings) -> tuple[IrGains, ...]:
    """The gains found by a calibration; empty without one."""
    if not settings.calibrated:
        return ()
    rng = np.random.default_rng([settings.seed, _GAINS])
    found = world.gains * np.exp(_GAINS_SIGMA * rng.standard_normal(world.gains.shape))
    rounded = np.round(found, 4)
    return tuple(
        IrGains(tuple(rounded[0, robot].tolist()), tuple(rounded[1, robot].tolist()), sigma=_GAINS_SIGMA)
        for robot in range(settings.robots)
    )
