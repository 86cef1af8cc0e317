"""The update: measurements correct the belief, in order or together, by one sequence of seven stages.

1. Predict both sides to the stamp of the measurement.
2. Innovation: measured minus predicted, linearized about the belief (eqs. (11) and (13) of the e-puck paper).
3. Of two mirrored solutions, use the likelier one; gate it; a heading that may be flipped counts less.
4. Attribute an outlier: to one of the sources that it links, or to their link, which may be excluded.
5. Confirm a pose that was assumed, or refute it.
6. Correct poses, parameters, landmarks and cameras (eqs. (11), (12) and (14)).
7. Count gated measurements; a robot with too many in a row is lost.

In order, each measurement passes all stages before the next one, at its exact stamp. Together, the stages
take many measurements of a period, linearized about one belief; a large swarm is cheaper so.

`fuse` is compiled. Where it needs what is not, it pauses, and is resumed at the next stage. Links, whose
models have no compiled kernel, such as ranges, are evaluated by their records, and gated with the number of
gated components of these. What is accepted confirms the poses of its robots; what is gated refutes no start.
A contradiction is evidence against the link, never against one end.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.common.numerics import assign, assign_matrix
from swarm_loc_estimator.filter import correlated_noise, models, sources
from swarm_loc_estimator.filter.joint_filter import JointFilter, link_covariance, update_one
from swarm_loc_estimator.filter.measurements import LossReason, Measurements, Verdict
from swarm_loc_estimator.filter.prediction import new_scratch, predict
from swarm_loc_estimator.filter.state import (
    BeliefArrays,
    Innovations,
    correct,
    covariance_within,
    own_within,
    to_map,
)
from swarm_loc_estimator.odometry import track_arrays
from swarm_loc_estimator.odometry.preintegration import Preintegrated
from swarm_loc_estimator.swarm.calibration_states import (
    CAMERA_OFFSET,
    CAMERA_SCALE,
    CAMERA_YAW,
    PARAMETERS,
    RADIO_BIAS,
)

_USED, _GATED = int(Verdict.USED), int(Verdict.GATED)
_UNCERTAIN, _REFUTED = int(LossReason.UNCERTAIN), int(LossReason.REFUTED)
PREDICT, EVALUATE, ATTRIBUTE, SETTLE = 1, 2, 4, 7  # Stages at which `fuse` is begun or resumed
FINISHED, LEFT_OUT, LOST, CONTRADICTED = 0, 1, 2, 3
"""Why `fuse` returns: all is fused; a measurement of a robot that is not localized; a robot is lost; a robot
or landmark is contradicted."""
PREDICTED, IS_LINK, CORRECTS = 4, 5, 6
"""Why it pauses: sides are predicted; links are to be evaluated by their records; the joint filter is to
correct. It is resumed at EVALUATE, ATTRIBUTE and SETTLE."""


@cached_njit
def fuse(
    measurements: Measurements,
    begin: int,
    stage: int,
    together: bool,
    tracks: track_arrays.TrackArrays,
    belief: BeliefArrays,
    limits: sources.LossLimits,
    work: Innovations,
    verdicts: NDArray[np.uint8],
    nis: FloatArray,
) -> tuple[int, int, int, int]:
    """Fuse measurements (m,), sorted by stamp, from `begin` and a stage on; see the module.

    They are fused one by one, or `together`, where all are between localized robots. `work` has one row, or
    one for each measurement; `lost` and `contradicted` are for the latter. The belief, verdicts (m,) and
    normalized innovations squared (m,) are written.

    Returns:
        Index of the measurement at which it returns, why, the robot or landmark concerned, and why a robot is
        lost (`LossReason`).
    """
    sample, scratch = track_arrays.new_sample(2), new_scratch()
    k = begin
    while k < measurements.stamp_ns.size:
        end = measurements.stamp_ns.size if together else k + 1
        if stage <= PREDICT:
            # 1. Predict both sides to the stamp.
            if together:
                _predict_together(measurements, tracks, belief, limits, work, sample, scratch)
                return k, PREDICTED, -1, 0
            for side in (measurements.observer[k], measurements.target[k]):
                if side >= 0 and not belief.tracked[side]:
                    return k, LEFT_OUT, -1, 0
            lost = _predict_one(measurements, k, tracks, belief, limits, work, sample, scratch)
            if lost >= 0:
                return k, LOST, lost, _UNCERTAIN
        if stage <= EVALUATE:
            # 2. Innovation. 3. Gate, second solution, heading.
            links = False
            for i in range(k, end):
                if models.has_kernel(measurements, i):
                    _evaluate(measurements, i, belief, limits, work, i - k)
                else:
                    links = True
            if links:
                return k, IS_LINK, -1, 0
        if stage <= ATTRIBUTE:
            # 4. Attribute outliers; measurements of excluded links are not used.
            for i in range(k, end):
                row = i - k
                whitened = (work.whitened[row, 0], work.whitened[row, 1])
                distance, share, limit = work.distance[row], work.share[row], limits.max_fault_score
                elsewhere = work.elsewhere[row]
                source = sources.assess(measurements, i, belief, limit, distance, whitened, share, elsewhere)
                if source >= 0 and not together:
                    return k, CONTRADICTED, source, 0
                if source >= 0:
                    work.contradicted[source] = True
                if measurements.observer[i] < 0 and measurements.has_heading[i] and work.accepted[row]:
                    sources.assess_direction(belief, measurements.target[i], work.misread[row], share, limit)
                place = sources.find_link(measurements, i, belief)
                if not models.has_kernel(measurements, i) and place >= 0:
                    scale = 1.0 + belief.sources.evidence[sources.robot_of(measurements, i), place]
                    work.noise[row] *= scale
                excluded = sources.is_excluded(measurements, i, belief, limit)
                work.accepted[row] = work.accepted[row] and not excluded
                if sources.is_fix(measurements, i) and not work.accepted[row]:
                    fixes, score = sources.source_of(measurements, i, belief), belief.sources.score
                    if _is_occupied(measurements, i, tracks, belief):
                        score[fixes] = 2.0 * limit
                    # Fixes that are wrong for long, or were sought near the pose, do not refute it.
                    if score[fixes] >= 1.5 * limit or measurements.has_second[i]:
                        work.share[row] = 0.0
                nis[i], verdicts[i] = work.nis[row], _USED if work.accepted[row] else _GATED
            # 5. Confirm assumed poses, or refute them; a link does not refute.
            for i in range(k, end):
                row = i - k
                if work.accepted[row] or models.has_kernel(measurements, i):
                    robot = sources.confirm(measurements, i, belief, work.accepted[row])
                    if robot >= 0 and not together:
                        return k, LOST, robot, _REFUTED
                    if robot >= 0:
                        work.lost[robot] = _REFUTED
            # 6. Correct.
            for i in range(k, end):
                if work.accepted[i - k] and models.has_kernel(measurements, i):
                    correlated_noise.record_pair(measurements, i, belief, work.pair[i - k])
            if together:
                return k, CORRECTS, -1, 0
            if work.accepted[0]:
                columns, jacobian, noise = work.columns[0], work.jacobian[0], work.noise[0]
                before = np.empty((2, 3, 3))  # covariances of observer and target
                for side, robot in enumerate((measurements.observer[k], measurements.target[k])):
                    for i in range(3):
                        for j in range(3):
                            before[side, i, j] = covariance_within(belief, 3 * max(robot, 0), i, j)
                correction = update_one(belief.covariance, columns, jacobian, work.innovation[0], noise)
                correct(belief, correction)
                correlated_noise.note_update(measurements, k, belief, before, correction, work)
        # 7. Count gated measurements.
        for i in range(k, end):
            robot, why = sources.count_gated(
                measurements, i, belief, work.accepted[i - k], work.share[i - k], limits
            )
            if robot >= 0 and not together:
                return k, LOST, robot, why
            if robot >= 0 and work.lost[robot] == 0:
                work.lost[robot] = why
        k, stage = end, PREDICT
    return k, FINISHED, -1, 0


@cached_njit
def _predict_one(
    measurements: Measurements,
    k: int,
    tracks: track_arrays.TrackArrays,
    belief: BeliefArrays,
    limits: sources.LossLimits,
    work: Innovations,
    sample: track_arrays.OdometrySample,
    scratch: FloatArray,
) -> int:
    """Predict the sides of measurement k to its stamp; return a robot that is too uncertain, or -1."""
    pose = work.pose[0]
    sides = (measurements.observer[k], measurements.target[k])
    for i in range(2):
        if sides[i] >= 0:
            track_arrays.look_up(tracks, sides[i], measurements.stamp_ns[k], sample, i)
            to = Preintegrated(measurements.stamp_ns[k], sample.covariance[i], sample.jacobian[i])
            predict(belief, sides[i], to, scratch)
            assign(pose[i], sample.pose[i])
            to_map(belief, sides[i], pose[i])
            drives = not tracks.is_stationary[sides[i]]
            by_axes = i == 0 and measurements.model[k] == models.CARTESIAN
            if sources.is_uncertain(belief, sides[i], pose[i], limits, drives, by_axes):
                lost: int = sides[i]
                return lost
    _write_surveyed(measurements, k, belief, pose)
    relative_motion(measurements, k, tracks, pose, work.motion[0])
    return -1


@cached_njit
def _is_occupied(
    measurements: Measurements, k: int, tracks: track_arrays.TrackArrays, belief: BeliefArrays
) -> bool:
    """Whether fix k puts its robot where another one is: the bodies of a motion capture are exchanged."""
    pose = np.empty(3)
    for robot in range(belief.tracked.size):
        if belief.tracked[robot] and robot != measurements.target[k]:
            track_arrays.look_up_pose(tracks, robot, measurements.stamp_ns[k], pose)
            to_map(belief, robot, pose)
            x, y = pose[0] - measurements.value[k, 0], pose[1] - measurements.value[k, 1]
            if math.hypot(x, y) < sources.OCCUPIED_M:
                return True
    return False


@inlined_njit
def _write_surveyed(measurements: Measurements, k: int, belief: BeliefArrays, pose: FloatArray) -> None:
    """Write corrections of surveyed places to the poses (2, 3) of the sides that are no robots."""
    if measurements.mount[k] >= 0:
        assign(pose[0], belief.landmark[measurements.mount[k]])
    if measurements.landmark[k] >= 0:
        assign(pose[1], belief.landmark[measurements.landmark[k]])


@cached_njit
def _predict_together(
    measurements: Measurements,
    tracks: track_arrays.TrackArrays,
    belief: BeliefArrays,
    limits: sources.LossLimits,
    work: Innovations,
    sample: track_arrays.OdometrySample,
    scratch: FloatArray,
) -> None:
    """Predict every involved robot to its first stamp, and compute poses at the stamps of measurements (m,).

    At a later instant its covariance would be too small: process noise after a measurement would come before
    it. Robots that are too uncertain are marked in `work.lost`.
    """
    involved = np.zeros(belief.tracked.size, dtype=np.bool_)
    for k in range(measurements.stamp_ns.size):
        for robot in (measurements.observer[k], measurements.target[k]):
            if robot >= 0 and not involved[robot]:
                involved[robot], stamp_ns = True, measurements.stamp_ns[k]
                track_arrays.look_up(tracks, robot, stamp_ns, sample, 0)
                to = Preintegrated(stamp_ns, sample.covariance[0], sample.jacobian[0])
                predict(belief, robot, to, scratch)
    for k in range(measurements.stamp_ns.size):
        _write_poses(measurements, k, tracks, belief, limits, work)


@inlined_njit
def _write_poses(
    measurements: Measurements,
    k: int,
    tracks: track_arrays.TrackArrays,
    belief: BeliefArrays,
    limits: sources.LossLimits,
    work: Innovations,
) -> None:
    """Write poses and motion of measurement k, from the predicted belief."""
    sides = (measurements.observer[k], measurements.target[k])
    for i in range(2):
        if sides[i] >= 0:
            pose = work.pose[k, i]
            is_after_another = i == 0 and k > 0 and sides[0] == measurements.observer[k - 1]
            if is_after_another and measurements.stamp_ns[k] == measurements.stamp_ns[k - 1]:  # of one image
                assign(pose, work.pose[k - 1, 0])
                continue
            track_arrays.look_up_pose(tracks, sides[i], measurements.stamp_ns[k], pose)
            to_map(belief, sides[i], pose)
            drives = not tracks.is_stationary[sides[i]]
            by_axes = i == 0 and measurements.model[k] == models.CARTESIAN
            if sources.is_uncertain(belief, sides[i], pose, limits, drives, by_axes):
                work.lost[sides[i]] = _UNCERTAIN
    _write_surveyed(measurements, k, belief, work.pose[k])
    relative_motion(measurements, k, tracks, work.pose[k], work.motion[k])


@cached_njit
def related_columns(measurements: Measurements, belief: BeliefArrays) -> IntArray:
    """First filter columns (m, 3) of observers, targets and observers' cameras or radios; -1: none."""
    columns = np.empty((measurements.stamp_ns.size, 3), dtype=np.int64)
    for k in range(columns.shape[0]):
        columns[k, 0], columns[k, 1] = body_columns(measurements, k, belief)
        columns[k, 2] = -1
        camera = models.has_kernel(measurements, k)
        for m in range(CAMERA_YAW if camera else RADIO_BIAS, RADIO_BIAS if camera else PARAMETERS):
            column = belief.table.column[max(measurements.observer[k], 0), m]
            if measurements.observer[k] >= 0 and column >= 0:
                columns[k, 2] = column - (m - (CAMERA_YAW if camera else RADIO_BIAS))
    return columns


