"""Scenarios of ceiling cameras, gyroscopes, motion capture, UWB and lidar.

Each replaces readings of a time by wrong ones, and says whom a contradiction may name. Under ceiling cameras,
five e-pucks carry lying tags; detections come without images.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bench.integrity import faults
from bench.integrity.faults import CLEAN, FAULT_S, Fault, settings_of
from bench.lidar.known_map import exact_map, record
from bench.pushbot.mapping import PLANS
from bench.scenarios.eight_run import drive_eight, simulate_eight
from bench.scenarios.lived_run import (
    CAMERA_LATENESS,
    ODOMETRY_DTYPE,
    LivedRun,
    SimulatedRun,
    arrival_ns,
    survivors,
)
from bench.scenarios.sightings import schedule_exposures
from bench.shared.common import OUT
from bench.shared.simulated_run import detection_rows
from swarm_loc_drivers.sim.differential_drive import Drive, roll
from swarm_loc_drivers.sim.pushbot.floor_plan import floor_plan
from swarm_loc_drivers.sim.run import START_NS, Trajectories
from swarm_loc_drivers.sim.worlds import W0, ErrorModel
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.filter.measurements import concatenate, select
from swarm_loc_estimator.mapping.map_file import save_map
from swarm_loc_estimator.sensors.camera import CameraSensor, DetectionRows
from swarm_loc_estimator.sensors.fix import NO_FIXES, FixRows
from swarm_loc_estimator.sensors.imu import TurnRateRows
from swarm_loc_estimator.sensors.ranges import RangeRows
from swarm_loc_estimator.sensors.sensor import in_order_of_arrival
from swarm_loc_estimator.swarm.error_models import ImuModel, OdometryModel
from swarm_loc_estimator.swarm.swarm import Anchor, Face, FixedCamera, Robot, StartSigma, Swarm, UwbDevice

_TOP = Face("top", 0, 0.0, 0.0, 0.105, 0.0, size=0.05, lies=True)  # The tag on a robot
_CAMERAS = tuple(
    FixedCamera(f"ceiling{k + 1}", x, 0.0, 2.0, yaw=0.5 * math.pi, position_sigma=0.002, yaw_sigma=0.001)
    for k, x in enumerate((-0.45, 0.45))
)
_HALF_VIEW = (0.5, 0.65)  # Of the plane of the tags, upwards and sideways in the image [m]
_RATE_HZ, _LOSS = 10.0, 0.02
_NOISE = np.array([0.001, 0.001, 0.005, 0.05, 0.05, 0.01])
"""Standard deviations of a tag's pose along and about the axes of the optical frame [m, rad]."""
_LEVEL = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Rotation from the optical frame of a camera that looks straight down to forward, left, up."""


@lru_cache(maxsize=2)  # scenarios of one seed share it
def drive_under_ceiling(seed: int, duration_s: float) -> LivedRun:
    """Drive the eight; no robot has a camera, and no start is known."""
    settings = replace(settings_of(seed, CLEAN, duration_s), start_known=False)
    described, truth, odometry = drive_eight(np.random.default_rng(seed), settings)
    robots = tuple(
        replace(robot, camera=None, faces=(replace(_TOP, id=k + 1),))
        for k, robot in enumerate(described.robots)
    )
    return LivedRun(Swarm(robots, (), _CAMERAS), truth, odometry)


def hung(swarm: Swarm, rng: np.random.Generator) -> Swarm:
    """The swarm with the cameras where they truly hang."""
    cameras = []
    for camera in swarm.cameras:
        dx, dy = (camera.position_sigma * rng.standard_normal(2)).tolist()
        turn = camera.yaw_sigma * float(rng.standard_normal())
        cameras.append(replace(camera, x=camera.x + dx, y=camera.y + dy, yaw=camera.yaw + turn))
    return replace(swarm, cameras=tuple(cameras))


def observe_tags(run: LivedRun, seen: Swarm, seed: int) -> DetectionRows:
    """Detections of the tags by all cameras, in order of arrival.

    Args:
        run: The run.
        seen: The swarm as it is; cameras look straight down.
        seed: Of exposures, noise and losses, which do not depend on `seen`.
    """
    # images, and the errors of all tags in each of them
    rng, robots = np.random.default_rng([seed, 20]), len(seen.robots)
    camera, stamp_ns = schedule_exposures(rng, len(seen.cameras), _RATE_HZ, run.start_ns, run.end_ns)
    arrives_ns, arrived = arrival_ns(rng, stamp_ns, CAMERA_LATENESS), survivors(rng, camera.size, _LOSS)
    noise = _NOISE * rng.standard_normal((camera.size, robots, 6))
    # tags in the level frames of the cameras
    mounts = np.array([(one.x, one.y, one.yaw) for one in seen.cameras])
    tops = [robot.faces[0] for robot in seen.robots]
    on_robots = np.array([(face.x, face.y, face.yaw) for face in tops], dtype=float)
    tags = se2.between(mounts[camera][:, None], se2.compose(run.truth.all_at(stamp_ns), on_robots))
    heights = np.array([[face.z - one.z for face in tops] for one in seen.cameras])[camera]
    image, robot = np.nonzero((np.abs(tags[..., :2]) < _HALF_VIEW).all(axis=-1) & arrived[:, None])
    tag, error, height = tags[image, robot], noise[image, robot], heights[image, robot]
    # their poses in the optical frames
    upright = Rotation.from_matrix(_LEVEL.T) * Rotation.from_euler("z", tag[:, 2:])
    rows = CameraSensor.rows(
        {
            "robot": robots + camera[image],
            "stamp_ns": stamp_ns[image],
            "arrival_ns": arrives_ns[image],
            "id": np.array([face.id for face in tops])[robot],
            "position": np.column_stack([tag[:, :2], height]) @ _LEVEL + error[:, :3],
            "orientation": (Rotation.from_rotvec(error[:, 3:]) * upright).as_quat(),
            "covariance": np.tile(np.diag(_NOISE**2), (image.size, 1, 1)),
        }
    )
    return in_order_of_arrival([rows])


_DURATION_S = 80.0  # Of each run; more than 30 s after the fault
_TO_THE_END_S = (FAULT_S[0], _DURATION_S)
_MOCAP_SIGMA, _MOCAP_NS = (0.001, 0.001, math.radians(0.3)), 1_000_000_000 // 30
Span = tuple[float, float]


def _rng(seed: int) -> np.random.Generator:
    """Draws the fault, not the run."""
    return np.random.default_rng([seed, 30])


def _aside(rng: np.random.Generator, distance: float) -> FloatArray:
    """A step (2,) of a length into a random direction [m]."""
    angle = rng.uniform(0.0, 2.0 * math.pi)
    return distance * np.array([math.cos(angle), math.sin(angle)])


def _is_within(run: LivedRun, rows: Any, span_s: Span) -> BoolArray:
    """Which rows (k,) have their stamps in a time since the run began."""
    time_s = faults.seconds(run, rows.stamp_ns)
    inside: BoolArray = (time_s >= span_s[0]) & (time_s < span_s[1])
    return inside


def _faulty(
    run: LivedRun,
    sensor: str,
    good: Any,
    wrong: Any,
    guilty: Collection[str],
    concerned: Collection[int] = (),
    span_s: Span = FAULT_S,
) -> Fault:
    """A run with wrong readings of a sensor for a while.

    Args:
        run: The run.
        sensor: Name of the sensor.
        good: Its readings without the fault.
        wrong: Those that replace them.
        guilty: Names of the sources that are to blame.
        concerned: Robots that the fault concerns; none: all.
        span_s: Begin and end of the fault.
    """
    before, during = select(good, ~_is_within(run, good, span_s)), _is_within(run, wrong, span_s)
    return Fault(
        run,
        ends_s=span_s[1] if span_s[1] < run.duration_s else None,
        readings={sensor: in_order_of_arrival([before, select(wrong, during)])},
        healthy={sensor: good},
        begins_s=span_s[0],
        guilty=frozenset(guilty),
        concerned=frozenset(concerned),
    )


def _under_ceiling(
    seed: int, change: Callable[[Swarm], Swarm], guilty: Collection[str], *concerned: int, span_s: Span
) -> Fault:
    """Robots under two ceiling cameras, in a world that changes for a while."""
    run = drive_under_ceiling(seed, _DURATION_S)
    seen = hung(run.swarm, np.random.default_rng([seed, 31]))
    good, wrong = observe_tags(run, seen, seed), observe_tags(run, change(seen), seed)
    return _faulty(run, "detections", good, wrong, guilty, concerned, span_s)


def _ceiling_camera(seed: int, least: Sequence[float], most: Sequence[float]) -> Fault:
    """One camera moves, in every other seed to the end; `least` and `most` of distance [m] and turn [rad]."""
    rng = _rng(seed)
    which, (distance, turn) = int(rng.integers(2)), rng.uniform(least, most).tolist()
    (dx, dy), turn = _aside(rng, distance).tolist(), turn * float(rng.choice([-1.0, 1.0]))

    def moved(swarm: Swarm) -> Swarm:
        cameras = list(swarm.cameras)
        one = cameras[which]
        cameras[which] = replace(one, x=one.x + dx, y=one.y + dy, yaw=one.yaw + turn)
        return replace(swarm, cameras=tuple(cameras))

    span_s = _TO_THE_END_S if seed % 2 else FAULT_S
    return _under_ceiling(seed, moved, {f"ceiling{which + 1}"}, span_s=span_s)


def _ceiling_cameras_swapped(seed: int) -> Fault:
    run = drive_under_ceiling(seed, _DURATION_S)
    good = observe_tags(run, hung(run.swarm, np.random.default_rng([seed, 31])), seed)
    swapped = good._replace(robot=2 * len(run.swarm.robots) + 1 - good.robot)
    span_s = (0.0, _DURATION_S) if seed % 2 else FAULT_S
    names = {camera.name for camera in run.swarm.cameras}
    return _faulty(run, "detections", good, swapped, names, span_s=span_s)


def _face_turned_90(seed: int) -> Fault:
    """A tag lies turned, in every other seed all the time."""
    rng = _rng(seed)
    which, turn = int(rng.integers(5)), float(rng.choice([-0.5, 0.5])) * math.pi

    def turned(swarm: Swarm) -> Swarm:
        robots = list(swarm.robots)
        (face,) = robots[which].faces
        robots[which] = replace(robots[which], faces=(replace(face, yaw=(face.yaw or 0.0) + turn),))
        return replace(swarm, robots=tuple(robots))

    span_s = (0.0, _DURATION_S) if seed % 2 else FAULT_S
    return _under_ceiling(seed, turned, {f"marker of epuck{which + 1}"}, which, span_s=span_s)


@lru_cache(maxsize=2)  # scenarios of one seed share it
def _eight(seed: int, errors: ErrorModel = CLEAN) -> SimulatedRun:
    """The eight, for longer than other scenarios."""
    return simulate_eight(settings_of(seed, errors, _DURATION_S))


def _fixes(
    run: LivedRun, seed: int, period_ns: int = _MOCAP_NS, sigma: Sequence[float] = _MOCAP_SIGMA
) -> FixRows:
    """Absolute fixes of all robots, in order of arrival; `sigma` is of x, y [m] and heading [rad]."""
    rng, robots = np.random.default_rng([seed, 32]), len(run.swarm.robots)
    stamp_ns = np.arange(run.start_ns + int(rng.integers(period_ns)), run.end_ns, period_ns)
    pose = run.truth.all_at(stamp_ns).reshape(-1, 3)
    pose += np.array(sigma) * rng.standard_normal(pose.shape)
    stamps, who = np.repeat(stamp_ns, robots), np.tile(np.arange(robots), stamp_ns.size)
    covariance = np.tile(np.diag(np.square(sigma)), (who.size, 1, 1))
    rows = FixRows(who, stamps, pose, covariance, arrival_ns(rng, stamps, CAMERA_LATENESS))
    return in_order_of_arrival([rows])


def _fixes_of(*robots: int) -> set[str]:
    """Names of the fixes of robots."""
    return {f"fixes of epuck{robot + 1}" for robot in robots}


def _mocap_swapped(seed: int, span_s: Span) -> Fault:
    run = _eight(seed)
    good = _fixes(run, seed)
    a, b = _rng(seed).choice(len(run.swarm.robots), 2, replace=False).tolist()
    body_of = np.arange(len(run.swarm.robots))
    body_of[[a, b]] = b, a
    wrong = good._replace(robot=body_of[good.robot])
    return _faulty(run, "fixes", good, wrong, _fixes_of(a, b), {a, b}, span_s)


def _mocap_frame(seed: int) -> Fault:
    """The frame of a body is 5 cm off, as of a marker plate that was pushed."""
    rng, run = _rng(seed), _eight(seed)
    good, which = _fixes(run, seed, 10_000_000), int(rng.integers(5))
    pose, own = good.pose.copy(), good.robot == which
    pose[own] = se2.compose(pose[own], np.append(_aside(rng, 0.05), 0.0))
    return _faulty(run, "fixes", good, good._replace(pose=pose), _fixes_of(which), {which})


def _mocap_creep(seed: int) -> Fault:
    rng, run = _rng(seed), _eight(seed)
    good, which = _fixes(run, seed), int(rng.integers(5))
    way_s = (good.robot == which) * (faults.seconds(run, good.stamp_ns) - FAULT_S[0])
    wrong = good._replace(pose=good.pose + way_s[:, None] * np.append(_aside(rng, 0.003), 0.0))
    return _faulty(run, "fixes", good, wrong, _fixes_of(which), {which})


def _fixes_1khz(seed: int) -> Fault:
    """A robot gets wrong fixes, and no other gets any."""
    rng, run = _rng(seed), _eight(seed)
    which, fixes = int(rng.integers(5)), _fixes(run, seed, 1_000_000, (0.01, 0.01, 0.02))
    wrong = select(fixes, fixes.robot == which)
    wrong = wrong._replace(pose=wrong.pose + np.append(_aside(rng, 0.05), 0.0))
    return _faulty(run, "fixes", NO_FIXES, wrong, _fixes_of(which), {which})


def _sure_detections(seed: int) -> Fault:
    """An observer's detections of a robot come a second time, 3 cm off and claimed to be exact."""
    rng, run = _rng(seed), _eight(seed)
    good = detection_rows(run)
    # one of the five pairs that see each other most
    target = np.array([run.swarm.owner_of[int(one)].robot_index for one in good.detection["id"]])
    seen = _is_within(run, good, FAULT_S) & (target >= 0)
    pairs, counts = np.unique(np.column_stack([good.robot, target])[seen], axis=0, return_counts=True)
    observer, other = pairs[np.argsort(counts)[-1 - int(rng.integers(5))]].tolist()
    # its detections
    again = select(good, (good.robot == observer) & (target == other))
    detection = again.detection.copy()
    detection["position"][:, [0, 2]] += _aside(rng, 0.03)
    detection["covariance"] = 1e-10 * np.eye(6)
    wrong: DetectionRows = concatenate([good, again._replace(detection=detection)])
    # the fault begins where the two see each other first
    first_s = float(faults.seconds(run, again.arrival_ns[_is_within(run, again, FAULT_S)]).min())
    span_s = first_s - 1e-3, FAULT_S[1]
    return _faulty(run, "detections", good, wrong, {f"epuck{observer + 1}"}, {observer, other}, span_s)


