"""Models of measurements: predicted values, Jacobians, innovations and gates.

A model is a `MeasurementModel` record; `MODELS` lists all. Those of a marker's position (`COMPILED`) have a
compiled kernel. Each of their measurements observes the pose of a marker in a sensor's frame,

    rel = (X_observer S)^-1 (X_target M),

the transform chains (3) and (5) of the e-puck paper in the plane (its printed eq. (6) has three wrong signs,
which the chain avoids). S is the sensor on the observer, M the marker on the target. A landmark has no target
robot: M is its pose in `map`, corrected by X_target if the landmark is estimated. So is the pose S of a fixed
camera, by X_observer. An absolute fix has no observer: S is the identity.

With right-invariant errors X = exp(xi) X_hat the chain depends on xi_target - xi_observer only, so one
Jacobian (3 x 3) serves both robots, with opposite signs. Three more columns are for the camera's yaw
offset, scale error and range offset, see CAMERA_YAW of swarm/calibration_states.py.

An innovation is gated by its Mahalanobis distance. The heading of a marker is not gated but down-weighted:
the planar ambiguity of a square marker flips it in otherwise good sightings.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.common.numerics import composed, factor_numbers, wrap
from swarm_loc_estimator.filter.measurements import NOBODY, Measurements

_STUDENT_DOF = 4.0
_MISREAD = 0.25 * np.pi  # Minimum error of the heading of a misread fiducial [rad]
NO_HEADING = 1e4  # Variance of a heading that is not used [rad^2]
ANY_HEADING = np.pi**2 / 3.0  # Variance of a heading of which nothing is known, uniform over a turn [rad^2]


def gate_threshold(probability: ArrayLike, degrees_of_freedom: int = 2) -> FloatArray:
    """Chi-square quantile: gate threshold of the squared distance for an acceptance probability."""
    threshold: FloatArray = np.vectorize(_quantile, otypes=[float])(probability, degrees_of_freedom)
    return threshold


@cache
def _quantile(probability: float, degrees_of_freedom: int) -> float:
    """Where `_exceeding` falls to the rest of a probability; SciPy has this, but takes long to import."""
    low, high = 0.0, 1.0
    while _exceeding(high, degrees_of_freedom) > 1.0 - probability:
        low, high = high, 2.0 * high
    while low < (middle := 0.5 * (low + high)) < high:
        is_below = _exceeding(middle, degrees_of_freedom) > 1.0 - probability
        low, high = (middle, high) if is_below else (low, middle)
    return high


def _exceeding(squared: float, degrees_of_freedom: int) -> float:
    """Probability of a larger chi-square: the upper incomplete gamma function, by its recursion."""
    half, order = 0.5 * squared, 1.0 - 0.5 * (degrees_of_freedom % 2)
    probability = math.exp(-half) if order == 1.0 else math.erfc(math.sqrt(half))
    while 2.0 * order < degrees_of_freedom:
        probability += half**order * math.exp(-half) / math.gamma(order + 1.0)
        order += 1.0
    return probability


POSE_GATE = float(gate_threshold(0.9999, 3))
"""Threshold of the squared distance of a pose whose heading is gated, too: fixes with systematic errors."""


CARTESIAN, POLAR = 0, 1  # Models of a marker's position; with a heading, of its pose
ANONYMOUS, SCAN = 2, 3  # Positions of unknown robots, and lidar scans: they become fixes when they are fused
COMPILED = (CARTESIAN, POLAR)
"""Models with compiled kernels. Others are links, evaluated by their records, or become fixes."""


class Prediction(NamedTuple):
    """Predicted value of a measurement with n components, n up to 3."""

    value: FloatArray  #: (n,) predicted value
    observer_jacobian: FloatArray  #: (n, 3) by the observer's right-invariant error X = exp(xi) X_hat
    target_jacobian: FloatArray  #: (n, 3) by the target's right-invariant error


Predict = Callable[[Measurements, FloatArray, FloatArray], Prediction]


@dataclass(frozen=True)
class MeasurementModel:
    """Model of a kind of measurement as a function of the poses of its observer and its target."""

    name: str  #: Human-readable name
    number: int  #: Value of the column `model` of its measurements
    components: tuple[str, ...]  #: Names and units of the components of a value, those that are gated first
    is_angle: tuple[bool, ...]  #: Whether each component is an angle
    gated: int  #: Number of leading components that are gated
    #: Predicts a row of measurements from the poses (3,) in `map` of observer and target. For a landmark, the
    #: pose of the target is the correction of its survey. The pose of a missing side is undefined. None: its
    #: measurements become others when they are fused
    predict: Predict | None
    #: By how much the biases of the radios of observer and target, where these are robots, add to its value
    radios: tuple[float, float] = (0.0, 0.0)

    @property
    def initializes(self) -> str:
        """How its measurements initialize a robot: "alone", "in a window" of several, or "": not at all."""
        if self.number in COMPILED:
            return "alone"
        return "in a window" if self.predict is not None and self.gated == 1 else ""

    def gate(self, probability: ArrayLike) -> FloatArray:
        """Gate threshold of the squared distance for an acceptance probability."""
        return gate_threshold(probability, self.gated)

    def predicted(self, one: Measurements, observer: FloatArray, target: FloatArray) -> Prediction:
        """Predict a row of measurements, see `predict`.

        Raises:
            ValueError: Its measurements become others when they are fused.
        """
        if self.predict is None:
            raise ValueError(f"measurements of the model {self.name!r} have no prediction")
        return self.predict(one, observer, target)

    def innovation(self, value: FloatArray, predicted: FloatArray) -> FloatArray:
        """Measured minus predicted (n,), angles wrapped.

        Eq. (11) of the e-puck paper does not wrap angles, which is wrong across +-pi.
        """
        difference = value[: predicted.size] - predicted
        angles = np.array(self.is_angle[: predicted.size])
        return np.where(angles, se2.wrap_angle(difference), difference)


def _predict_marker(one: Measurements, observer: FloatArray, target: FloatArray) -> Prediction:
    """Predict the pose of a marker in the frame of a sensor."""
    value, jacobian = predict(one.columns(), observer[None], target[None])
    return Prediction(value[0], -jacobian[0, :, :3], jacobian[0, :, :3])


def _predict_bearing(one: Measurements, observer: FloatArray, target: FloatArray) -> Prediction:
    """Predict the direction of a marker."""
    pose = _predict_marker(one._replace(model=np.int64(POLAR)), observer, target)
    return Prediction(pose.value[1:2], pose.observer_jacobian[1:2], pose.target_jacobian[1:2])


def _predict_range(one: Measurements, observer: FloatArray, target: FloatArray) -> Prediction:
    """Predict the slant range of two antennas; the state of an anchor is a displacement and its bias."""
    (sz, mz), (mx, my, _) = one.height.tolist(), one.marker.tolist()
    (sx, sy), bias = _moved(one.sensor, observer), 0.0
    if one.target >= 0:
        mx, my = _moved(one.marker, target)
    elif one.landmark >= 0:
        mx, my, bias = mx + target[0], my + target[1], float(target[2])
    distance, ux, uy = _direction(mx - sx, my - sy, mz - sz)
    return Prediction(
        np.array([distance + bias]),
        np.array([[-ux, -uy, ux * sy - uy * sx]]),
        np.array([[ux, uy, uy * mx - ux * my if one.target >= 0 else 1.0]]),
    )


def _predict_difference(one: Measurements, observer: FloatArray, target: FloatArray) -> Prediction:
    """Predict the slant range minus that to the reference, whose antenna is fixed in `map`."""
    value, own, other = _predict_range(one, observer, target)
    (x, y, z), (sx, sy) = one.reference.tolist(), _moved(one.sensor, observer)
    distance, ux, uy = _direction(x - sx, y - sy, z - float(one.height[0]))
    return Prediction(value - distance, own + np.array([[ux, uy, uy * sx - ux * sy]]), other)


def _moved(place: FloatArray, pose: FloatArray) -> tuple[float, float]:
    """Position in `map` of a place (3,) on a body at a pose (3,)."""
    x, y, theta = pose.tolist()
    cos, sin = math.cos(theta), math.sin(theta)
    return x + cos * place[0] - sin * place[1], y + sin * place[0] + cos * place[1]


def _direction(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Length of a vector, and the horizontal components of its direction; zero at length zero."""
    length = math.sqrt(x * x + y * y + z * z)
    scale = 1.0 / length if length > 1e-6 else 0.0
    return length, scale * x, scale * y


