"""Camera calibration files as written by ROS's camera_calibration."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from swarm_loc_estimator.common.codec import shown
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.common.yaml_tree import read_tree

_COEFFICIENTS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
_IDENTITY: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


class CalibrationFileError(UserError):
    """A camera calibration that cannot be used; the message is one sentence."""


@dataclass(frozen=True)
class CameraCalibration:
    """Calibration of a camera: the content of sensor_msgs/CameraInfo."""

    width: int  # Columns of the image [px]
    height: int  # Rows [px]
    model: str  # Distortion model
    distortion: tuple[float, ...]  # Coefficients of the distortion model
    matrix: tuple[float, ...]  # K (9,) row-major [px]
    rectification: tuple[float, ...]  # R (9,) row-major
    projection: tuple[float, ...]  # P (12,) row-major [px]


def load_calibration(path: Path, width: int, height: int) -> CameraCalibration:
    """Read the calibration of a camera whose images have this size [px].

    Raises CalibrationFileError if the file cannot be read, is incomplete, or is for another image size.
    """
    tree = read_tree(path, CalibrationFileError)
    if not isinstance(tree, dict):
        raise CalibrationFileError(f"{path} is not a camera calibration.")

    def value_of(key: str) -> Any:
        if key not in tree:
            raise CalibrationFileError(f"{path} has no {key}.")
        return tree[key]

    def numbers(key: str, count: int) -> tuple[float, ...]:
        """The data of a matrix."""
        value = value_of(key)
        data = value.get("data") if isinstance(value, dict) else None
        if not isinstance(data, list) or len(data) != count or not all(map(_is_number, data)):
            raise CalibrationFileError(f"{path}: {key}.data must be a list of {count} finite numbers.")
        return tuple(float(number) for number in data)

    # the file must be for these images, and of a known model
    size = (value_of("image_width"), value_of("image_height"))
    if size != (width, height):
        raise CalibrationFileError(
            f"{path} is for images of {shown(size[0])} x {shown(size[1])} px,"
            f" but the camera's have {width} x {height} px."
        )
    model = value_of("distortion_model")
    if model not in _COEFFICIENTS:
        known = ", ".join(_COEFFICIENTS)
        raise CalibrationFileError(f"{path}: distortion_model is {shown(model)} but must be one of {known}.")
    k = numbers("camera_matrix", 9)
    if not (k[0] > 0.0 and k[4] > 0.0):
        raise CalibrationFileError(
            f"{path}: camera_matrix has the focal lengths {k[0]:g} and {k[4]:g} px,"
            " but they must be above 0 px."
        )
    # without rectification the projection is K
    lens, turn = numbers("distortion_coefficients", _COEFFICIENTS[model]), _IDENTITY
    projection: tuple[float, ...] = (*k[0:3], 0.0, *k[3:6], 0.0, *k[6:9], 0.0)
    if "rectification_matrix" in tree:
        turn = numbers("rectification_matrix", 9)
    if "projection_matrix" in tree:
        projection = numbers("projection_matrix", 12)
    return CameraCalibration(width, height, model, lens, k, turn, projection)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