@inlined_njit
def _evaluate(
    measurements: Measurements,
    k: int,
    belief: BeliefArrays,
    limits: sources.LossLimits,
    work: Innovations,
    row: int,
) -> None:
    """Linearize measurement k about the belief and gate it: stages 2 and 3; write the row of `work`."""
    columns, jacobian, innovation = work.columns[row], work.jacobian[row], work.innovation[row]
    pose, motion, noise = work.pose[row], work.motion[row], work.noise[row]
    bodies = body_columns(measurements, k, belief)
    predicted, slopes = work.predicted, work.value_jacobian
    s, variances = work.innovation_covariance, work.variances
    # Linearize: predicted value, and its Jacobian by both sides and by the observer's camera.
    camera, of_camera, observer = (0.0, 0.0, 0.0), (-1, -1, -1), measurements.observer[k]
    if observer >= 0:
        own, column = belief.parameter[observer], belief.table.column[observer]
        camera = (own[CAMERA_YAW], own[CAMERA_SCALE], own[CAMERA_OFFSET])
        of_camera = (column[CAMERA_YAW], column[CAMERA_SCALE], column[CAMERA_OFFSET])
    models.predict_one(measurements, k, pose[0], pose[1], camera, predicted, slopes)
    for j in range(3):  # missing columns are arbitrary: their Jacobian is zero
        columns[j], columns[3 + j] = max(bodies[0], 0) + j, max(bodies[1], 0) + j
        columns[6 + j] = max(of_camera[j], 0)
        for i in range(3):
            jacobian[i, j] = -slopes[i, j] if bodies[0] >= 0 else 0.0
            jacobian[i, 3 + j] = slopes[i, j] if bodies[1] >= 0 else 0.0
            jacobian[i, 6 + j] = slopes[i, 3 + j] if of_camera[j] >= 0 else 0.0
    # Noise, with that of the stamp at this rate of change.
    assign_matrix(noise, measurements.covariance[k])
    of_stamp = measurements.stamp_variance[k]
    if of_stamp > 0.0:
        change = _times(slopes, 0, motion), _times(slopes, 1, motion), _times(slopes, 2, motion)
        for i in range(3):
            for j in range(3):
                noise[i, j] += of_stamp * change[i] * change[j]
    polar = measurements.model[k] == models.POLAR
    work.place[row, 0] = predicted[0] * math.cos(predicted[1]) if polar else predicted[0]
    work.place[row, 1] = predicted[0] * math.sin(predicted[1]) if polar else predicted[1]
    # Covariance of the innovation, S = H P H^T + R, eq. (13).
    assign_matrix(s, noise)
    cross, relative, p = work.cross_covariance[row], work.relative_covariance, belief.covariance
    o, t = max(bodies[0], 0), max(bodies[1], 0)
    if belief.is_dense:  # undefined if a side is missing
        for i in range(3):
            for j in range(3):
                cross[i, j], cross[i, 3 + j] = p[o + i, t + j], p[t + i, max(of_camera[j], 0)]
    _add_uncertainty(belief, bodies, of_camera, slopes, cross, relative, s)
    for i in range(3):
        variances[i] = s[i, i] - noise[i, i]
    # Innovation, eq. (11), of the likelier solution.
    models.write_innovation(measurements, k, measurements.value[k], predicted, innovation)
    if measurements.has_second[k]:
        other = work.other
        models.write_innovation(measurements, k, measurements.second[k], predicted, other)
        if models.squared_distance(other, s) < models.squared_distance(innovation, s):
            assign(innovation, other)
    # Gate.
    work.accepted[row] = models.position_distance(innovation, s) <= measurements.gate[k]
    small = sources.small_variances(measurements, k, predicted)
    work.distance[row] = models.position_distance(innovation, s, small)
    x, y = innovation[0] / math.sqrt(s[0, 0] + small[0]), innovation[1] / math.sqrt(s[1, 1] + small[1])
    if sources.is_fix(measurements, k):  # late fixes err along the path
        cos, sin = math.cos(pose[1, 2]), math.sin(pose[1, 2])
        x, y = cos * x + sin * y, cos * y - sin * x
    work.whitened[row, 0], work.whitened[row, 1] = x, y
    work.elsewhere[row] = sources.is_elsewhere(measurements, k, innovation, predicted)
    work.share[row] = sources.share_of(measurements, k, belief)
    if measurements.observer[k] < 0 and measurements.systematic_share[k, 0] > 0.0:
        work.nis[row] = models.squared_distance(innovation, s)
        work.accepted[row] = work.nis[row] <= models.POSE_GATE
        s -= noise
        correlated_noise.inflate_fix(measurements.systematic_share[k], s, noise)
        return
    # A heading that may be flipped or misread counts less.
    if measurements.has_heading[k]:
        before = (noise[0, 2], noise[1, 2], noise[2, 2])
        misread = measurements.observer[k] < 0 and models.is_misread(
            innovation[2], s[2, 2], measurements.gate[k]
        )
        work.misread[row] = misread
        direction = sources.direction_of(belief, max(measurements.target[k], 0))
        if misread or (
            measurements.observer[k] < 0 and sources.is_suspended(belief, direction, limits.max_fault_score)
        ):
            noise[0, 2] = noise[1, 2] = noise[2, 0] = noise[2, 1] = 0.0
            noise[2, 2] = models.NO_HEADING
        else:
            models.soften_heading(innovation, s, noise)
        for i in range(3):
            s[i, 2] += noise[i, 2] - before[i]
            if i < 2:
                s[2, i] = s[i, 2]
    work.nis[row] = models.squared_distance(innovation, s)
    # Looks that follow each other closely share their errors; so do repeated exchanges of a pair.
    noise /= work.share[row]
    correlated_noise.use_mean(
        measurements, k, belief, pose, predicted, variances, innovation, noise, work.pair[row]
    )


