"""Decode the brightness of cells: the nearest code word over all ids and rotations, and its margin.

Blur mixes neighbouring cells, so cells are sharpened first. Bits are weighted by the distance of a cell from
the threshold: a difference in a clear cell costs a whole bit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_vision.common.sampling import GRID
from swarm_loc_vision.markers.families import BITS, CELLS, Family, rotated, unpacked

Words = NDArray[np.uint64]

FALSE_READINGS = 1e-5
"""Maximum false positive rate for random squares, with whole bits and one threshold. Weighted bits and the
second threshold increase it: with all 4096 ids to one or two of 100 000 random squares."""
_SHARPENING = 0.2
"""Share of the difference to each of its four neighbours that is added to a cell."""
_MAX_DARK_ERRORS = 3.0
"""Maximum number of light cells among the 28 cells of the border's inner ring."""
_MAX_SLOPE = 0.5
"""Maximum difference of the border's brightness between its sides, relative to the contrast."""
_MIDDLE, _LOW = 0.5, 0.28
"""Thresholds between ink and paper: the default, and one for a marker half in shadow."""
_MIN_CORRELATION = 0.4
"""Minimum correlation of a candidate and its word. A black square with a speck of light has cells near the
threshold that fit any word at little cost; it reaches 0.37, moving markers 0.5 and more."""
_FAR = 1e9
_WEIGHED = 4
"""Maximum excess of different bits over the nearest word for words compared by weighted bits."""


class Readings(NamedTuple):
    """Decoded candidates, one row each.

    Attributes:
        word: Index of the nearest word, -1: none accepted.
        quarters: Counter-clockwise quarter turns of the marker in the image.
        errors: Distance from the word in weighted bits.
        margin: Weighted bits that could flip before another reading would be nearer.
        contrast: Light minus dark cells [counts].
    """

    word: NDArray[np.int64]
    quarters: NDArray[np.int64]
    errors: FloatArray
    margin: FloatArray
    contrast: FloatArray


class Dictionary:
    """Words in use of families with the same border.

    Args:
        ids_of: Ids in use of each family.

    Attributes:
        codes: (N,) the family's code of each word.
        ids: (N,) its id in it.
        strips: (N, 4, cells) the row of cells behind the border along each side, clockwise; 1 is white.
        correctable: Bits that may differ; see `FALSE_READINGS`.
    """

    def __init__(self, ids_of: Mapping[Family, NDArray[np.int64]]) -> None:
        self.codes = np.concatenate([np.full(len(ids), family.code) for family, ids in ids_of.items()])
        self.ids = np.concatenate(list(ids_of.values()))
        words = np.concatenate([family.words[ids] for family, ids in ids_of.items()])
        border = next(iter(ids_of)).border
        self._words = np.concatenate([rotated(words, quarters) for quarters in range(4)])
        self.correctable = correctable_bits(len(words))
        cells = unpacked(words)
        rows = np.stack([np.rot90(cells, k, axes=(1, 2))[:, 0] for k in range(4)], axis=1)
        self.strips = np.pad(rows, ((0, 0), (0, 0), (border, border)))

    def read(self, cells: FloatArray, min_contrast: float) -> Readings:
        """Decode candidates.

        Args:
            cells: (N, GRID, GRID) of `sampling.read_cells`.
            min_contrast: Minimum difference of light and dark cells [counts].
        """
        count = len(cells)
        readings = Readings(
            np.full(count, -1), np.zeros(count, np.int64), np.zeros(count), np.zeros(count), np.zeros(count)
        )
        _read(cells, self._words, min_contrast, float(self.correctable), readings)
        return readings


def correctable_bits(words: int) -> int:
    """Maximum number of different bits with a false positive rate of at most FALSE_READINGS."""
    near, bits = 1, 0
    while bits < BITS // 4:
        near += math.comb(BITS, bits + 1)
        if 4.0 * words * near / 2.0**BITS > FALSE_READINGS:
            break
        bits += 1
    return bits


