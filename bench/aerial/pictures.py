"""Overhead pictures drawn by plain image operations, not by the simulator's renderer.

A floor plan is painted with discs, texture, lines and things that are no robots; light and shadows are laid
over it; a camera of any tilt and lens looks at it, pixel by pixel as means of several samples.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.aerial.ground_control import GroundCamera
from swarm_loc_vision.aerial.pattern import MARGIN, inside_mark
from swarm_loc_vision.common.camera import Camera

Plain = NDArray[np.float32]

DIAMETER = 0.07
SIZE = (640, 480)
_SUPER = 3
_PLAN_FINE = 2.0
_FAR = 1.2
"""Widths of the image, at its middle, to either side of map's origin up to which the floor is painted."""
_POSE_SIGMA = 1e-6
_WHITE = 235.0
_SLICES, _EXPOSURES, _PARTS = 12, 13, 14
_CORNERS = (-1, -1), (-1, 1), (1, 1), (1, -1)
_LID = 0.66  # Radius of a lid, in radii of its robot


@dataclass(frozen=True)
class Look:
    """What a picture is like."""

    diameter_px: float = 24.0  # Of robots in the middle of the picture
    robots: int = 12  # How many
    # `pattern`, or plain discs: `dark`, `bright`; `board`, dark with bright parts; `lid`, a board with a
    # bright lid; `led`, a bright spot with soft rims
    kind: str = "pattern"
    tilt: float = 0.0  # Of the camera [rad]
    barrel: float = 0.0  # Radial distortion k1 of the lens
    field_of_view: float = math.radians(60.0)  # Across [rad]
    gradient: float = 1.0  # Brightness at the dark end of the floor over that at the bright one
    shadow: float = 0.0  # Share of the light that shadows take
    touching: float = 0.0  # Share of the robots that touch another one
    noise: float = 2.0  # Of the sensor, one standard deviation [counts]
    floor: float = 0.55  # Brightness of the floor, 0 to 1
    texture: float = 0.02  # Of the floor, one standard deviation of its brightness
    clutter: int = 6  # Things on the floor that are no robots
    blur_px: float = 0.6  # Of the optics, one standard deviation
    height: float = 0.0  # Of the robots [m]
    wall: float = 0.06  # Brightness of their sides
    taper: float = 0.0  # Share of the diameter that is missing at the floor
    motion: float = 0.0  # Way of each robot while the shutter is open, in any direction, in diameters
    rails: float = 0.0  # Share of the robots that stand at a bright rail
    boards: float = 0.0  # One standard deviation of the brightness of the floor's boards


@dataclass(frozen=True)
class Picture:
    """A picture with what is true of it."""

    gray: NDArray[np.uint8]  # (height, width)
    ground: GroundCamera  # The camera
    poses: FloatArray  # (N, 3) of the robots in map
    has_heading: bool  # Whether their pattern shows a heading


def overhead_camera(look: Look, rng: np.random.Generator) -> GroundCamera:
    """A camera that sees robots as large as it should, tilted to any side."""
    width, height = SIZE
    focal = 0.5 * width / math.tan(0.5 * look.field_of_view)
    lens = (look.barrel, 0.0, 0.0, 0.0, 0.0)
    camera = Camera(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), lens)
    distance = focal * DIAMETER / look.diameter_px
    turn = rng.uniform(-math.pi, math.pi)
    down = np.diag([1.0, -1.0, -1.0])
    spin = cv2.Rodrigues(np.array([0.0, 0.0, rng.uniform(-math.pi, math.pi)]))[0]
    tilt = cv2.Rodrigues(look.tilt * np.array([math.cos(turn), math.sin(turn), 0.0]))[0]
    rotation = tilt @ down @ spin
    shift = np.array([0.0, 0.0, distance])
    pose = np.concatenate([cv2.Rodrigues(rotation)[0].ravel(), shift])
    return GroundCamera(camera, pose, _POSE_SIGMA**2 * np.eye(6))


