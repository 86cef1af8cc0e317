"""Parameters of `aerial_camera_node`."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.parameters import autostart, choice, number, text
from swarm_loc_vision.common.images import TRANSPORTS

BRIGHT, DARK = 1.0, -1.0  # Polarities of discs: brighter or darker than the floor
POLARITIES = {"auto": (BRIGHT, DARK), "bright": (BRIGHT,), "dark": (DARK,)}
"""The polarities that are tried, by the value of the parameter."""


@dataclass(frozen=True)
class AerialSettings:
    """Numbers of the aerial detector; the first three are of the control points."""

    control_sigma_px: float = number(
        1.0, "px", 0.01, 100.0, "standard deviation of the control points' pixels"
    )
    control_sigma: float = number(0.003, "m", 0.0, 1.0, "standard deviation of the control points' places")
    max_residual: float = number(
        4.0, "1", 1.0, 1e3, "reprojection residual beyond which control points are refused, in their sigmas"
    )
    robot_height: float = number(0.0, "m", 0.0, 10.0, "height of the robots' tops above the floor")
    robot_height_sigma: float = number(
        0.001, "m", 0.0, 1.0, "standard deviation of that height, one for all robots"
    )
    pixel_sigma: float = number(
        0.1, "px", 0.001, 10.0, "standard deviation of a robot's centre by the model of the lens"
    )
    robot_diameter: float = number(
        0.0, "m", 0.0, 10.0, "diameter of the pattern or blob on a robot; 0: estimated from the images"
    )
    min_diameter_px: float = number(6.0, "px", 4.0, 1000.0, "smallest diameter of robots in the image")
    x_min: float = number(-1e4, "m", -1e4, 1e4, "lower bound of the searched region in map")
    x_max: float = number(1e4, "m", -1e4, 1e4, "upper bound of the searched region in map")
    y_min: float = number(-1e4, "m", -1e4, 1e4, "lower bound of the searched region in map")
    y_max: float = number(1e4, "m", -1e4, 1e4, "upper bound of the searched region in map")
    min_contrast: float = number(
        0.12, "1", 0.01, 3.0, "least difference of robots and floor in the logarithm of brightness"
    )
    min_coverage: float = number(
        0.55, "1", 0.3, 1.0, "share of a robot's circle that must show an edge against the floor"
    )
    max_robots: int = number(200, "1", 1, 2000, "most detections in one image; the clearest are kept")

    @property
    def region(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds (2,) of the searched region [m]."""
        return np.array([self.x_min, self.y_min]), np.array([self.x_max, self.y_max])


@dataclass(frozen=True)
class AerialParameters:
    """Parameters of `aerial_camera_node`."""

    autostart: bool = autostart()
    image_transport: str = choice("raw", tuple(TRANSPORTS), "transport: uncompressed images, or JPEG or PNG")
    control_points_file: str = text(
        "", "path of the control points, floor markers and intrinsics; without one nothing is published"
    )
    polarity: str = choice(
        "auto", tuple(POLARITIES), "whether robots are brighter or darker than the floor; auto: the clearer"
    )
    settings: AerialSettings = field(default_factory=AerialSettings, metadata={"numbers_of": AerialSettings})
