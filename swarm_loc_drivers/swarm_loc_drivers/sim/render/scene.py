"""Contents of an arena as flat patches: floor, walls, markers, bodies.

Brightness 0 is black, 1 is white in full light. A marker is a white sheet, on that a black square, on that
white runs of cells; each patch knows only by how much it differs from what it lies on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from swarm_loc_drivers.sim.render.raster import Patches
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_vision.aerial.pattern import MARK_RADIUS

BLACK, WHITE = 0.05, 0.85
ROOM = 0.30  # Brightness above the walls

_FLOOR, _TILE, _TILE_SPREAD = 0.45, 0.2, 0.02
_WALLS, _WALL_HEIGHT = (0.58, 0.66, 0.62, 0.70), 0.30
_CLUTTER_PER_M, _CLUTTER_ABOVE = 4.0, 0.16
_BODY, _BODY_TOP, _BAND, _TOWER, _TOWER_TOP = 0.28, 0.35, 0.12, 0.20, 0.24
_BODY_RADIUS, _BODY_HEIGHT, _BODY_SIDES, _BAND_HEIGHTS = 0.035, 0.055, 10, (0.024, 0.030)
TOP_RADIUS, TOP_HEIGHT = 0.035, 0.105  # Of the pattern on a robot's top [m]
_DISC_SIDES = 32
_PENUMBRA = (-0.004, 0.0, 0.004)
_TOWER_RADIUS, _TOWER_HEIGHT, _TOWER_SIDES = 0.036, TOP_HEIGHT, 5


class Surface:
    """A flat surface that grows by patches on it, from its origin (3,) [m].

    Right (3,) and down (3,) are unit vectors, as seen from the front.
    """

    def __init__(self, origin: FloatArray, right: FloatArray, down: FloatArray) -> None:
        self._origin, self._right, self._down = origin, right, down
        self.normal = np.cross(down, right)
        self.corners: list[FloatArray] = []
        self.change: list[float] = []
        self.cover: list[float] = []

    def rectangle(
        self, left: float, top: float, right: float, bottom: float, change: float, *, covers: bool = False
    ) -> None:
        """Add a rectangle [m], `change` brighter than what it lies on."""
        self.polygon([(left, top), (right, top), (right, bottom), (left, bottom)], change, covers=covers)

    def fan(
        self,
        corners: Sequence[tuple[float, float]],
        change: float,
        *,
        covers: bool = False,
        cover: float = 0.0,
    ) -> None:
        """Add a convex outline of any number of corners [m], anticlockwise as seen from the front.

        What it covers shows through where `cover`, the share of it that is hidden, is below one.
        """
        ring = list(corners)[::-1]
        for i in range(1, len(ring) - 1, 2):
            third = ring[i + 2] if i + 2 < len(ring) else ring[i + 1]
            self.polygon([ring[0], ring[i], ring[i + 1], third], change, covers=covers)
            self.cover[-1] = cover or self.cover[-1]

    def polygon(self, corners: Sequence[tuple[float, float]], change: float, *, covers: bool = False) -> None:
        """Add four corners [m] to the right and down of the origin, clockwise as seen from the front."""
        places = np.array(corners)
        self.corners.append(self._origin + places[:, :1] * self._right + places[:, 1:] * self._down)
        self.change.append(change)
        self.cover.append(float(covers))


def upright(x: float, y: float, z: float, yaw: float) -> Surface:
    """An upright surface at x, y, z [m] whose front looks to `yaw` [rad]."""
    right = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
    return Surface(np.array([x, y, z]), right, np.array([0.0, 0.0, -1.0]))


def level(z: float) -> Surface:
    """A level surface at height z [m] that looks up; right is x, down is -y."""
    return Surface(np.array([0.0, 0.0, z]), np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0]))


def patches(surfaces: Sequence[Surface]) -> Patches:
    """Surfaces in the form that `raster.draw` takes."""
    places = [np.concatenate(surface.corners) for surface in surfaces]
    middle = np.array([0.5 * (place.min(axis=0) + place.max(axis=0)) for place in places])
    radius = [np.linalg.norm(place - mid, axis=1).max() for place, mid in zip(places, middle, strict=True)]
    return Patches(
        np.concatenate(places).reshape(-1, 4, 3),
        np.array([change for surface in surfaces for change in surface.change]),
        np.array([cover for surface in surfaces for cover in surface.cover]),
        np.cumsum([0, *(len(surface.change) for surface in surfaces)]),
        middle,
        np.array(radius),
        np.array([surface.normal for surface in surfaces]),
    )


def marker(pose: Sequence[float], height: float, cells: BoolArray, size: float) -> Patches:
    """A marker on its sheet, one cell wider all round, at x, y [m] and the direction out of its face [rad].

    The cells (n, n) are those of the black square, border included; True is white. The square's side, and the
    height of its centre, are in m.
    """
    return _printed(upright(pose[0], pose[1], height, pose[2]), cells, size)


def _printed(sheet: Surface, cells: BoolArray, size: float) -> Patches:
    """A sheet with a marker on it."""
    half, cell = 0.5 * size, size / len(cells)
    sheet.rectangle(-half - cell, -half - cell, half + cell, half + cell, WHITE, covers=True)
    sheet.rectangle(-half, -half, half, half, BLACK - WHITE)
    for row, line in enumerate(cells):
        ends = np.flatnonzero(np.diff(line, prepend=False, append=False)).reshape(-1, 2)
        for left, right in (ends * cell - half).tolist():
            top = row * cell - half
            sheet.rectangle(left, top, right, top + cell, WHITE - BLACK)
    return patches([sheet])


def lying_marker(pose: Sequence[float], height: float, cells: BoolArray, size: float) -> Patches:
    """A marker on its sheet that lies level and looks up; arguments as for `marker`.

    The last number of the pose is the direction to the marker's own right, from the x axis of the frame.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    sheet = Surface(
        np.array([pose[0], pose[1], height]), np.array([cos, sin, 0.0]), np.array([sin, -cos, 0.0])
    )
    return _printed(sheet, cells, size)