_XY = ("forward [m]", "left [m]", "heading [rad]")
_LINE = ("range [m]", "bearing [rad]", "heading [rad]")
_OFF = ("difference [m]",)
BEARING, RANGE, RANGE_DIFFERENCE = 4, 10, 11

MODELS: dict[int, MeasurementModel] = {
    model.number: model
    for model in (
        MeasurementModel("cartesian", CARTESIAN, _XY, (False, False, True), 2, _predict_marker),
        MeasurementModel("polar", POLAR, _LINE, (False, True, True), 2, _predict_marker),
        MeasurementModel("anonymous", ANONYMOUS, _XY, (False, False, True), 2, None),
        MeasurementModel("scan", SCAN, (), (), 2, None),
        MeasurementModel("bearing", BEARING, ("bearing [rad]",), (True,), 1, _predict_bearing),
        MeasurementModel("range", RANGE, ("range [m]",), (False,), 1, _predict_range, (1.0, 1.0)),
        MeasurementModel(
            "range difference", RANGE_DIFFERENCE, _OFF, (False,), 1, _predict_difference, (0.0, 1.0)
        ),
    )
}
"""All models by number. Bearings are positive to the left."""


def register(model: MeasurementModel) -> None:
    """Add a model.

    Raises:
        ValueError: Its number is in use or not positive, or it gates other than 1, 2 or 3 components.
    """
    if model.number <= 0 or model.number in MODELS:
        raise ValueError(f"the number {model.number} of the measurement model {model.name!r} is not free")
    if model.gated not in (1, 2, 3):
        raise ValueError(
            f"the measurement model {model.name!r} gates {model.gated} components but must gate 1, 2 or 3"
        )
    MODELS[model.number] = model


