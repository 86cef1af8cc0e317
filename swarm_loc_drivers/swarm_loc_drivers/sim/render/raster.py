"""Rasterize planar patches by exact area coverage: a pixel's value is the mean over its whole square.

Pixel (0, 0) is the square around the image point (0, 0), as OpenCV counts. A boundary stores
the change of brightness across it: in every row that it crosses it adds signed shares of that change, and the
cumulative sum along the row is the exact mean over every pixel (box filter). Boundaries are additive, so
nested patches need no order, averaging over an exposure adds boundaries but no pixels, and there is no
aliasing.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_vision.common.camera import CX, CY, FX, FY, LENS_KIND, LENS_SIZE, STRAIGHT, distorted

Image = NDArray[np.float32]
Changes = NDArray[np.float32]  # (height, width + 2): changes along each row of an image (height, width)


class Layer(NamedTuple):
    """Changes of brightness and opacity of an object."""

    changes: Changes  # Changes of the brightness
    covers: Changes  # Changes of the opacity
    box: FloatArray  # (4,) left, top, right and bottom [px] of it


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
        after = (end - begin) * (middle - left) / (right - left) + (column + 1.0 - end)
        row[column] += change * (after - before)
        before = after
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


_NEAR = 0.004  # [m] in front of the camera; what is nearer is cut off
CORNERS = 12  # a quadrangle cut by five planes has at most nine


@cached_njit
def _inside(plane: int, reach: float, point: FloatArray) -> float:
    """Signed distance of a point inside one of the five clipping planes; negative outside."""
    x, y, z = float(point[0]), float(point[1]), float(point[2])
    if plane == 0:
        return z - _NEAR
    if plane == 1:
        return reach * z - x
    if plane == 2:
        return reach * z + x
    if plane == 3:
        return reach * z - y
    return reach * z + y


@cached_njit
def _blend(target: FloatArray, here: FloatArray, there: FloatArray, share: float) -> None:
    """Write the point (3,) that lies `share` of the way from `here` to `there`."""
    for axis in range(3):
        target[axis] = here[axis] + share * (there[axis] - here[axis])


@cached_njit
def cut(polygon: FloatArray, count: int, spare: FloatArray, reach: float) -> int:
    """Cut a convex polygon, its first `count` rows, by the five planes; its new number of corners."""
    for plane in range(5):
        outside = 0
        for i in range(count):
            if _inside(plane, reach, polygon[i]) < 0.0:
                outside += 1
        if outside == 0:
            continue
        if outside == count:
            return 0
        kept = 0
        for i in range(count):
            here, there = polygon[i], polygon[(i + 1) % count]
            a, b = _inside(plane, reach, here), _inside(plane, reach, there)
            if a >= 0.0:
                _blend(spare[kept], here, here, 0.0)
                kept += 1
            if (a >= 0.0) != (b >= 0.0):
                _blend(spare[kept], here, there, a / (a - b))
                kept += 1
        count = kept
        for i in range(count):
            _blend(polygon[i], spare[i], spare[i], 0.0)
    return count


@cached_njit
def move(rotation: FloatArray, shift: FloatArray, point: FloatArray, moved: FloatArray) -> None:
    """Rotate and shift a point (3,) into `moved`."""
    for axis in range(3):
        moved[axis] = shift[axis]
        for k in range(3):
            moved[axis] += rotation[axis, k] * point[k]


@cached_njit
def ball_in_view(centre: FloatArray, radius: float, reach: float) -> bool:
    """Whether a ball touches what is drawn, in the optical frame."""
    slack = radius * math.sqrt(1.0 + reach * reach)
    for plane in range(5):  # noqa: SIM110 - the compiler knows no generators
        if _inside(plane, reach, centre) < -slack:
            return False
    return True


REACH = LENS_SIZE  # After the constants of a lens, the radius at distance 1 up to which they hold

_CHORD_PX = 4.0  # in 1280 columns, 60 degrees and a distortion of -0.3 it leaves its arc by 0.004 px at most

Motion = tuple[FloatArray, FloatArray]
"""Rotations (K, 3, 3) and shifts (K, 3) [m] from some frame to the optical one, at K instants."""


class Patches(NamedTuple):
    """Flat patches, grouped into surfaces that are seen only from one side."""

    corners: FloatArray  # (Q, 4, 3) [m], clockwise as seen from the front
    change: FloatArray  # (Q,) brightness minus that of the patch it lies on [1]
    cover: FloatArray  # (Q,) 1 where it hides what is behind, 0 where the patch it lies on does so already
    first: IntArray  # (S + 1,) surface s has the patches first[s] to first[s + 1]
    centre: FloatArray  # (S, 3) of each surface [m]
    radius: FloatArray  # (S,) around it [m]
    normal: FloatArray  # (S, 3) unit vector out of its front


@cached_njit
def project(lens: FloatArray, x: float, y: float) -> tuple[float, float]:
    """Pixel of the direction (x, y, 1); beyond the lens' reach the image goes on straight."""
    radius = math.sqrt(x * x + y * y)
    near = 1.0 if radius <= lens[REACH] else lens[REACH] / radius
    a, b = near * x, near * y
    u, v = distorted(lens, a, b)
    return lens[FX] * (u + (x - a)) + lens[CX], lens[FY] * (v + (y - b)) + lens[CY]