_IMU = ImuModel(turn_noise_density=3e-4, turn_scale_sigma=0.005, turn_bias_sigma=0.01)
"""A cheap MEMS gyroscope, three times as noisy as the data sheet of an MPU-6050 says (0.005 deg/s/Hz^0.5)."""
_IMU_HZ = 50.0


def _turn_rates(rng: np.random.Generator, run: LivedRun) -> TurnRateRows:
    """Readings of an IMU on each robot, with bias and scale drawn from their sigmas, in order of arrival."""
    period_ns = round(1e9 / _IMU_HZ)
    stamp_ns = np.arange(run.start_ns, run.end_ns, period_ns)
    robots, kept = len(run.swarm.robots), math.exp(-1.0 / _IMU_HZ / _IMU.turn_bias_time_s)
    rates = []
    for robot in range(robots):
        turn = np.gradient(np.unwrap(run.truth.at(robot, stamp_ns)[:, 2]), 1e-9 * period_ns)
        # a Gauss-Markov bias, in its stationary distribution
        bias, step = np.empty(stamp_ns.size), _IMU.turn_bias_sigma * math.sqrt(1.0 - kept**2)
        bias[0] = _IMU.turn_bias_sigma * rng.standard_normal()
        for k, noise in enumerate(step * rng.standard_normal(stamp_ns.size - 1)):
            bias[k + 1] = kept * bias[k] + noise
        white = _IMU.turn_noise_density * math.sqrt(_IMU_HZ) * rng.standard_normal(stamp_ns.size)
        scale = _IMU.turn_scale * (1.0 + _IMU.turn_scale_sigma * rng.standard_normal())
        rates.append((turn - bias - _IMU.turn_bias) / scale + white)
    stamps, velocity = np.tile(stamp_ns, robots), np.zeros((robots * stamp_ns.size, 3))
    velocity[:, 2] = np.concatenate(rates)
    unknown = np.full(velocity.shape, np.nan)
    arrivals = arrival_ns(rng, stamps, CAMERA_LATENESS)
    who = np.repeat(np.arange(robots), stamp_ns.size)
    return in_order_of_arrival([TurnRateRows(who, stamps, velocity, unknown[:, 0], unknown, arrivals)])