def arena(size: tuple[float, float], rng: np.random.Generator) -> Patches:
    """Floor and walls of `size` [m] around the origin; `rng` draws the tiles and what hangs on the walls."""
    floor = level(0.0)
    floor.rectangle(-0.5 * size[0], -0.5 * size[1], 0.5 * size[0], 0.5 * size[1], _FLOOR - ROOM)
    for left in np.arange(-0.5 * size[0], 0.5 * size[0] - 1e-9, _TILE).tolist():
        for top in np.arange(-0.5 * size[1], 0.5 * size[1] - 1e-9, _TILE).tolist():
            shade = _TILE_SPREAD * rng.standard_normal()
            floor.rectangle(left, top, left + _TILE, top + _TILE, shade)
    surfaces = [floor]
    for side, brightness in enumerate(_WALLS):
        yaw = 0.5 * math.pi * side
        along, away = (size[1], size[0]) if side % 2 == 0 else size
        wall = upright(-0.5 * away * math.cos(yaw), -0.5 * away * math.sin(yaw), 0.0, yaw)
        wall.rectangle(-0.5 * along, -_WALL_HEIGHT, 0.5 * along, 0.0, brightness - ROOM)
        _hang(wall, along, brightness, rng)
        surfaces.append(wall)
    return patches(surfaces)


def _hang(wall: Surface, along: float, brightness: float, rng: np.random.Generator) -> None:
    """Hang sheets of any brightness side by side on the upper part of a wall."""
    count = round(_CLUTTER_PER_M * along)
    pitch = along / count
    for place in range(count):
        centre = (place + 0.5) * pitch - 0.5 * along
        width, height = rng.uniform(0.2, 0.9) * pitch, rng.uniform(0.2, 0.9) * (_WALL_HEIGHT - _CLUTTER_ABOVE)
        bottom = -_CLUTTER_ABOVE
        change = rng.uniform(BLACK, WHITE) - brightness
        wall.rectangle(centre - 0.5 * width, bottom - height, centre + 0.5 * width, bottom, change)