@cached_njit
def _read(
    cells: FloatArray, words: Words, min_contrast: float, correctable: float, readings: Readings
) -> None:
    """Decode each candidate into the readings."""
    word, quarters, errors, margin, contrast = readings
    clear, flat = np.empty(BITS), np.empty((GRID - 2, GRID - 2))
    bits = np.empty(len(words), np.uint8)
    for n in range(len(cells)):
        before = np.uint64(0)
        light = _flatten(cells[n], flat)
        for level in (_MIDDLE, _LOW):
            contrast[n] = light if light > 0.0 and _clear_cells(flat, light, level, clear) else 0.0
            if contrast[n] < min_contrast:
                continue
            seen = np.uint64(0)
            for bit in range(BITS):
                seen = (seen << np.uint64(1)) | np.uint64(clear[bit] > 0.0)
            if level == _LOW and seen == before:
                continue
            before = seen
            best, distance, runner_up = nearest(words, seen, clear, bits)
            if distance > correctable or runner_up <= distance:
                continue
            if np.abs(clear).mean() - 2.0 * distance / BITS < _MIN_CORRELATION:
                continue
            quarters[n], word[n] = divmod(best, len(words) // 4)
            errors[n], margin[n] = distance, 0.5 * (runner_up - distance)
            break


@cached_njit
def _flatten(cells: FloatArray, sharp: FloatArray) -> float:
    """Write sharpened brightness minus dark (GRID - 2, GRID - 2); returns that of light, 0 if there is none.

    Dark is a plane through the border's inner ring, to allow for uneven light; light is the mean of the
    lighter cells.
    """
    for row in range(GRID - 2):
        for column in range(GRID - 2):
            here = cells[row + 1, column + 1]
            around = (
                cells[row, column + 1]
                + cells[row + 2, column + 1]
                + cells[row + 1, column]
                + cells[row + 1, column + 2]
            )
            sharp[row, column] = here + _SHARPENING * (4.0 * here - around)
    middle = 0.5 * (GRID - 3)
    mean, by_x, by_y, square, n = 0.0, 0.0, 0.0, 0.0, 0
    for row in range(GRID - 2):
        for column in range(GRID - 2):
            if 0 < row < GRID - 3 and 0 < column < GRID - 3:
                continue
            mean += sharp[row, column]
            by_x += (column - middle) * sharp[row, column]
            by_y += (row - middle) * sharp[row, column]
            square += (column - middle) ** 2
            n += 1
    mean, by_x, by_y = mean / n, by_x / square, by_y / square
    lightest = 0.0
    for row in range(GRID - 2):
        for column in range(GRID - 2):
            sharp[row, column] -= mean + by_x * (column - middle) + by_y * (row - middle)
            if 0 < row < GRID - 3 and 0 < column < GRID - 3:
                lightest = max(lightest, sharp[row, column])
    total, light = 0.0, 0
    for row in range(1, GRID - 3):
        for column in range(1, GRID - 3):
            if sharp[row, column] > 0.5 * lightest:
                total += sharp[row, column]
                light += 1
    if light == 0:
        return 0.0
    high = total / light
    return high if (abs(by_x) + abs(by_y)) * (GRID - 3) <= _MAX_SLOPE * high else 0.0


@cached_njit
def _clear_cells(flat: FloatArray, light: float, level: float, clear: FloatArray) -> bool:
    """Map brightness to -1 (dark) ... 1 (light) in `clear`; returns whether the border is dark.

    The share `level` of `light` maps to 0.
    """
    wrong = 0.0
    for row in range(GRID - 2):
        for column in range(GRID - 2):
            above = flat[row, column] / light - level
            value = min(max(above / (level if above < 0.0 else min(1.0 - level, 2.0 * level)), -1.0), 1.0)
            if 0 < row < GRID - 3 and 0 < column < GRID - 3:
                clear[(row - 1) * CELLS + column - 1] = value
            elif value > 0.0:
                wrong += value
    return wrong <= _MAX_DARK_ERRORS


@cached_njit
def nearest(
    words: Words, seen: np.uint64, clear: FloatArray, bits: NDArray[np.uint8]
) -> tuple[int, float, float]:
    """Find the nearest word to a candidate.

    Args:
        words: (N,) all words.
        seen: The candidate's bits.
        clear: (BITS,) soft bits, -1 (dark) to 1 (light).
        bits: (N,) filled with the number of different bits.

    Returns:
        Index of the nearest word, its weighted distance, and that of the second nearest. A distant second is
        that with the fewest different bits, although another may be nearer by a tenth of a weighted bit.
    """
    fewest, second = np.uint8(BITS), np.uint8(BITS)
    for i in range(len(words)):
        bits[i] = _bits_set(words[i] ^ seen)
        fewest = min(fewest, bits[i])
    for i in range(len(words)):  # a separate loop: the compiler does not vectorize a joint one
        second = min(second, bits[i] if bits[i] > fewest else np.uint8(BITS))
    reach = max(fewest + _WEIGHED, second)  # so that there is always a second nearest
    best, distance, runner_up = -1, _FAR, _FAR
    for i in range(len(words)):
        if bits[i] > reach:
            continue
        different = words[i] ^ seen
        cost = 0.0
        for bit in range(BITS):
            if (different >> np.uint64(BITS - 1 - bit)) & np.uint64(1):
                cost += abs(clear[bit])
        if cost < distance:
            best, distance, runner_up = i, cost, distance
        elif cost < runner_up:
            runner_up = cost
    return best, distance, runner_up


@cached_njit
def _bits_set(x: np.uint64) -> np.uint8:
    """Number of ones, by shifts and sums, which the compiler vectorizes."""
    x -= (x >> np.uint64(1)) & np.uint64(0x5555555555555555)
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    x += x >> np.uint64(8)
    x += x >> np.uint64(16)
    x += x >> np.uint64(32)
    count: np.uint8 = np.uint8(x & np.uint64(0x7F))
    return count
