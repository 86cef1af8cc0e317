"""Simulated gyroscopes: true turn rates with white noise, a bias that walks, and a wrong scale."""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_drivers.sim.run import CAMERA_LATENESS, LivedRun, Trajectories, arrival_ns
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.sensors.imu import TurnRateRows
from swarm_loc_estimator.sensors.sensor import in_order_of_arrival
from swarm_loc_estimator.swarm.error_models import ImuModel

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
    return in_order_of_arrival([TurnRateRows(robots, stamps, velocity, np.full(rate.size, np.nan), arrivals)])


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
