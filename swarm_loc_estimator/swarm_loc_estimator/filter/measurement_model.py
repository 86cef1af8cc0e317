"""Measurements and their models: predicted values, Jacobians, innovations and gates.

A model is a `MeasurementModel` record; `MODELS` lists all. Those of `Kind` are built in: compiled kernels
switch on their numbers. Each of their measurements observes the pose of a marker in a sensor's frame,

    rel = (X_observer S)^-1 (X_target M),

the transform chains (3) and (5) of the e-puck paper in the plane (its printed eq. (6) has three wrong signs,
which the chain avoids). S is the sensor on the observer, M the marker on the target. A landmark has no target
robot: M is its pose in `map`, corrected by X_target if the landmark is estimated. An absolute fix has no
observer: S is the identity, or the pose of a fixed camera in `map`.

With right-invariant errors X = exp(xi) X_hat the chain depends on xi_target - xi_observer only, so one
Jacobian (3 x 3) serves both robots, with opposite signs. Two more columns are for the camera's yaw offset
and scale error, see CAMERA_YAW and CAMERA_SCALE of swarm/calibration_states.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.common.se2_scalar import composed, wrap
from swarm_loc_estimator.filter.gating import gate_threshold

NOBODY = -1  # Robot index for the observer of an absolute fix and the target of a landmark sighting


class Kind(IntEnum):
    """Numbers of the built-in models, named by the first two components of the value."""

    CARTESIAN = 0  # forward [m], left [m]
    POLAR = 1  # range [m], bearing [rad], positive to the left
    ANONYMOUS = 2  # an unknown robot was at `value` in map; marker_id: index of the detection in the image
    SCAN = 3  # a lidar's sweep in a known map, without `value`; marker_id: stamp of its first beam [ns]


class Command(IntEnum):
    """Commands for the target robot, executed at their stamps among the measurements."""

    NONE = 0  # a measurement
    SET_POSE = 1  # set the target to `value` in map with `covariance`
    FORGET = 2  # deinitialize the target


POLAR = int(Kind.POLAR)  # `Kind.POLAR` as a plain int, for compiled code
NO_MODEL = -1  # The `kind` of a command

MEASUREMENT_DTYPE = np.dtype(
    [
        ("stamp_ns", np.int64),  # time of measurement
        ("received_from", np.int64),  # robot or fixed camera of the message; -1: about the whole swarm
        ("observer", np.int64),  # robot index or NOBODY
        ("target", np.int64),  # robot index or NOBODY
        ("landmark", np.int64),  # 1 + index of the landmark; 0: none
        ("marker_id", np.int64),
        ("command", np.int64),  # Command; NONE for a measurement
        ("kind", np.int64),  # number of its model in MODELS
        ("has_heading", np.int64),  # 1 when value[2] was measured, else 0
        ("has_alternative", np.int64),  # 1 when `alternative` is a second, mirrored solution, else 0
        ("stamp_variance", np.float64),  # of stamp_ns [s^2], times how many measurements share its error
        ("gate", np.float64),  # maximum accepted squared distance of the gated components
        ("sensor", np.float64, (3,)),  # S: x [m], y [m], yaw [rad] in the observer's base_link
        ("marker", np.float64, (3,)),  # M: in the target's base_link, or in map
        (
            "value",
            np.float64,
            (3,),
        ),  # built-in models: two components by kind, then the heading of the face [rad]
        ("alternative", np.float64, (3,)),
        (
            "covariance",
            np.float64,
            (3, 3),
        ),  # of value; a component not measured has variance 1 and no correlation
        (
            "systematic_share",
            np.float64,
            (3,),
        ),  # systematic share of each variance, see filter/correlated_noise.py
    ]
)

MeasurementArray = NDArray[np.void]


class MeasurementColumns(NamedTuple):
    """Fields of measurements (m,) as separate arrays, for compiled code."""

    stamp_ns: NDArray[np.int64]
    observer: NDArray[np.int64]
    target: NDArray[np.int64]
    landmark: NDArray[np.int64]
    kind: NDArray[np.int64]
    has_heading: NDArray[np.int64]
    has_alternative: NDArray[np.int64]
    stamp_variance: FloatArray
    gate: FloatArray
    sensor: FloatArray
    marker: FloatArray
    value: FloatArray
    alternative: FloatArray
    covariance: FloatArray
    systematic_share: FloatArray

    @classmethod
    def of(cls, measurements: MeasurementArray) -> MeasurementColumns:
        """Contiguous copies of the columns of an array of MEASUREMENT_DTYPE, for reading.

        Views are contiguous only for a single measurement; for this second array type, numba would compile
        all kernels again at runtime.
        """
        return cls(*(np.ascontiguousarray(measurements[name]) for name in cls._fields))

    @classmethod
    def views(cls, measurements: MeasurementArray) -> MeasurementColumns:
        """Views of the columns, for writing."""
        return cls(*(measurements[name] for name in cls._fields))


@inlined_njit
def has_kernel(measurements: MeasurementColumns, k: int) -> bool:
    """Whether compiled code can evaluate measurement k: not a command, and a built-in model."""
    kind: int = measurements.kind[k]
    return 0 <= kind <= POLAR


@inlined_njit
def locates_alone(measurements: MeasurementColumns, k: int) -> bool:
    """Whether measurement k is a whole pose in `map` whose errors the next ones have, too.

    More of them would not confirm it, so a single one initializes a robot.
    """
    is_fix: bool = measurements.observer[k] < 0 and measurements.has_heading[k] > 0
    is_fix = is_fix and not measurements.has_alternative[k]
    return is_fix and measurements.systematic_share[k, 0] > 0.0


class Prediction(NamedTuple):
    """Predicted value of a measurement with n components, n up to 3."""

    value: FloatArray  #: (n,) predicted value
    observer_jacobian: FloatArray  #: (n, 3) by the observer's right-invariant error X = exp(xi) X_hat
    target_jacobian: FloatArray  #: (n, 3) by the target's right-invariant error


@dataclass(frozen=True)
class MeasurementModel:
    """Model of a kind of measurement as a function of the poses of its observer and its target.

    A model without a compiled kernel is evaluated by its record, see `filter/model_evaluation.py`.
    """

    name: str  #: Human-readable name
    number: int  #: Value of the field `kind` of its measurements
    degrees_of_freedom: int  #: Number of leading components that are gated
    #: Predicts from a measurement (1,) and the poses (3,) in `map` of observer and target. For a landmark,
    #: the pose of the target is the correction of its survey. The pose of a missing side is undefined.
    predict: Callable[[MeasurementArray, FloatArray, FloatArray], Prediction]
    #: Returns measured minus predicted (n,), angles wrapped, for a measurement (1,) and a predicted value
    #: (n,)
    innovation: Callable[[MeasurementArray, FloatArray], FloatArray]
    #: Converts a measurement (1,) to `Kind.CARTESIAN` or `Kind.POLAR`, to initialize a robot. None: those of
    #: one degree of freedom initialize one together, see `initialization/window.py`, and others do not.
    constraint: Callable[[MeasurementArray], MeasurementArray] | None = None

    def gate(self, probability: ArrayLike) -> FloatArray:
        """Gate threshold of the squared distance for an acceptance probability."""
        return gate_threshold(probability, self.degrees_of_freedom)


def _predict_built_in(one: MeasurementArray, observer: FloatArray, target: FloatArray) -> Prediction:
    value, jacobian = predict(one, observer[None], target[None])
    return Prediction(value[0], -jacobian[0, :, :3], jacobian[0, :, :3])


def _innovation_built_in(one: MeasurementArray, predicted: FloatArray) -> FloatArray:
    out = np.empty(3)
    write_innovation(MeasurementColumns.of(one), 0, one["value"][0], predicted, out)
    return out


def _itself(one: MeasurementArray) -> MeasurementArray:
    return one


MODELS: dict[int, MeasurementModel] = {
    int(kind): MeasurementModel(
        kind.name.lower(),
        int(kind),
        2,  # the heading is not gated, see `gating.position_distance`
        _predict_built_in,
        _innovation_built_in,
        None if kind > POLAR else _itself,
    )
    for kind in Kind
}
"""All models by number."""


def register(model: MeasurementModel) -> None:
    """Add a model.

    Raises:
        ValueError: Its number is in use or not positive, or its degrees of freedom are not 1, 2 or 3.
    """
    if model.number <= 0 or model.number in MODELS:
        raise ValueError(f"the number {model.number} of the measurement model {model.name!r} is not free")
    if model.degrees_of_freedom not in (1, 2, 3):
        raise ValueError(
            f"the measurement model {model.name!r} has {model.degrees_of_freedom} degrees of freedom"
            " but must have 1, 2 or 3"
        )
    MODELS[model.number] = model


def predict(
    measurements: MeasurementArray,
    observer_pose: FloatArray,
    target_pose: FloatArray,
    camera: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Predicted values (m, 3) and their Jacobians (m, 3, 5) by xi_target - xi_observer, camera yaw and scale.

    A heading that was not measured has a zero row.

    Args:
        measurements: (m,) of MEASUREMENT_DTYPE.
        observer_pose: (m, 3) in `map`; rows without an observer are ignored.
        target_pose: (m, 3), or correction of a landmark's survey; rows with neither are ignored.
        camera: (m, 2) yaw offset of the sensor, positive to the left [rad], and relative error of distances;
            zero by default.
    """
    value, jacobian = np.zeros((measurements.size, 3)), np.zeros((measurements.size, 3, 5))
    errors = np.zeros((measurements.size, 2)) if camera is None else camera
    columns = MeasurementColumns.of(measurements)
    _predict_all(columns, observer_pose, target_pose, errors, value, jacobian)
    return value, jacobian