def is_compiled(models: IntArray) -> BoolArray:
    """Whether compiled code evaluates measurements of models (m,)."""
    return np.isin(models, COMPILED)


@inlined_njit
def has_kernel(measurements: Measurements, k: int) -> bool:
    """Whether compiled code evaluates measurement k."""
    model: int = measurements.model[k]
    return model in (CARTESIAN, POLAR)


@inlined_njit
def locates_alone(measurements: Measurements, k: int) -> bool:
    """Whether measurement k is a whole pose in `map` whose errors the next ones have, too.

    More of them would not confirm it, so a single one initializes a robot.
    """
    is_fix: bool = measurements.observer[k] == NOBODY and measurements.has_heading[k]
    is_fix = is_fix and not measurements.has_second[k]
    return is_fix and measurements.systematic_share[k, 0] > 0.0


def predict(
    measurements: Measurements,
    observer_pose: FloatArray,
    target_pose: FloatArray,
    camera: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Predicted values (m, 3) and their Jacobians (m, 3, 6) by xi_target - xi_observer and camera errors.

    A heading that was not measured has a zero row.

    Args:
        measurements: (m,).
        observer_pose: (m, 3) in `map`, or correction of the survey of a fixed camera.
        target_pose: (m, 3), or correction of a landmark's survey; rows with neither are ignored.
        camera: (m, 3) yaw offset of the sensor, positive to the left [rad], relative error of distances, and
            range offset [m]; zero by default.
    """
    errors = np.zeros((measurements.size, 3)) if camera is None else camera
    return _predict_all(measurements, observer_pose, target_pose, errors)


def predict_any(
    measurements: Measurements, observer_pose: FloatArray, target_pose: FloatArray, camera: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Predicted values (m, 3) of any models, and Jacobians (m, 3, 3) by observer, target and camera.

    Arguments are those of `predict`. Components that were not measured are zero, as are their rows.
    """
    value, jacobian = predict(measurements, observer_pose, target_pose, camera)
    sides = -jacobian[:, :, :3], jacobian[:, :, :3].copy()
    for k in np.flatnonzero(~is_compiled(measurements.model)).tolist():
        one = measurements.row(k)
        found = MODELS[int(one.model)].predicted(one, observer_pose[k], target_pose[k])
        value[k], jacobian[k], count = 0.0, 0.0, found.value.size
        value[k, :count] = found.value
        for side, by_pose in zip(sides, (found.observer_jacobian, found.target_jacobian), strict=True):
            side[k] = 0.0
            side[k, :count] = by_pose
    return value, *sides, jacobian[:, :, 3:]


def angles(models: IntArray) -> BoolArray:
    """Which components (m, 3) of measurements of models (m,) are angles."""
    found = np.zeros((models.size, 3), dtype=bool)
    for number in np.unique(models).tolist():
        is_angle = MODELS[number].is_angle
        found[models == number, : len(is_angle)] = is_angle
    return found


@cached_njit
def _predict_all(
    measurements: Measurements, observer_pose: FloatArray, target_pose: FloatArray, camera: FloatArray
) -> tuple[FloatArray, FloatArray]:
    value, jacobian = np.zeros((len(camera), 3)), np.zeros((len(camera), 3, 6))
    for k in range(len(camera)):
        errors = (camera[k, 0], camera[k, 1], camera[k, 2])
        predict_one(measurements, k, observer_pose[k], target_pose[k], errors, value[k], jacobian[k])
    return value, jacobian


@inlined_njit
def predict_one(
    measurements: Measurements,
    k: int,
    observer_pose: FloatArray,
    target_pose: FloatArray,
    camera: tuple[float, float, float],
    value: FloatArray,
    jacobian: FloatArray,
) -> None:
    """Write the predicted value (3,) of measurement k and its Jacobian (3, 6), see `predict`."""
    sensor, marker = measurements.sensor[k], measurements.marker[k]
    sx, sy, stheta = sensor[0], sensor[1], sensor[2] + camera[0]
    if measurements.observer[k] >= 0 or measurements.mount[k] >= 0:
        sx, sy, stheta = composed(observer_pose[0], observer_pose[1], observer_pose[2], sx, sy, stheta)
    mx, my, mtheta = marker[0], marker[1], marker[2]
    if measurements.target[k] >= 0 or measurements.landmark[k] >= 0:
        mx, my, mtheta = composed(target_pose[0], target_pose[1], target_pose[2], mx, my, mtheta)
    cos, sin = math.cos(stheta), math.sin(stheta)
    stretch = 1.0 + camera[1]
    x, y = cos * (mx - sx) + sin * (my - sy), -sin * (mx - sx) + cos * (my - sy)
    value[0], value[1], value[2] = stretch * x, stretch * y, wrap(mtheta - stheta)
    # moving the target by xi moves its marker by rho + phi * (-my, mx)
    jacobian[0, 0], jacobian[0, 1], jacobian[0, 2] = cos, sin, -cos * my + sin * mx
    jacobian[1, 0], jacobian[1, 1], jacobian[1, 2] = -sin, cos, sin * my + cos * mx
    jacobian[2, 0], jacobian[2, 1], jacobian[2, 2] = 0.0, 0.0, (1.0 if measurements.has_heading[k] else 0.0)
    jacobian[0, 3], jacobian[1, 3], jacobian[2, 3] = y, -x, -jacobian[2, 2]
    for j in range(4):
        jacobian[0, j] *= stretch
        jacobian[1, j] *= stretch
    jacobian[0, 4], jacobian[1, 4], jacobian[2, 4] = x, y, 0.0
    jacobian[0, 5] = jacobian[1, 5] = jacobian[2, 5] = 0.0
    if measurements.model[k] == POLAR:
        distance = max(math.hypot(x, y), 1e-6)
        ux, uy = x / distance, y / distance
        value[0], value[1] = stretch * distance + camera[2], math.atan2(y, x)
        for j in range(5):
            forward, left = jacobian[0, j], jacobian[1, j]
            jacobian[0, j] = ux * forward + uy * left
            jacobian[1, j] = (ux * left - uy * forward) / (stretch * distance)
        jacobian[0, 5] = 1.0


@inlined_njit
def write_innovation(
    measurements: Measurements, k: int, measured: FloatArray, predicted: FloatArray, out: FloatArray
) -> None:
    """Write measured minus predicted (3,), angles wrapped, zero for a heading that was not measured.

    Eq. (11) of the e-puck paper does not wrap angles, which is wrong across +-pi.
    """
    out[0] = measured[0] - predicted[0]
    out[1] = measured[1] - predicted[1]
    out[2] = wrap(measured[2] - predicted[2]) if measurements.has_heading[k] else 0.0
    if measurements.model[k] == POLAR:
        out[1] = wrap(out[1])


@inlined_njit
def squared_distance(innovation: FloatArray, covariance: FloatArray) -> float:
    """Normalized innovation squared of an innovation (3,) with covariance (3, 3)."""
    aa, ba, bb, ca, cb, cc = factor_numbers(covariance)
    a = innovation[0] / aa
    b = (innovation[1] - ba * a) / bb
    c = (innovation[2] - ca * a - cb * b) / cc
    c = c / cc
    b = (b - cb * c) / bb
    a = (a - ba * b - ca * c) / aa
    distance: float = innovation[0] * a + innovation[1] * b + innovation[2] * c
    return distance


@inlined_njit
def position_distance(
    innovation: FloatArray, covariance: FloatArray, more: tuple[float, float] = (0.0, 0.0)
) -> float:
    """Squared Mahalanobis distance of the position by an innovation (3,) and its covariance (3, 3).

    The heading of a marker is not gated: the planar ambiguity of a square flips it in good sightings. `more`
    are variances added to both components.
    """
    a, b, d = covariance[0, 0] + more[0], covariance[0, 1], covariance[1, 1] + more[1]
    x, y = innovation[0], innovation[1]
    distance: float = (d * x * x - 2.0 * b * x * y + a * y * y) / (a * d - b * b)
    return distance


@inlined_njit
def is_misread(innovation: float, variance: float, gate: float) -> bool:
    """Whether a fix has the heading of a fiducial that was misread, turned by a quarter or a half.

    Such errors last for seconds, so down-weighting each of them does not suffice.
    """
    misread: bool = abs(innovation) > _MISREAD and innovation * innovation > gate * variance
    return misread


@inlined_njit
def soften_heading(innovation: FloatArray, covariance: FloatArray, noise: FloatArray) -> None:
    """Inflate the heading variance in `noise` (3, 3) if its innovation is large, to down-weight flips.

    Weight of Student's t with 4 degrees of freedom; `covariance` (3, 3) is that of the innovation.
    """
    normalised = innovation[2] * innovation[2] / covariance[2, 2]
    factor = (_STUDENT_DOF + normalised) / (_STUDENT_DOF + 1.0)
    if factor > 1.0:
        scale = np.sqrt(factor)
        noise[0, 2] *= scale
        noise[1, 2] *= scale
        noise[2, 0] *= scale
        noise[2, 1] *= scale
        noise[2, 2] *= factor