@cached_njit
def _add_boundary(
    changes: Changes, lens: FloatArray, start: FloatArray, end: FloatArray, change: float, box: FloatArray
) -> None:
    """The image changes by `change` to the left of the line from `start` to `end`, seen in the image.

    Args:
        changes: Where it is noted.
        lens: Constants of `project`.
        start: (3,) in the camera's optical frame [m].
        end: (3,) in the same frame [m].
        change: [1].
        box: Left, top, right and bottom [px] of what was drawn, extended.
    """
    ax, ay = start[0] / start[2], start[1] / start[2]
    bx, by = end[0] / end[2], end[1] / end[2]
    u0, v0 = project(lens, ax, ay)
    u1, v1 = project(lens, bx, by)
    pieces = 1 if lens[LENS_KIND] == STRAIGHT else math.ceil(math.hypot(u1 - u0, v1 - v0) / _CHORD_PX)
    for piece in range(1, pieces + 1):
        share = piece / pieces
        u, v = (u1, v1) if piece == pieces else project(lens, ax + share * (bx - ax), ay + share * (by - ay))
        add_straight(changes, u0 + 0.5, v0 + 0.5, u + 0.5, v + 0.5, change)
        box[0], box[1] = min(box[0], u), min(box[1], v)
        box[2], box[3] = max(box[2], u), max(box[3], v)
        u0, v0 = u, v


@cached_njit
def _in_view(
    patches: Patches, surface: int, rotation: FloatArray, shift: FloatArray, reach: float, spare: FloatArray
) -> bool:
    """Whether a surface shows its front and its ball touches what is drawn."""
    centre = patches.centre[surface]
    towards = 0.0  # the way from the camera to the surface along its normal
    for axis in range(3):
        to_camera = 0.0
        for k in range(3):
            to_camera -= rotation[k, axis] * shift[k]
        towards += patches.normal[surface, axis] * (centre[axis] - to_camera)
    if towards >= 0.0:
        return False
    move(rotation, shift, centre, spare[0])
    return ball_in_view(spare[0], patches.radius[surface], reach)


@cached_njit
def draw(layer: Layer, patches: Patches, lens: FloatArray, motion: Motion, weight: float) -> None:
    """Note the boundaries of patches as a camera sees them during its exposure.

    Args:
        layer: Added to.
        patches: What is drawn; fronts must not overlap in the image except where nested.
        lens: Constants of `project`.
        motion: From the frame of the patches, at K instants of the exposure.
        weight: Share of the light that comes this way.
    """
    changes, covers, box = layer
    rotations, shifts = motion
    polygon, spare = np.empty((CORNERS, 3)), np.empty((CORNERS, 3))
    reach, share = lens[REACH], weight / len(rotations)
    for instant in range(len(rotations)):
        rotation, shift = rotations[instant], shifts[instant]
        for surface in range(len(patches.radius)):
            if not _in_view(patches, surface, rotation, shift, reach, spare):
                continue
            for index in range(patches.first[surface], patches.first[surface + 1]):
                for i in range(4):
                    move(rotation, shift, patches.corners[index, i], polygon[i])
                count = cut(polygon, 4, spare, reach)
                for i in range(count):
                    start, end = polygon[i], polygon[(i + 1) % count]
                    _add_boundary(changes, lens, start, end, -share * patches.change[index], box)
                    if patches.cover[index] != 0.0:
                        _add_boundary(covers, lens, start, end, -share * patches.cover[index], box)
