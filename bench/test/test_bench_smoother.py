"""The offline smoother: its factors' Jacobians, and that knowing the future helps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from calibration_world import World, record, robot

from bench.mrclam.jobs import Job, smoothed
from swarm_loc_estimator.filter.measurements import Measurements
from swarm_loc_estimator.filter.models import POLAR
from swarm_loc_estimator.offline.calibration.models import with_noise
from swarm_loc_estimator.offline.calibration.recording import rerun, started_at_truth
from swarm_loc_estimator.offline.metrics import pool, summarise
from swarm_loc_estimator.swarm.swarm import Robot

gtsam = pytest.importorskip("gtsam", exc_type=ImportError)
smoother = pytest.importorskip("bench.mrclam.smoother", exc_type=ImportError)

NOISE = {
    "range_sigma": 0.001,
    "range_sigma_per_m": 0.005,
    "bearing_sigma": 0.005,
    "turn_drift": 0.03**2,
    "wheel_noise": 1e-6,
}
"""As the world errs."""


def sighting() -> Measurements:
    """Robot 0 sees robot 1."""
    one = Measurements.empty(1)
    one.observer[:], one.target[:], one.model[:] = 0, 1, POLAR
    one.sensor[:], one.marker[:] = [0.1, -0.05, 0.2], [0.02, 0.03, 0.0]
    one.value[:] = [1.8, 0.4, 0.0]
    return one


def test_jacobians_are_those_of_finite_differences() -> None:
    values = gtsam.Values()
    values.insert(0, gtsam.Pose2(1.0, 2.0, 0.5))
    values.insert(1, gtsam.Pose2(2.5, 2.8, -0.7))
    values.insert(2, np.array([0.01]))
    moved = values.atPose2(0).between(values.atPose2(1))
    drift = np.array([0.01, 0.02, 1.0])
    unit = gtsam.noiseModel.Unit.Create
    factors = [
        gtsam.CustomFactor(unit(2), [0, 1], smoother._Sighting(sighting(), 0, 2)),
        gtsam.CustomFactor(unit(3), [0, 1, 2], smoother._Drifting(moved, drift)),
        gtsam.CustomFactor(unit(1), [2, 2], smoother._Fading(0.9)),
    ]
    for factor in factors[:2]:
        jacobian, _ = factor.linearize(values).jacobian()
        np.testing.assert_allclose(jacobian, differences(factor, values), atol=1e-6)
    assert factors[2].unwhitenedError(values)[0] == pytest.approx(0.1 * 0.01)


def differences(factor: Any, values: Any) -> np.ndarray:
    """Jacobian of the error by the values, each in its own frame."""
    columns, sizes = [], {0: 3, 1: 3, 2: 1}
    for key in factor.keys():  # noqa: SIM118 # a method of gtsam
        for place in range(sizes[key]):
            errors = []
            for step in (1e-6, -1e-6):
                delta = gtsam.VectorValues()
                for other, size in sizes.items():
                    delta.insert(other, step * np.eye(size)[place] if other == key else np.zeros(size))
                errors.append(factor.unwhitenedError(values.retract(delta)))
            columns.append((errors[0] - errors[1]) / 2e-6)
    return np.column_stack(columns)


def test_a_system_without_a_solution_fails_with_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    recording, swarm = record(World((robot(1, Robot("r")),), 3, duration_s=10.0))
    swarm = with_noise(started_at_truth(swarm, recording), NOISE)
    monkeypatch.setattr(smoother, "_add_motion", lambda *_: None)  # so nothing ties the poses together
    done = smoothed(Job(6, "plain", "smoother"), recording, swarm)
    assert done.sums is None
    assert done.failure.startswith("gtsam: Indeterminate linear system detected while working near variable")
    assert done.failure.endswith(".")


@pytest.mark.parametrize("bias_sigma", [0.0, 0.01])
def test_who_knows_the_future_errs_less(bias_sigma: float) -> None:
    recording, swarm = record(
        World((robot(1, Robot("r")), robot(2, Robot("r"))), 3, duration_s=60.0, turn_sigma=0.03)
    )
    truth = recording.truth["robot2"]
    sparse = type(truth)(truth.stamp_ns[5::100], truth.pose[5::100])
    recording = replace(recording, truth={**recording.truth, "robot2": sparse})
    swarm = with_noise(started_at_truth(swarm, recording), {**NOISE, "turn_bias_sigma": bias_sigma})
    online = rerun(recording, swarm, 0.1)
    found = smoother.smooth(recording, online)
    filtered, smoothed = (summarise(pool([*errors.values()])) for errors in (online.errors, found))
    assert smoothed.count == filtered.count
    assert smoothed.position_rmse < 0.9 * filtered.position_rmse
    assert smoothed.heading_rmse < 0.9 * filtered.heading_rmse
    assert 2.0 < smoothed.nees < 4.5
