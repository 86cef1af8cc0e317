"""Numerical settings of the marker detector."""

from __future__ import annotations

from dataclasses import dataclass

from swarm_loc_estimator.common.number_spec import number


@dataclass(frozen=True)
class DetectorSettings:
    """Numbers of the detector, with units and ranges.

    Candidates: `min_side_px`, `min_contrast`. Poses: the rest.
    """

    marker_length: float = number(
        0.05, "m", 0.001, 10.0, "side of a marker that has no other, black border included"
    )
    min_side_px: float = number(8.0, "px", 6.0, 1000.0, "smaller markers are not looked for")
    min_contrast: float = number(4.0, "1", 1.0, 100.0, "by how much ink is darker than paper [counts]")
    tilt_sigma: float = number(
        0.0, "rad", 0.0, 1.0, "how upright markers stand towards a level camera's mount; 0: any way up"
    )
    ambiguity: float = number(
        16.0, "1", 0.0, 1e4, "the mirrored pose is told when it fits worse by no more than this chi square"
    )
