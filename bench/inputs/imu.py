"""Gyroscopes and twist-only odometry: heading after a minute without any sighting, positions by twists.

Five simulated e-pucks drive the eight for two minutes; their wheels slip ten times as much as those of the
other benchmarks. All cameras are covered for the second minute.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from bench.inputs.gyro import simulate_gyroscopes
from bench.integrity.faults import twist_only, with_twists
from bench.integrity.scenarios import CLEAN
from bench.shared.common import ProgressLine, new_plot, save_plot
from bench.shared.simulated_run import errors_of, inputs_between, mean_nees, position_rmse
from swarm_loc_drivers.sim.run import SimulatedRun
from swarm_loc_drivers.sim.scenarios.eight import EightSettings, simulate_eight
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.offline.metrics import is_misleading
from swarm_loc_estimator.sensors.imu import TurnRateRows
from swarm_loc_estimator.sensors.registry import Batch
from swarm_loc_estimator.sensors.sensor import chosen
from swarm_loc_estimator.swarm.error_models import ImuModel
from swarm_loc_estimator.timeline.estimator import Estimator

IMU = ImuModel(turn_noise_density=3e-4, turn_scale_sigma=0.005, turn_bias_sigma=0.01)
"""A cheap MEMS gyroscope, three times as noisy as the data sheet of an MPU-6050 says (0.005 deg/s/Hz^0.5)."""
WHEEL_NOISE = 10.0 * CLEAN.wheel_noise
BLIND_S, END_S, TICK_NS = 60.0, 120.0, 100_000_000
LATE_S = (0.15, 0.3)


def measure(seeds: Sequence[int], say: ProgressLine) -> Mapping[str, float]:
    """Heading errors at the end of a blind minute with and without gyroscopes, and positions by twists."""
    found: dict[str, list[tuple[FloatArray, FloatArray]]] = {
        "with": [],
        "without": [],
        "pose": [],
        "twist": [],
    }
    for seed in seeds:
        for name, runs in found.items():
            say(f"seed {seed}, {name}")
            runs.append(
                _blind(seed, name == "with") if name.startswith("with") else _short(seed, name == "twist")
            )
    figures: dict[str, float] = {}
    for name in ("with", "without"):
        last = [(error[-10:], covariance[-10:]) for error, covariance in found[name]]
        prefix = f"imu.blind60s.{name}_gyro"
        figures[f"{prefix}.heading_deg"] = math.degrees(_rms([error[..., 2] for error, _ in last]))
        figures[f"{prefix}.position_cm"] = 100.0 * position_rmse(np.stack([error for error, _ in last]))
        figures[f"{prefix}.nees"] = float(np.mean([mean_nees(*one) for one in last]))
        wrong = [
            is_misleading(error.reshape(-1, 3), covariance.reshape(-1, 3, 3)).mean()
            for error, covariance in found[name]
        ]
        figures[f"{prefix}.misleading_share"] = float(np.mean(wrong))
    figures["imu.blind60s.heading_deg"] = figures["imu.blind60s.with_gyro.heading_deg"]
    rmse = {name: position_rmse(np.stack([error for error, _ in found[name]])) for name in ("pose", "twist")}
    figures["twist_only.position_ratio_to_pose"] = rmse["twist"] / rmse["pose"]
    figures["twist_only.nees"] = float(np.mean([mean_nees(*one) for one in found["twist"]]))
    _plot(found)
    return figures


def _blind(seed: int, has_gyro: bool) -> tuple[FloatArray, FloatArray]:
    """Errors (T, N, 3) and covariances of a run without sightings in its second minute."""
    run = simulate_eight(
        EightSettings(seed=seed, duration_s=END_S, errors=replace(CLEAN, wheel_noise=WHEEL_NOISE))
    )
    blind = np.repeat(run.frames["stamp_ns"] >= run.start_ns + round(1e9 * BLIND_S), run.frames["count"])
    robots = tuple(
        replace(
            robot,
            odometry=replace(robot.odometry, wheel_noise=WHEEL_NOISE),
            imu=IMU if has_gyro else robot.imu,
        )
        for robot in run.swarm.robots
    )
    run = replace(run.masked(~blind), swarm=replace(run.swarm, robots=robots))
    rates = simulate_gyroscopes(np.random.default_rng([seed, 9]), run, IMU, LATE_S) if has_gyro else None
    return _estimate(run, rates)


def _short(seed: int, by_twist: bool) -> tuple[FloatArray, FloatArray]:
    """The same of a minute with sightings, by poses of the wheels or by their twists alone."""
    run = with_twists(simulate_eight(EightSettings(seed=seed, duration_s=BLIND_S, errors=CLEAN)))
    for robot in range(len(run.swarm.robots) if by_twist else 0):
        run = twist_only(run, robot)
    error, covariance = _estimate(run, None)
    return error[50:], covariance[50:]  # a constant pose is noticed within seconds


def _estimate(run: SimulatedRun, rates: TurnRateRows | None) -> tuple[FloatArray, FloatArray]:
    tick_ns = np.arange(run.start_ns + 10 * TICK_NS, run.end_ns + 1, TICK_NS)
    estimator, estimates = Estimator(run.swarm), []
    for k, (now_ns, batch) in enumerate(zip(tick_ns.tolist(), inputs_between(run, tick_ns), strict=True)):
        estimator.receive(batch if rates is None else _with_rates(batch, rates, tick_ns, k))
        estimates.append(estimator.tick(now_ns))
    error = errors_of(np.array([one.poses for one in estimates]), run, tick_ns)
    return error, np.array([one.covariances for one in estimates])


def _with_rates(batch: Batch, rates: TurnRateRows, tick_ns: IntArray, k: int) -> Batch:
    """A batch with the turn rates that arrived since the tick before."""
    begin_ns = tick_ns[k - 1] if k else 0
    begin, end = np.searchsorted(rates.arrival_ns, [begin_ns, tick_ns[k]], side="right").tolist()
    return replace(batch, rows={**batch.rows, "imu": chosen(rates, slice(begin, end))})


def _rms(parts: Sequence[FloatArray]) -> float:
    return float(np.sqrt(np.mean(np.square(np.concatenate([part.ravel() for part in parts])))))


def _plot(found: Mapping[str, Sequence[tuple[FloatArray, FloatArray]]]) -> None:
    figure, (axis,) = new_plot(1, width=7.0)
    for name, colour in (("without", "tab:orange"), ("with", "tab:blue")):
        error = np.degrees(np.abs(np.concatenate([one[..., 2] for one, _ in found[name]], axis=1)))
        sigma = np.degrees(np.sqrt(np.concatenate([one[..., 2, 2] for _, one in found[name]], axis=1)))
        time_s = 1.0 + 0.1 * np.arange(len(error))
        axis.plot(time_s, error, color=colour, linewidth=0.4, alpha=0.4)
        axis.plot(time_s, _quadratic_mean(error), color=colour, label=f"{name} gyroscopes, RMS error")
        axis.plot(time_s, _quadratic_mean(sigma), color=colour, linestyle=":", label="... reported sigma")
    axis.axvline(BLIND_S, color="0.5", linewidth=0.8)
    axis.set(xlabel="time [s]", ylabel="heading error [deg]", yscale="log", ylim=(0.05, 60.0))
    axis.set_title("no sightings in the second minute", loc="left")
    axis.legend(fontsize=8)
    save_plot(figure, "inputs-imu")


def _quadratic_mean(rows: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(np.square(rows), axis=1)))