@cached_njit
def _predict_all(
    measurements: MeasurementColumns,
    observer_pose: FloatArray,
    target_pose: FloatArray,
    camera: FloatArray,
    value: FloatArray,
    jacobian: FloatArray,
) -> None:
    """Write `predict` for all measurements."""
    for k in range(observer_pose.shape[0]):
        errors = (camera[k, 0], camera[k, 1])
        predict_one(measurements, k, observer_pose[k], target_pose[k], errors, value[k], jacobian[k])


@inlined_njit
def predict_one(
    measurements: MeasurementColumns,
    k: int,
    observer_pose: FloatArray,
    target_pose: FloatArray,
    camera: tuple[float, float],
    value: FloatArray,
    jacobian: FloatArray,
) -> None:
    """Write the predicted value (3,) of measurement k and its Jacobian (3, 5), see `predict`."""
    sensor, marker = measurements.sensor[k], measurements.marker[k]
    sx, sy, stheta = sensor[0], sensor[1], sensor[2] + camera[0]
    if measurements.observer[k] >= 0:
        sx, sy, stheta = composed(observer_pose[0], observer_pose[1], observer_pose[2], sx, sy, stheta)
    mx, my, mtheta = marker[0], marker[1], marker[2]
    if measurements.target[k] >= 0 or measurements.landmark[k] > 0:
        mx, my, mtheta = composed(target_pose[0], target_pose[1], target_pose[2], mx, my, mtheta)
    cos, sin = math.cos(stheta), math.sin(stheta)
    stretch = 1.0 + camera[1]
    x, y = cos * (mx - sx) + sin * (my - sy), -sin * (mx - sx) + cos * (my - sy)
    value[0], value[1], value[2] = stretch * x, stretch * y, wrap(mtheta - stheta)
    # moving the target by xi moves its marker by rho + phi * (-my, mx)
    jacobian[0, 0], jacobian[0, 1], jacobian[0, 2] = cos, sin, -cos * my + sin * mx
    jacobian[1, 0], jacobian[1, 1], jacobian[1, 2] = -sin, cos, sin * my + cos * mx
    jacobian[2, 0], jacobian[2, 1], jacobian[2, 2] = 0.0, 0.0, float(measurements.has_heading[k])
    jacobian[0, 3], jacobian[1, 3], jacobian[2, 3] = y, -x, -jacobian[2, 2]
    for j in range(4):
        jacobian[0, j] *= stretch
        jacobian[1, j] *= stretch
    jacobian[0, 4], jacobian[1, 4], jacobian[2, 4] = x, y, 0.0
    if measurements.kind[k] == POLAR:
        distance = max(math.hypot(x, y), 1e-6)
        ux, uy = x / distance, y / distance
        value[0], value[1] = stretch * distance, math.atan2(y, x)
        for j in range(5):
            forward, left = jacobian[0, j], jacobian[1, j]
            jacobian[0, j] = ux * forward + uy * left
            jacobian[1, j] = (ux * left - uy * forward) / (stretch * distance)


@inlined_njit
def write_innovation(
    measurements: MeasurementColumns, k: int, measured: FloatArray, predicted: FloatArray, out: FloatArray
) -> None:
    """Write measured minus predicted (3,), angles wrapped, zero for a heading that was not measured.

    Eq. (11) of the e-puck paper does not wrap angles, which is wrong across +-pi.
    """
    out[0] = measured[0] - predicted[0]
    out[1] = measured[1] - predicted[1]
    out[2] = wrap(measured[2] - predicted[2]) if measurements.has_heading[k] else 0.0
    if measurements.kind[k] == POLAR:
        out[1] = wrap(out[1])
