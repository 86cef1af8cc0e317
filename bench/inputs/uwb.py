"""UWB: errors with ranges to anchors or between robots, compared with their posterior Cramer-Rao bound."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bench.scenarios.lived_run import CAMERA_LATENESS, ODOMETRY_DTYPE, LivedRun, arrival_ns
from bench.shared.common import ProgressLine, plot_curves
from bench.shared.simulated_run import mean_nees
from swarm_loc_drivers.sim.run import START_NS, Trajectories
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.messages.cdr import RANGES, encode
from swarm_loc_estimator.common.messages.poses import encode_odometry
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.filter.measurements import concatenate, select
from swarm_loc_estimator.offline.metrics import is_misleading
from swarm_loc_estimator.sensors.inputs import Ingest
from swarm_loc_estimator.sensors.ranges import RangeRows
from swarm_loc_estimator.sensors.sensor import in_order_of_arrival
from swarm_loc_estimator.swarm.error_models import OdometryModel
from swarm_loc_estimator.swarm.swarm import Anchor, Robot, StartSigma, Swarm, UwbDevice
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator, Status

STEP_NS = 50_000_000
TICK_STEPS = 2
_SPEED, _TURN_RATE, _ARENA_M = 0.3, 1.0, 3.0
_ANCHORS = ((-4.0, -4.0, 2.0), (4.0, -4.0, 2.4), (4.0, 4.0, 2.0), (-4.0, 4.0, 2.4))
_ANTENNA_Z = 0.3
_ODOMETRY = OdometryModel(wheel_separation=0.15, wheel_noise=2e-5)
_START_SIGMA = StartSigma(0.05, 0.05, 0.05)
_NLOS_M, _NLOS_S = (0.3, 2.0), (1.0, 4.0)
_FIRST_ANCHOR = 100


@dataclass(frozen=True)
class Plan:
    """What to simulate."""

    robots: int = 3  # N
    anchors: int = 4  # Number of anchors
    duration_s: float = 60.0  # [s]
    between_robots: bool = False  # Whether robots measure each other, too
    known_starts: int = 99  # Number of robots with a start, the first ones
    nlos: float = 0.0  # Share of ranges that are too long, for seconds per link
    sigma: float = 0.05  # Noise of a range [m]
    bias_sigma: float = 0.0  # Unknown biases of anchors; 0: they are calibrated [m]
    steps_per_range: int = 4  # Of one link: five ranges a second


class Ranges(NamedTuple):
    """Ranges (k,) in order of their stamps."""

    step: IntArray  # (k,) number of the step of the truth at which it was measured
    robot: IntArray  # (k,) who measured
    device: IntArray  # (k,) the other robot, or N plus the index of the anchor
    range: FloatArray  # (k,) [m]
    arrival_ns: IntArray  # (k,)


@dataclass(frozen=True)
class UwbWorld:
    """A simulated run."""

    plan: Plan  # What was simulated
    swarm: Swarm  # Its description
    truth: FloatArray  # (T, N, 3) at every step
    odometry: FloatArray  # (T, N, 3) as reported
    ranges: Ranges  # All ranges

    @property
    def tick_steps(self) -> IntArray:
        """Steps (K,) at which the estimator ticks."""
        return np.arange(TICK_STEPS, len(self.truth), TICK_STEPS)

    @property
    def antenna_z(self) -> float:
        """Height of the robots' antennas [m]."""
        return _ANTENNA_Z

    @property
    def addresses(self) -> list[int]:
        """Addresses of all devices, of robots and then of anchors."""
        radios = [robot.uwb.address for robot in self.swarm.robots if robot.uwb]
        return radios + [anchor.address for anchor in self.swarm.anchors]

    def lived(self) -> LivedRun:
        """Truth and odometry of the run, which arrives at its stamps."""
        stamp_ns = START_NS + STEP_NS * np.arange(len(self.truth))
        odometry = np.zeros(self.odometry.shape[:2], ODOMETRY_DTYPE)
        odometry["robot"], odometry["pose"] = np.arange(self.plan.robots), self.odometry
        odometry["stamp_ns"] = odometry["arrival_ns"] = stamp_ns[:, None]
        return LivedRun(self.swarm, Trajectories(stamp_ns, self.truth), odometry.reshape(-1))

    def range_rows(self) -> RangeRows:
        """The ranges in order of arrival."""
        step, robot, device, distance, arrivals_ns = self.ranges
        address = np.array(self.addresses, dtype=np.uint64)[device]
        stamps_ns, zero = START_NS + STEP_NS * step, np.zeros_like(distance)
        rows = RangeRows(robot, stamps_ns, address, zero.astype(np.uint64), distance, zero, arrivals_ns)
        return in_order_of_arrival([rows])

    def anchor_places(self) -> FloatArray:
        """Antennas (A, 3) of the anchors."""
        return np.array([(one.x, one.y, one.z) for one in self.swarm.anchors]).reshape(-1, 3)


