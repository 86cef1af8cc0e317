"""A swarm of Droplets that take turns to emit, half of them wandering, recorded as their drivers publish it.

Robots, consoles and conversations are those of the live graph (see `droplet_lockstep`). A tracker above the
table sees two robots, all others are to be located by infrared alone.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from swarm_loc_drivers.droplet.commanded_motion import MotionNoise
from swarm_loc_drivers.droplet.exchange import Brightness
from swarm_loc_drivers.droplet.hardware import DROPLET, ELEMENTS, FULL_POWER
from swarm_loc_drivers.droplet.session import SessionSettings
from swarm_loc_drivers.droplet.tdma import TdmaSettings
from swarm_loc_drivers.sim.common.record import ODOMETRY_DTYPE, LivedRun, in_order_of_arrival
from swarm_loc_drivers.sim.common.trajectories import Trajectories
from swarm_loc_drivers.sim.common.transport import ODOMETRY_LATENESS, arrival_ns
from swarm_loc_drivers.sim.droplet.fixes import Fix, Tracker
from swarm_loc_drivers.sim.droplet.lockstep import Cable, run
from swarm_loc_drivers.sim.droplet.world import (
    DROPLET_WORLDS,
    NEAR_POWER,
    STEP_NS,
    DropletWorld,
    DropletWorldSettings,
)
from swarm_loc_drivers.sim.scenarios.droplet_table import (
    DropletSwarmSettings,
    Wander,
    describe_droplets,
    starts,
)
from swarm_loc_drivers.sim.scenarios.eight import START_NS
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.board_file import load_ir_platform
from swarm_loc_estimator.swarm.ir_board import IrGains

TURN_S = 0.9
FIXED = (0, -1)
"""The robots in two opposite corners."""
FIX_SIGMAS = (0.003, 0.02)
FIX_RATE_HZ = 1.0
ODOMETRY_NS, CONTROL_NS = 200_000_000, 100_000_000
NOISE = MotionNoise(walk_noise=5e-4, veer_noise=0.05, turn_noise=0.01)
_GAINS_SIGMA = 0.02
_GAINS, _LATENESS = range(2)


@dataclass(frozen=True)
class DropletRunSettings:
    """What to simulate.

    Attributes:
        seed: Two runs with the same settings are identical.
        duration_s: [s].
        robots: How many.
        world: How they err, of `DROPLET_WORLDS`.
        calibrated: Whether the description tells the gains of the elements, to 2 %.
        start_known: Whether it tells where robots begin.
        boards: Runs with the same one have the same elements; None: as the seed says.
    """

    seed: int = 1
    duration_s: float = 90.0
    robots: int = 20
    world: str = "d1"
    calibrated: bool = False
    start_known: bool = False
    boards: int | None = None


@dataclass(frozen=True)
class Measured:
    """A brightness matrix as it was published.

    Attributes:
        receiver: Index of the robot.
        published_ns: When.
        brightness: What.
    """

    receiver: int
    published_ns: int
    brightness: Brightness


@dataclass(frozen=True)
class DropletRun(LivedRun):
    """A simulated swarm with infrared boards from start to end.

    Attributes:
        matrices: In order of publication.
        fixes: In order of their stamps.
        counts: What happened in all conversations together.
    """

    matrices: tuple[Measured, ...]
    fixes: tuple[Fix, ...]
    counts: Counter[str]


@dataclass
class _Recorder:
    """Keeps what happens."""

    stamps: list[int] = field(default_factory=list)
    poses: list[FloatArray] = field(default_factory=list)
    odometry: list[tuple[int, int, int, FloatArray]] = field(default_factory=list)
    matrices: list[Measured] = field(default_factory=list)
    fixes: list[Fix] = field(default_factory=list)


def simulate_droplets(settings: DropletRunSettings) -> DropletRun:
    """Let the swarm live and record it."""
    platform = load_ir_platform("droplet")
    layout = DropletSwarmSettings(settings.seed, settings.robots, settings.start_known)
    start = starts(layout)
    errors = DROPLET_WORLDS[settings.world]
    world_settings = DropletWorldSettings(settings.seed, errors, platform, START_NS, settings.boards)
    plain = describe_droplets(layout, start, platform, (None,) * settings.robots)
    ids = [robot.ir.id for robot in plain.robots if robot.ir is not None]
    world = DropletWorld(ids, start, world_settings)
    recorder = _Recorder()
    cables = [_cable(world, robot, settings, recorder) for robot in range(settings.robots)]
    _live(world, cables, settings, recorder)
    odometry = np.array(recorder.odometry, dtype=ODOMETRY_DTYPE)
    rng = np.random.default_rng([settings.seed, _LATENESS])
    odometry["arrival_ns"] = arrival_ns(rng, odometry["stamp_ns"], ODOMETRY_LATENESS)
    return DropletRun(
        describe_droplets(layout, start, platform, _gains(world, settings)),
        Trajectories(np.array(recorder.stamps, dtype=np.int64), np.array(recorder.poses)),
        in_order_of_arrival(odometry, recorder.stamps[-1]),
        tuple(recorder.matrices),
        tuple(recorder.fixes),
        sum((cable.counts for cable in cables), Counter()),
    )


def _cable(world: DropletWorld, robot: int, settings: DropletRunSettings, recorder: _Recorder) -> Cable:
    """A robot with its conversation, as a driver has it."""
    turns = TdmaSettings(robot, settings.robots, TURN_S, (FULL_POWER, NEAR_POWER), ())
    session = SessionSettings(DROPLET, ELEMENTS, reply_timeout_s=0.3, exchanges=turns)

    def publish(one: Brightness) -> None:
        recorder.matrices.append(Measured(robot, world.now_ns, one))

    return Cable(world, robot, session, NOISE, publish)


def _live(
    world: DropletWorld, cables: list[Cable], settings: DropletRunSettings, recorder: _Recorder
) -> None:
    """Let time pass; every other robot wanders."""
    robots = len(cables)
    wander = Wander(world.poses.copy(), np.arange(robots) % 2 == 1, settings.seed)
    fixed = tuple(sorted({robot % robots for robot in FIXED}))
    tracker = Tracker(fixed, FIX_RATE_HZ, FIX_SIGMAS, settings.seed)

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
    run(world, cables, round(settings.duration_s * 1e9) // STEP_NS, control)


def _gains(world: DropletWorld, settings: DropletRunSettings) -> tuple[IrGains | None, ...]:
    """What a calibration has found, if there was one."""
    if not settings.calibrated:
        return (None,) * settings.robots
    rng = np.random.default_rng([settings.seed, _GAINS])
    found = world.gains * np.exp(_GAINS_SIGMA * rng.standard_normal(world.gains.shape))
    rounded = np.round(found, 4)
    return tuple(
        IrGains(tuple(rounded[0, robot].tolist()), tuple(rounded[1, robot].tolist()), sigma=_GAINS_SIGMA)
        for robot in range(settings.robots)
    )
