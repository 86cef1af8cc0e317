"""Rasterize planar patches by exact area coverage: a pixel's value is the mean over its whole square.

Pixel (0, 0) is the square around the image point (0, 0), as OpenCV counts.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarm_loc_drivers.sim.render.clipping import CORNERS, ball_in_view, cut, move
from swarm_loc_drivers.sim.render.coverage import Changes, Layer, add_straight
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_vision.common.lens import CX, CY, FX, FY, LENS_KIND, LENS_SIZE, STRAIGHT, distorted

REACH = LENS_SIZE
"""Behind the constants of a lens, the radius at distance 1 up to which they hold."""

_CHORD_PX = 4.0  # in 1280 columns, 60 degrees and a distortion of -0.3 it leaves its arc by 0.004 px at most

Motion = tuple[FloatArray, FloatArray]
"""Rotations (K, 3, 3) and shifts (K, 3) [m] from some frame to the optical one, at K instants."""


class Patches(NamedTuple):
    """Flat patches, grouped into surfaces that are seen from one side only.

    Attributes:
        corners: (Q, 4, 3) [m], clockwise as seen from the front.
        change: (Q,) brightness minus that of the patch it lies on [1].
        cover: (Q,) 1 where it hides what is behind, 0 where the patch it lies on does so already.
        first: (S + 1,) surface s has the patches first[s] to first[s + 1].
        centre: (S, 3) of each surface [m].
        radius: (S,) around it [m].
        normal: (S, 3) unit vector out of its front.
    """

    corners: FloatArray
    change: FloatArray
    cover: FloatArray
    first: IntArray
    centre: FloatArray
    radius: FloatArray
    normal: FloatArray


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
    changes: Changes,
    lens: FloatArray,
    start: FloatArray,
    end: FloatArray,
    change: float,
    box: FloatArray,
) -> None:
    """The image changes by `change` to the left of the line from `start` to `end`, seen in the image.

    Args:
        changes: Where it is noted.
        lens: Constants of `project`.
        start: (3,) in the camera's optical frame [m].
        end: Likewise.
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
