"""Motion capture with drop-outs and delays, through the bridge and the estimator, compared with bounds.

The posterior Cramer-Rao bounds of a robot's position are those of Kalman filter and smoother linearized at
the true path: the filter uses at each tick the odometry and the fixes that have arrived by then, the
smoother those of the whole run.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from types import SimpleNamespace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bench.shared.common import ProgressLine, equal_parts, new_plot, save_plot
from bench.shared.simulated_run import estimates_of, inputs_between
from swarm_loc_drivers.sim.run import CAMERA_LATENESS, START_NS, arrival_ns
from swarm_loc_estimator import FixRows, OdometryRows, Robot, Swarm
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.health import Health
from swarm_loc_estimator.offline.metrics import nees
from swarm_loc_estimator.sensors.localizers import SOURCES, BridgeParameters, LocalizedRobots
from swarm_loc_estimator.sensors.sensor import in_order_of_arrival
from swarm_loc_estimator.swarm.error_models import OdometryModel

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray

ROBOTS = 5
DURATION_S = 60.0
SECOND_NS = 1_000_000_000
STEP_NS = SECOND_NS // 50  # Period of odometry
FIX_NS = SECOND_NS // 30
TICK_NS = SECOND_NS // 10
SETTLING_NS = 3 * SECOND_NS
LATENCY_NS = 10_000_000  # From the exposure to the stamp of a message
LOST = 0.1  # Share of single fixes that are lost
BLACKOUT_S, BETWEEN_BLACKOUTS_S = (0.5, 3.0), 10.0  # Duration of longer drop-outs, and their mean distance
POSITION_SIGMA, HEADING_SIGMA = 0.001, np.radians(0.3)
OFFSET = np.array([0.02, -0.01, 0.5 * np.pi])  # Pose of the tracked body in base_link
MODEL = OdometryModel()
_UNKNOWN = np.diag([1e2, 1e2, 1e2])


class _Fixes(NamedTuple):
    """Fixes of a robot (f,): time of exposure, arrival, body's pose as measured (f, 3)."""

    at_ns: IntArray
    arrival_ns: IntArray
    body: FloatArray


class _Shown(NamedTuple):
    """What is drawn of one robot (k,): time [s], error, its estimated sigma and its bound [m]."""

    time_s: FloatArray
    error: FloatArray
    sigma: FloatArray
    bound: FloatArray


_NO_FIXES = _Fixes(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))


@dataclass(frozen=True)
class _Drive:
    """A robot's run: true poses (s, 3) at the stamps (s,) of odometry, its odometry (s, 3), and its fixes."""

    stamp_ns: IntArray
    truth: FloatArray
    odometry: FloatArray
    fixes: _Fixes

    def truth_at(self, at_ns: IntArray) -> FloatArray:
        """(k, 3) true poses at any time."""
        k = np.clip(np.searchsorted(self.stamp_ns, at_ns, side="right") - 1, 0, len(self.stamp_ns) - 2)
        share = (at_ns - self.stamp_ns[k])[:, None] / STEP_NS
        return se2.compose(
            self.truth[k], se2.exp(share * se2.log(se2.between(self.truth[k], self.truth[k + 1])))
        )


def measure(seeds: Sequence[int], say: ProgressLine) -> Mapping[str, float]:
    """Errors of the estimator and both bounds, over all seeds and robots."""
    ticks = np.arange(START_NS + SETTLING_NS, START_NS + round(DURATION_S * 1e9), TICK_NS)
    errors, normalized, online, smoothed, ages = [], [], [], [], []
    for seed in seeds:
        say(f"seed {seed}")
        drives = [_drive(np.random.default_rng([seed, robot])) for robot in range(ROBOTS)]
        poses, covariances = _estimate(drives, ticks)
        for robot, drive in enumerate(drives):
            truth = drive.truth_at(ticks)
            error = poses[:, robot] - truth
            error[:, 2] = se2.wrap_angle(error[:, 2])
            errors.append(np.linalg.norm(error[:, :2], axis=1))
            normalized.append(nees(error, covariances[:, robot]))
            filter_bound, smoother_bound, age = _bounds(drive, ticks)
            online.append(filter_bound)
            smoothed.append(smoother_bound)
            ages.append(age)
            sigma = np.sqrt(np.trace(covariances[:, robot, :2, :2], axis1=1, axis2=2))
            shown = _Shown(1e-9 * (ticks - START_NS).astype(float), errors[-1], sigma, np.sqrt(filter_bound))
    _plot(shown, np.concatenate(ages), np.concatenate(errors), np.concatenate(online))
    rms, by_filter, by_smoother = (
        float(np.sqrt(np.mean(one))) for one in (np.square(errors), online, smoothed)
    )
    return {
        "mocap.position_mm": 1e3 * rms,
        "mocap.filter_bound_mm": 1e3 * by_filter,
        "mocap.smoother_mm": 1e3 * by_smoother,
        "mocap.ratio_to_filter_bound": rms / by_filter,
        "mocap.ratio_to_smoother": rms / by_smoother,
        "mocap.nees": float(np.mean(normalized)),
    }


