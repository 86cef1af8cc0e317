"""Process noise of odometry steps and gaps."""

from __future__ import annotations

import math
from typing import NamedTuple

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.swarm.calibration_states import DISTANCE_SCALE, TURN_BIAS, TURN_SCALE
from swarm_loc_estimator.swarm.error_models import OdometryModel

_MAX_DISTANCE_M = 1e3
_MAX_TURNING_S = 100.0


class OdometryStep(NamedTuple):
    """One step of a robot along its track."""

    forward: float  # Displacement of the body [m], as is left
    left: float
    turn: float  # Change of heading [rad]
    turn_rate_change: float  # Absolute change of the turn rate [rad/s]
    duration_s: float  # Duration [s]
    x: float  # Position on the track in the middle of the step [m], as is y
    y: float
    theta: float  # Heading in the middle of the step [rad]
    turn_variance: float  # Variance of a turn that a gyroscope measured [rad^2]; NaN: of the wheels
    estimates_turn: bool  # Whether the estimated scale and bias of turns are those of the sensor of this turn


@cached_njit
def add_step_noise(model: OdometryModel, step: OdometryStep, covariance: FloatArray) -> None:
    """Add a step's noise to a covariance (3, 3) in the track's frame.

    Wheels: covar(ds_r, ds_l) = diag(k |ds_r|, k |ds_l|) (Siegwart and Nourbakhsh), the U Q U^T of the e-puck
    paper's eq. (9), whose Q is not printed. The noise along, across and in heading is relative to the
    direction of motion, so a sideways step has the noise of a forward step of that length.
    """
    turn, duration_s = step.turn, step.duration_s
    separation, wheel, path = model.wheel_separation, model.wheel_noise, math.hypot(step.forward, step.left)
    right_wheel, left_wheel = abs(path + 0.5 * separation * turn), abs(path - 0.5 * separation * turn)
    along = 0.25 * wheel * (right_wheel + left_wheel) + model.distance_noise * path
    along += model.distance_turn_noise * abs(turn)
    across = model.lateral_noise * path
    heading = wheel * (right_wheel + left_wheel) / separation**2 + model.turn_noise * abs(turn)
    heading += model.turn_change_noise * step.turn_rate_change
    if right_wheel + left_wheel > 0.0:
        along += model.distance_drift * duration_s
        across += model.lateral_drift * duration_s
        heading += model.turn_drift * duration_s
    cross = 0.5 * wheel * (right_wheel - left_wheel) / separation
    if not math.isnan(step.turn_variance):
        heading, cross = step.turn_variance, 0.0
    course = step.theta + math.atan2(step.left, step.forward)
    add_in_track_frame((step.x, step.y, course), (along, across, heading, cross), covariance)


@cached_njit
def add_step_jacobian(model: OdometryModel, step: OdometryStep, jacobian: FloatArray) -> None:
    """Add the Jacobian of a step's motion by the parameters: Ad(O) times their body directions.

    Args:
        model: Gives the position of the axle.
        step: The step.
        jacobian: (3, 3) sum to add to.
    """
    forward, left, turn = step.forward, step.left, step.turn
    if forward == 0.0 and left == 0.0 and turn == 0.0:
        return
    cos, sin = math.cos(step.theta + model.course_offset), math.sin(step.theta + model.course_offset)
    jacobian[0, DISTANCE_SCALE] += cos * forward - sin * left
    jacobian[1, DISTANCE_SCALE] += sin * forward + cos * left
    if not step.estimates_turn:
        return
    # when the axle turns, base_link ahead of it also moves sideways
    turned_x = step.y - math.sin(step.theta) * model.axle_offset
    turned_y = -step.x + math.cos(step.theta) * model.axle_offset
    for parameter, angle in ((TURN_BIAS, step.duration_s), (TURN_SCALE, turn)):
        jacobian[0, parameter] += turned_x * angle
        jacobian[1, parameter] += turned_y * angle
        jacobian[2, parameter] += angle


@cached_njit
def add_dropout_noise(
    model: OdometryModel,
    silence_s: float,
    unknown: bool,
    pose: FloatArray,
    rate: FloatArray,
    covariance: FloatArray,
) -> None:
    """Add the noise of an odometry dropout that started at `pose` (3,) on the track with `rate` (3,).

    Speed and turn rate are random walks at first; if the motion is `unknown`, any feasible motion is covered.
    Both noises act about the last known pose, so the covariance never decreases with time.
    """
    # bounded, so that rounding does not lose the noise of later steps
    reach = min(model.max_speed * silence_s, _MAX_DISTANCE_M) ** 2 / 3.0
    turned = min(model.max_turn_rate * silence_s, math.pi) ** 2 / 3.0  # pi: any heading
    if model.max_turn_rate * silence_s > math.pi:  # the noise grows further while the robot may turn
        turned += min(silence_s - math.pi / model.max_turn_rate, _MAX_TURNING_S) * math.pi**2 / 3.0
    along, across, heading = reach, reach, turned
    if not unknown:
        walked = silence_s**3 / 3.0
        along, across = min(along, model.speed_change**2 * walked), 0.0
        heading = min(heading, model.turn_rate_change**2 * walked)
    course = pose[2] + math.atan2(rate[1], rate[0])
    add_in_track_frame((pose[0], pose[1], course), (along, across, heading, 0.0), covariance)


@cached_njit
def add_in_track_frame(
    pose: tuple[float, float, float], body: tuple[float, float, float, float], covariance: FloatArray
) -> None:
    """Add Ad(pose) Q Ad(pose)^T for body variances along, across, heading and cov(along, heading)."""
    x, y, theta = pose
    along, across, heading, cross = body
    cos, sin = math.cos(theta), math.sin(theta)
    forward, left, turning = (cos, sin, 0.0), (-sin, cos, 0.0), (y, -x, 1.0)
    for i in range(3):
        for j in range(3):
            covariance[i, j] += along * forward[i] * forward[j] + across * left[i] * left[j]
            covariance[i, j] += heading * turning[i] * turning[j]
            covariance[i, j] += cross * (forward[i] * turning[j] + turning[i] * forward[j])
