"""Sequential update: predict two robots, evaluate one innovation and update, for each measurement."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.small_matrix import assign
from swarm_loc_estimator.filter import prediction
from swarm_loc_estimator.filter.belief import BeliefArrays, correct, to_map
from swarm_loc_estimator.filter.correlated_noise import count_repeated, record_pair
from swarm_loc_estimator.filter.innovation import evaluate, new_batch, new_scratch, relative_motion
from swarm_loc_estimator.filter.integrity import (
    LossLimits,
    assess,
    confirm,
    count_gated,
    is_excluded,
    is_uncertain,
)
from swarm_loc_estimator.filter.joint_filter import update_one
from swarm_loc_estimator.filter.measurement_model import MeasurementColumns, has_kernel, locates_alone
from swarm_loc_estimator.filter.prediction import learn
from swarm_loc_estimator.odometry.preintegration import Preintegrated
from swarm_loc_estimator.odometry.track_arrays import TrackArrays, look_up, new_sample

OPEN, USED, GATED = 0, 1, 2  # Verdicts, see `fusion.Verdict`

FINISHED, LEFT_OUT, LOST, CONTRADICTED = 0, 1, 2, 3
"""Reasons to return from `update_in_order`: all fused; a command, a model without a kernel or a measurement
of a robot that is not localized; a robot is lost; a robot or landmark is contradicted."""


@cached_njit
def update_in_order(
    measurements: MeasurementColumns,
    begin: int,
    tracks: TrackArrays,
    belief: BeliefArrays,
    limits: LossLimits,
    verdicts: NDArray[np.uint8],
    nis: FloatArray,
) -> tuple[int, int, int]:
    """Fuse measurements sequentially, each at its exact stamp, linearized about the newest belief.

    Args:
        measurements: (m,) sorted by stamp.
        begin: Index of the first measurement to fuse.
        tracks: Odometry.
        belief: Updated in place.
        limits: Thresholds beyond which a robot is lost.
        verdicts: (m,) written.
        nis: (m,) normalized innovation squared, written.

    Returns:
        Index of the first measurement not processed, the reason, and the robot or landmark concerned. A fix
        that locates alone the robot that is lost by it is processed again.
    """
    batch, sample, scratch, room = new_batch(1), new_sample(2), new_scratch(), prediction.new_scratch()
    pose = batch.pose[0]
    for k in range(begin, measurements.stamp_ns.size):
        sides = (measurements.observer[k], measurements.target[k])
        for side in sides:
            if not has_kernel(measurements, k) or (side >= 0 and not belief.tracked[side]):
                return k, LEFT_OUT, -1
        for i in range(2):
            if sides[i] >= 0:
                look_up(tracks, sides[i], measurements.stamp_ns[k], sample, i)
                to = Preintegrated(measurements.stamp_ns[k], sample.covariance[i], sample.jacobian[i])
                prediction.predict(belief, sides[i], to, room)
                assign(pose[i], sample.pose[i])
                to_map(belief, sides[i], pose[i])
                if is_uncertain(belief, sides[i], pose[i], limits):
                    return k, LOST, sides[i]
        if measurements.landmark[k] > 0:
            assign(pose[1], belief.landmark[measurements.landmark[k] - 1])
        relative_motion(measurements, k, tracks, belief, pose, batch.motion[0])
        evaluate(measurements, k, belief, batch, 0, scratch)
        whitened = (batch.whitened[0, 0], batch.whitened[0, 1])
        contradicted = assess(
            measurements, k, belief, limits.max_fault_score, batch.distance[0], whitened, batch.cause[0]
        )
        if contradicted >= 0:
            return k, CONTRADICTED, contradicted
        accepted, nis[k] = batch.accepted[0] and not is_excluded(measurements, k, belief), batch.nis[0]
        verdicts[k] = USED if accepted else GATED
        following = k if locates_alone(measurements, k) and not accepted else k + 1
        contradicted = confirm(measurements, k, belief, accepted)
        if contradicted >= 0:
            return following, LOST, contradicted
        if accepted:
            noise, jacobian = batch.noise[0], batch.jacobian[0]
            record_pair(measurements, k, belief, batch.pair[0])
            columns = batch.columns[0]
            correction, gain = update_one(belief.covariance, columns, jacobian, batch.innovation[0], noise)
            count_repeated(measurements, k, belief, scratch.predicted, gain[:, columns[:6]], jacobian, noise)
            correct(belief, correction)
            for i in range(2):
                learn(belief, sides[i], pose[i], measurements.stamp_ns[k])
        lost = count_gated(measurements, k, belief, accepted, limits)
        if lost >= 0:
            return following, LOST, lost
    return measurements.stamp_ns.size, FINISHED, -1