def _drive(rng: np.random.Generator) -> _Drive:
    """A random drive with noisy wheels and fixes."""
    steps = round(DURATION_S * 1e9) // STEP_NS
    change = rng.normal(size=(steps, 2))
    speed_turn = np.zeros((steps, 2))
    for k in range(1, steps):  # speeds wander about their means within about a second
        speed_turn[k] = 0.98 * speed_turn[k - 1] + 0.2 * change[k]
    seconds = 1e-9 * STEP_NS
    path, turn = seconds * (0.08 + 0.03 * speed_turn[:, 0]), seconds * 0.8 * speed_turn[:, 1]
    wheels = path[:, None] + 0.5 * MODEL.wheel_separation * turn[:, None] * np.array([1.0, -1.0])
    noisy = wheels + np.sqrt(MODEL.wheel_noise * np.abs(wheels)) * rng.normal(size=wheels.shape)
    start = np.array([*rng.uniform(-1.0, 1.0, 2), rng.uniform(-np.pi, np.pi)])
    stamp_ns = START_NS + STEP_NS * np.arange(steps + 1)
    drive = _Drive(stamp_ns, _track(start, wheels), _track(np.zeros(3), noisy), _NO_FIXES)
    at_ns = np.arange(START_NS + int(rng.integers(FIX_NS)), stamp_ns[-1], FIX_NS)
    at_ns = at_ns[~_is_lost(at_ns, rng)]
    noise = np.array([POSITION_SIGMA, POSITION_SIGMA, HEADING_SIGMA]) * rng.normal(size=(at_ns.size, 3))
    body = se2.compose(drive.truth_at(at_ns), OFFSET) + noise
    fixes = _Fixes(at_ns, arrival_ns(rng, at_ns, CAMERA_LATENESS), body)
    return _Drive(drive.stamp_ns, drive.truth, drive.odometry, fixes)


def _track(start: FloatArray, wheels: FloatArray) -> FloatArray:
    """(s + 1, 3) poses from a start by the paths (s, 2) of the right and the left wheel."""
    poses = [start]
    for right, left in wheels:
        turn = (right - left) / MODEL.wheel_separation
        poses.append(se2.compose(poses[-1], se2.exp(np.array([0.5 * (right + left), 0.0, turn]))))
    return np.stack(poses)


def _is_lost(at_ns: IntArray, rng: np.random.Generator) -> BoolArray:
    """Which fixes (f,) are lost: single ones, and all of drop-outs."""
    lost = rng.random(at_ns.size) < LOST
    begin_s = rng.exponential(BETWEEN_BLACKOUTS_S)
    while begin_s < DURATION_S:
        end_s = begin_s + rng.uniform(*BLACKOUT_S)
        lost |= (at_ns >= START_NS + begin_s * 1e9) & (at_ns < START_NS + end_s * 1e9)
        begin_s = end_s + rng.exponential(BETWEEN_BLACKOUTS_S)
    return lost


def _estimate(drives: Sequence[_Drive], ticks: IntArray) -> tuple[FloatArray, FloatArray]:
    """Poses (k, N, 3) and covariances (k, N, 3, 3) at ticks (k,), by the bridge and the estimator."""
    swarm = Swarm(tuple(Robot(f"robot{k}", odometry=MODEL) for k in range(len(drives))))
    odometry = OdometryRows.without_twist(
        np.repeat(np.arange(len(drives)), [len(one.stamp_ns) for one in drives]),
        np.concatenate([one.stamp_ns for one in drives]),
        np.concatenate([one.odometry for one in drives]),
        np.concatenate([one.stamp_ns for one in drives]),
    )
    fixes = _bridged(drives, list(swarm.index_of))
    all_ns = np.arange(START_NS, ticks[-1] + 1, TICK_NS)
    inputs = inputs_between(all_ns, odometry=in_order_of_arrival([odometry]), fixes=fixes)
    estimates = [one for one, _ in estimates_of(swarm, inputs, all_ns) if one.stamp_ns >= ticks[0]]
    return np.stack([one.poses for one in estimates]), np.stack([one.covariances for one in estimates])


