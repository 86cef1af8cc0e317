"""Exact area coverage: signed changes along the rows of an image, whose running sums are means over pixels.

A boundary does not paint an area, it notes by how much the image changes across it: in every row that it
crosses it leaves signed shares of that change, and the running sum along the row is the exact mean over every
pixel (box filter). Boundaries simply add up. So nested patches need no order, an image averaged over an
exposure costs more boundaries but no more pixels, and nothing is sampled: no aliasing, no bias.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit

Image = NDArray[np.float32]
Changes = NDArray[np.float32]
"""(height, width + 2): changes along each row of an image (height, width)."""


class Layer(NamedTuple):
    """What was noted of something to be drawn.

    Attributes:
        changes: Of the brightness.
        covers: Of what hides the background.
        box: (4,) left, top, right and bottom [px] of it.
    """

    changes: Changes
    covers: Changes
    box: FloatArray


def empty_box() -> FloatArray:
    """The box of nothing."""
    return np.array([math.inf, math.inf, -math.inf, -math.inf])


@cached_njit
def _add_in_row(row: Changes, width: int, left: float, right: float, change: float) -> None:
    """A piece of boundary inside one row, from column `left` to `right` >= `left`."""
    if left >= width:
        return
    if right <= 0.0:
        row[0] += change
        return
    if left < 0.0:
        outside = change * -left / (right - left)
        row[0] += outside
        change -= outside
        left = 0.0
    if right > width:
        change *= (width - left) / (right - left)
        right = float(width)
    first, last = int(left), math.ceil(right)
    if last <= first + 1:
        share = 0.5 * (left + right) - first
        row[first] += change * (1.0 - share)
        row[first + 1] += change * share
        return
    before = 0.0
    for column in range(first, last):
        begin, end = max(float(column), left), min(column + 1.0, right)
        middle = 0.5 * (begin + end)
        behind = (end - begin) * (middle - left) / (right - left) + (column + 1.0 - end)
        row[column] += change * (behind - before)
        before = behind
    row[last] += change * (1.0 - before)


@cached_njit
def add_straight(changes: Changes, x0: float, y0: float, x1: float, y1: float, change: float) -> None:
    """A straight boundary between two points, counted in pixels from the corner of the first one."""
    if y1 < y0:
        x0, y0, x1, y1, change = x1, y1, x0, y0, -change
    height, width = changes.shape[0], changes.shape[1] - 2
    if y1 <= 0.0 or y0 >= height or y0 == y1:
        return
    slope = (x1 - x0) / (y1 - y0)
    top, bottom = max(y0, 0.0), min(y1, float(height))
    x = x0 + slope * (top - y0)
    for line in range(int(top), math.ceil(bottom)):
        low, high = max(float(line), top), min(line + 1.0, bottom)
        x_next = x0 + slope * (high - y0)
        _add_in_row(changes[line], width, min(x, x_next), max(x, x_next), change * (high - low))
        x = x_next


@cached_njit
def fill(image: Image, changes: Changes, before: float) -> None:
    """Sum changes up into an image that begins with `before` at the left; the changes become zero."""
    for line in range(image.shape[0]):
        value = before
        for column in range(image.shape[1]):
            value += changes[line, column]
            image[line, column] = value
        for column in range(changes.shape[1]):
            changes[line, column] = 0.0


@cached_njit
def lay_over(image: Image, layer: Layer) -> None:
    """Put a layer over an image; its changes become zero."""
    changes, covers, box = layer
    height, width = image.shape
    left, top = max(int(box[0]) - 1, 0), max(int(box[1]) - 1, 0)
    right, bottom = min(max(int(box[2]) + 3, 0), width), min(int(box[3]) + 3, height)
    for line in range(top, bottom):
        value, cover = 0.0, 0.0
        for column in range(left, right):
            value += changes[line, column]
            cover += covers[line, column]
            image[line, column] = image[line, column] * (1.0 - cover) + value
        for column in range(left, right + 2):
            changes[line, column] = covers[line, column] = 0.0