def simulate(plan: Plan, seed: int) -> UwbWorld:
    """Robots that drive arcs within a square, the anchors in its corners."""
    # drive: wheels slip in truth, and odometry does not know
    rng = np.random.default_rng(seed)
    steps, n = round(plan.duration_s * 1e9 / STEP_NS), plan.robots
    truth, odometry = np.zeros((2, steps + 1, n, 3))
    truth[0, :, :2] = rng.uniform(-0.6, 0.6, (n, 2)) * _ARENA_M
    truth[0, :, 2] = rng.uniform(-math.pi, math.pi, n)
    odometry[0] = rng.uniform(-1.0, 1.0, (n, 3))
    rate = np.zeros(n)
    for k in range(steps):
        if k % 30 == 0:
            rate = rng.uniform(-_TURN_RATE, _TURN_RATE, n)
        path, turn = _commanded(truth[k], rate)
        half = 0.5 * turn * _ODOMETRY.wheel_separation
        wheels = np.abs([path + half, path - half])
        slip = np.sqrt(_ODOMETRY.wheel_noise * wheels) * rng.standard_normal((2, n))
        odometry[k + 1] = _arc(odometry[k], path, turn)
        slipped = turn + (slip[0] - slip[1]) / _ODOMETRY.wheel_separation
        truth[k + 1] = _arc(truth[k], path + slip.mean(axis=0), slipped)
    # the description, with uncertain starts
    sigma = np.array([_START_SIGMA.x, _START_SIGMA.y, _START_SIGMA.theta])
    start = truth[0] + sigma * rng.standard_normal((n, 3))
    swarm = Swarm(
        tuple(
            Robot(
                f"robot_{k}",
                odometry=_ODOMETRY,
                camera=None,
                start=(float(x), float(y), float(theta)) if k < plan.known_starts else None,
                start_sigma=_START_SIGMA,
                uwb=UwbDevice(k + 1, z=_ANTENNA_Z, range_sigma=plan.sigma),
            )
            for k, (x, y, theta) in enumerate(start)
        ),
        anchors=tuple(
            Anchor(_FIRST_ANCHOR + k, *_ANCHORS[k], range_bias_sigma=plan.bias_sigma)
            for k in range(plan.anchors)
        ),
    )
    world = UwbWorld(plan, swarm, truth, odometry, Ranges(*np.zeros((5, 0))))
    return UwbWorld(plan, swarm, truth, odometry, _measured(world, rng))


