"""Images of square markers whose corners are known: random scenes rendered by sampling every pixel's area.

A pixel's value is the mean over a grid of points in its square and over instants of the exposure, so corners
are where the geometry puts them, to 0.01 px. Then come the blur of the optics, light and noise.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_vision.markers.families import Family
from swarm_loc_vision.markers.lines import homographies
from swarm_loc_vision.markers.pose import square

Gray = NDArray[np.uint8]

WIDTH, HEIGHT, FOCAL_PX = 1280, 960, 1000.0
CAMERA = np.array([[FOCAL_PX, 0.0, (WIDTH - 1) / 2], [0.0, FOCAL_PX, (HEIGHT - 1) / 2], [0.0, 0.0, 1.0]])
_CELL_MARGIN = 1
_BORDER_PX = 4.0
_GAP_PX = 6.0


@dataclass(frozen=True)
class Look:
    """How a scene is lit and photographed.

    Attributes:
        white, black: Counts of paper and ink.
        gradient: Share by which the light differs across the image.
        noise: Standard deviation [counts].
        focus: Blur of the optics, standard deviation [px].
        clutter: Number of shapes in the background.
        max_blur: Longest way of a marker during the exposure [px].
    """

    white: float = 200.0
    black: float = 35.0
    gradient: float = 0.4
    noise: float = 2.0
    focus: float = 0.6
    clutter: int = 60
    max_blur: float = 0.0


@dataclass(frozen=True)
class Truth:
    """One marker of a scene.

    Attributes:
        marker_id: Its id.
        corners: (4, 2) in the middle of the exposure, clockwise from its own upper left [px].
        rotation, position: Of the marker in the optical frame; its y axis points up, z out of it.
        length: Its side [m].
        incidence: Angle between its normal and the line of sight [rad].
        blur: How far it moves in the image during the exposure [px].
    """

    marker_id: int
    corners: FloatArray
    rotation: FloatArray
    position: FloatArray
    length: float
    incidence: float
    blur: float

    @property
    def side_px(self) -> float:
        """Square root of the area in the image [px]."""
        x, y = self.corners.T
        return math.sqrt(0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))))


def project(rotation: FloatArray, position: FloatArray, points: FloatArray) -> FloatArray:
    """(N, 2) pixels of points (N, 3) given in a marker's frame."""
    seen = points @ rotation.T + position
    return np.asarray(seen[:, :2] / seen[:, 2:] * FOCAL_PX + CAMERA[:2, 2])


def facing(azimuth: float, incidence: float, roll: float, position: FloatArray) -> FloatArray:
    """Rotation (3, 3) of a marker turned away from the line of sight by an incidence about a tilted axis."""
    sight = position / np.linalg.norm(position)
    right = np.cross([0.0, 1.0, 0.0], sight)
    right /= np.linalg.norm(right)
    upright = np.column_stack([right, np.cross(right, sight), -sight])
    axis = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    tilt, _ = cv2.Rodrigues(incidence * axis)
    turn, _ = cv2.Rodrigues(np.array([0.0, 0.0, roll]))
    return np.asarray(upright @ tilt @ turn)


def _random_truth(rng: np.random.Generator, family: Family, max_blur: float) -> Truth | None:
    """A marker of 3 to 10 cm at 0.2 to 2 m, tilted by up to 70 degrees; None when it leaves the image."""
    length, distance = rng.uniform(0.03, 0.10), rng.uniform(0.2, 2.0)
    pixel = rng.uniform([0.0, 0.0], [WIDTH, HEIGHT])
    position = distance * np.array([*((pixel - CAMERA[:2, 2]) / FOCAL_PX), 1.0])
    incidence = rng.uniform(0.0, math.radians(70.0))
    azimuth, roll = rng.uniform(-math.pi, math.pi, 2)
    rotation = facing(azimuth, incidence, roll, position)
    corners = project(rotation, position, square(length * _whole_side(family) / family.side))
    blur = rng.uniform(min(1.0, max_blur), max_blur) if max_blur else 0.0
    room = _BORDER_PX + 0.5 * blur
    if corners.min() < room or (corners > np.array([WIDTH, HEIGHT]) - 1 - room).any():
        return None
    inner = project(rotation, position, square(length))
    return Truth(int(rng.integers(len(family.words))), inner, rotation, position, length, incidence, blur)


def _whole_side(family: Family) -> int:
    """Cells along a side with the margin."""
    return family.side + 2 * (family.layout.outside + _CELL_MARGIN)