def _bridged(drives: Sequence[_Drive], names: list[str]) -> FixRows:
    """The fixes that the bridge makes of the messages, in order of arrival."""
    x, y, yaw = OFFSET.tolist()
    parameters = BridgeParameters(
        swarm_file="swarm.yaml",
        offsets=tuple(f"{name}={x},{y},{yaw}" for name in names),
        latency_s=1e-9 * LATENCY_NS,
        position_sigma=POSITION_SIGMA,
        heading_sigma=HEADING_SIGMA,
    )
    robots = LocalizedRobots(parameters, names, Health(print))
    rows = []
    for number, (name, drive) in enumerate(zip(names, drives, strict=True)):
        for at_ns, arrived_ns, body in zip(*drive.fixes, strict=True):
            bodies = SOURCES["pose"].bodies(_message(int(at_ns) + LATENCY_NS, body))
            (found,) = robots.convert(bodies, name, int(arrived_ns))
            rows.append((number, found.stamp_ns, found.pose, found.covariance, int(arrived_ns)))
    return in_order_of_arrival([FixRows(*(np.array(column) for column in zip(*rows, strict=True)))])


def _message(stamp_ns: int, body: FloatArray) -> SimpleNamespace:
    """The fields of a geometry_msgs/PoseStamped."""
    seconds, nanoseconds = divmod(stamp_ns, SECOND_NS)
    stamp = SimpleNamespace(sec=seconds, nanosec=nanoseconds)
    half = 0.5 * body[2]
    return SimpleNamespace(
        header=SimpleNamespace(frame_id="world", stamp=stamp),
        pose=SimpleNamespace(
            position=SimpleNamespace(x=body[0], y=body[1], z=0.1),
            orientation=SimpleNamespace(x=0.0, y=0.0, z=np.sin(half), w=np.cos(half)),
        ),
    )


