"""Gyroscopes and twist-only odometry: heading after a minute without any sighting, positions by twists.

Five simulated e-pucks drive the eight for two minutes; the variance of their wheels' slip is ten times that
of the other benchmarks. All cameras are covered for the second minute. Twists are measured in a minute with
the usual slip and all sightings.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from bench.integrity.faults import CLEAN, twist_only, with_twists
from bench.scenarios.eight_run import EightSettings, simulate_eight
from bench.scenarios.lived_run import CAMERA_LATENESS, LivedRun, SimulatedRun, arrival_ns
from bench.shared.common import ProgressLine, plot_curves, rms
from bench.shared.simulated_run import errors_of, estimates_of, inputs_of, mean_nees, position_rmse, ticks
from swarm_loc_drivers.sim.run import Trajectories
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.offline.metrics import is_misleading
from swarm_loc_estimator.sensors.imu import TurnRateRows
from swarm_loc_estimator.sensors.sensor import in_order_of_arrival
from swarm_loc_estimator.swarm.error_models import ImuModel

IMU = ImuModel(turn_noise_density=3e-4, turn_scale_sigma=0.005, turn_bias_sigma=0.01)
"""A cheap MEMS gyroscope, three times as noisy as the data sheet of an MPU-6050 says (0.005 deg/s/Hz^0.5)."""
WHEEL_NOISE = 10.0 * CLEAN.wheel_noise
BLIND_S, END_S = 60.0, 120.0


def measure(seeds: Sequence[int], say: ProgressLine) -> Mapping[str, float]:
    """Heading errors at the end of a blind minute with and without gyroscopes, and positions by twists."""
    found: dict[str, list[tuple[FloatArray, FloatArray]]] = {
        name: [] for name in ("with", "without", "pose", "twist")
    }
    # estimate with and without gyroscopes, by poses and by twists
    for seed in seeds:
        say(f"seed {seed}")
        blind = _blind(seed)
        rates = simulate_gyroscopes(np.random.default_rng([seed, 9]), blind, IMU)
        found["without"].append(_estimate(blind))
        found["with"].append(_estimate(with_imus(blind), imu=rates))
        run = with_twists(simulate_eight(EightSettings(seed=seed, duration_s=BLIND_S, errors=CLEAN)))
        found["pose"].append(_settled(_estimate(run)))
        for robot in range(len(run.swarm.robots)):
            run = twist_only(run, robot)
        found["twist"].append(_settled(_estimate(run)))
    # errors at the end, and misleading poses
    figures: dict[str, float] = {}
    for name in ("with", "without"):
        last = [(error[-10:], covariance[-10:]) for error, covariance in found[name]]
        prefix = f"imu.blind60s.{name}_gyro"
        figures[f"{prefix}.heading_deg"] = math.degrees(rms([error[..., 2] for error, _ in last]))
        figures[f"{prefix}.position_cm"] = 100.0 * position_rmse(np.stack([error for error, _ in last]))
        figures[f"{prefix}.nees"] = float(np.mean([mean_nees(*one) for one in last]))
        wrong = [
            is_misleading(error.reshape(-1, 3), covariance.reshape(-1, 3, 3)).mean()
            for error, covariance in found[name]
        ]
        figures[f"{prefix}.misleading_share"] = float(np.mean(wrong))
    figures["imu.blind60s.heading_deg"] = figures["imu.blind60s.with_gyro.heading_deg"]
    pose, twist = (position_rmse(np.stack([error for error, _ in found[name]])) for name in ("pose", "twist"))
    figures["twist_only.position_ratio_to_pose"] = twist / pose
    figures["twist_only.nees"] = float(np.mean([mean_nees(*one) for one in found["twist"]]))
    shown = {}
    for name in ("without", "with"):
        error = np.concatenate([one[..., 2] for one, _ in found[name]], axis=1)
        sigma = np.sqrt(np.concatenate([one[..., 2, 2] for _, one in found[name]], axis=1))
        shown[f"{name} gyroscopes, RMS error"] = np.degrees(np.sqrt(np.mean(error**2, axis=1)))
        shown[f"{name} gyroscopes, reported sigma"] = np.degrees(np.sqrt(np.mean(sigma**2, axis=1)))
    time_s = 1.0 + 0.1 * np.arange(len(error))
    plot_curves("inputs-imu", ("time [s]", "heading error [deg]", time_s, shown), yscale="log")
    return figures


def _blind(seed: int) -> SimulatedRun:
    """A run without sightings in its second minute."""
    errors = replace(CLEAN, wheel_noise=WHEEL_NOISE)
    run = simulate_eight(EightSettings(seed=seed, duration_s=END_S, errors=errors))
    blind = np.repeat(run.frames["stamp_ns"] >= run.start_ns + round(1e9 * BLIND_S), run.frames["count"])
    return run.masked(~blind)


def with_imus(run: SimulatedRun) -> SimulatedRun:
    """The run with an IMU on each robot."""
    robots = tuple(replace(robot, imu=IMU) for robot in run.swarm.robots)
    return replace(run, swarm=replace(run.swarm, robots=robots))


def _settled(estimated: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """The same from the sixth second on: a constant pose is noticed within seconds."""
    return estimated[0][50:], estimated[1][50:]


def _estimate(run: SimulatedRun, **rates: TurnRateRows) -> tuple[FloatArray, FloatArray]:
    """Errors (T, N, 3) and covariances at all ticks from the first second on."""
    tick_ns = ticks(run)[9:]
    estimates = [one for one, _ in estimates_of(run.swarm, inputs_of(run, tick_ns, **rates), tick_ns)]
    error = errors_of(np.array([one.poses for one in estimates]), run, tick_ns)
    return error, np.array([one.covariances for one in estimates])


RATE_HZ = 50.0  # Rate of the messages of an IMU


def simulate_gyroscopes(rng: np.random.Generator, run: LivedRun, imu: ImuModel) -> TurnRateRows:
    """Readings of an IMU on each robot, with bias and scale drawn from their sigmas, in order of arrival.

    Args:
        rng: Draws errors and delays.
        run: Gives the true motion.
        imu: Error model of all robots.
    """
    stamp_ns = np.arange(run.start_ns, run.end_ns, round(1e9 / RATE_HZ))
    parts = [_readings(rng, run.truth, robot, stamp_ns, imu) for robot in range(len(run.swarm.robots))]
    robots = np.repeat(np.arange(len(parts)), stamp_ns.size)
    stamps, rate = np.tile(stamp_ns, len(parts)), np.concatenate(parts)
    arrivals = arrival_ns(rng, stamps, CAMERA_LATENESS)
    velocity = np.column_stack([np.zeros((rate.size, 2)), rate])
    unknown = np.full(velocity.shape, np.nan)
    rows = TurnRateRows(robots, stamps, velocity, unknown[:, 0], unknown, arrivals)
    return in_order_of_arrival([rows])


def _readings(
    rng: np.random.Generator, truth: Trajectories, robot: int, stamp_ns: IntArray, imu: ImuModel
) -> FloatArray:
    """Turn rates (k,) that the IMU of one robot measures, each the mean over its period."""
    period_s = 1.0 / RATE_HZ
    heading = truth.at(robot, stamp_ns)[:, 2]
    turn = np.gradient(np.unwrap(heading), period_s)
    # a Gauss-Markov bias, in its stationary distribution
    kept = math.exp(-period_s / imu.turn_bias_time_s)
    bias, step = np.empty(stamp_ns.size), imu.turn_bias_sigma * math.sqrt(1.0 - kept**2)
    bias[0] = imu.turn_bias_sigma * rng.standard_normal()
    for k, noise in enumerate(step * rng.standard_normal(stamp_ns.size - 1)):
        bias[k + 1] = kept * bias[k] + noise
    white = imu.turn_noise_density * math.sqrt(RATE_HZ) * rng.standard_normal(stamp_ns.size)
    scale = imu.turn_scale * (1.0 + imu.turn_scale_sigma * rng.standard_normal())
    measured: FloatArray = (turn - bias - imu.turn_bias) / scale + white
    return measured
