"""What is remembered of aerial images: chains of robots that look for themselves, and the camera's view."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.identification.chain import Chains

_GENERATION_NS = 10_000_000_000
"""What was seen longer ago than one to two such times says nothing of where the camera looks now."""
_NOWHERE: FloatArray = np.zeros((0, 2))


class Outcome(IntEnum):
    """What an image told a robot that looked for itself in it."""

    ANSWERED = 0
    UNDECIDED = 1  # not yet sure enough
    NOT_MOVED = 2  # the robot has not moved since the image before, so all detections are alike to it
    CONFLICT = 3  # two robots took the same detection for themselves
    CROWDED = 4  # more detections than can be looked through
    NO_ODOMETRY = 5  # how the robot has moved is not known


class Identities(NamedTuple):
    """Who is who in an image.

    Attributes:
        stamp_ns: Of the image.
        place: (N,) which detection each robot is, counted as in the message; -1: not known, or not there.
        probability: (N,) of that; where it is not known, of the best guess.
    """

    stamp_ns: int
    place: IntArray
    probability: FloatArray


class IdentityMemory:
    """What has come of aerial images so far; part of the filter's state.

    Attributes:
        chains: Robots that look for themselves, with what they know; the chains are never written to.
        newest: Who is who in the newest image; None before the first.
        outcomes: (len(Outcome),) how many times a robot's look at an image ended so.
    """

    def __init__(self) -> None:
        self.chains: dict[int, Chains] = {}
        self.newest: Identities | None = None
        self.outcomes: IntArray = np.zeros(len(Outcome), dtype=np.int64)
        self._hulls = (_NOWHERE, _NOWHERE)
        self._begun_ns = 0

    def copy(self) -> IdentityMemory:
        """An independent copy."""
        other = IdentityMemory.__new__(IdentityMemory)
        vars(other).update(vars(self))
        other.chains, other.outcomes = self.chains.copy(), self.outcomes.copy()
        return other

    def see(self, positions: FloatArray, stamp_ns: int) -> None:
        """Note where an image shows something (n, 2)."""
        older, newer = self._hulls
        if stamp_ns - self._begun_ns > _GENERATION_NS:
            older, newer, self._begun_ns = newer, _NOWHERE, stamp_ns
        self._hulls = (older, convex_hull(np.concatenate([newer, positions])))

    def is_in_view(self, positions: FloatArray, margin: FloatArray) -> BoolArray:
        """Whether places (k, 2) lie inside of what was seen of late, by a margin (k,) [m].

        What a camera sees of a plane is convex; so it sees all that lies between things that it has seen.
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
    """The corners (h, 2) of the convex hull of points (n, 2), counter-clockwise (Andrew's monotone chain)."""
    ordered = np.unique(points, axis=0)
    if len(ordered) < 3:
        return ordered
    return np.array(_half(ordered.tolist())[:-1] + _half(ordered[::-1].tolist())[:-1])


def _half(points: list[list[float]]) -> list[list[float]]:
    """Half of a hull, along which points in order turn left."""
    out: list[list[float]] = []
    for x, y in points:
        while len(out) > 1:
            (ax, ay), (bx, by) = out[-2:]
            if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0.0:
                break
            out.pop()
        out.append([x, y])
    return out
