"""ROS parameters of `markers_node`. No ROS here."""

from __future__ import annotations

from dataclasses import dataclass

from swarm_loc_estimator.common.parameters import number, text


@dataclass(frozen=True)
class MarkersParameters:
    """Parameters of `markers_node`."""

    swarm_file: str = text("", "path of the swarm description", required=True)
    rate: float = number(10.0, "Hz", 0.1, 100.0, "how often markers are published, at most")
