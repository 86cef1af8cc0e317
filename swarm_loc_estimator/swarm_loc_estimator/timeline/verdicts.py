"""Outcomes of measurements, and the reasons under which the unused ones are counted."""

from __future__ import annotations

from enum import IntEnum

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.filter import sequential_update


class Verdict(IntEnum):
    """Outcome of a measurement."""

    OPEN = sequential_update.OPEN  # not processed yet
    USED = sequential_update.USED
    GATED = sequential_update.GATED  # rejected by the innovation gate
    CONSTRAINT = 3  # stored to initialize a robot
    NOT_LOCALIZED = 4  # neither side is localized, or a robot has no odometry yet
    UNASSIGNED = 5  # an anonymous detection that matches no robot
    AMBIGUOUS = 6  # an anonymous detection that matches several robots
    OFF_MAP = 7  # a scan that contradicts the map at the pose of its robot
    BLOCKED = 8  # a scan of which too few beams meet walls of the map


_DROPS = {
    "gated": Verdict.GATED,
    "not_localized": Verdict.NOT_LOCALIZED,
    "aerial_unassigned": Verdict.UNASSIGNED,
    "aerial_ambiguous": Verdict.AMBIGUOUS,
    "scan_off_map": Verdict.OFF_MAP,
    "scan_blocked": Verdict.BLOCKED,
}


def drops_by_reason(counts: IntArray) -> dict[str, int]:
    """Numbers of unused measurements by reason, from those by verdict (len(Verdict),)."""
    return {reason: int(counts[verdict]) for reason, verdict in _DROPS.items()}
