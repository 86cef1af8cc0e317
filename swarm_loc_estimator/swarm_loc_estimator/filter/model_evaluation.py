"""Evaluation of measurements whose models have no compiled kernel.

Such a measurement is gated with the degrees of freedom of its model. When accepted it confirms the poses of
its robots; when gated it counts towards their loss (`filter/integrity.py`), but does not refute a
configured start. A contradiction is evidence against its pair of observer and source, never against one of
them (`filter/integrity.py`). It takes no part in the noise inflation of robots or in the mean of
repeated measurements (`correlated_noise.py`): these need positions and headings.
"""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.filter.belief import BeliefArrays
from swarm_loc_estimator.filter.innovation import InnovationBatch
from swarm_loc_estimator.filter.joint_filter import JointFilter
from swarm_loc_estimator.filter.measurement_model import MODELS, POLAR, MeasurementArray
from swarm_loc_estimator.odometry.track_arrays import TrackArrays, rate_at

_BODY: IntArray = np.arange(3)


def evaluate_by_records(
    measurements: MeasurementArray,
    tracks: TrackArrays,
    belief: BeliefArrays,
    joint: JointFilter,
    batch: InnovationBatch,
) -> None:
    """Evaluate those measurements (m,) whose models have no kernel; `evaluate_all` does the others.

    Args:
        measurements: (m,) between localized robots.
        tracks: Odometry.
        belief: Predicted belief.
        joint: Its filter, prepared for an update with these measurements.
        batch: (m,) input: `pose` and, for a sparse filter, `cross_covariance`; output: the other fields.
    """
    for k in np.flatnonzero(measurements["kind"] > POLAR).tolist():
        _evaluate(measurements[k : k + 1], k, tracks, belief, joint, batch)


def _evaluate(
    one: MeasurementArray,
    k: int,
    tracks: TrackArrays,
    belief: BeliefArrays,
    joint: JointFilter,
    batch: InnovationBatch,
) -> None:
    """Write row k of a batch; missing components get zero rows and unit noise."""
    model, stamp_ns = MODELS[int(one["kind"][0])], int(one["stamp_ns"][0])
    predicted = model.predict(one, batch.pose[k, 0], batch.pose[k, 1])
    count, sides = predicted.value.size, (int(one["observer"][0]), int(one["target"][0]))
    columns = _columns(one, belief)
    batch.columns[k], batch.jacobian[k], batch.innovation[k] = 0, 0.0, 0.0
    batch.noise[k], batch.pair[k] = np.eye(3), 0.0
    noise, slope = one["covariance"][0, :count, :count].copy(), np.zeros(count)
    for i, jacobian in enumerate((predicted.observer_jacobian, predicted.target_jacobian)):
        if columns[i] >= 0:
            body = slice(3 * i, 3 * i + 3)
            batch.columns[k, body], batch.jacobian[k, :count, body] = columns[i] + _BODY, jacobian
        if sides[i] >= 0:
            slope += jacobian @ _motion(tracks, sides[i], stamp_ns, batch.pose[k, i])
    noise += one["stamp_variance"][0] * np.outer(slope, slope)
    jacobian = batch.jacobian[k, :count, :6]
    s = jacobian @ _covariance(columns, belief, joint, batch.cross_covariance[k]) @ jacobian.T + noise
    innovation = model.innovation(one, predicted.value)
    gated = slice(model.degrees_of_freedom)
    batch.noise[k, :count, :count], batch.innovation[k, :count] = noise, innovation
    batch.whitened[k], batch.cause[k] = 0.0, 0
    if np.isfinite(s).all() and np.isfinite(innovation).all() and np.isfinite(jacobian).all():
        batch.distance[k] = innovation[gated] @ np.linalg.solve(s[gated, gated], innovation[gated])
        batch.accepted[k] = batch.distance[k] <= one["gate"][0]
        batch.nis[k] = innovation @ np.linalg.solve(s, innovation)
        batch.whitened[k, 0] = innovation[0] / np.sqrt(s[0, 0])
    else:  # the model has failed at these poses
        batch.jacobian[k], batch.innovation[k], batch.noise[k] = 0.0, 0.0, np.eye(3)
        batch.distance[k], batch.nis[k], batch.accepted[k] = np.inf, np.nan, False


def _columns(one: MeasurementArray, belief: BeliefArrays) -> tuple[int, int]:
    """First filter columns of observer and target of a measurement (1,); -1: none."""
    observer, target, landmark = (int(one[name][0]) for name in ("observer", "target", "landmark"))
    first = 3 * target if target >= 0 else -1
    if landmark > 0:
        first = int(belief.table.survey_column[landmark - 1])
    return (3 * observer if observer >= 0 else -1), first


def _covariance(
    columns: tuple[int, int], belief: BeliefArrays, joint: JointFilter, cross_covariance: FloatArray
) -> FloatArray:
    """Covariance (6, 6) of the errors of observer and target; zero for a side without columns."""
    covariance = np.zeros((6, 6))
    for i, first in enumerate(columns):
        if first >= 0:
            covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = joint.block(first + _BODY)
    if min(columns) >= 0:
        o, t = columns
        shared = belief.covariance[o : o + 3, t : t + 3] if joint.is_dense else cross_covariance[:, :3]
        covariance[:3, 3:], covariance[3:, :3] = shared, shared.T
    return covariance


def _motion(tracks: TrackArrays, robot: int, stamp_ns: int, pose: FloatArray) -> FloatArray:
    """Right-invariant velocity twist (3,) of a robot at a pose (3,) in `map` [1/s]."""
    forward, left, turn = rate_at(tracks, robot, stamp_ns)
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return np.array(
        [
            cos * forward - sin * left + turn * pose[1],
            sin * forward + cos * left - turn * pose[0],
            turn,
        ]
    )