def random_scene(
    rng: np.random.Generator, family: Family, count: int, look: Look
) -> tuple[Gray, list[Truth]]:
    """An image with up to `count` markers that do not touch, and the truth."""
    truths: list[Truth] = []
    boxes: list[FloatArray] = []
    for _ in range(40 * count):
        truth = _random_truth(rng, family, look.max_blur)
        if truth is None:
            continue
        grown = project(
            truth.rotation, truth.position, square(truth.length * max(1.5, _whole_side(family) / family.side))
        )
        box = np.concatenate([grown.min(axis=0) - _GAP_PX, grown.max(axis=0) + _GAP_PX])
        if any((box[:2] < other[2:]).all() and (other[:2] < box[2:]).all() for other in boxes):
            continue
        truths.append(truth)
        boxes.append(box)
        if len(truths) == count:
            break
    return render(rng, family, truths, look), truths


def render(rng: np.random.Generator, family: Family, truths: Sequence[Truth], look: Look) -> Gray:
    """The image of markers before a cluttered background."""
    image = _background(rng, look)
    for truth in truths:
        _paint(rng, image, family, truth, look)
    sigma = look.focus
    blurred = cv2.GaussianBlur(image, (0, 0), sigma) if sigma else image
    light = _light(rng, look.gradient)
    noisy = blurred * light + rng.normal(0.0, look.noise, image.shape).astype(np.float32)
    return np.asarray(np.clip(np.rint(noisy), 0, 255), np.uint8)


def _background(rng: np.random.Generator, look: Look) -> NDArray[np.float32]:
    """Gray with filled shapes, some as dark as ink and some as light as paper."""
    image = np.full((HEIGHT, WIDTH), rng.uniform(look.black, look.white), np.float32)
    for _ in range(look.clutter):
        shade = float(rng.uniform(look.black, look.white))
        centre = rng.uniform([0, 0], [WIDTH, HEIGHT])
        spread = rng.uniform(4.0, 120.0)
        corners = centre + rng.uniform(-spread, spread, (int(rng.integers(3, 7)), 2))
        cv2.fillPoly(image, [np.rint(corners).astype(np.int32)], shade, cv2.LINE_AA)
    return image


def _light(rng: np.random.Generator, gradient: float) -> NDArray[np.float32]:
    """Light that falls off evenly across the image."""
    angle = rng.uniform(-math.pi, math.pi)
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    along = (u / WIDTH - 0.5) * math.cos(angle) + (v / HEIGHT - 0.5) * math.sin(angle)
    return np.asarray(1.0 + gradient * along, np.float32)


def _paint(
    rng: np.random.Generator, image: NDArray[np.float32], family: Family, truth: Truth, look: Look
) -> None:
    """Put a marker with its white margin into the image."""
    cells = np.pad(family.pattern(truth.marker_id), _CELL_MARGIN, constant_values=1)
    shades = np.where(cells, look.white, look.black).astype(np.float32)
    instants = 1 if truth.blur == 0.0 else 24
    grid = 8 if instants == 1 else 4
    side = _whole_side(family)
    outer = project(truth.rotation, truth.position, square(truth.length * side / family.side))
    to_cells = np.linalg.inv(homographies(outer[None])[0] @ np.diag([1.0 / side, 1.0 / side, 1.0]))
    direction = rng.uniform(-math.pi, math.pi)
    way = truth.blur * np.array([math.cos(direction), math.sin(direction)])
    shares = (np.arange(instants) + 0.5) / instants - 0.5
    low = np.floor(outer.min(axis=0) - 0.5 * np.abs(way)).astype(int) - 1
    high = np.ceil(outer.max(axis=0) + 0.5 * np.abs(way)).astype(int) + 2
    low, high = np.maximum(low, 0), np.minimum(high, [WIDTH, HEIGHT])
    _sample(image, low, high, to_cells, shares[:, None] * way, shades, grid)


@cached_njit
def _sample(
    image: NDArray[np.float32],
    low: NDArray[np.int64],
    high: NDArray[np.int64],
    to_cells: FloatArray,
    shifts: FloatArray,
    shades: NDArray[np.float32],
    grid: int,
) -> None:
    """Average the marker, and what lies behind it, over each pixel's square and over all shifts."""
    side = shades.shape[0]
    total = grid * grid * len(shifts)
    for v in range(low[1], high[1]):
        for u in range(low[0], high[0]):
            behind = image[v, u]
            mean = 0.0
            for k in range(len(shifts)):
                for i in range(grid):
                    y = v - 0.5 + (i + 0.5) / grid - shifts[k, 1]
                    for j in range(grid):
                        x = u - 0.5 + (j + 0.5) / grid - shifts[k, 0]
                        w = to_cells[2, 0] * x + to_cells[2, 1] * y + to_cells[2, 2]
                        a = (to_cells[0, 0] * x + to_cells[0, 1] * y + to_cells[0, 2]) / w
                        b = (to_cells[1, 0] * x + to_cells[1, 1] * y + to_cells[1, 2]) / w
                        if 0.0 <= a < side and 0.0 <= b < side:
                            mean += shades[int(b), int(a)]
                        else:
                            mean += behind
            image[v, u] = mean / total
