"""From the row of the laser's spot to a distance: a hyperbola.

The laser is parallel to the camera's axis, a base b below it, so the spot of something at depth d lies at the
row p = p_inf + f b / d. (The PushBot paper uses a logarithm, figure 2, which is tens of centimetres off over
10 to 250 cm.) An error sigma_px of the row makes an error d^2 sigma_px / (f b) of the distance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.parameters import NumberSpec, UserError, number, number_specs
from swarm_loc_estimator.common.yaml_tree import Tree, YamlTreeError, read_tree

STEP_PX = 0.2
"""Distance of two knots: the bias has a period of one pixel, with harmonics."""


@dataclass(frozen=True)
class RowBias:
    """Tracked row minus true row, linear between knots.

    Attributes:
        first_row: Row of the first knot [px].
        step: From knot to knot [px].
        offsets: (K,) bias at each knot [px]; empty: unknown.
    """

    first_row: float = 0.0
    step: float = STEP_PX
    offsets: tuple[float, ...] = ()

    def reaches(self, row: float) -> bool:
        """Whether a tracked row [px] lies between knots."""
        return 0.0 <= (row - self.first_row) / self.step < len(self.offsets) - 1

    def at(self, row: float) -> float:
        """The bias at a tracked row [px]; zero beyond the knots."""
        if not self.reaches(row):
            return 0.0
        place = (row - self.first_row) / self.step
        k = math.floor(place)
        share = place - k
        return (1.0 - share) * self.offsets[k] + share * self.offsets[k + 1]

    def at_each(self, rows: FloatArray) -> FloatArray:
        """The bias (N,) at tracked rows (N,) [px]."""
        return np.array([self.at(row) for row in rows.tolist()])


class Distance(NamedTuple):
    """A distance and its standard deviation [m]; NaN where there is none."""

    distance: float
    sigma: float


UNKNOWN = Distance(math.nan, math.nan)


@dataclass(frozen=True)
class LaserCalibration:
    """Geometry of one robot's laser and camera; `row_bias` is subtracted from tracked rows."""

    row_at_infinity: float = number(64.0, "px", -1000.0, 10_000.0, "p_inf, row of the spot at infinity")
    focal_base: float = number(6.3, "px m", 0.01, 10_000.0, "f b, focal length times base")
    row_sigma: float = number(0.1, "px", 0.001, 10.0, "standard deviation of the spot's row")
    camera_x: float = number(0.04, "m", -1.0, 1.0, "position of the camera ahead of base_link")
    min_depth: float = number(0.1, "m", 0.001, 100.0, "smallest depth, from the camera, that was calibrated")
    max_depth: float = number(2.5, "m", 0.01, 100.0, "largest depth")
    row_bias: RowBias = field(default_factory=RowBias)

    def row(self, depth: float) -> float:
        """Row [px] of the spot on an object at a depth from the camera [m]."""
        return self.row_at_infinity + self.focal_base / depth

    def distance(self, row: float, row_variance: float, locking: float = 0.0) -> Distance:
        """Distance from base_link to what the laser hits.

        Args:
            row: Of the spot as it was tracked [px].
            row_variance: Its variance by the tracker [px^2]; at least that of the calibration is used.
            locking: Its part that is the bias within pixels [px^2]; left out where `row_bias` is known.

        Returns:
            NaN outside the calibrated depths.
        """
        offset = row - self.row_bias.at(row) - self.row_at_infinity
        if not self.focal_base / self.max_depth <= offset <= self.focal_base / self.min_depth:
            return UNKNOWN
        depth = self.focal_base / offset
        noise = row_variance - locking if self.row_bias.reaches(row) else row_variance
        sigma_px = math.sqrt(max(noise, self.row_sigma**2))
        return Distance(self.camera_x + depth, depth**2 * sigma_px / self.focal_base)


_HEAD = (
    "# Laser and event camera of one robot: the spot of what is at depth d lies at the row p_inf + f b / d.\n"
)
_BIAS = "row_bias"
_FIRST_ROW = NumberSpec("px", -1000.0, 10_000.0, False, "row of the first knot")
_STEP = NumberSpec("px", 0.0, 10.0, True, "from knot to knot")
_OFFSET = NumberSpec("px", -10.0, 10.0, False, "tracked row minus true row at each knot")
_MAX_KNOTS = 10_000


class LaserFileError(UserError):
    """A file that is no laser calibration; the message is one sentence."""


def save_laser(path: Path, calibration: LaserCalibration) -> None:
    """Write a calibration.

    Raises:
        LaserFileError: It cannot be written there.
    """
    specs = number_specs(LaserCalibration)
    lines = [
        f"{name}: {getattr(calibration, name):.9g}  # {spec.doc} [{spec.unit}]"
        for name, spec in specs.items()
    ]
    bias = calibration.row_bias
    if bias.offsets:
        offsets = ", ".join(f"{offset:.4f}" for offset in bias.offsets)
        lines += [
            f"{_BIAS}:",
            f"  first_row: {bias.first_row:.9g}  # {_FIRST_ROW.doc} [px]",
            f"  step: {bias.step:.9g}  # {_STEP.doc} [px]",
            f"  offsets: [{offsets}]  # {_OFFSET.doc} [px]",
        ]
    try:
        path.write_text(_HEAD + "\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise LaserFileError(f"{path} cannot be written: {error.strerror}.") from error


def load_laser(path: Path) -> LaserCalibration:
    """Read a calibration.

    Raises:
        LaserFileError: There is none, or a number is missing, unknown or out of its range.
    """
    try:
        content = read_tree(path)
    except YamlTreeError as error:
        raise LaserFileError(str(error)) from error
    specs = number_specs(LaserCalibration)
    if not isinstance(content, dict) or set(content) - {_BIAS} != set(specs):
        raise LaserFileError(f"{path} must have exactly the keys {', '.join(specs)}, and may have {_BIAS}.")
    values = {name: _number(path, name, content[name], spec) for name, spec in specs.items()}
    if values["min_depth"] >= values["max_depth"]:
        raise LaserFileError(
            f"{path}: min_depth = {values['min_depth']} must be below max_depth = {values['max_depth']}."
        )
    return LaserCalibration(
        **values, row_bias=_row_bias(path, content[_BIAS]) if _BIAS in content else RowBias()
    )


def _row_bias(path: Path, content: Tree) -> RowBias:
    if not isinstance(content, dict) or set(content) != {"first_row", "step", "offsets"}:
        raise LaserFileError(f"{path}: {_BIAS} must have exactly the keys first_row, step, offsets.")
    offsets = content["offsets"]
    if not isinstance(offsets, list) or len(offsets) > _MAX_KNOTS:
        raise LaserFileError(f"{path}: {_BIAS}.offsets must be a list of at most {_MAX_KNOTS} numbers.")
    return RowBias(
        _number(path, f"{_BIAS}.first_row", content["first_row"], _FIRST_ROW),
        _number(path, f"{_BIAS}.step", content["step"], _STEP),
        tuple(_number(path, f"{_BIAS}.offsets", offset, _OFFSET) for offset in offsets),
    )


def _number(path: Path, name: str, value: Tree, spec: NumberSpec) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not spec.allows(value):
        raise LaserFileError(f"{path}: {name} = {value!r} must be a number in {spec.range_text}.")
    return float(value)
