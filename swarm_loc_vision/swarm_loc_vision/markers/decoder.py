"""Decode the brightness of cells: the nearest code word over all ids and rotations, and its margin.

Blur mixes neighbouring cells, so cells are sharpened first. Bits are weighted by the distance of a cell from
the threshold: a difference in a clear cell costs a whole bit.

With few bits, as in AprilTag 16h5, random squares match some word too often. Then no bit may differ, and all
that is known of a marker must be seen: clear data, a dark border, and a light margin all around it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_vision.markers.families import Family, Layout, Words

# Limits of the decoder: checked by random squares and by black squares with a speck in `make bench-vision`,
# and by test_decoder.py.
FALSE_READINGS = 1e-5
"""Maximum false positive rate for random squares, with whole bits and one threshold. Weighted bits and the
second threshold increase it: with all 4096 ids to one or two of 100 000 random squares."""
_SHARPENING = 0.2  # Share of the difference to each of its four neighbours that is added to a cell
_MAX_DARK_ERRORS = 3.0  # Maximum number of light cells among the 16 or more of the border's inner ring
_MAX_SLOPE = 0.5  # Maximum difference of the border's brightness between its sides, relative to the contrast
_MIDDLE, _LOW = 0.5, 0.28  # Between ink and paper: the default, and that of a marker half in shadow
_MIN_CORRELATION = 0.4
"""Minimum correlation of a candidate and its word. A black square with a speck of light has cells near the
threshold that fit any word at little cost; it reaches 0.37, moving markers 0.5 and more."""
_CLEAR = 0.3
"""Where words are scarce, minimum clearness of data cells and maximum number of light cells in the border.
Sharpening brightens light cells that have dark neighbours; compared with these, light cells among light ones
have a clearness of 0.4 at most."""
_FAR = 1e9
_WEIGHED = 4  # Maximum excess of different bits over the nearest word for words compared by weighted bits


class Readings(NamedTuple):
    """Decoded candidates, one row each."""

    word: NDArray[np.int64]  # Index of the nearest word, -1: none accepted
    quarters: NDArray[np.int64]  # Counter-clockwise quarter turns of the marker in the image
    errors: FloatArray  # Distance from the word in weighted bits
    margin: FloatArray  # Weighted bits that could flip before another reading would be nearer
    contrast: FloatArray  # Light minus dark cells [counts]


class _Places(NamedTuple):
    """Rows and columns (k, 2) of data, of the border's inner ring and of the margin, see `Layout`."""

    data: IntArray
    ring: IntArray
    margin: IntArray


class _Rules(NamedTuple):
    """When a candidate is accepted, see `Dictionary`."""

    min_contrast: float
    correctable: float
    scarce: bool
    framed: bool


class Dictionary:
    """Words in use of families with the same layout; `ids_of` are the ids in use of each family."""

    def __init__(self, layout: Layout, ids_of: Mapping[Family, NDArray[np.int64]]) -> None:
        self.layout = layout
        # (N,) the family's code of each word, and its id in it
        self.codes = np.concatenate([np.full(len(ids), family.code) for family, ids in ids_of.items()])
        self.ids = np.concatenate(list(ids_of.values()))
        words = np.concatenate([family.words[ids] for family, ids in ids_of.items()])
        if layout.surrounded:
            words = words ^ np.uint64((1 << layout.bits) - 1)  # as seen with light and dark swapped
        self._words = np.concatenate([layout.rotated(words, quarters) for quarters in range(4)])
        self._places = _Places(layout.data, layout.ring, layout.margin)
        self.correctable = correctable_bits(len(words), layout.bits)  # Bits that may differ
        # whether even words without a difference are too common, and whether the margin must be seen
        self.scarce = 4.0 * len(words) / 2.0**layout.bits > FALSE_READINGS
        self.framed = self.scarce or layout.surrounded
        # (N, 4, cells) the row of cells behind the border along each side, clockwise, as seen; 1 is white
        cells = layout.inner(words)
        rows = np.stack([np.rot90(cells, k, axes=(1, 2))[:, 0] for k in range(4)], axis=1)
        self.strips = np.pad(rows, ((0, 0), (0, 0), (layout.border, layout.border)))

    def read(self, cells: FloatArray, min_contrast: float) -> Readings:
        """Decode cells (N, grid, grid) of `read_cells`; light and dark differ by `min_contrast` [counts]."""
        count = len(cells)
        readings = Readings(
            np.full(count, -1), np.zeros(count, np.int64), np.zeros(count), np.zeros(count), np.zeros(count)
        )
        rules = _Rules(min_contrast, float(self.correctable), self.scarce, self.framed)
        _read(cells, self._words, self._places, rules, readings)
        return readings


def correctable_bits(words: int, bits: int) -> int:
    """Maximum number of different bits with a false positive rate of at most FALSE_READINGS."""
    near, different = 1, 0
    while different < bits // 4:
        near += math.comb(bits, different + 1)
        if 4.0 * words * near / 2.0**bits > FALSE_READINGS:
            break
        different += 1
    return different


