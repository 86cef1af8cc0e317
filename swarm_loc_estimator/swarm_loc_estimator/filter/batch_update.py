"""Batch update: many measurements of one period, linearized about one belief and fused at once."""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.common.small_matrix import assign
from swarm_loc_estimator.filter import prediction
from swarm_loc_estimator.filter.belief import BeliefArrays, to_map
from swarm_loc_estimator.filter.innovation import (
    InnovationBatch,
    body_columns,
    evaluate,
    new_scratch,
    relative_motion,
)
from swarm_loc_estimator.filter.integrity import (
    LossLimits,
    assess,
    assess_link,
    confirm,
    count_gated,
    is_excluded,
    is_uncertain,
)
from swarm_loc_estimator.filter.measurement_model import MeasurementColumns, has_kernel
from swarm_loc_estimator.odometry.preintegration import Preintegrated
from swarm_loc_estimator.odometry.track_arrays import TrackArrays, look_up, look_up_pose, new_sample
from swarm_loc_estimator.swarm.calibration_states import CAMERA_SCALE, CAMERA_YAW


@cached_njit
def predict_all(
    measurements: MeasurementColumns,
    stamp_ns: int,
    tracks: TrackArrays,
    belief: BeliefArrays,
    limits: LossLimits,
    batch: InnovationBatch,
    uncertain: BoolArray,
) -> None:
    """Predict every involved robot to one instant, and compute poses at the measurements' stamps.

    Args:
        measurements: (m,) between localized robots.
        stamp_ns: Instant of the prediction.
        tracks: Odometry.
        belief: Updated in place.
        limits: Thresholds beyond which a robot is lost.
        batch: (m,) `pose` and `motion` are written, except the pose of NOBODY.
        uncertain: (N,) written, True for involved robots beyond the thresholds.
    """
    involved, sample = np.zeros(belief.tracked.size, dtype=np.bool_), new_sample(1)
    scratch = prediction.new_scratch()
    for k in range(measurements.stamp_ns.size):
        for robot in (measurements.observer[k], measurements.target[k]):
            if robot >= 0 and not involved[robot]:
                involved[robot] = True
                look_up(tracks, robot, stamp_ns, sample, 0)
                to = Preintegrated(stamp_ns, sample.covariance[0], sample.jacobian[0])
                prediction.predict(belief, robot, to, scratch)
    for k in range(measurements.stamp_ns.size):
        _write_poses(measurements, k, tracks, belief, limits, batch, uncertain)


@inlined_njit
def _write_poses(
    measurements: MeasurementColumns,
    k: int,
    tracks: TrackArrays,
    belief: BeliefArrays,
    limits: LossLimits,
    batch: InnovationBatch,
    uncertain: BoolArray,
) -> None:
    """Write the row of measurement k for `predict_all`, from the predicted belief."""
    sides = (measurements.observer[k], measurements.target[k])
    for i in range(2):
        if sides[i] >= 0:
            pose = batch.pose[k, i]
            if _is_of_same_image(measurements, k, i):
                assign(pose, batch.pose[k - 1, i])
                continue
            look_up_pose(tracks, sides[i], measurements.stamp_ns[k], pose)
            to_map(belief, sides[i], pose)
            uncertain[sides[i]] |= is_uncertain(belief, sides[i], pose, limits)
    if measurements.landmark[k] > 0:
        assign(batch.pose[k, 1], belief.landmark[measurements.landmark[k] - 1])
    relative_motion(measurements, k, tracks, belief, batch.pose[k], batch.motion[k])


@inlined_njit
def _is_of_same_image(measurements: MeasurementColumns, k: int, side: int) -> bool:
    """Whether measurement k - 1 has the same observer and stamp, so that its look-up can be reused."""
    if side != 0 or k == 0 or measurements.observer[k] != measurements.observer[k - 1]:
        return False
    same: bool = measurements.stamp_ns[k] == measurements.stamp_ns[k - 1]
    return same


@cached_njit
def related_columns(measurements: MeasurementColumns, belief: BeliefArrays) -> IntArray:
    """First filter columns (m, 3) of observers, targets and observers' cameras; -1: none."""
    columns = np.empty((measurements.stamp_ns.size, 3), dtype=np.int64)
    for k in range(columns.shape[0]):
        columns[k, 0], columns[k, 1] = body_columns(measurements, k, belief)
        columns[k, 2] = -1
        for m in (CAMERA_YAW, CAMERA_SCALE):
            column = belief.table.column[max(measurements.observer[k], 0), m]
            if measurements.observer[k] >= 0 and column >= 0:
                columns[k, 2] = column - (m - CAMERA_YAW)
    return columns


@cached_njit
def evaluate_all(measurements: MeasurementColumns, belief: BeliefArrays, batch: InnovationBatch) -> None:
    """Evaluate the innovations of all measurements (m,) that have a kernel, at one belief."""
    scratch = new_scratch()
    for k in range(measurements.stamp_ns.size):
        if has_kernel(measurements, k):
            evaluate(measurements, k, belief, batch, k, scratch)


@cached_njit
def assess_all(
    measurements: MeasurementColumns,
    belief: BeliefArrays,
    limits: LossLimits,
    batch: InnovationBatch,
) -> BoolArray:
    """Run fault detection on measurements (m,); return contradicted robots and landmarks (N + L,).

    Measurements of excluded pairs are rejected.
    """
    accepted = batch.accepted
    contradicted = np.zeros(belief.integrity.fault_score.size, dtype=np.bool_)
    for k in range(accepted.size):
        pair, distance = (batch.whitened[k, 0], batch.whitened[k, 1]), batch.distance[k]
        if has_kernel(measurements, k):
            source = assess(measurements, k, belief, limits.max_fault_score, distance, pair, batch.cause[k])
            if source >= 0:
                contradicted[source] = True
        else:
            batch.noise[k] *= assess_link(measurements, k, belief, distance, pair[0])
        accepted[k] &= not is_excluded(measurements, k, belief)
    return contradicted


@cached_njit
def confirm_all(measurements: MeasurementColumns, belief: BeliefArrays, accepted: BoolArray) -> BoolArray:
    """Confirm initial poses by measurements (m,); return robots (N,) whose initial pose is refuted.

    Measurements of models without a kernel can confirm a pose, but not refute it.
    """
    lost = np.zeros(belief.tracked.size, dtype=np.bool_)
    for k in range(accepted.size):
        if accepted[k] or has_kernel(measurements, k):
            robot = confirm(measurements, k, belief, accepted[k])
            if robot >= 0:
                lost[robot] = True
    return lost


@cached_njit
def count_all_gated(
    measurements: MeasurementColumns, belief: BeliefArrays, accepted: BoolArray, limits: LossLimits
) -> BoolArray:
    """Count gated measurements (m,); return robots (N,) that exceed the maximum number in a row."""
    lost = np.zeros(belief.tracked.size, dtype=np.bool_)
    for k in range(accepted.size):
        robot = count_gated(measurements, k, belief, accepted[k], limits)
        if robot >= 0:
            lost[robot] = True
    return lost
