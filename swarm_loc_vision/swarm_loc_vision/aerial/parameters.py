"""Parameters of `aerial_camera_node`."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.parameters import choice, number, text
from swarm_loc_vision.common.images import TRANSPORTS

BRIGHT, DARK = 1.0, -1.0
"""Polarities of discs: brighter or darker than the floor."""
POLARITIES = {"auto": (BRIGHT, DARK), "bright": (BRIGHT,), "dark": (DARK,)}
"""The polarities that are tried, by the value of the parameter."""


@dataclass(frozen=True)
class AerialSettings:
    """Numbers of the aerial detector, with units and ranges.

    Ground: the first three. Robots: the rest.
    """

    control_sigma_px: float = number(
        1.0, "px", 0.01, 100.0, "noise of the control points' pixels, one standard deviation"
    )
    control_sigma: float = number(
        0.003, "m", 0.0, 1.0, "noise of the control points' places, one standard deviation"
    )
    max_residual: float = number(
        4.0, "1", 1.0, 1e3, "reprojection residual beyond which control points are refused, in their sigmas"
    )
    robot_height: float = number(0.0, "m", 0.0, 10.0, "height of the robots' tops above the floor")
    robot_height_sigma: float = number(0.003, "m", 0.0, 1.0, "noise of that height, one standard deviation")
    pixel_sigma: float = number(
        0.2, "px", 0.001, 10.0, "error of a robot's centre that all its edges share, one standard deviation"
    )
    robot_diameter: float = number(
        0.0, "m", 0.0, 10.0, "diameter of the pattern or blob on a robot; 0: estimated from the images"
    )
    min_diameter_px: float = number(6.0, "px", 4.0, 1000.0, "robots that look smaller are not looked for")
    x_min: float = number(-1e4, "m", -1e4, 1e4, "robots are looked for from here on in map")
    x_max: float = number(1e4, "m", -1e4, 1e4, "up to here")
    y_min: float = number(-1e4, "m", -1e4, 1e4, "and from here on")
    y_max: float = number(1e4, "m", -1e4, 1e4, "up to here")
    min_contrast: float = number(
        0.12, "1", 0.01, 3.0, "by how much robots and floor differ in the logarithm of brightness"
    )
    min_coverage: float = number(
        0.55, "1", 0.3, 1.0, "share of a robot's circle that must show an edge against the floor"
    )
    max_robots: int = number(200, "1", 1, 2000, "detections in one image at most, the clearest ones")

    @property
    def region(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper x and y (2,) between which robots are looked for [m]."""
        return np.array([self.x_min, self.y_min]), np.array([self.x_max, self.y_max])


@dataclass(frozen=True)
class AerialParameters:
    """Parameters of `aerial_camera_node`; those of the detector itself are its settings."""

    image_transport: str = choice("raw", tuple(TRANSPORTS), "how images come: as they are, or as JPEG or PNG")
    control_points_file: str = text(
        "", "path of the control points, floor markers and intrinsics; empty: none, and nothing is published"
    )
    polarity: str = choice(
        "auto", tuple(POLARITIES), "whether robots are brighter or darker than the floor; auto: as clearer"
    )
    settings: AerialSettings = field(default_factory=AerialSettings, metadata={"numbers_of": AerialSettings})