def draw_picture(look: Look, seed: int) -> Picture:
    """A picture, the same for the same seed."""
    rng = np.random.default_rng(seed)
    ground = overhead_camera(look, rng)
    view = _raw_places(ground)
    fine = DIAMETER / (_PLAN_FINE * look.diameter_px)
    poses = _poses(look, ground, rng)
    low, high = np.nanmin(view, axis=(0, 1)), np.nanmax(view, axis=(0, 1))
    far = _FAR * DIAMETER * SIZE[0] / look.diameter_px
    low, high = np.maximum(low, -far), np.minimum(high, far)
    columns, rows = (int(n) for n in np.ceil((high - low) / fine))
    plan = _Plan(low, fine, (rows, columns), rng)
    plan.paint_floor(look)
    plan.scatter(look, poses)
    plan.lay_rails(look, poses)
    # whatever is over the floor hides a place that is farther from the foot of the camera
    foot, lift = ground.centre[:2], ground.centre[2] / (ground.centre[2] - look.height)
    tops = poses.copy()
    tops[:, :2] = foot + lift * (poses[:, :2] - foot)
    for row in np.argsort(-np.linalg.norm(tops[:, :2] - foot, axis=1), kind="stable"):
        plan.put_robot(look, poses[row], tops[row], lift)
    plan.light(look, poses, tops, lift)
    cells = np.nan_to_num((view - low) / fine - 0.5, nan=-1.0).astype(np.float32)
    light = cv2.remap(
        plan.image, cells[..., 0], cells[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    light = cv2.resize(light, SIZE, interpolation=cv2.INTER_AREA)
    light = cv2.GaussianBlur(light, (0, 0), look.blur_px)
    counts = _WHITE * light + look.noise * rng.standard_normal(light.shape)
    gray = np.clip(np.rint(counts), 0, 255).astype(np.uint8)
    return Picture(gray, ground, poses, look.kind == "pattern")


def control_pixels(
    ground: GroundCamera, count: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Places (count, 3) on the floor all over the picture, and their exact pixels (count, 2)."""
    width, height = ground.camera.width, ground.camera.height
    pixels = rng.uniform([0.05 * width, 0.05 * height], [0.95 * width, 0.95 * height], (50 * count, 2))
    flat = ground.places(pixels, 0.0)
    seen = np.isfinite(flat).all(axis=1)
    places = np.concatenate([flat[seen][:count], np.zeros((count, 1))], axis=1)
    return places, ground.pixels(places)


def _raw_places(ground: GroundCamera) -> FloatArray:
    """(3 height, 3 width, 2) places that the parts of pixels show, linear between pixels."""
    width, height = SIZE
    grid = np.stack(np.meshgrid(np.arange(-1.0, width + 1.0), np.arange(-1.0, height + 1.0)), axis=-1)
    places = ground.places(grid, 0.0)
    across = ((np.arange(_SUPER * width) + 0.5) / _SUPER + 0.5).astype(np.float32)
    down = ((np.arange(_SUPER * height) + 0.5) / _SUPER + 0.5).astype(np.float32)
    maps = np.meshgrid(across, down)
    return np.asarray(cv2.remap(places, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), float)


def _poses(look: Look, ground: GroundCamera, rng: np.random.Generator) -> FloatArray:
    """Poses (N, 3) in view, some of them touching another, none over another."""
    width, height = ground.camera.width, ground.camera.height
    poses: list[list[float]] = []
    touching = round(look.touching * look.robots)
    for _ in range(200 * look.robots):
        if len(poses) == look.robots:
            break
        if poses and len(poses) > look.robots - 1 - touching:
            near = poses[rng.integers(len(poses))]
            angle = rng.uniform(-math.pi, math.pi)
            place = np.array(near[:2]) + DIAMETER * np.array([math.cos(angle), math.sin(angle)])
        else:
            pixel = np.array([rng.uniform(0.0, width), rng.uniform(0.0, height)])
            place = ground.places(pixel, 0.0)
        if np.isfinite(place).all() and _fits(place, poses, ground, look):
            poses.append([*place.tolist(), rng.uniform(-math.pi, math.pi)])
    return np.array(poses).reshape(-1, 3)


def _fits(place: FloatArray, poses: list[list[float]], ground: GroundCamera, look: Look) -> bool:
    """Whether a robot may stand there: wholly in view, large enough, not in another one."""
    if any(math.dist(place, pose[:2]) < 0.999 * DIAMETER for pose in poses):
        return False
    angles = np.arange(8) * math.pi / 4.0
    rim = place + 0.75 * DIAMETER * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    pixels = ground.pixels(np.concatenate([rim, np.zeros((8, 1))], axis=1))
    inside = (pixels > 1.0) & (pixels < np.array(SIZE) - 2.0)
    seen = float(ground.scale(np.append(place, 0.0))) * DIAMETER
    return bool(inside.all()) and seen > 0.6 * look.diameter_px


def _lay(image: Plain, depth: FloatArray, shade: float) -> None:
    """Paint where a depth [cells] is above 0."""
    share = np.clip(0.5 + depth, 0.0, 1.0).astype(np.float32)
    image[:] = image * (1.0 - share) + shade * share


def _window(image: Plain, centre: FloatArray, reach: FloatArray) -> tuple[Plain, FloatArray]:
    """The part of an image around a centre (2,), and the columns and rows (..., 2) of its cells."""
    most = np.array(image.shape[::-1])
    left, upper = np.clip(np.floor(centre - reach), 0, most).astype(int)
    right, lower = np.clip(np.ceil(centre + reach), 0, most).astype(int)
    grid = np.stack(np.meshgrid(np.arange(left, right), np.arange(upper, lower)), axis=-1)
    return image[upper:lower, left:right], grid


def _paint_top(
    image: Plain, offset: FloatArray, radius: float, look: Look, heading: float, parts: FloatArray
) -> None:
    """Paint a robot's top at offsets (rows, columns, 2) from its centre, in its radii [cells]."""
    distance = np.linalg.norm(offset, axis=-1)
    if look.kind == "led":
        image += (0.95 * np.exp(-0.5 * (distance / 0.85) ** 8) * (1.0 - image)).astype(np.float32)
    elif look.kind == "pattern":
        cos, sin = math.cos(heading), math.sin(heading)
        if look.floor < 0.3:
            _lay(image, (1.0 + MARGIN - distance) * radius, 0.9)
        _lay(image, (1.0 - distance) * radius, 0.06)
        _lay(image, inside_mark(offset @ np.array([[cos, -sin], [sin, cos]])) * radius, 0.9)
    else:
        _lay(image, (1.0 - distance) * radius, 0.92 if look.kind == "bright" else 0.12)
    if look.kind == "lid":
        _lay(image, (_LID - distance) * radius, 0.45 + 0.25 * math.cos(heading))
    for part in parts:
        away = np.linalg.norm(offset - 0.8 * part / max(1.0, float(np.linalg.norm(part))), axis=-1)
        _lay(image, (0.09 - away) * radius, 0.7)


class _Plan:
    """A floor plan that is painted, brightness 0 to 1."""

    def __init__(
        self, low: FloatArray, step: float, shape: tuple[int, int], rng: np.random.Generator
    ) -> None:
        self._low, self._step, self._rng = low, step, rng
        self.image: Plain = np.zeros(shape, np.float32)

    def paint_floor(self, look: Look) -> None:
        """Texture of several sizes, and joints between boards."""
        rows, columns = self.image.shape
        floor = np.zeros((rows, columns), np.float32)
        for cell in (3, 9, 30, 100):
            size = columns // cell + 2, rows // cell + 2
            rough = self._rng.standard_normal(size[::-1]).astype(np.float32)
            floor += cv2.resize(rough, (columns, rows), interpolation=cv2.INTER_CUBIC)
        floor *= look.texture / max(float(floor.std()), 1e-9)
        self.image[:] = look.floor + floor
        if look.boards > 0.0:
            wide = round(0.9 * DIAMETER / self._step)
            for number, left in enumerate(range(0, columns, wide)):
                begin = -int(self._rng.integers(5 * wide)) if number else 0
                for upper in range(begin, rows, 5 * wide):
                    part = self.image[max(upper, 0) : upper + 5 * wide, left : left + wide]
                    part += look.boards * self._rng.standard_normal()
        if look.texture > 0.0:
            pitch = round(2.7 * DIAMETER / self._step)
            for line in range(int(self._rng.integers(pitch)), columns, pitch):
                cv2.line(self.image, (line, 0), (line + rows // 9, rows), look.floor * 0.8, 2, cv2.LINE_AA)

    def scatter(self, look: Look, poses: FloatArray) -> None:
        """Lay down sheets, bars and small and large discs, away from robots."""
        rows, columns = self.image.shape
        for number in range(look.clutter):
            place = self._rng.uniform([0, 0], [columns, rows]) * self._step + self._low
            if len(poses) and np.linalg.norm(poses[:, :2] - place, axis=1).min() < 2.5 * DIAMETER:
                continue
            shade = float(self._rng.choice([0.1, 0.9]))
            x, y = ((place - self._low) / self._step).tolist()
            size = DIAMETER / self._step * self._rng.uniform(0.6, 2.5)
            angle = float(self._rng.uniform(0.0, 180.0))
            if number % 3 == 2:
                radius = size * float(self._rng.choice([0.18, 1.0]))
                cv2.circle(self.image, (round(x), round(y)), round(radius), shade, -1, cv2.LINE_AA)
            else:
                across = size * (1.0 if number % 3 else 0.15)
                box = cv2.boxPoints(((x, y), (size, across), angle))
                cv2.fillConvexPoly(self.image, np.rint(box).astype(np.int32), shade, cv2.LINE_AA)

    def lay_rails(self, look: Look, poses: FloatArray) -> None:
        """Lay bright rails with dark edges beside the first robots, away from the others."""
        size = DIAMETER / self._step
        for pose in poses[: round(look.rails * len(poses))]:
            angle = float(self._rng.uniform(-math.pi, math.pi))
            towards, along = np.array(
                [[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]
            )
            for share, wide, shade in ((0.5, 0.1, 0.15), (0.62, 0.15, 0.95), (0.9, 0.35, 0.7)):
                middle = (pose[:2] - self._low) / self._step - 0.5 + (share + 0.5 * wide) * size * towards
                corners = [
                    middle + k * 2.0 * size * along + m * 0.5 * wide * size * towards for k, m in _CORNERS
                ]
                cv2.fillConvexPoly(self.image, np.rint(corners).astype(np.int32), shade, cv2.LINE_AA)

    def put_robot(self, look: Look, pose: FloatArray, top: FloatArray, lift: float) -> None:
        """One robot, in a window around it: the floor that its top and its sides hide while it moves."""
        radius = 0.5 * DIAMETER / self._step
        way = np.zeros(2)
        if look.motion > 0.0:
            angle = self._rng.uniform(-math.pi, math.pi)
            way = look.motion * DIAMETER / self._step * np.array([math.cos(angle), math.sin(angle)])
        base, centre = ((place[:2] - self._low) / self._step - 0.5 for place in (pose, top))
        reach = 1.6 * radius * lift + np.abs(way) + 0.5 * np.abs(centre - base)
        window, grid = _window(self.image, 0.5 * (base + centre), reach)
        if not window.size:
            return
        parts = (
            self._rng.uniform(-1.0, 1.0, (_PARTS, 2)) if look.kind in {"board", "lid"} else np.zeros((0, 2))
        )
        shares = np.linspace(-0.5, 0.5, _EXPOSURES) if look.motion > 0.0 else np.zeros(1)
        exposures = []
        for share in shares:
            one = window.copy()
            shift = share * way
            if look.height > 0.0:
                for rise in np.linspace(0.0, 1.0, _SLICES):
                    size = radius * (1.0 + rise * (lift - 1.0) - (1.0 - rise) * look.taper)
                    away = np.linalg.norm(grid - shift - base - rise * (centre - base), axis=-1)
                    _lay(one, size - away, look.wall)
            offset = (grid - shift - centre) / (radius * lift)
            _paint_top(one, offset, radius * lift, look, pose[2], parts)
            exposures.append(one)
        window[:] = np.mean(exposures, axis=0)

    def light(self, look: Look, poses: FloatArray, tops: FloatArray, lift: float) -> None:
        """Uneven light over all, shadows next to robots and of things that are not seen."""
        rows, columns = self.image.shape
        if look.gradient < 1.0:
            angle = self._rng.uniform(-math.pi, math.pi)
            x, y = np.meshgrid(np.linspace(-1, 1, columns), np.linspace(-1, 1, rows))
            share = 0.5 + 0.5 * (math.cos(angle) * x + math.sin(angle) * y) / 1.3
            self.image *= (look.gradient + (1.0 - look.gradient) * share).astype(np.float32)
        if look.shadow <= 0.0:
            return
        shade = np.zeros((rows, columns), np.float32)
        angle = self._rng.uniform(-math.pi, math.pi)
        size = DIAMETER / self._step
        towards = np.array([math.cos(angle), math.sin(angle)])
        for pose in poses:
            base = (pose[:2] - self._low) / self._step
            for share in np.linspace(0.2, 1.1, 10):
                centre = np.rint(base + share * size * towards).astype(int)
                cv2.circle(shade, centre.tolist(), round(0.5 * size), 1.0, -1, cv2.LINE_AA)
        for _ in range(3):
            corners = self._rng.uniform([0, 0], [columns, rows]) + 4.0 * size * self._rng.standard_normal(
                (4, 2)
            )
            hull = cv2.convexHull(corners.astype(np.float32)).astype(np.int32)
            cv2.fillConvexPoly(shade, hull, 1.0, cv2.LINE_AA)
        soft = cv2.GaussianBlur(shade, (0, 0), 0.08 * size)
        lit = np.zeros((rows, columns), np.float32)
        radius = 0.5 * size * lift
        for top in tops:
            centre = (top[:2] - self._low) / self._step - 0.5
            window, grid = _window(lit, centre, np.full(2, radius + 1.0))
            _lay(window, radius - np.linalg.norm(grid - centre, axis=-1), 1.0)
        self.image *= 1.0 - look.shadow * soft * (1.0 - lit)
