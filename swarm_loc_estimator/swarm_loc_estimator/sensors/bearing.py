"""Measurement model of the direction of a marker; it is evaluated by its record."""

from __future__ import annotations

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.filter.measurement_model import (
    POLAR,
    MeasurementArray,
    MeasurementModel,
    Prediction,
    predict,
    register,
)

BEARING = 4  # Number of the model; the first component of a value is the bearing, positive to the left [rad]


def _predict_bearing(one: MeasurementArray, observer: FloatArray, target: FloatArray) -> Prediction:
    polar = one.copy()
    polar["kind"] = POLAR
    value, jacobian = predict(polar, observer[None], target[None])
    row = jacobian[0, 1:2, :3]
    return Prediction(value[0, 1:2], -row, row)


def _bearing_innovation(one: MeasurementArray, predicted: FloatArray) -> FloatArray:
    return wrap_angle(one["value"][0, :1] - predicted)


register(MeasurementModel("bearing", BEARING, 1, _predict_bearing, _bearing_innovation))
