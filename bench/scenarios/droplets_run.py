"""Twenty Droplets on a table as a run without ROS: drivers' sessions at their consoles, in one thread.

The bytes are those of the cable, without delay. So runs behave like live ones and are reproducible.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from bench.scenarios.lived_run import (
    ODOMETRY_DTYPE,
    ODOMETRY_LATENESS,
    LivedRun,
    arrival_ns,
    in_order_of_arrival,
)
from swarm_loc_drivers.common.odometry import OdometryState
from swarm_loc_drivers.common.robot_driver import Velocity, VelocityCommand
from swarm_loc_drivers.droplet.driver import DropletMover, DropletSession
from swarm_loc_drivers.droplet.exchange import Brightness, SessionSettings, TdmaSettings
from swarm_loc_drivers.droplet.hardware import DROPLET, ELEMENTS, FULL_POWER
from swarm_loc_drivers.droplet.odometry import CommandedMotion, MotionNoise
from swarm_loc_drivers.sim.droplet.firmware import DropletFirmware
from swarm_loc_drivers.sim.droplet.world import (
    DROPLET_WORLDS,
    NEAR_POWER,
    STEP_NS,
    DropletWorld,
    DropletWorldSettings,
    Fix,
    SimulatedDroplet,
    Tracker,
)
from swarm_loc_drivers.sim.link_host import ConsoleFirmware
from swarm_loc_drivers.sim.run import START_NS, Trajectories
from swarm_loc_drivers.sim.scenarios.droplets import Wander, starts
from swarm_loc_drivers.sim.scenarios.eight import rounded
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.ir_board import IrGains, RobotIr, load_ir_platform
from swarm_loc_estimator.swarm.new_swarm import DROPLET_ODOMETRY
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

_FIRST_ID = 0x1001


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
    start = starts(settings.seed, settings.robots)
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


_TIMEOUT_S = 1.0


STRIDE_S = 2.0


class Cable:
    """A robot connected by cable: its console and the driver's session, with its model of motion errors.

    `publish` is called with the matrices of exchanges.
    """

    def __init__(
        self,
        world: DropletWorld,
        robot: int,
        settings: SessionSettings,
        noise: MotionNoise,
        publish: Callable[[Brightness], None],
    ) -> None:
        self.counts: Counter[str] = Counter()  # Events of the session by name
        self._world = world
        # The firmware at the console
        self.firmware: ConsoleFirmware = DropletFirmware(SimulatedDroplet(world, robot))
        self._command = VelocityCommand(
            _TIMEOUT_S, lambda: world.now_ns, self.counts, lambda: 1e-9 * world.now_ns
        )
        self._motion = CommandedMotion(noise)
        mover = DropletMover(self._command, self._motion, STRIDE_S)
        self.session = DropletSession(settings, mover, (), publish, self.counts)  # The session of the driver

    def set_velocity(self, velocity: Velocity) -> None:
        """Command a velocity."""
        self._command.set(velocity)

    def odometry(self) -> OdometryState:
        """The session's odometry."""
        return self._motion.state(self._world.now_ns)

    def step(self) -> None:
        """Exchange bytes until neither end sends."""
        data = self.firmware.stream()
        while not self.session.ended:
            output = self.session.step(data, self._world.now_ns)
            if not output:
                return
            data = self.firmware.receive(output)
            if not data:
                return


def run(
    world: DropletWorld, robots: Sequence[Callable[[], object]], steps: int, control: Callable[[], None]
) -> None:
    """Advance a world by steps, with a function that steps each robot, such as `Cable.step`.

    `control` is called after every step, to set velocities and record data.
    """
    for _ in range(steps):
        world.step()
        for robot in robots:
            robot()
        control()
