"""From the row of the laser's spot to a distance: a hyperbola.

The laser is parallel to the camera's axis, a base b below it, so the spot of something at depth d lies at the
row p = p_inf + f b / d. The PushBot paper has a logarithm there (figure 2), which is tens of centimetres off
over 10 to 250 cm. An error of the row makes one of d^2 sigma_px / (f b), quadratic in the distance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

from swarm_loc_estimator.common.number_spec import number
from swarm_loc_vision.laser.row_bias import RowBias


class Distance(NamedTuple):
    """A distance and its standard deviation [m]; NaN where there is none."""

    distance: float
    sigma: float


UNKNOWN = Distance(math.nan, math.nan)


@dataclass(frozen=True)
class LaserCalibration:
    """How one robot's laser and camera sit to each other; `row_bias` is what tracked rows are off besides."""

    row_at_infinity: float = number(64.0, "px", -1000.0, 10_000.0, "p_inf, row of the spot at infinity")
    focal_base: float = number(6.3, "px m", 0.01, 10_000.0, "f b, focal length times base")
    row_sigma: float = number(0.1, "px", 0.001, 10.0, "standard deviation of the spot's row")
    camera_x: float = number(0.04, "m", -1.0, 1.0, "the camera before base_link")
    min_depth: float = number(0.1, "m", 0.001, 100.0, "smallest depth, from the camera, that was calibrated")
    max_depth: float = number(2.5, "m", 0.01, 100.0, "largest one")
    row_bias: RowBias = field(default_factory=RowBias)

    def row(self, depth: float) -> float:
        """Row [px] of the spot on what is so far from the camera [m]."""
        return self.row_at_infinity + self.focal_base / depth

    def distance(self, row: float, row_variance: float, locking: float = 0.0) -> Distance:
        """Distance from base_link to what the laser hits.

        Args:
            row: Of the spot as it was tracked [px].
            row_variance: Its variance as the tracker has it [px^2]; that of the calibration is the least.
            locking: What of it is the bias within pixels [px^2], which is known where `row_bias` reaches.

        Returns:
            NaN when it lies outside of what was calibrated.
        """
        offset = row - self.row_bias.at(row) - self.row_at_infinity
        if not self.focal_base / self.max_depth <= offset <= self.focal_base / self.min_depth:
            return UNKNOWN
        depth = self.focal_base / offset
        noise = row_variance - locking if self.row_bias.reaches(row) else row_variance
        sigma_px = math.sqrt(max(noise, self.row_sigma**2))
        return Distance(self.camera_x + depth, depth**2 * sigma_px / self.focal_base)