@inlined_njit
def relative_motion(
    measurements: Measurements,
    k: int,
    tracks: track_arrays.TrackArrays,
    pose: FloatArray,
    motion: FloatArray,
) -> None:
    """Write the rate of change of xi_target - xi_observer (3,) of measurement k by driving [1/s].

    Zero for an exact stamp, where the rate is not needed. `pose` (2, 3) is that of observer and target.
    """
    motion.fill(0.0)
    if measurements.stamp_variance[k] == 0.0:
        return
    sides = (measurements.observer[k], measurements.target[k])
    for i in range(2):
        if sides[i] >= 0:
            x, y, turn = _driven(tracks, sides[i], measurements.stamp_ns[k], pose[i])
            sign = 2.0 * i - 1.0
            motion[0], motion[1], motion[2] = (
                motion[0] + sign * x,
                motion[1] + sign * y,
                motion[2] + sign * turn,
            )


@inlined_njit
def _times(slopes: FloatArray, row: int, motion: FloatArray) -> float:
    """The product of the first three columns of a row of `slopes` and a vector (3,)."""
    return float(slopes[row, 0] * motion[0] + slopes[row, 1] * motion[1] + slopes[row, 2] * motion[2])


@inlined_njit
def body_columns(measurements: Measurements, k: int, belief: BeliefArrays) -> tuple[int, int]:
    """First filter columns of the observer and the target of measurement k; -1: none."""
    observer, target = measurements.observer[k], measurements.target[k]
    columns = belief.table.survey_column
    of_observer, of_target = 3 * observer if observer >= 0 else -1, 3 * target if target >= 0 else -1
    if measurements.mount[k] >= 0:
        of_observer = columns[measurements.mount[k]]
    if measurements.landmark[k] >= 0:
        of_target = columns[measurements.landmark[k]]
    return of_observer, of_target


