"""Settings of the mapper: what its robots' motion and lasers are like."""

from __future__ import annotations

import math
from dataclasses import dataclass

from swarm_loc_estimator.common.parameters import number


@dataclass(frozen=True)
class MapperSettings:
    """Noise of the robots, limits, and how far a robot goes at once."""

    max_range: float = number(2.5, "m", 0.2, 50.0, "farthest reflection of a laser that is seen")
    distance_noise: float = number(0.018, "1", 0.0, 1.0, "error of driven paths, per path", above=True)
    heading_noise: float = number(
        math.radians(0.45), "rad", 0.0, 1.0, "error of the heading over one drive", above=True
    )
    course_noise: float = number(0.006, "rad/m^0.5", 0.0, 1.0, "heading error, per square root of the path")
    turn_noise: float = number(
        0.0018, "1", 0.0, 0.1, "error of turns, per turn and square root of turns", above=True
    )
    usual_slip: float = number(0.02, "1", 0.0, 0.5, "share of turns that wheels usually slip")
    slip_sigma: float = number(0.03, "1", 0.0, 0.5, "how much that differs from robot to robot", above=True)
    robot_radius: float = number(0.07, "m", 0.0, 1.0, "minimum distance of the centre from walls", above=True)
    margin: float = number(0.09, "m", 0.0, 1.0, "distance kept between robot and walls")
    max_hop: float = number(1.2, "m", 0.1, 10.0, "longest drive between two stops")
    max_stops: int = number(2000, "1", 50, 100000, "stops kept; later ones locate robots, the map stays")
    max_cells: int = number(16_000_000, "1", 10_000, 400_000_000, "largest grid")