def _gyroscopes(seed: int, break_it: Callable[[FloatArray], FloatArray], span_s: Span = FAULT_S) -> Fault:
    """The gyroscope of a robot breaks within 5 s, in every other seed those of all robots.

    Detections are as noisy as those of the e-puck paper, so that turn rates matter.

    Args:
        seed: Of the run and the fault.
        break_it: Makes wrong rates (k, 3) of those of a robot from the fault on.
        span_s: Begin and end of the fault.
    """
    rng, run = _rng(seed), _eight(seed, W0)
    robots = tuple(replace(robot, imu=_IMU) for robot in run.swarm.robots)
    run = replace(run, swarm=replace(run.swarm, robots=robots))
    good, which = _turn_rates(rng, run), int(rng.integers(5))
    broken = [which] if seed % 2 else range(len(run.swarm.robots))
    span_s = (span_s[0] + float(rng.uniform(0.0, 5.0)), span_s[1])
    order, velocity = np.argsort(good.stamp_ns, kind="stable"), good.velocity.copy()
    since = order[faults.seconds(run, good.stamp_ns[order]) >= span_s[0]]
    for robot in broken:
        own = since[good.robot[since] == robot]
        velocity[own] = break_it(velocity[own])
    guilty, concerned = {f"gyroscope of epuck{robot + 1}" for robot in broken}, broken if seed % 2 else ()
    return _faulty(run, "imu", good, good._replace(velocity=velocity), guilty, concerned, span_s)


