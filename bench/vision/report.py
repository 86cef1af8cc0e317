"""Report of the detector's benchmark: tables, a plot, and figures `vision.*` and `bch.*`.

All ids of the BCH family are read in every rotation and with both borders, and their cost is measured.
"""

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.shared.common import Cell, new_plot, save_plot, table
from bench.vision.comparison import (
    BLURS_PX,
    INCIDENCES,
    MARKERS,
    SIDES_PX,
    Score,
    Scores,
    compare,
    share_flipped,
)
from bench.vision.negatives import black_squares, random_squares
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


BLACK_SQUARES = 1000
_BINS = {"side_px": SIDES_PX, "incidence": INCIDENCES, "blur": BLURS_PX}


@dataclass(frozen=True)
class VisionResult:
    """All that was measured."""

    scores: Scores  # Kind of image -> detector -> score
    bch: BchFigures  # The ids of the paper's markers
    squares: int  # Random squares that were shown
    square_ids: int  # Ids read from them, all false
    # Black squares with a speck that were read as an id, by family and number of ids
    black_square_ids: dict[str, int]

    def figures(self) -> dict[str, float]:
        """Figures by name."""
        own = {kind: scores["own"] for kind, scores in self.scores.items()}
        stock_ms = [score for scores in self.scores.values() for score in scores["cv2.aruco"].ms]
        own_ms = [ms for score in own.values() for ms in score.ms]
        return {
            "vision.recall_still": own["still"].recall,
            "vision.recall_motion": own["motion"].recall,
            "vision.corner_px": own["still"].corner_rms(),
            "vision.ms_per_frame": float(np.median(own_ms)),
            "vision.stock_ms_per_frame": float(np.median(stock_ms)),
            "vision.false_ids": float(sum(score.false_ids for score in own.values()) + self.square_ids),
            "vision.black_square_false_ids": float(sum(self.black_square_ids.values())),
            "bch.ids_right": float(self.bch.ids_right),
            "bch.us_per_candidate": self.bch.us_per_candidate,
        }

    def tables(self) -> str:
        """All tables as text."""
        whole: list[list[Cell]] = [
            [
                kind,
                name,
                len(score.truths),
                score.recall,
                score.corner_rms(),
                share_flipped(score),
                score.false_ids,
                float(np.median(score.ms)),
            ]
            for kind, scores in self.scores.items()
            for name, score in scores.items()
        ]
        columns = ["images", "detector", "markers", "recall", "corner px", "flips", "false ids", "ms/frame"]
        parts = [table(columns, whole)]
        parts += [_binned(self.scores, name, edges) for name, edges in _BINS.items()]
        parts.append(f"{self.squares} random squares: {self.square_ids} read as an id")
        parts.append(
            table(
                [f"of {BLACK_SQUARES} black squares with a speck", "read as an id"],
                [*self.black_square_ids.items()],
            )
        )
        return "\n\n".join(parts)


def measure(seeds: Sequence[int], frames: int) -> VisionResult:
    """Measure everything; one thread.

    Args:
        seeds: One run of images each.
        frames: Images of each kind per seed.
    """
    return VisionResult(
        compare(seeds, frames),
        measure_bch(),
        *random_squares(seeds, frames, MARKERS),
        black_squares(BLACK_SQUARES),
    )


def _binned(scores: Scores, name: str, edges: Sequence[float]) -> str:
    """Recall by an attribute of the markers."""
    spans = list(itertools.pairwise(edges))
    shown = np.degrees(edges) if name == "incidence" else np.array(edges)
    columns = [
        f"recall by {name}",
        "detector",
        *(f"{low:.3g}-{high:.3g}" for low, high in itertools.pairwise(shown)),
    ]
    rows = [
        [kind, detector, *(_or_none(score, name, low, high) for low, high in spans)]
        for kind, of_kind in scores.items()
        for detector, score in of_kind.items()
        if name != "blur" or kind == "motion"
    ]
    return table(columns, rows)


def _or_none(score: Score, name: str, low: float, high: float) -> float | None:
    """Recall between two values; None where there are no markers."""
    recall = score.recall_within(score.of_truths(name), low, high)
    return None if np.isnan(recall) else recall


def plot(scores: Scores, name: str = "vision") -> Path:
    """Recall by size and under blur as out/NAME.png; returns the file."""
    figure, (by_side, by_blur) = new_plot(2)
    for axes, kind, attribute, edges in (
        (by_side, "still", "side_px", (*SIDES_PX[:-1], 160.0)),
        (by_blur, "motion", "blur", BLURS_PX),
    ):
        middle = [0.5 * (low + high) for low, high in itertools.pairwise(edges)]
        for detector, score in scores[kind].items():
            values = score.of_truths(attribute)
            recall = [score.recall_within(values, *span) for span in itertools.pairwise(edges)]
            axes.plot(middle, recall, "o-", label=detector)
        axes.set_ylim(0.0, 1.02)
    by_side.set(xlabel="side of the marker [px]", ylabel="recall", xscale="log", title="still")
    by_blur.set(xlabel="blur [px]", ylabel="recall", title="moving")
    by_side.legend()
    return save_plot(figure, name)
