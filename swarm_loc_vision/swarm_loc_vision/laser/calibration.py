"""From the row of the laser's spot to a distance: a hyperbola.

The laser is parallel to the camera's axis, a base b below it, so the spot of something at depth d lies at the
row p = p_inf + f b / d. (The PushBot paper uses a logarithm, figure 2, which is tens of centimetres off over
10 to 250 cm.) An error sigma_px of the row makes an error d^2 sigma_px / (f b) of the distance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.parameters import NumberSpec, UserError, number, number_specs
from swarm_loc_estimator.common.yaml_tree import Tree, YamlTreeError, read_tree
from swarm_loc_estimator.swarm.tree_checks import WHOLE_FILE, TreeChecks

STEP_PX = 0.2  # Distance of two knots: the bias has a period of one pixel, with harmonics


@dataclass(frozen=True)
class RowBias:
    """Tracked row minus true row, linear between knots."""

    first_row: float = number(0.0, "px", -1000.0, 10_000.0, "row of the first knot")
    step: float = number(STEP_PX, "px", 0.0, 10.0, "from knot to knot", above=True)
    offsets: tuple[float, ...] = ()  # (K,) bias at each knot [px]; empty: unknown

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
_OFFSET = NumberSpec("px", -10.0, 10.0, False, "tracked row minus true row at each knot")
_MAX_KNOTS = 10_000


class LaserFileError(UserError):
    """A file that is no laser calibration; the message is one sentence."""


def save_laser(path: Path, calibration: LaserCalibration) -> None:
    """Write a calibration.

    Raises:
        LaserFileError: It cannot be written there.
    """
    lines = _lines(calibration)
    bias = calibration.row_bias
    if bias.offsets:
        offsets = ", ".join(f"{offset:.4f}" for offset in bias.offsets)
        within = [*_lines(bias), f"offsets: [{offsets}]  # {_OFFSET.doc} [px]"]
        lines += [f"{_BIAS}:", *(f"  {line}" for line in within)]
    try:
        path.write_text(_HEAD + "\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise LaserFileError(f"{path} cannot be written: {error.strerror}.") from error


def _lines(numbers: LaserCalibration | RowBias) -> list[str]:
    return [
        f"{name}: {getattr(numbers, name):.9g}  # {spec.doc} [{spec.unit}]"
        for name, spec in number_specs(type(numbers)).items()
    ]


def load_laser(path: Path) -> LaserCalibration:
    """Read a calibration.

    Raises:
        LaserFileError: There is none, or a number is missing, unknown or out of its range.
    """
    try:
        tree = read_tree(path)
    except YamlTreeError as error:
        raise LaserFileError(str(error)) from error
    checks, specs = TreeChecks(path, LaserFileError), number_specs(LaserCalibration)
    content = checks.mapping(tree, WHOLE_FILE, (*specs, _BIAS), required=specs)
    numbers: Any = {name: checks.number(content[name], name, spec) for name, spec in specs.items()}
    calibration = LaserCalibration(**numbers, row_bias=_row_bias(checks, content.get(_BIAS)))
    if calibration.min_depth >= calibration.max_depth:
        raise checks.error(
            "min_depth", calibration.min_depth, f"must be below max_depth = {calibration.max_depth}"
        )
    return calibration


def _row_bias(checks: TreeChecks, tree: Tree) -> RowBias:
    if tree is None:
        return RowBias()
    specs, key = number_specs(RowBias), f"{_BIAS}.offsets"
    section = checks.mapping(tree, _BIAS, (*specs, "offsets"), required=(*specs, "offsets"))
    offsets = checks.items(section["offsets"], key)
    if len(offsets) > _MAX_KNOTS:
        raise checks.said(f"{key} has {len(offsets)} numbers but must have at most {_MAX_KNOTS}")
    numbers: Any = {
        name: checks.number(section[name], f"{_BIAS}.{name}", spec) for name, spec in specs.items()
    }
    knots: Any = tuple(checks.number(offset, f"{key}[{k}]", _OFFSET) for k, offset in enumerate(offsets))
    return RowBias(**numbers, offsets=knots)