@inlined_njit
def _add_uncertainty(
    belief: BeliefArrays,
    bodies: tuple[int, int],
    camera: tuple[int, int, int],
    value_jacobian: FloatArray,
    cross_covariance: FloatArray,
    relative: FloatArray,
    s: FloatArray,
) -> None:
    """Add H P H^T (3, 3), eq. (13) of the e-puck paper, where H is `value_jacobian`.

    The covariance of xi_target - xi_observer is computed first, in `relative` (3, 3), which saves two thirds
    of the work.
    """
    o, t = max(bodies[0], 0), max(bodies[1], 0)
    of_observer, of_target = 1.0 if bodies[0] >= 0 else 0.0, 1.0 if bodies[1] >= 0 else 0.0
    for i in range(3):
        for j in range(3):
            both = of_target * of_observer * (cross_covariance[j, i] + cross_covariance[i, j])
            of_t, of_o = covariance_within(belief, t, i, j), covariance_within(belief, o, i, j)
            relative[i, j] = of_target * of_t + of_observer * of_o - both
    for i in range(3):
        x, y, z = _turned(value_jacobian, i, relative)
        for j in range(3):
            s[i, j] = s[i, j] + x * value_jacobian[j, 0] + y * value_jacobian[j, 1] + z * value_jacobian[j, 2]
    for k in range(3):
        if camera[k] >= 0:
            for a in range(3):
                own = own_within(belief, o // 3, a, 3 + CAMERA_YAW + k)
                relative[a, 0] = of_target * cross_covariance[a, 3 + k] - of_observer * own
            for i in range(3):
                shared = value_jacobian[i, 0] * relative[0, 0] + value_jacobian[i, 1] * relative[1, 0]
                shared += value_jacobian[i, 2] * relative[2, 0]
                for other in range(3):  # its own variance, and its covariances with the other parameters
                    if camera[other] >= 0:
                        both = own_within(belief, o // 3, 3 + CAMERA_YAW + other, 3 + CAMERA_YAW + k)
                        shared += 0.5 * value_jacobian[i, 3 + other] * both
                for j in range(3):
                    s[i, j] += shared * value_jacobian[j, 3 + k]
                    s[j, i] += shared * value_jacobian[j, 3 + k]


@inlined_njit
def _turned(value_jacobian: FloatArray, row: int, matrix: FloatArray) -> tuple[float, float, float]:
    """The product of the first three columns of a row of `value_jacobian` and a matrix (3, 3)."""
    a, b, c = value_jacobian[row, 0], value_jacobian[row, 1], value_jacobian[row, 2]
    return (
        a * matrix[0, 0] + b * matrix[1, 0] + c * matrix[2, 0],
        a * matrix[0, 1] + b * matrix[1, 1] + c * matrix[2, 1],
        a * matrix[0, 2] + b * matrix[1, 2] + c * matrix[2, 2],
    )


def evaluate_link(
    one: Measurements,
    k: int,
    tracks: track_arrays.TrackArrays,
    belief: BeliefArrays,
    joint: JointFilter,
    work: Innovations,
) -> None:
    """Evaluate a measurement whose model has no compiled kernel: stages 2 and 3; write row k of `work`.

    Its sides are localized and predicted, the filter is prepared. Components that its model lacks get zero
    rows and unit noise.
    """
    # Predict.
    model, stamp_ns = models.MODELS[int(one.model)], int(one.stamp_ns)
    predicted = model.predicted(one, work.pose[k, 0], work.pose[k, 1])
    count, sides, row = predicted.value.size, (int(one.observer), int(one.target)), one.columns()
    columns = body_columns(row, 0, belief)
    work.columns[k], work.jacobian[k], work.innovation[k] = 0, 0.0, 0.0
    work.noise[k], work.pair[k] = np.eye(3), 0.0
    # Jacobian by both sides, and noise, with that of the stamp.
    noise, slope = one.covariance[:count, :count].copy(), np.zeros(count)
    for i, jacobian in enumerate((predicted.observer_jacobian, predicted.target_jacobian)):
        if columns[i] >= 0:
            body = slice(3 * i, 3 * i + 3)
            work.columns[k, body], work.jacobian[k, :count, body] = columns[i] + np.arange(3), jacobian
        if sides[i] >= 0:
            slope += jacobian @ np.array(_driven(tracks, sides[i], stamp_ns, work.pose[k, i]))
    noise += one.stamp_variance * np.outer(slope, slope)
    # Biases of radios; a sparse filter has that of the observer only, as of a camera.
    bias, radios = _write_radios(one, belief, work.columns[k], work.jacobian[k])
    if not belief.is_dense and radios[1] >= 0:
        noise[0, 0] += model.radios[1] ** 2 * own_within(belief, sides[1], 3 + RADIO_BIAS, 3 + RADIO_BIAS)
    jacobian = work.jacobian[k, :count]
    covariance = link_covariance(joint, work.columns[k], columns, radios[0], work.cross_covariance[k])
    s = jacobian @ covariance @ jacobian.T + noise
    innovation = model.innovation(one.value, predicted.value + bias)
    gated = slice(model.gated)
    work.share[k] = sources.share_of(row, 0, belief)
    work.noise[k, :count, :count], work.innovation[k, :count] = noise, innovation
    work.whitened[k], work.elsewhere[k], work.place[k] = 0.0, False, (one.value[0], 0.0)
    # Gate, also what is not finite.
    finite = np.isfinite(s).all() and np.isfinite(innovation).all() and np.isfinite(jacobian).all()
    if finite and s[0, 0] > 0.0:  # covariances of a sparse filter are approximate
        work.distance[k] = innovation[gated] @ np.linalg.solve(s[gated, gated], innovation[gated])
        work.accepted[k] = work.distance[k] <= one.gate
        work.nis[k] = innovation @ np.linalg.solve(s, innovation)
        work.whitened[k, 0] = innovation[0] / np.sqrt(s[0, 0])
    else:
        work.jacobian[k], work.innovation[k], work.noise[k] = 0.0, 0.0, np.eye(3)
        work.distance[k], work.nis[k], work.accepted[k] = np.inf, np.nan, False
    # What its link has from these places already counts less.
    own = float((s - noise)[0, 0]), float(innovation[0]), bool(work.accepted[k])
    variance = correlated_noise.noise_of_range(row, 0, belief, tracks, *own)
    repeats = work.share[k] if work.share[k] == sources.LEAST_SHARE else 1.0
    work.noise[k, :count, :count] *= variance / (repeats * float(one.covariance[0, 0]))


def _write_radios(
    one: Measurements, belief: BeliefArrays, columns: IntArray, jacobian: FloatArray
) -> tuple[float, list[int]]:
    """Write columns (c,) and Jacobian (3, c) by the biases of both robots' radios.

    Returns:
        What they add to the value, and their columns; -1: not estimated.
    """
    bias, found, weights = 0.0, [-1, -1], models.MODELS[int(one.model)].radios
    for i, (robot, weight) in enumerate(zip((int(one.observer), int(one.target)), weights, strict=True)):
        if robot >= 0 and weight != 0.0:
            bias += weight * float(belief.parameter[robot, RADIO_BIAS])
            found[i] = int(belief.table.column[robot, RADIO_BIAS])
            if found[i] >= 0 and (i == 0 or belief.is_dense):
                columns[6 + i], jacobian[0, 6 + i] = found[i], weight
    return bias, found


@inlined_njit
def _driven(
    tracks: track_arrays.TrackArrays, robot: int, stamp_ns: int, pose: FloatArray
) -> tuple[float, float, float]:
    """Right-invariant velocity twist (3,) of a robot at a pose (3,) in `map` [1/s]."""
    forward, left, turn = track_arrays.rate_at(tracks, robot, stamp_ns)
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    x, y = cos * forward - sin * left, sin * forward + cos * left
    return x + turn * pose[1], y - turn * pose[0], turn
