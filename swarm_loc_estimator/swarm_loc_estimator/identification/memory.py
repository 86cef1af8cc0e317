"""State of the identification between images: chains of unidentified robots, and the view of the camera."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
import scipy

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.identification.chain import Chains

_GENERATION_NS = 10_000_000_000
"""Detections older than one to two of these times do not count for the view of the camera."""
_NOWHERE: FloatArray = np.zeros((0, 2))


class Outcome(IntEnum):
    """Result of the search for one robot in one image."""

    ANSWERED = 0
    UNDECIDED = 1  # the probability is too low
    NOT_MOVED = 2  # the robot has not moved since the last image, so no detection stands out
    CONFLICT = 3  # two robots claim the same detection
    CROWDED = 4  # too many detections
    NO_ODOMETRY = 5  # the motion of the robot is unknown


class Identities(NamedTuple):
    """Identities of the robots in an image."""

    stamp_ns: int  # Of the image
    place: IntArray  # (N,) index of each robot's detection in the message; -1: unknown, or not detected
    probability: FloatArray  # (N,) of the identity; where it is unknown, of the best candidate


class IdentityMemory:
    """Memory of the identification; part of the filter's state."""

    def __init__(self) -> None:
        self.chains: dict[int, Chains] = {}  # Unidentified robots and their chains; chains are immutable
        self.newest: Identities | None = None  # Identities in the newest image; None before the first
        # (len(Outcome),) number of searches with each outcome
        self.outcomes: IntArray = np.zeros(len(Outcome), dtype=np.int64)
        self._hulls = (_NOWHERE, _NOWHERE)
        self._generation_ns = 0

    def copy(self) -> IdentityMemory:
        """An independent copy."""
        other = IdentityMemory.__new__(IdentityMemory)
        vars(other).update(vars(self))
        other.chains, other.outcomes = self.chains.copy(), self.outcomes.copy()
        return other

    def see(self, positions: FloatArray, stamp_ns: int) -> None:
        """Extend the view of the camera by positions (n, 2) detected in an image."""
        older, newer = self._hulls
        if stamp_ns - self._generation_ns > _GENERATION_NS:
            older, newer, self._generation_ns = newer, _NOWHERE, stamp_ns
        self._hulls = (older, convex_hull(np.concatenate([newer, positions])))

    def is_in_view(self, positions: FloatArray, margin: FloatArray) -> BoolArray:
        """Whether positions (k, 2) lie inside the recent view of the camera, by a margin (k,) [m].

        The view of a plane is convex, so it contains the convex hull of all detections.
        """
        inside = np.zeros(len(positions), dtype=bool)
        for hull in self._hulls:
            if len(hull) < 3:
                continue
            edge = np.roll(hull, -1, axis=0) - hull
            normal = np.column_stack([-edge[:, 1], edge[:, 0]]) / np.hypot(edge[:, 0], edge[:, 1])[:, None]
            depth = np.einsum("khi,hi->kh", positions[:, None] - hull[None], normal)
            inside |= depth.min(axis=1) > margin
        return inside


def convex_hull(points: FloatArray) -> FloatArray:
    """Corners (h, 2) of the convex hull of points (n, 2), counter-clockwise; the two ends of a line."""
    try:
        return np.asarray(points[scipy.spatial.ConvexHull(points).vertices])
    except (scipy.spatial.QhullError, ValueError):  # fewer than three points, or all in a line
        ordered = np.unique(points, axis=0)
        return ordered[[0, -1]] if len(ordered) > 1 else ordered
