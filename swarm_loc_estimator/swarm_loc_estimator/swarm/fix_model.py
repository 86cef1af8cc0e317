"""Error model of absolute fixes."""

from __future__ import annotations

from dataclasses import dataclass

from swarm_loc_estimator.common.parameters import number


@dataclass(frozen=True)
class FixModel:
    """Error model of a robot's absolute fixes, beside or in place of the covariance of each."""

    systematic_share: float = number(
        0.0, "1", 0.0, 1.0, "share of a fix's variance that earlier fixes have, too; 1: fixes of a mapper"
    )
    position_sigma: float = number(0.0, "m", 0.0, 1e3, "of x and y, for fixes without covariance; 0: dropped")
    heading_sigma: float = number(0.0, "rad", 0.0, 10.0, "of the heading, for such fixes; 0: it is not used")