def _on_another_axis(seed: int) -> Fault:
    """The yaw rate appears on another axis, and noise on the vertical one."""
    rng, sigma = _rng(seed), _IMU.turn_noise_density * math.sqrt(_IMU_HZ)

    def on_its_side(rates: FloatArray) -> FloatArray:
        return np.roll(rates, 1 + int(seed % 3 == 0), axis=1) + sigma * rng.standard_normal(rates.shape)

    return _gyroscopes(seed, on_its_side)


_ANCHORS = ((-4.0, -4.0, 2.0), (4.0, -4.0, 2.4), (4.0, 4.0, 2.0), (-4.0, 4.0, 2.4))
_RADIOS, _ANTENNA_Z, _RANGE_SIGMA = 3, 0.3, 0.05  # Robots, and their radios
_ARENA_M, _RADIO_STEP_NS, _RANGE_STEPS = 2.4, 50_000_000, 10  # Each link measures twice a second


def _among_anchors(seed: int) -> tuple[LivedRun, RangeRows]:
    """Three robots that drive arcs between four anchors: the run, and its ranges in order of arrival."""
    # drive arcs at random rates, and back to the middle from outside; odometry does not know of slip
    rng, rate = np.random.default_rng(seed), np.zeros(_RADIOS)
    model, sigma = OdometryModel(wheel_separation=0.15, wheel_noise=2e-5), StartSigma(0.05, 0.05, 0.05)
    stamp_ns = START_NS + _RADIO_STEP_NS * np.arange(round(1e9 * _DURATION_S / _RADIO_STEP_NS) + 1)
    truth, reported = np.zeros((2, stamp_ns.size, _RADIOS, 3))
    truth[0, :, :2] = rng.uniform(-1.8, 1.8, (_RADIOS, 2))
    truth[0, :, 2] = rng.uniform(-math.pi, math.pi, _RADIOS)
    reported[0] = rng.uniform(-1.0, 1.0, (_RADIOS, 3))
    wheels, speed, step_s = Drive(model.wheel_separation, 1.0), np.full(_RADIOS, 0.3), 1e-9 * _RADIO_STEP_NS
    for k, pose in enumerate(truth[:-1]):
        if k % 30 == 0:
            rate = rng.uniform(-1.0, 1.0, _RADIOS)
        away = se2.wrap_angle(np.arctan2(-pose[:, 1], -pose[:, 0]) - pose[:, 2])
        outside = np.abs(pose[:, :2]).max(axis=1) > _ARENA_M
        turn = np.where(outside, np.clip(2.0 * away, -1.5, 1.5), rate)
        slip = math.sqrt(model.wheel_noise) * rng.standard_normal((2, _RADIOS)).T
        truth[k + 1] = roll(pose, speed, turn, wheels, step_s, slip)
        reported[k + 1] = roll(reported[k], speed, turn, wheels, step_s, np.zeros_like(slip))
    records = np.zeros(reported.shape[:2], ODOMETRY_DTYPE)
    records["robot"], records["pose"] = np.arange(_RADIOS), reported
    records["stamp_ns"] = records["arrival_ns"] = stamp_ns[:, None]
    # describe the robots, with uncertain starts
    robots = []
    for k, pose in enumerate(truth[0] + 0.05 * rng.standard_normal((_RADIOS, 3))):
        x, y, theta = pose.tolist()
        radio = UwbDevice(k + 1, z=_ANTENNA_Z, range_sigma=_RANGE_SIGMA)
        one = Robot(f"robot_{k}", odometry=model, camera=None, uwb=radio)
        robots.append(replace(one, start=(x, y, theta), start_sigma=sigma))
    swarm = Swarm(
        tuple(robots),
        anchors=tuple(Anchor(100 + k, *place, range_bias_sigma=0.0) for k, place in enumerate(_ANCHORS)),
    )
    run = LivedRun(swarm, Trajectories(stamp_ns, truth), records.reshape(-1))
    # ranges of each link in turn
    parts = []
    for number, (robot, anchor) in enumerate(np.ndindex(_RADIOS, len(_ANCHORS))):
        measured = slice(1 + number % _RANGE_STEPS, None, _RANGE_STEPS)
        at_ns, place = stamp_ns[measured], np.insert(truth[measured, robot, :2], 2, _ANTENNA_Z, axis=-1)
        distance = np.linalg.norm(np.array(_ANCHORS[anchor]) - place, axis=1)
        distance += _RANGE_SIGMA * rng.standard_normal(at_ns.size)
        who, zero = np.full_like(at_ns, robot), np.zeros_like(distance)
        device = np.full_like(at_ns, 100 + anchor).astype(np.uint64)
        arrivals_ns = arrival_ns(rng, at_ns, CAMERA_LATENESS)
        parts.append(RangeRows(who, at_ns, device, zero.astype(np.uint64), distance, zero, arrivals_ns))
    return run, in_order_of_arrival(parts)