def _commanded(pose: FloatArray, rate: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Path and turn (N,) of a step: arcs at random rates, and back to the middle from outside."""
    away = se2.wrap_angle(np.arctan2(-pose[:, 1], -pose[:, 0]) - pose[:, 2])
    out = np.abs(pose[:, :2]).max(axis=1) > 0.8 * _ARENA_M
    rate = np.where(out, np.clip(2.0 * away, -1.5, 1.5), rate)
    return np.full(len(pose), _SPEED * STEP_NS * 1e-9), rate * STEP_NS * 1e-9


def _arc(pose: FloatArray, path: FloatArray, turn: FloatArray) -> FloatArray:
    """Poses (N, 3) after arcs."""
    return se2.compose(pose, se2.exp(np.stack([path, np.zeros_like(path), turn], axis=1)))


def antenna(world: UwbWorld, steps: IntArray | int, device: int) -> FloatArray:
    """True places (..., 3) of a robot's antenna at steps (...), or of an anchor (3,) as N plus its index."""
    if device >= world.plan.robots:
        place: FloatArray = world.anchor_places()[device - world.plan.robots]
        return place
    return np.insert(world.truth[steps, device, :2], 2, _ANTENNA_Z, axis=-1)


def _measured(world: UwbWorld, rng: np.random.Generator) -> Ranges:
    """Each link as often as planned, one after the other."""
    plan, n = world.plan, world.plan.robots
    links = [(robot, n + k) for robot in range(n) for k in range(plan.anchors)]
    if plan.between_robots:
        links += [(robot, other) for robot in range(n) for other in range(robot)]
    bias, parts = np.zeros(n + plan.anchors), []
    if plan.bias_sigma:
        bias[n:] = plan.bias_sigma * rng.standard_normal(plan.anchors)
    for number, (robot, device) in enumerate(links):
        steps = np.arange(1 + number % plan.steps_per_range, len(world.truth), plan.steps_per_range)
        distance = np.linalg.norm(antenna(world, steps, device) - antenna(world, steps, robot), axis=1)
        distance += bias[device] + _nlos(plan, steps.size, rng) + plan.sigma * rng.standard_normal(steps.size)
        arrivals_ns = arrival_ns(rng, START_NS + steps * STEP_NS, CAMERA_LATENESS)
        parts.append(
            Ranges(steps, np.full_like(steps, robot), np.full_like(steps, device), distance, arrivals_ns)
        )
    ranges = concatenate(parts)
    return select(ranges, np.lexsort((ranges.device, ranges.robot, ranges.step)))


def _nlos(plan: Plan, count: int, rng: np.random.Generator) -> FloatArray:
    """How much too long the ranges (count,) of a link are: in bursts, one error each."""
    bias, step_s = np.zeros(count), plan.steps_per_range * STEP_NS * 1e-9
    while np.mean(bias > 0.0) < plan.nlos:
        begin = int(rng.integers(count))
        bias[begin : begin + round(rng.uniform(*_NLOS_S) / step_s)] = rng.uniform(*_NLOS_M)
    return bias


def messages(world: UwbWorld, ingest: Ingest) -> list[SerializedMessage]:
    """All messages in order of arrival; odometry arrives at its stamp."""
    out, unknown = [], np.zeros((6, 6))
    stamps = START_NS + STEP_NS * np.arange(len(world.truth))
    for k, robot in enumerate(world.swarm.robots):
        twist = np.full((len(stamps), 3), np.nan)
        data = encode_odometry("odom", "base", stamps, world.odometry[:, k], twist, unknown, unknown)
        handle = ingest.handle_of[f"{robot.name}/odom"]
        out += [SerializedMessage(handle, *one) for one in zip(data, stamps.tolist(), strict=True)]
    addresses = world.addresses
    for step, robot, device, distance, arrived_ns in zip(*world.ranges, strict=True):
        header = {"stamp": int(START_NS + step * STEP_NS)}
        one = {"device": addresses[int(device)], "range": float(distance)}
        handle = ingest.handle_of[f"{world.swarm.robots[int(robot)].name}/ranges"]
        data_of = encode({"header": header, "ranges": [one]}, RANGES)
        out.append(SerializedMessage(handle, data_of, int(arrived_ns)))
    return sorted(out, key=lambda message: message[2])


class UwbResult(NamedTuple):
    """Estimates at the ticks."""

    error: FloatArray  # (K, N, 3) NaN where not located
    covariance: FloatArray  # (K, N, 3, 3)
    status: IntArray  # (K, N) of `Status`


def run(world: UwbWorld) -> UwbResult:
    """Give the bytes of all messages to the estimator, as a node does."""
    ingest, estimator = Ingest(world.swarm), Estimator(world.swarm)
    waiting, begin = messages(world, ingest), 0
    estimates: list[Estimate] = []
    for step in world.tick_steps.tolist():
        now_ns, end = START_NS + step * STEP_NS, begin
        while end < len(waiting) and waiting[end][2] <= now_ns:
            end += 1
        for batch in ingest.read(MessageBatch.of(waiting[begin:end])):
            estimator.receive(batch)
        begin = end
        estimates.append(estimator.tick(now_ns))
    error = np.array([one.poses for one in estimates]) - world.truth[world.tick_steps]
    error[..., 2] = se2.wrap_angle(error[..., 2])
    covariance = np.array([one.covariances for one in estimates])
    status = np.array([one.status for one in estimates])
    return UwbResult(error, covariance, status)


def _step_noise(world: UwbWorld, robot: int, step: int, course: float) -> FloatArray:
    """Covariance (3, 3) of x, y, heading of a step in a direction [rad]."""
    move = world.odometry[step + 1, robot] - world.odometry[step, robot]
    path = math.hypot(move[0], move[1])
    half = 0.5 * _ODOMETRY.wheel_separation * float(se2.wrap_angle(move[2]))
    wheels = np.diag(_ODOMETRY.wheel_noise * np.abs([path + half, path - half]))
    cos, sin = math.cos(course), math.sin(course)
    moved = np.array([[cos, -0.5 * path * sin], [sin, 0.5 * path * cos], [0.0, 1.0]])
    moved = moved @ [[0.5, 0.5], [1.0 / _ODOMETRY.wheel_separation, -1.0 / _ODOMETRY.wheel_separation]]
    covariance: FloatArray = moved @ wheels @ moved.T
    return covariance


class _Bound:
    """Covariance (3N, 3N) of x, y, heading of all robots along their true trajectories."""

    def __init__(self, world: UwbWorld) -> None:
        self._world = world
        sigma = [_START_SIGMA.x, _START_SIGMA.y, _START_SIGMA.theta]
        self.covariance = np.diag(np.tile(np.square(sigma), world.plan.robots))

    def copy(self) -> _Bound:
        """An independent copy."""
        other = _Bound(self._world)
        other.covariance = self.covariance.copy()
        return other

    def move(self, step: int) -> None:
        """Predict from a step to the next one."""
        count = self._world.plan.robots
        transition, noise = np.eye(3 * count), np.zeros((3 * count, 3 * count))
        for robot in range(count):
            (dx, dy) = self._world.truth[step + 1, robot, :2] - self._world.truth[step, robot, :2]
            own = slice(3 * robot, 3 * robot + 3)
            transition[own, own][:2, 2] = -dy, dx
            noise[own, own] = _step_noise(self._world, robot, step, math.atan2(dy, dx))
        self.covariance = transition @ self.covariance @ transition.T + noise

    def measure(self, step: int, robot: int, device: int) -> None:
        """Update with a range."""
        away = antenna(self._world, step, device) - antenna(self._world, step, robot)
        direction = away[:2] / np.linalg.norm(away)
        row = np.zeros(len(self.covariance))
        row[3 * robot : 3 * robot + 2] = -direction
        if device < self._world.plan.robots:
            row[3 * device : 3 * device + 2] = direction
        gain = self.covariance @ row
        self.covariance -= np.outer(gain, gain) / (row @ gain + self._world.plan.sigma**2)


def bounds(world: UwbWorld) -> FloatArray:
    """Variances (K, N) of x plus y at the ticks, of what has arrived by then: no estimator can do better."""
    ranges, out = world.ranges, []
    first = np.searchsorted(ranges.step, np.arange(len(world.truth) + 1))
    certain, at = _Bound(world), 0
    everything: BoolArray = np.ones(ranges.step.size, dtype=bool)
    for step in world.tick_steps.tolist():
        until = max(0, step - round(1e9 * CAMERA_LATENESS.high_s) // STEP_NS)
        _advance(certain, ranges, first, at, until, everything)
        at = until
        now = certain.copy()
        _advance(now, ranges, first, at, step, ranges.arrival_ns <= START_NS + step * STEP_NS)
        variance = np.diag(now.covariance).reshape(-1, 3)
        out.append(variance[:, 0] + variance[:, 1])
    return np.array(out)


def _advance(bound: _Bound, ranges: Ranges, first: IntArray, begin: int, end: int, used: BoolArray) -> None:
    """Predict from a step to another, with the ranges that are used."""
    for step in range(begin, end):
        bound.move(step)
        for k in range(int(first[step + 1]), int(first[step + 2])):
            if used[k]:
                bound.measure(step + 1, int(ranges.robot[k]), int(ranges.device[k]))


def rms(squared: Sequence[FloatArray]) -> float:
    """Root of the mean over all arrays."""
    return math.sqrt(float(np.mean(np.concatenate([one.reshape(-1) for one in squared]))))


_FOUR, _AMONG_ROBOTS = Plan(), Plan(robots=4, anchors=0, between_robots=True, duration_s=30.0)
_UNKNOWN_START, _NLOS = Plan(robots=4, known_starts=0, duration_s=20.0), Plan(nlos=0.2)
_BIASED = Plan(bias_sigma=0.2)
_SETTLED_TICKS = 20
_RIGHT_M = 0.2


class _Case(NamedTuple):
    """All runs of one plan."""

    worlds: list[UwbWorld]  # The runs
    results: list[UwbResult]  # Their estimates
    squared: list[FloatArray]  # (K, N) squared distances from the truth of each


def measure(seeds: Sequence[int], say: ProgressLine) -> dict[str, float]:
    """Figures of all cases; draws errors over time."""
    # simulate and run all cases
    cases = {}
    plans = {"anchors4": _FOUR, "robots_only": _AMONG_ROBOTS, "unknown_start": _UNKNOWN_START}
    for name, plan in {**plans, "nlos20": _NLOS, "biased": _BIASED}.items():
        worlds, results = [], []
        for seed in seeds:
            say(f"{name}, seed {seed}")
            worlds.append(simulate(plan, seed))
            results.append(run(worlds[-1]))
        squared = [np.square(result.error[..., :2]).sum(axis=-1) for result in results]
        cases[name] = _Case(worlds, results, squared)
    # errors compared with the bound
    figures: dict[str, float] = {}
    bound_of = {}
    for name in ("anchors4", "robots_only"):
        say(f"{name}: bound")
        bound_of[name] = [bounds(world) for world in cases[name].worlds]
        position, bound = rms(_settled(cases[name].squared)), rms(_settled(bound_of[name]))
        figures |= {f"uwb.{name}.position_cm": 100.0 * position, f"uwb.{name}.bound_cm": 100.0 * bound}
        figures[f"uwb.{name}.ratio_to_bound"] = position / bound
        figures[f"uwb.{name}.nees"] = _nees(cases[name].results)
    # located starts, and ranges through obstacles
    unknown, nlos = cases["unknown_start"], cases["nlos20"]
    right = [
        (result.status[-1] == Status.TRACKED) & (squared[-1] < _RIGHT_M**2)
        for result, squared in zip(unknown.results, unknown.squared, strict=True)
    ]
    figures["uwb.unknown_start.located"] = float(np.mean(right))
    figures["uwb.unknown_start.misleading_share"] = _misleading(unknown.results)
    figures["uwb.nlos20.misleading_share"] = _misleading(nlos.results)
    tracked = [result.status[_SETTLED_TICKS:] == Status.TRACKED for result in nlos.results]
    figures["uwb.nlos20.tracked_share"] = float(np.mean(tracked))
    whole = [squared[_SETTLED_TICKS:][one] for squared, one in zip(nlos.squared, tracked, strict=True)]
    figures["uwb.nlos20.position_cm"] = 100.0 * rms(whole)
    # anchors that nobody calibrated
    biased = cases["biased"]
    figures["uwb.biased.position_cm"] = 100.0 * rms(_settled(biased.squared))
    figures["uwb.biased.nees"] = _nees(biased.results)
    figures["uwb.biased.misleading_share"] = _misleading(biased.results)
    # errors over time, root mean square of all seeds and tracked robots
    plots = []
    for name, case in cases.items():
        is_tracked = np.array([result.status == Status.TRACKED for result in case.results])
        total = np.where(is_tracked, np.array(case.squared), 0.0).sum(axis=(0, 2))
        shown = {"tracked robots": 100.0 * np.sqrt(total / np.maximum(is_tracked.sum(axis=(0, 2)), 1))}
        if name in bound_of:
            shown["bound"] = 100.0 * np.sqrt(np.mean(bound_of[name], axis=(0, 2)))
        time_s = (1 + np.arange(len(total))) * TICK_STEPS * STEP_NS * 1e-9
        plots.append(("time [s]", f"position error [cm], {name}", time_s, shown))
    plot_curves("inputs-uwb", *plots)
    return figures


def _settled(arrays: Sequence[FloatArray]) -> list[FloatArray]:
    return [one[_SETTLED_TICKS:] for one in arrays]


def _nees(results: Sequence[UwbResult]) -> float:
    """Mean normalised error squared after the first seconds; 3 is ideal."""
    pairs = [(r.error[_SETTLED_TICKS:], r.covariance[_SETTLED_TICKS:]) for r in results]
    return float(np.mean([mean_nees(*pair) for pair in pairs]))


def _misleading(results: Sequence[UwbResult]) -> float:
    """Share of robot-seconds TRACKED with a position wrong by more than 5 sigma and 2 cm."""
    shares = []
    for result in results:
        wrong = result.status == Status.TRACKED
        wrong[wrong] = is_misleading(result.error[wrong], result.covariance[wrong])
        shares.append(wrong.mean())
    return float(np.mean(shares))
