"""All ids of the BCH family in every rotation and both borders, through the detector; and their cost."""

from __future__ import annotations

import time
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from swarm_loc_vision.markers.decoder import Dictionary
from swarm_loc_vision.markers.detector import DetectorSettings, MarkerDetector
from swarm_loc_vision.markers.families import Family, draw_marker, family_named

Gray = NDArray[np.uint8]

_PIXELS_PER_CELL, _MARGIN = 4, 2
_COLUMNS, _ROWS = 24, 18
_BLUR_PX, _NOISE = 0.6, 2.0


@dataclass(frozen=True)
class BchFigures:
    """What came of it."""

    ids_right: int  # Ids that were read right in all rotations and with both borders
    us_per_candidate: float  # To find the nearest of all 4096 words in all rotations, CPU time


def measure_bch() -> BchFigures:
    """Read every id, and time it."""
    right = np.ones(4096, np.bool_)
    for name in ("artoolkit_bch_thin", "artoolkit_bch_thick"):
        for quarters in range(4):
            right &= _read_right(family_named(name), quarters)
    return BchFigures(int(right.sum()), _us_per_candidate())


def _read_right(family: Family, quarters: int) -> NDArray[np.bool_]:
    """(4096,) whether each id is read where it is, turned as it is."""
    detector = MarkerDetector(DetectorSettings(), {family: None})
    rng = np.random.default_rng(quarters)
    right = np.zeros(len(family.words), np.bool_)
    tile = (family.side + 2 * _MARGIN) * _PIXELS_PER_CELL
    margin = _MARGIN * _PIXELS_PER_CELL - 0.5
    for first in range(0, len(right), _COLUMNS * _ROWS):
        ids = np.arange(first, min(first + _COLUMNS * _ROWS, len(right)))
        found = detector.detect(_sheet(family, ids, quarters, rng))
        for marker_id, corners in zip(found.id, found.corners, strict=True):
            row, column = divmod(int(marker_id) - first, _COLUMNS)
            upper_left = np.array([column, row]) * tile + margin
            side = family.side * _PIXELS_PER_CELL
            square = upper_left + side * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
            expected = np.roll(square, quarters, axis=0)
            right[marker_id] |= bool(np.abs(corners - expected).max() < 0.5)
    return right


def _sheet(family: Family, ids: NDArray[np.int64], quarters: int, rng: np.random.Generator) -> Gray:
    """An image full of markers, each turned counter-clockwise by quarter turns, blurred and noisy."""
    tile = (family.side + 2 * _MARGIN) * _PIXELS_PER_CELL
    sheet = np.full((_ROWS * tile, _COLUMNS * tile), 255, np.uint8)
    for place, marker_id in enumerate(ids):
        row, column = divmod(place, _COLUMNS)
        marker = np.rot90(draw_marker(family, int(marker_id), _PIXELS_PER_CELL, _MARGIN), quarters)
        sheet[row * tile : (row + 1) * tile, column * tile : (column + 1) * tile] = marker
    blurred = cv2.GaussianBlur(sheet.astype(np.float32) * 0.7 + 30.0, (0, 0), _BLUR_PX)
    return np.asarray(np.clip(blurred + rng.normal(0.0, _NOISE, blurred.shape), 0, 255), np.uint8)


def _us_per_candidate() -> float:
    """Median CPU time of decoding, per candidate."""
    candidates, rounds = 200, 7
    family = family_named("artoolkit_bch_thin")
    dictionary = Dictionary(family.layout, {family: np.arange(len(family.words))})
    rng = np.random.default_rng(0)
    cells = np.full((candidates, family.layout.grid, family.layout.grid), 200.0)
    for square in cells:
        square[1:-1, 1:-1] = np.where(family.pattern(int(rng.integers(4096))), 200.0, 40.0)
    cells += rng.normal(0.0, 5.0, cells.shape)
    dictionary.read(cells, 8.0)
    times = []
    for _ in range(rounds):
        begin_s = time.process_time()
        dictionary.read(cells, 8.0)
        times.append(time.process_time() - begin_s)
    return 1e6 * float(np.median(times)) / candidates