def _uwb_repeated(seed: int) -> Fault:
    """Ranges of all radios are measured twice a second and published five times each."""
    run, good = _among_anchors(seed)
    again = [
        good._replace(stamp_ns=good.stamp_ns + late_ns, arrival_ns=good.arrival_ns + late_ns)
        for late_ns in range(0, 500_000_000, 100_000_000)
    ]
    guilty = {f"radio of {robot.name}" for robot in run.swarm.robots}
    return _faulty(run, "ranges", good, concatenate(again), guilty)


def _scans_late(seed: int) -> Fault:
    """Scans are stamped late, as by a driver that stamps them when it publishes them."""
    plan, late_ns = floor_plan(PLANS[seed % len(PLANS)]), (200_000_000, 400_000_000)[seed % 2]
    folder = OUT / "integrity" / f"scans_late{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    swarm_map, _ = save_map(exact_map(plan), folder / "map")
    run, good = record(plan, swarm_map, seed, _DURATION_S)
    stamps_ns, scans = good.stamp_ns + late_ns, good.scan.copy()
    scans[:] = [one._replace(stamp_ns=one.stamp_ns + late_ns) for one in scans]
    late = good._replace(stamp_ns=stamps_ns, scan=scans, arrival_ns=good.arrival_ns + late_ns)
    return _faulty(run, "scans", good, late, {f"lidar of {run.swarm.robots[0].name}"})