def body() -> Patches:
    """The lower part of an e-puck: a cylinder with a dark band, in base_link."""
    sides = _prism(_BODY_RADIUS, 0.0, _BODY_HEIGHT, _BODY_SIDES, _BODY)
    half = _BODY_RADIUS * math.sin(math.pi / _BODY_SIDES)
    for side in sides:
        low, high = (_BODY_HEIGHT - z for z in _BAND_HEIGHTS)
        side.rectangle(-half, high, half, low, _BAND - _BODY)
    return patches([*sides, _lid(_BODY_RADIUS, _BODY_HEIGHT, _BODY_SIDES, _BODY_TOP)])


def tower() -> Patches:
    """The upper part, which carries camera and markers, in base_link."""
    sides = _prism(_TOWER_RADIUS, _BODY_HEIGHT, _TOWER_HEIGHT, _TOWER_SIDES, _TOWER)
    return patches([*sides, _lid(_TOWER_RADIUS, _TOWER_HEIGHT, _TOWER_SIDES, _TOWER_TOP)])


def top_pattern() -> Patches:
    """The pattern on an e-puck's top, the same on all: a black disc with a white half-disc, in base_link."""
    top = level(_TOWER_HEIGHT)
    top.fan(_disc(TOP_RADIUS, 0.0, 2.0 * math.pi), BLACK, covers=True)
    half = _disc(MARK_RADIUS * TOP_RADIUS, -0.5 * math.pi, math.pi)
    top.fan(half, WHITE - BLACK)
    return patches([top])


def shadow(strength: float, towards: float, slope: float) -> Patches:
    """The shadow of an e-puck on the floor, around its centre, with a soft rim.

    It takes a share of the light, and falls in a direction in the frame of the patches [rad]; `slope` is its
    length per height.
    """
    floor = level(0.0)
    for grown in _PENUMBRA:
        radius, length = _BODY_RADIUS + grown, _TOWER_HEIGHT * slope
        near = _disc(radius, towards + 0.5 * math.pi, math.pi)
        far = [
            (x + length * math.cos(towards), y - length * math.sin(towards))
            for x, y in _disc(radius, towards - 0.5 * math.pi, math.pi)
        ]
        floor.fan([*near, *far], 0.0, cover=strength / len(_PENUMBRA))
    return patches([floor])


def _disc(radius: float, begin: float, angle: float) -> list[tuple[float, float]]:
    """A circle or a part of it, to the right and down, anticlockwise as seen from above."""
    count = round(_DISC_SIDES * angle / (2.0 * math.pi))
    ends = 0 if angle > 6.0 else 1
    angles = begin + angle * np.arange(count + ends) / count
    return [(radius * math.cos(a), -radius * math.sin(a)) for a in angles.tolist()]


def _prism(radius: float, low: float, high: float, sides: int, brightness: float) -> list[Surface]:
    """The upright sides of a prism, origins in the middle of their upper edges; corners at `radius`."""
    half, inner = radius * math.sin(math.pi / sides), radius * math.cos(math.pi / sides)
    surfaces = []
    for side in range(sides):
        yaw = 2.0 * math.pi * (side + 0.5) / sides
        surface = upright(inner * math.cos(yaw), inner * math.sin(yaw), high, yaw)
        surface.rectangle(-half, 0.0, half, high - low, brightness, covers=True)
        surfaces.append(surface)
    return surfaces


def _lid(radius: float, height: float, sides: int, brightness: float) -> Surface:
    """The top of a prism, in quadrangles that share their first corner."""
    surface = level(height)
    angles = -2.0 * math.pi * np.arange(sides) / sides  # clockwise as seen from above, y up
    ring = [(radius * math.cos(angle), -radius * math.sin(angle)) for angle in angles]
    surface.fan(ring[::-1], brightness, covers=True)
    return surface
