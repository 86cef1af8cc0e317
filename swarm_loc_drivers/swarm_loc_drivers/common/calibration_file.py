"""Camera calibration files as written by ROS's camera_calibration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from swarm_loc_estimator.common.codec import shown
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.common.yaml_tree import read_tree

_COEFFICIENTS = {"plumb_bob": (5,), "rational_polynomial": (8,), "equidistant": (4,)}
_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


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

    Raises:
        CalibrationFileError: The file cannot be read, is incomplete, or is for another image size.
    """
    tree = read_tree(path, CalibrationFileError)
    if not isinstance(tree, dict):
        raise CalibrationFileError(f"{path} is not a camera calibration.")
    return _Reader(path, tree).calibration(width, height)


class _Reader:
    """Reads the values of one file."""

    def __init__(self, path: Path, tree: dict[Any, Any]) -> None:
        self._path = path
        self._tree = tree

    def calibration(self, width: int, height: int) -> CameraCalibration:
        size = (self._value("image_width"), self._value("image_height"))
        if size != (width, height):
            raise CalibrationFileError(
                f"{self._path} is for images of {shown(size[0])} x {shown(size[1])} px,"
                f" but the camera's have {width} x {height} px."
            )
        model = self._value("distortion_model")
        if model not in _COEFFICIENTS:
            known = ", ".join(_COEFFICIENTS)
            raise CalibrationFileError(
                f"{self._path}: distortion_model is {shown(model)} but must be one of {known}."
            )
        matrix = self._numbers("camera_matrix", (9,))
        if not (matrix[0] > 0.0 and matrix[4] > 0.0):
            raise CalibrationFileError(
                f"{self._path}: camera_matrix has the focal lengths {matrix[0]:g} and {matrix[4]:g} px,"
                " but they must be above 0 px."
            )
        plain_projection = (*matrix[0:3], 0.0, *matrix[3:6], 0.0, *matrix[6:9], 0.0)
        return CameraCalibration(
            width,
            height,
            model,
            self._numbers("distortion_coefficients", _COEFFICIENTS[model]),
            matrix,
            self._numbers("rectification_matrix", (9,), _IDENTITY),
            self._numbers("projection_matrix", (12,), plain_projection),
        )

    def _value(self, key: str) -> Any:
        if key not in self._tree:
            raise CalibrationFileError(f"{self._path} has no {key}.")
        return self._tree[key]

    def _numbers(
        self, key: str, counts: Sequence[int], default: tuple[float, ...] | None = None
    ) -> tuple[float, ...]:
        """The data of a matrix; `default` if the file lacks it."""
        if default is not None and key not in self._tree:
            return default
        value = self._value(key)
        data = value.get("data") if isinstance(value, dict) else None
        right = isinstance(data, list) and len(data) in counts and all(map(_is_number, data))
        if not right or data is None:
            wanted = " or ".join(map(str, counts))
            raise CalibrationFileError(f"{self._path}: {key}.data must be a list of {wanted} finite numbers.")
        return tuple(float(number) for number in data)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
