"""A small swarm of Droplets that light their emitters in turn, and what the others read of it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.sensors.fix import FixRows
from swarm_loc_estimator.sensors.infrared import BrightnessRows
from swarm_loc_estimator.sensors.inputs import Batch
from swarm_loc_estimator.sensors.odometry import OdometryRows
from swarm_loc_estimator.swarm.error_models import OdometryModel
from swarm_loc_estimator.swarm.ir_board import IrGains, IrPlatform, PairGains, RobotIr, load_ir_platform
from swarm_loc_estimator.swarm.swarm import Robot, StartSigma, Swarm
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator
from swarm_loc_estimator.timeline.settings import Settings

SECOND = 10**9
T0 = 1_000 * SECOND
DROPLET = load_ir_platform("droplet")
REACH_M = 0.28
FIX_SIGMA = np.array([0.002, 0.002, 0.02])
WALK = OdometryModel(
    wheel_noise=0.0,
    distance_noise=2e-4,
    lateral_noise=2e-4,
    turn_noise=0.02,
    turn_drift=3e-4,
    max_speed=0.05,
    speed_change=0.002,
    turn_rate_change=0.02,
)
"""Of a robot that walks as it is told to, more or less."""


@dataclass(frozen=True)
class Light:
    """What a robot read of another's emitters: (n, n) [count], at one power."""

    robot: int
    stamp_ns: int
    transmitter: int
    power: int
    readings: FloatArray


@dataclass(frozen=True)
class Move:
    """The pose (3,) that a robot's odometry reports."""

    robot: int
    stamp_ns: int
    pose: FloatArray


@dataclass(frozen=True)
class Place:
    """The pose (3,) of a robot that was measured from outside."""

    robot: int
    stamp_ns: int
    pose: FloatArray


Event = Light | Move | Place


@dataclass(frozen=True)
class Plan:
    """What happens."""

    columns: int = 3  # Robots stand in a square of so many by so many
    pitch: float = 0.09  # Between them [m]
    seconds: float = 24.0  # How long
    fixed: Sequence[int] = ()  # Robots that get an absolute fix once a second
    known: Sequence[int] = ()  # Robots whose start is known
    walking: bool = False  # Whether they walk, now in one of six directions, now turning; the others stand
    noise: float = 1.0  # Scale of the sensors' noise
    differ: float = 0.0  # By how much elements differ, unknown to all


@dataclass
class Run:
    """What has happened: the swarm, its messages by stamp, and the true poses (N, 3) at each stamp."""

    swarm: Swarm
    events: list[Event] = field(default_factory=list)
    truth: dict[int, FloatArray] = field(default_factory=dict)


def simulate(plan: Plan, seed: int) -> Run:
    """Droplets that exchange light in turn."""
    rng = np.random.default_rng(seed)
    n = plan.columns**2
    places = plan.pitch * np.array([divmod(k, plan.columns) for k in range(n)], dtype=float)
    poses = np.column_stack([places + 0.008 * rng.standard_normal((n, 2)), rng.uniform(-3.1, 3.1, n)])
    run = Run(Swarm(tuple(_robot(rng, plan, k, poses[k]) for k in range(n))))
    gains = np.exp(plan.differ * np.random.default_rng([seed, n]).standard_normal((2, n, DROPLET.n)))
    odometry, ways = np.zeros((n, 3)), np.zeros((n, 3))
    for step in range(round(plan.seconds * 10)):
        stamp_ns = T0 + (step + 1) * SECOND // 10
        if plan.walking:
            ways = _ways(rng, n) if step % 50 == 0 else ways
            odometry, poses = se2.compose(odometry, ways), se2.compose(poses, _walked(rng, ways))
            if step % 2 == 0:
                run.events += [Move(k, stamp_ns, odometry[k]) for k in range(n)]
        run.truth[stamp_ns] = poses
        if step % 4 == 3:
            run.events += exchange(rng, poses, step // 4 % n, stamp_ns, noise=plan.noise, gains=gains)
        if step % 10 == 9:
            run.events += [
                Place(k, stamp_ns, poses[k] + FIX_SIGMA * rng.standard_normal(3)) for k in plan.fixed
            ]
    return run


def _robot(rng: np.random.Generator, plan: Plan, number: int, pose: FloatArray) -> Robot:
    sigma = StartSigma(0.001, 0.001, 0.01)
    x, y, theta = pose + np.array([sigma.x, sigma.y, sigma.theta]) * rng.standard_normal(3)
    return Robot(
        f"droplet{number}",
        odometry=WALK if plan.walking else OdometryModel(),
        camera=None,
        start=(float(x), float(y), float(theta)) if number in plan.known else None,
        start_sigma=sigma,
        stands=not plan.walking,
        ir=RobotIr(number + 1, DROPLET, "droplet", gains=None if plan.differ else calibrated(DROPLET)),
    )


def calibrated(platform: IrPlatform) -> IrGains:
    """Of elements that are exactly alike."""
    return replace(IrGains.unknown(platform), sigma=0.0)


def _ways(rng: np.random.Generator, n: int) -> FloatArray:
    """What robots (n,) are told to do in a tenth of a second: (n, 3)."""
    angle, turns = math.pi / 3.0 * rng.integers(6, size=n), rng.uniform(size=n) < 0.3
    ways = 4e-4 * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])
    ways[turns] = [0.0, 0.0, 0.008]
    return ways