SENSOR_SCENARIOS: Mapping[str, Callable[[int], Fault]] = {
    "ceiling_camera_moved": lambda seed: _ceiling_camera(seed, (0.03, 0.0), (0.08, 0.0)),
    "ceiling_camera_turned": lambda seed: _ceiling_camera(
        seed, (0.0, math.radians(2.0)), (0.0, math.radians(5.0))
    ),
    "ceiling_cameras_swapped": _ceiling_cameras_swapped,
    "face_turned_90": _face_turned_90,
    "gyro_zero": lambda seed: _gyroscopes(seed, np.zeros_like),
    "gyro_axis": _on_another_axis,
    "gyro_freezes": lambda seed: _gyroscopes(
        seed, lambda rates: np.broadcast_to(rates[0], rates.shape), _TO_THE_END_S
    ),
    "mocap_swapped": lambda seed: _mocap_swapped(seed, _TO_THE_END_S),
    "mocap_swapped_8s": lambda seed: _mocap_swapped(seed, (FAULT_S[0], FAULT_S[0] + 8.0)),
    "mocap_frame_5cm_100hz": _mocap_frame,
    "mocap_creep_3mm": _mocap_creep,
    "fixes_1khz": _fixes_1khz,
    "sure_detections": _sure_detections,
    "uwb_repeated": _uwb_repeated,
    "scans_late": _scans_late,
}