def _bounds(drive: _Drive, ticks: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Variances of the position [m^2] of filter and smoother at ticks (k,), and the newest fix's age [s]."""
    fixes = drive.fixes
    at = np.unique(np.concatenate([fixes.at_ns, ticks]))
    fix_at = np.searchsorted(at, fixes.at_ns)
    tick_at = np.searchsorted(at, ticks)
    moves, noises = _motion(drive, at)
    information = _information(drive.truth_at(fixes.at_ns))
    arrives = np.full(len(at), np.iinfo(np.int64).max)
    arrives[fix_at] = fixes.arrival_ns
    of_fix = np.zeros((len(at), 3, 3))
    of_fix[fix_at] = information
    online, age = np.zeros(len(ticks)), np.zeros(len(ticks))
    settled, begin = _UNKNOWN, 0  # the covariance before the fix at `begin`, behind which all have arrived
    for k, end in enumerate(tick_at):
        while at[begin] + round(1e9 * CAMERA_LATENESS.high_s) <= ticks[k]:
            settled = _moved(_fused(settled, of_fix[begin]), moves[begin], noises[begin])
            begin += 1
        covariance = settled
        for j in range(begin, end):
            known = of_fix[j] if arrives[j] <= ticks[k] else np.zeros((3, 3))
            covariance = _moved(_fused(covariance, known), moves[j], noises[j])
        online[k] = covariance[0, 0] + covariance[1, 1]
        age[k] = 1e-9 * (ticks[k] - fixes.at_ns[fixes.arrival_ns <= ticks[k]].max())
    return online, _smoothed(of_fix, moves, noises)[tick_at], age


def _motion(drive: _Drive, at: IntArray) -> tuple[FloatArray, FloatArray]:
    """Jacobians and noise (n - 1, 3, 3) of the errors of x, y and heading between times (n,)."""
    stamps = np.unique(np.concatenate([at, drive.stamp_ns]))
    poses = drive.truth_at(stamps)
    twist = se2.log(se2.between(poses[:-1], poses[1:]))
    middle = se2.compose(poses[:-1], se2.exp(0.5 * twist))
    moves, noises = [np.eye(3)], [np.zeros((3, 3))]
    for begin, end, (path, _, turn), (*_, heading) in zip(poses[:-1], poses[1:], twist, middle, strict=True):
        wheels = np.abs(path + 0.5 * MODEL.wheel_separation * turn * np.array([1.0, -1.0]))
        along, cross, heading_noise = (
            0.25 * MODEL.wheel_noise * wheels.sum(),
            0.5 * MODEL.wheel_noise * (wheels[0] - wheels[1]) / MODEL.wheel_separation,
            MODEL.wheel_noise * wheels.sum() / MODEL.wheel_separation**2,
        )
        turned = np.array([[np.cos(heading), 0.0], [np.sin(heading), 0.0], [0.0, 1.0]])
        noise = turned @ np.array([[along, cross], [cross, heading_noise]]) @ turned.T
        move = np.eye(3)
        move[:2, 2] = begin[1] - end[1], end[0] - begin[0]
        moves.append(move @ moves[-1])
        noises.append(move @ noises[-1] @ move.T + noise)
    knots = np.searchsorted(stamps, at)
    total = [np.linalg.solve(moves[a].T, moves[b].T).T for a, b in pairwise(knots)]
    added = [
        noises[b] - move @ noises[a] @ move.T for move, a, b in zip(total, knots[:-1], knots[1:], strict=True)
    ]
    return np.stack(total), np.stack(added)


def _information(truth: FloatArray) -> FloatArray:
    """Information (f, 3, 3) of fixes on x, y and heading of robots at true poses (f, 3)."""
    lever = se2.compose(truth, OFFSET)[:, :2] - truth[:, :2]
    by_pose = np.tile(np.eye(3), (len(truth), 1, 1))
    by_pose[:, 0, 2], by_pose[:, 1, 2] = -lever[:, 1], lever[:, 0]
    weights = np.array([POSITION_SIGMA, POSITION_SIGMA, HEADING_SIGMA]) ** -2.0
    return np.asarray(np.einsum("fia,i,fib->fab", by_pose, weights, by_pose))


def _fused(covariance: FloatArray, information: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(np.linalg.inv(covariance) + information))


def _moved(covariance: FloatArray, move: FloatArray, noise: FloatArray) -> FloatArray:
    return np.asarray(move @ covariance @ move.T + noise)


def _smoothed(of_fix: FloatArray, moves: FloatArray, noises: FloatArray) -> FloatArray:
    """Variances of the position (n,) by all fixes, by the Rauch-Tung-Striebel smoother."""
    fused, predicted = [_fused(_UNKNOWN, of_fix[0])], [_UNKNOWN]
    for move, noise, information in zip(moves, noises, of_fix[1:], strict=True):
        predicted.append(_moved(fused[-1], move, noise))
        fused.append(_fused(predicted[-1], information))
    covariance, variances = fused[-1], np.zeros(len(fused))
    for k in range(len(fused) - 1, -1, -1):
        if k < len(fused) - 1:
            gain = fused[k] @ moves[k].T @ np.linalg.inv(predicted[k + 1])
            covariance = fused[k] + gain @ (covariance - predicted[k + 1]) @ gain.T
        variances[k] = covariance[0, 0] + covariance[1, 1]
    return variances


def _plot(shown: _Shown, ages: FloatArray, errors: FloatArray, online: FloatArray) -> None:
    """Draw the errors of one robot over time, and those of all by the age of the newest fix."""
    figure, (left, right) = new_plot(2)
    left.plot(shown.time_s, 1e3 * shown.error, lw=1.0, label="error")
    left.plot(shown.time_s, 1e3 * shown.sigma, lw=1.2, label="estimated sigma")
    left.plot(shown.time_s, 1e3 * shown.bound, "k--", lw=1.0, label="bound of the filter")
    left.set(xlabel="time [s]", ylabel="position, one robot [mm]", ylim=(0.0, None))
    left.legend()
    parts = equal_parts(ages, 24)
    middle = [ages[part].mean() for part in parts]
    for squares, style, label in ((errors**2, "o", "estimator"), (online, "k--", "bound of the filter")):
        right.plot(middle, [1e3 * np.sqrt(squares[part].mean()) for part in parts], style, label=label)
    right.set(xlabel="age of the newest fix [s]", ylabel="position, RMS [mm]")
    right.legend()
    save_plot(figure, "inputs-mocap")