@cached_njit
def _read(cells: FloatArray, words: Words, places: _Places, rules: _Rules, readings: Readings) -> None:
    """Decode each candidate into the readings."""
    word, quarters, errors, margin, contrast = readings
    area, count = cells.shape[1] - 2, len(places.data)
    clear, flat, plane = np.empty(count), np.empty((area, area)), np.empty(3)
    bits = np.empty(len(words), np.uint8)
    for n in range(len(cells)):
        before = np.uint64(0)
        light = _flatten(cells[n], places, flat, plane)
        for level in (_MIDDLE, _LOW):
            border = _clear_cells(flat, light, level, places, clear) if light > 0.0 else 0.0
            contrast[n] = light if border <= _MAX_DARK_ERRORS else 0.0
            if contrast[n] < rules.min_contrast:
                continue
            seen = np.uint64(0)
            for bit in range(count):
                seen = (seen << np.uint64(1)) | np.uint64(clear[bit] > 0.0)
            if level == _LOW and seen == before:
                continue
            before = seen
            best, distance, runner_up = nearest(words, seen, clear, bits)
            if distance > rules.correctable or runner_up <= distance:
                continue
            if np.abs(clear).mean() - 2.0 * distance / count < _MIN_CORRELATION:
                continue
            if rules.scarce and (border > _CLEAR or np.abs(clear).min() < _CLEAR):
                continue
            if rules.framed and not _has_margin(cells[n], light, level, places, plane):
                continue
            quarters[n], word[n] = divmod(best, len(words) // 4)
            errors[n], margin[n] = distance, 0.5 * (runner_up - distance)
            break


@cached_njit
def _flatten(cells: FloatArray, places: _Places, sharp: FloatArray, plane: FloatArray) -> float:
    """Write sharpened brightness minus dark (area, area); returns that of light, 0 if there is none.

    Dark is a plane through the border's inner ring, written to `plane`: in the middle, by column, by row.
    """
    area = len(sharp)
    # sharpen: subtract light of the four neighbours
    for row in range(area):
        for column in range(area):
            here = cells[row + 1, column + 1]
            around = (
                cells[row, column + 1]
                + cells[row + 2, column + 1]
                + cells[row + 1, column]
                + cells[row + 1, column + 2]
            )
            sharp[row, column] = here + _SHARPENING * (4.0 * here - around)
    # fit dark as a plane to the ring, whose columns and rows are symmetric, so that sums are enough
    middle = 0.5 * (area - 1)
    mean, by_x, by_y, square = 0.0, 0.0, 0.0, 0.0
    for i in range(len(places.ring)):
        row, column = places.ring[i, 0], places.ring[i, 1]
        mean += sharp[row, column]
        by_x += (column - middle) * sharp[row, column]
        by_y += (row - middle) * sharp[row, column]
        square += (column - middle) ** 2
    mean, by_x, by_y = mean / len(places.ring), by_x / square, by_y / square
    plane[0], plane[1], plane[2] = mean, by_x, by_y
    # brightness above dark
    for row in range(area):
        for column in range(area):
            sharp[row, column] -= mean + by_x * (column - middle) + by_y * (row - middle)
    # the mean of the lighter data cells
    lightest = 0.0
    for i in range(len(places.data)):
        lightest = max(lightest, sharp[places.data[i, 0], places.data[i, 1]])
    total, light = 0.0, 0
    for i in range(len(places.data)):
        value = sharp[places.data[i, 0], places.data[i, 1]]
        if value > 0.5 * lightest:
            total += value
            light += 1
    if light == 0:
        return 0.0
    high = total / light
    return high if (abs(by_x) + abs(by_y)) * (area - 1) <= _MAX_SLOPE * high else 0.0


@cached_njit
def _clear_cells(flat: FloatArray, light: float, level: float, places: _Places, clear: FloatArray) -> float:
    """Map data to -1 (dark) ... 1 (light), `level` of light to 0; returns the border's light in cells."""
    for bit in range(len(places.data)):
        clear[bit] = _clearness(flat[places.data[bit, 0], places.data[bit, 1]], light, level)
    border = 0.0
    for i in range(len(places.ring)):
        border += max(_clearness(flat[places.ring[i, 0], places.ring[i, 1]], light, level), 0.0)
    return border


@cached_njit
def _clearness(value: float, light: float, level: float) -> float:
    """A brightness above dark on a scale from -1 (dark) to 1 (light)."""
    above = value / light - level
    return float(min(max(above / (level if above < 0.0 else min(1.0 - level, 2.0 * level)), -1.0), 1.0))


@cached_njit
def _has_margin(cells: FloatArray, light: float, level: float, places: _Places, plane: FloatArray) -> bool:
    """Whether the margin around the border is light, which is not sharpened and so less light than data."""
    middle = 0.5 * (len(cells) - 1)
    for i in range(len(places.margin)):
        row, column = places.margin[i, 0], places.margin[i, 1]
        dark = plane[0] + plane[1] * (column - middle) + plane[2] * (row - middle)
        if _clearness(cells[row, column] - dark, light, level) < 0.0:
            return False
    return True


@cached_njit
def nearest(
    words: Words, seen: np.uint64, clear: FloatArray, bits: NDArray[np.uint8]
) -> tuple[int, float, float]:
    """Index of the word (N,) that is nearest to a candidate's bits, its weighted distance, and the second's.

    Clear (bits,) are soft bits, -1 (dark) to 1 (light); `bits` (N,) is filled with the number of different
    bits. A distant second is that with the fewest of them, although another may be nearer by a tenth of a
    weighted bit.
    """
    count = clear.size
    fewest, second = np.uint8(count), np.uint8(count)
    for i in range(len(words)):
        bits[i] = _bits_set(words[i] ^ seen)
        fewest = min(fewest, bits[i])
    for i in range(len(words)):  # a separate loop: the compiler does not vectorize a joint one
        second = min(second, bits[i] if bits[i] > fewest else np.uint8(count))
    reach = max(fewest + _WEIGHED, second)  # so that there is always a second nearest
    best, distance, runner_up = -1, _FAR, _FAR
    for i in range(len(words)):
        if bits[i] > reach:
            continue
        different = words[i] ^ seen
        cost = 0.0
        for bit in range(count):
            if (different >> np.uint64(count - 1 - bit)) & np.uint64(1):
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
