"""Candidates for discs of known size: every edge votes for the centres that it could belong to.

This is the Hough transform of circles with the direction of each edge (Kimme, Ballard and Sklansky 1975): an
edge between a disc and the floor points at its centre, so touching discs keep the votes of all of their rims
that still border on the floor, and shadows and tiles, which are not round, spread theirs.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.aerial.rectification import Plain

BRIGHT, DARK = 1.0, -1.0
"""Polarities: of discs brighter and darker than the floor."""

_RADII = np.array([0.82, 0.91, 1.0, 1.09, 1.18])
_MAX_EDGES = 400_000
_EDGE_SHARE = 0.15
"""Of the least contrast, the slope that an edge must have, per pixel."""
_BLUR_SHARE, _APART_SHARE = 0.08, 0.3
"""Of a diameter: smoothing of votes, and how near two candidates may be."""


class Edges:
    """Edges of an image.

    Args:
        log: (rows, columns) logarithm of brightness.
        seen: (rows, columns) where it shows something.
        contrast: The least step that counts.
    """

    def __init__(self, log: Plain, seen: NDArray[np.bool_], contrast: float) -> None:
        self._shape = log.shape
        # divided by 32 Scharr's kernel gives the change per pixel
        across, down = (
            np.asarray(cv2.Scharr(log, cv2.CV_32F, *axis), np.float32) / np.float32(32.0)
            for axis in ((1, 0), (0, 1))
        )
        slope = np.hypot(across, down)
        slope[~_shrunk(seen)] = 0.0
        least = _EDGE_SHARE * contrast
        rows, columns = np.nonzero(slope > least)
        strength = slope[rows, columns]
        if len(strength) > _MAX_EDGES:
            kept = np.argpartition(-strength, _MAX_EDGES)[:_MAX_EDGES]
            rows, columns, strength = rows[kept], columns[kept], strength[kept]
        self._place = np.stack([columns, rows], axis=1).astype(np.float32)
        towards = np.stack([across[rows, columns], down[rows, columns]], axis=1)
        self._towards = towards / np.maximum(strength, 1e-12)[:, None]
        # strong edges count little more than weak ones: a shadow's rim may weaken one side of a disc
        self._weight = strength / (strength + 2.0 * least)

    def votes(self, diameter_px: float, polarity: float) -> Plain:
        """(rows, columns) votes for centres of discs."""
        rows, columns = self._shape
        total = np.zeros(rows * columns)
        for radius in 0.5 * diameter_px * _RADII:
            cells = np.rint(self._place + polarity * radius * self._towards).astype(np.int64)
            inside = ((cells >= 0) & (cells < [columns, rows])).all(axis=1)
            flat = cells[inside, 1] * columns + cells[inside, 0]
            total += np.bincount(flat, self._weight[inside], rows * columns)
        votes = total.reshape(self._shape).astype(np.float32)
        return np.asarray(cv2.GaussianBlur(votes, (0, 0), max(_BLUR_SHARE * diameter_px, 0.8)), np.float32)


def peaks(votes: Plain, diameter_px: float, most: int) -> FloatArray:
    """(C, 2) columns and rows of the highest peaks of votes, at most so many, the highest first."""
    side = 2 * max(int(_APART_SHARE * diameter_px), 1) + 1
    highest = cv2.dilate(votes, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)))
    rows, columns = np.nonzero((votes >= highest) & (votes > 0.0))
    order = np.argsort(-votes[rows, columns], kind="stable")[:most]
    return np.stack([columns[order], rows[order]], axis=1).astype(float)


def _shrunk(seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Where everything around is seen, too: the rim of what is seen is no edge."""
    return np.asarray(cv2.erode(seen.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0)
