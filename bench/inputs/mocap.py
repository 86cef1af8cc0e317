"""Motion capture with drop-outs and delays, through the bridge and the estimator."""

from collections.abc import Mapping, Sequence
from types import SimpleNamespace

import numpy as np

from bench.scenarios.lived_run import CAMERA_LATENESS, LivedRun, arrival_ns, record_drive
from bench.shared.common import ProgressLine, plot_curves, rms
from bench.shared.simulated_run import errors_of, estimates_of, inputs_between, mean_nees, odometry_rows
from swarm_loc_drivers.sim.differential_drive import Drive
from swarm_loc_drivers.sim.run import START_NS
from swarm_loc_estimator import FixRows, Robot, Swarm
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.health import Health
from swarm_loc_estimator.sensors.localizers import SOURCES, BridgeParameters, LocalizedRobots
from swarm_loc_estimator.sensors.sensor import in_order_of_arrival

ROBOTS = 5
DURATION_S = 60.0
SECOND_NS = 1_000_000_000
STEP_NS = SECOND_NS // 50  # Period of odometry
FIX_NS = SECOND_NS // 30
TICK_NS = SECOND_NS // 10
SETTLING_TICKS = 29
LATENCY_NS = 10_000_000  # From the exposure to the stamp of a message
LOST = 0.1  # Share of single fixes that are lost
BLACKOUT_S, BETWEEN_BLACKOUTS_S = (0.5, 3.0), 10.0  # Duration of longer drop-outs, and their mean distance
POSITION_SIGMA, HEADING_SIGMA = 0.001, np.radians(0.3)
OFFSET = np.array([0.02, -0.01, 0.5 * np.pi])  # Pose of the tracked body in base_link


def measure(seeds: Sequence[int], say: ProgressLine) -> Mapping[str, float]:
    """Errors of the estimator over all seeds and robots."""
    errors, covariances = [], []
    for seed in seeds:
        say(f"seed {seed}")
        rng = np.random.default_rng(seed)
        run = _drive(rng)
        tick_ns = np.arange(START_NS + TICK_NS, run.end_ns, TICK_NS)
        inputs = inputs_between(tick_ns, odometry=odometry_rows(run), fixes=_bridged(run, rng))
        estimates = [one for one, _ in estimates_of(run.swarm, inputs, tick_ns)]
        errors.append(errors_of(np.stack([one.poses for one in estimates]), run, tick_ns)[SETTLING_TICKS:])
        covariances.append(np.stack([one.covariances for one in estimates])[SETTLING_TICKS:])
    error, covariance = np.concatenate(errors), np.concatenate(covariances)
    distance = np.hypot(error[..., 0], error[..., 1])
    last, spread = errors[-1][:, 0], np.trace(covariances[-1][:, 0, :2, :2], axis1=1, axis2=2)
    time_s = 0.1 * (1 + SETTLING_TICKS + np.arange(len(last)))
    shown = {"error": 1e3 * np.hypot(*last[:, :2].T), "estimated sigma": 1e3 * np.sqrt(spread)}
    plot_curves("inputs-mocap", ("time [s]", "position, one robot [mm]", time_s, shown))
    return {"mocap.position_mm": 1e3 * rms(distance), "mocap.nees": mean_nees(error, covariance)}


def _drive(rng: np.random.Generator) -> LivedRun:
    """Robots whose speeds wander about their means within about a second."""
    wander = np.zeros((2, ROBOTS))

    def control(_step: int, _pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        wander[:] = 0.98 * wander + 0.2 * rng.normal(size=wander.shape)
        return 0.08 + 0.03 * wander[0], 0.8 * wander[1]

    swarm = Swarm(tuple(Robot(f"robot{k}") for k in range(ROBOTS)))
    start = rng.uniform([-1.0, -1.0, -np.pi], [1.0, 1.0, np.pi], (ROBOTS, 3))
    model = swarm.robots[0].odometry
    wheels, rate_hz = Drive(model.wheel_separation, model.wheel_noise), SECOND_NS / STEP_NS
    truth, odometry = record_drive(
        rng, start, control, wheels, step_ns=STEP_NS, duration_s=DURATION_S, odometry_rate_hz=rate_hz
    )
    odometry["arrival_ns"] = odometry["stamp_ns"]  # fixes alone are late
    return LivedRun(swarm, truth, odometry[np.argsort(odometry["stamp_ns"], kind="stable")])


def _is_lost(at_ns: IntArray, rng: np.random.Generator) -> BoolArray:
    """Which fixes (f,) are lost: single ones, and all of drop-outs."""
    lost = rng.random(at_ns.size) < LOST
    begin_s = rng.exponential(BETWEEN_BLACKOUTS_S)
    while begin_s < DURATION_S:
        end_s = begin_s + rng.uniform(*BLACKOUT_S)
        lost |= (at_ns >= START_NS + begin_s * 1e9) & (at_ns < START_NS + end_s * 1e9)
        begin_s = end_s + rng.exponential(BETWEEN_BLACKOUTS_S)
    return lost


def _bridged(run: LivedRun, rng: np.random.Generator) -> FixRows:
    """The fixes that the bridge makes of the messages, in order of arrival."""
    x, y, yaw = OFFSET.tolist()
    names = list(run.swarm.index_of)
    parameters = BridgeParameters(
        swarm_file="swarm.yaml",
        offsets=tuple(f"{name}={x},{y},{yaw}" for name in names),
        latency_s=1e-9 * LATENCY_NS,
        position_sigma=POSITION_SIGMA,
        heading_sigma=HEADING_SIGMA,
    )
    robots, rows = LocalizedRobots(parameters, names, Health(print)), []
    for number, name in enumerate(names):
        at_ns = np.arange(START_NS + int(rng.integers(FIX_NS)), run.end_ns, FIX_NS)
        at_ns = at_ns[~_is_lost(at_ns, rng)]
        noise = np.array([POSITION_SIGMA, POSITION_SIGMA, HEADING_SIGMA]) * rng.normal(size=(at_ns.size, 3))
        bodies = se2.compose(run.truth.at(number, at_ns), OFFSET) + noise
        arrivals_ns = arrival_ns(rng, at_ns, CAMERA_LATENESS)
        for stamp_ns, arrived_ns, body in zip(at_ns.tolist(), arrivals_ns.tolist(), bodies, strict=True):
            message = _message(stamp_ns + LATENCY_NS, body)
            (found,) = robots.convert(SOURCES["pose"].bodies(message), name, arrived_ns)
            rows.append((number, found.stamp_ns, found.pose, found.covariance, arrived_ns))
    return in_order_of_arrival([FixRows(*(np.array(column) for column in zip(*rows, strict=True)))])


def _message(stamp_ns: int, body: FloatArray) -> SimpleNamespace:
    """The fields of a geometry_msgs/PoseStamped."""
    seconds, nanoseconds = divmod(stamp_ns, SECOND_NS)
    stamp, half = SimpleNamespace(sec=seconds, nanosec=nanoseconds), 0.5 * body[2]
    position = SimpleNamespace(x=body[0], y=body[1], z=0.1)
    orientation = SimpleNamespace(x=0.0, y=0.0, z=np.sin(half), w=np.cos(half))
    return SimpleNamespace(
        header=SimpleNamespace(frame_id="world", stamp=stamp),
        pose=SimpleNamespace(position=position, orientation=orientation),
    )