def _walked(rng: np.random.Generator, ways: FloatArray) -> FloatArray:
    """What they do instead: noise along and across the way, and in heading, as in `WALK`."""
    path, course = np.hypot(ways[:, 0], ways[:, 1]), np.arctan2(ways[:, 1], ways[:, 0])
    along, across, turn = rng.standard_normal((3, len(ways)))
    along, across = np.sqrt(WALK.distance_noise * path) * along, np.sqrt(WALK.lateral_noise * path) * across
    turn *= np.sqrt(WALK.turn_noise * np.abs(ways[:, 2]) + 0.1 * WALK.turn_drift)
    cos, sin = np.cos(course), np.sin(course)
    walked: FloatArray = ways + np.column_stack(
        [cos * along - sin * across, sin * along + cos * across, turn]
    )
    return walked


def exchange(
    rng: np.random.Generator,
    poses: FloatArray,
    transmitter: int,
    stamp_ns: int,
    platform: IrPlatform = DROPLET,
    noise: float = 1.0,
    gains: FloatArray | None = None,
) -> list[Light]:
    """What all robots in reach read of one that lights its emitters, at each power; gains (2, N, n)."""
    seen = se2.between(poses, poses[transmitter])
    away = np.hypot(seen[:, 0], seen[:, 1])
    relative = np.column_stack([away, np.arctan2(seen[:, 1], seen[:, 0]), seen[:, 2]])
    near = [int(k) for k in np.flatnonzero(away < REACH_M) if k != transmitter]
    pairs = None
    if gains is not None:
        emitters = np.broadcast_to(gains[1, transmitter], (len(near), platform.n))
        pairs = PairGains(gains[0, near], emitters, np.zeros((len(near), 4)))
    bright = platform.dark_level + expected_brightness(platform, relative[near], pairs)
    read = np.rint(bright + noise * platform.noise * rng.standard_normal(bright.shape))
    read = np.minimum(read, platform.saturation)
    return [
        Light(robot, stamp_ns, transmitter, power, read[k, power])
        for k, robot in enumerate(near)
        for power in range(read.shape[1])
    ]


def messages(events: Sequence[Event], arrivals_ns: Sequence[int]) -> Batch:
    """Events as messages that arrived at some instants, not decreasing."""
    pairs = list(zip(events, arrivals_ns, strict=True))
    moves = [(e, at) for e, at in pairs if isinstance(e, Move)]
    places = [(e, at) for e, at in pairs if isinstance(e, Place)]
    return Batch.of(
        arrivals_ns[0],
        arrivals_ns[-1],
        odometry=OdometryRows.without_twist(
            column([e.robot for e, _ in moves]),
            column([e.stamp_ns for e, _ in moves]),
            np.array([e.pose for e, _ in moves]).reshape(-1, 3),
            column([at for _, at in moves]),
        ),
        brightness=brightness_rows([(e, at) for e, at in pairs if isinstance(e, Light)]),
        fixes=FixRows(
            column([e.robot for e, _ in places]),
            column([e.stamp_ns for e, _ in places]),
            np.array([e.pose for e, _ in places]).reshape(-1, 3),
            np.tile(np.diag(FIX_SIGMA**2), (len(places), 1, 1)),
            column([at for _, at in places]),
        ),
    )


def column(values: Sequence[int]) -> IntArray:
    return np.array(values, dtype=np.int64)


def brightness_rows(arrived: Sequence[tuple[Light, int]]) -> BrightnessRows:
    """Exchanges, with when they arrived, as columns."""
    lights = [light for light, _ in arrived]
    readings = np.empty(len(lights), dtype=object)
    for k, light in enumerate(lights):
        readings[k] = light.readings.astype(np.int32).ravel()
    return BrightnessRows(
        robot=column([light.robot for light in lights]),
        stamp_ns=column([light.stamp_ns for light in lights]),
        receiver=column([light.robot + 1 for light in lights]),
        transmitter=column([light.transmitter + 1 for light in lights]),
        n=column([len(light.readings) for light in lights]),
        power=column([light.power for light in lights]),
        saturation=column([0] * len(lights)),
        readings=readings,
        arrival_ns=column([at for _, at in arrived]),
    )


def play(
    run: Run,
    arrivals: Sequence[tuple[int, Event]] | None = None,
    settings: Settings | None = None,
    period_s: float = 0.5,
) -> tuple[Estimator, list[Estimate]]:
    """Let messages arrive, by default each at its stamp, and tick now and then."""
    estimator = Estimator(run.swarm, settings)
    waiting = sorted(arrivals or [(event.stamp_ns, event) for event in run.events], key=lambda pair: pair[0])
    period_ns, estimates, begin = round(period_s * SECOND), list[Estimate](), 0
    for now_ns in range(T0 + period_ns, waiting[-1][0] + 2 * period_ns, period_ns):
        end = begin
        while end < len(waiting) and waiting[end][0] <= now_ns:
            end += 1
        if end > begin:
            part = waiting[begin:end]
            estimator.receive(messages([event for _, event in part], [at for at, _ in part]))
        begin = end
        estimates.append(estimator.tick(now_ns))
    return estimator, estimates
