"""Aerial detector: an overhead image in, places and headings of robots without identity out.

`AerialCamera` takes CameraInfo and images and gives serialized anonymous detections. Messages may be those of
rclpy or of rosbags, whose fields have the same names.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.cdr import nanoseconds
from swarm_loc_estimator.common.messages.detections import ANONYMOUS_DTYPE, encode_detections
from swarm_loc_vision.aerial.circles import (
    INNER,
    PARTLY,
    SIDES,
    TOP,
    Circles,
    Edges,
    Light,
    Rims,
    Sides,
    likely,
    peaks,
)
from swarm_loc_vision.aerial.ground_control import (
    NO_GROUND,
    POLARITIES,
    AerialSettings,
    Ground,
    GroundCamera,
    GroundControl,
)
from swarm_loc_vision.aerial.pattern import Marks, find_marks
from swarm_loc_vision.aerial.rectification import (
    Brightness,
    Rectification,
    RectificationError,
    brightness,
    noise_of,
    rectification,
)
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.common.images import CalibratedCamera, Gray, GrayOf, ImageError

# Numbers below were chosen on drawn pictures (bench/aerial/pictures.py), not on those of seeds 101 to 104,
# which doc/aerial_camera_node.md reports on (`make bench-aerial`).
_SIZES_PX = 16.0, 32.0  # Least and largest diameter of robots in the rectified image
_ROUGH_PX = 10.0, 20.0  # The same where the diameter is not known yet
_MAX_SHARE = 0.25  # Largest robot that is searched for, over the shorter side of the image
_SPARE, _SPARE_SHARE = 60, 4
_ROUGH_MOST = 100  # Candidates of each size that is tried
_LEAST_DISTANCE = 0.75  # Least distance of two robots, in diameters
_MAX_SPREAD, _MAX_SPREAD_PX = 0.03, 0.2
"""Largest rms distance of a disc's rim from a circle: a share of the radius, plus pixels."""
_MAX_OVAL = 0.15  # Largest second harmonic of a disc's outline, over its radius: what motion leaves
_MAX_SHIFT, _MAX_GROWTH = 0.2, 3.0
"""Largest distance of a refined centre from the first one, in radii, and largest ratio of their sigmas."""
_SHIFT_SHARE = 0.03  # Share of the square of that distance that is a variance of the refined centre
_UNREFINED = 0.03  # Error of a centre that cannot be refined, one standard deviation in radii
_PARALLAX_SHARE = 0.05
"""Error of a centre by sides that its outline leaves out, over the distance of top and base in the image."""
_MOTION_SHARE = 0.1  # Variance of the place along the motion, in squares of the second harmonic
_FLAT = ((TOP, True, 0.6),)
_TALL = ((SIDES, False, 1.0), (PARTLY, False, 0.6), (TOP, True, 0.6), (SIDES, True, 0.6), (PARTLY, True, 0.4))
"""Outlines that are tried where the quality is below their weight: kind, if edges are blurred, weight."""
_PART, _SURE = 0.3, 0.2
"""Least coverage of discs for which other outlines are tried, and least weighted quality of these."""
_SAME_SIZE = 0.2  # Largest relative difference of a disc's radius from the others in the image
_SAME_CONTRAST = 0.45  # Least contrast of a disc over that of the others: shadows have less
_TOUCHING, _USUAL = 1.3, 0.65
"""Largest distance of touching discs, in diameters; least share of the usual coverage of any other disc."""
_RAGGED = 0.1  # Quality of a disc with a ragged rim, over the square of its coverage
_NOTHING_HIDDEN, _HIDDEN_SHARE = 0.9, 0.3
"""Coverage below which what hides a rim may be taken for it; error of the centre in radii, over the lack."""
_LIDS = 0.55, 0.7, 0.85  # Radii of inner circles that are tried, in radii of discs
_LID_AWAY, _SAME_LID = 0.3, 0.1
"""Largest distance of their centres in radii of discs, and largest relative difference of their radii."""
_MOST_LIDS = 0.5  # Least share of clear discs that show an inner circle, if any does
_LID_SIGMA = 0.1  # Error of a disc's centre by its inner circle, one standard deviation in radii
_MAX_SQUARENESS = 0.4
_MARK_ROUNDS = 2
_MOST, _CLEAR = 0.6, 0.85  # If this share of discs shows a mark, discs without one need this coverage


@dataclass(frozen=True)
class AerialDetections:
    """The robots in an image, one row each, in no order."""

    place: FloatArray  # (N, 2) of their centres in map [m]
    theta: FloatArray  # (N,) headings in map [rad]; NaN: unknown
    # (N, 3, 3) of x, y and theta; an unknown heading has that of a uniform distribution
    covariance: FloatArray
    pixel: FloatArray  # (N, 2) centres in the raw image
    diameter: FloatArray  # (N,) [m]
    coverage: FloatArray  # (N,) share of the rim that shows an edge
    dropped: Mapping[str, int]  # Number of discs left out, by reason

    def __len__(self) -> int:
        return len(self.place)


class _Look(NamedTuple):
    """A rectified image."""

    grid: Rectification
    image: Brightness
    edges: Edges


class _Found(NamedTuple):
    """Discs of one polarity."""

    rims: Rims
    circles: Circles

    @property
    def score(self) -> float:
        """Sum of their quality."""
        return float(np.sum(_quality(self.circles)))


class AerialDetector:
    """Finds discs of one size, of one of POLARITIES, on a level plane, and the mark on them.

    Without a diameter in the settings it is estimated from the first images.
    """

    def __init__(self, settings: AerialSettings, ground: GroundCamera, polarity: str = "auto") -> None:
        self._settings, self._ground = settings, ground
        self._polarities = POLARITIES[polarity]
        self.diameter = settings.robot_diameter  # Diameter of the robots [m]; 0: not known yet
        self._grid: Rectification | None = None

    def detect(self, gray: Gray) -> AerialDetections:
        """The robots in an image (height, width).

        Raises:
            RectificationError: The camera does not see the plane, or robots on it look too small.
        """
        diameter = self.diameter or self._estimated(gray)
        if not diameter:
            return _nothing({"size_unknown": 1})
        if self._grid is None:
            self._grid = rectification(self._ground, self._settings, diameter, _SIZES_PX)
        most = _SPARE_SHARE * self._settings.max_robots + _SPARE
        look = self._look(self._grid, gray, noise_of(gray), diameter)
        # discs of the polarity with the higher score
        wide = diameter / look.grid.metres_per_px
        kinds: list[tuple[_Found, dict[str, int]]] = []
        for polarity in self._polarities:
            rims, centres = self._candidates(look, wide, polarity, most)
            circles = _outlined(rims, centres, np.full(len(centres), 0.5 * wide))
            kinds.append(self._chosen(rims, circles, look.grid))
        found, dropped = max(kinds, key=lambda kind: kind[0].score)
        located = self._located(self._grid, found, dropped)
        if len(located):
            self.diameter = diameter
        elif not self.diameter:  # what was measured was no robot
            self._grid = None
        return located

    def _look(self, grid: Rectification, gray: Gray, noise: float, diameter: float) -> _Look:
        """The image on a grid, for robots of about a diameter [m]."""
        image = brightness(grid.apply(gray), diameter / grid.metres_per_px, noise)
        return _Look(grid, image, Edges(image, grid.seen, self._settings.min_contrast))

    def _candidates(self, look: _Look, wide: float, polarity: float, most: int) -> tuple[Rims, FloatArray]:
        """Candidates (C, 2) for discs of about a diameter [px]."""
        centres = peaks(look.edges.votes(wide, polarity), wide, most)
        foot, grid = self._ground.centre, look.grid
        sides = Sides((foot[:2] - grid.origin) / grid.metres_per_px, max(grid.height, 0.0) / foot[2])
        rims = Rims(look.image, polarity, self._settings.min_contrast, sides)
        return rims, likely(rims, centres, 0.5 * wide)

    def _clear(self, circles: Circles) -> NDArray[np.bool_]:
        """Which discs (C,) have clear rims."""
        return np.asarray((_quality(circles) > 0.0) & (circles.coverage >= self._settings.min_coverage))

    def _chosen(self, rims: Rims, circles: Circles, grid: Rectification) -> tuple[_Found, dict[str, int]]:
        """Select discs that do not overlap and are alike."""
        # some have clear rims; hidden or ragged rims count for others of their size
        circles = circles.select(_inside(grid, circles.centre))
        least, clear = self._settings.min_coverage, self._clear(circles)
        if not clear.any():
            return _Found(rims, circles.select(clear)), {}
        size = commonest(circles.radius[clear], _quality(circles)[clear])
        circles = _with_lids(rims, circles, clear, size, least)
        circles = circles.select(circles.coverage >= least)
        circles = circles.select(_apart(circles))
        alike = np.abs(circles.radius / size - 1.0) <= _SAME_SIZE
        dropped = {"other_size": int(np.sum(~alike))}
        circles = circles.select(alike)
        # a touching disc may hide a rim, hardly anything else: a disc alone must show as much as the others,
        # and not only where a square would
        away = np.linalg.norm(circles.centre[:, None] - circles.centre, axis=2)
        np.fill_diagonal(away, np.inf)
        alone = away.min(axis=1, initial=np.inf) > _TOUCHING * 2.0 * circles.radius
        usual = np.median(circles.coverage) if len(circles.coverage) else 0.0
        whole = (circles.coverage >= _USUAL * usual) & (circles.squareness <= _MAX_SQUARENESS) | ~alone
        dropped["not_whole"] = int(np.sum(~whole))
        circles = circles.select(whole)
        most = self._settings.max_robots
        dropped["too_many"] = max(len(circles.radius) - most, 0)
        order = np.argsort(-_rank(circles), kind="stable")[:most]
        return _Found(rims, circles.select(order)), dropped

    def _located(self, grid: Rectification, found: _Found, dropped: dict[str, int]) -> AerialDetections:
        """Locate discs in map: fit the mark, then the rim again without the light of the mark."""
        circles, rims, settings = found.circles, found.rims, self._settings
        if not len(circles.radius):
            return _nothing(dropped)
        # the mark, then the rim again without its light, in turns
        is_strong = circles.contrast >= _SAME_CONTRAST * commonest(circles.contrast, _rank(circles))
        for _ in range(_MARK_ROUNDS):
            marks = find_marks(rims.image.plain, circles.centre, circles.radius, rims.polarity)
            again = rims.measure(circles.centre, circles.radius, circles.kind, circles.soft, marks.light)
            better = (marks.step != 0.0) & (again.coverage >= settings.min_coverage)
            better &= circles.kind != INNER
            circles = circles.updated(np.flatnonzero(better), again.select(better))
        marks = find_marks(rims.image.plain, circles.centre, circles.radius, rims.polarity)
        # discs that are too weak, or that lack the mark of the others, are no robots
        has_mark = np.isfinite(marks.theta)
        is_strong |= has_mark  # a shadow may weaken a rim, but shows no mark
        quality = _rank(circles)
        alike = has_mark | (circles.coverage >= _CLEAR) | ~is_strong
        alike |= quality[has_mark].sum() < _MOST * quality.sum()  # few show a mark
        dropped |= {"other_contrast": int(np.sum(~is_strong)), "without_mark": int(np.sum(~alike))}
        kept = alike & is_strong
        circles, marks = circles.select(kept), Marks(*(column[kept] for column in marks))
        # the rim once more, and the centres on the floor
        circles = _refined(rims, circles, marks.light)
        places = grid.places(circles.centre)
        # noise of the outline, of pixels, of the camera's pose and of the robots' height
        # motion during the exposure draws an outline out, and its middle may not be the place at the stamp
        size, (cos, sin) = np.hypot(*circles.oval.T), circles.oval.T
        along = size[:, None, None] * np.array([[size + cos, sin], [sin, size - cos]]).transpose(2, 0, 1)
        of_outline = circles.covariance + 0.5 * _MOTION_SHARE * along
        of_pixel = self._ground.pixel_covariances(places, of_outline * grid.metres_per_px**2)
        of_pixel = of_pixel + settings.pixel_sigma**2 * np.eye(2)
        covariance = np.zeros((len(places), 3, 3))
        covariance[:, :2, :2] = self._ground.covariances(places, of_pixel, settings.robot_height_sigma)
        covariance[:, 2, 2] = np.where(np.isfinite(marks.theta), marks.variance, np.pi**2 / 3.0)
        return AerialDetections(
            place=places[:, :2],
            theta=marks.theta,
            covariance=covariance,
            pixel=self._ground.pixels(places),
            diameter=2.0 * circles.radius * grid.metres_per_px,
            coverage=circles.coverage,
            dropped=dropped,
        )

    def _estimated(self, gray: Gray) -> float:
        """Estimate the diameter of the robots from one image [m]; 0: there are none."""
        settings, ground = self._settings, self._ground
        middle = ground.places(np.array([0.5 * gray.shape[1], 0.5 * gray.shape[0]]), settings.robot_height)
        if not np.isfinite(middle).all():
            raise RectificationError("the middle of the image does not show the floor.")
        per_metre = float(ground.scale(np.append(middle, settings.robot_height)))
        least, largest = settings.min_diameter_px / per_metre, _MAX_SHARE * min(gray.shape) / per_metre
        diameters, scores = [np.zeros(0)], [np.zeros(0)]
        look, noise = None, noise_of(gray)
        steps = math.log(largest / (1.2 * least)) / math.log(_RATIO)
        for diameter in (1.2 * least * _RATIO ** np.arange(max(math.ceil(steps), 0) + 1)).tolist():
            # a pyramid: one image for all diameters that are neither small nor large in it
            if look is None or diameter > _ROUGH_PX[1] * look.grid.metres_per_px:
                grid = rectification(ground, settings, diameter, (0.0, _ROUGH_PX[0]))
                look = self._look(grid, gray, noise, diameter)
            wide, kinds = diameter / look.grid.metres_per_px, []
            for polarity in self._polarities:
                rims, centres = self._candidates(look, wide, polarity, _ROUGH_MOST)
                circles = _measured(rims, centres, np.full(len(centres), 0.5 * wide))
                clear = self._clear(circles) & _inside(look.grid, circles.centre)
                circles = circles.select(clear)
                kinds.append(_Found(rims, circles.select(_apart(circles))))
            circles = max(kinds, key=lambda kind: kind.score).circles
            diameters.append(2.0 * circles.radius * look.grid.metres_per_px)
            scores.append(_quality(circles))
        return commonest(np.concatenate(diameters), np.concatenate(scores))


def _measured(rims: Rims, centre: FloatArray, radius: FloatArray) -> Circles:
    """Measured discs (C,) that are flat and at rest."""
    return rims.measure(centre, radius, np.full(len(centre), TOP), np.zeros(len(centre), np.bool_))


def _outlined(rims: Rims, centre: FloatArray, radius: FloatArray) -> Circles:
    """Measured discs (C,), each with the outline that fits best."""
    best = _measured(rims, centre, radius)
    for kind, soft, weight in _TALL if rims.sides.share > 0.0 else _FLAT:
        rows = np.flatnonzero((_quality(best) < weight) & (best.coverage >= _PART))
        other = rims.measure(centre[rows], radius[rows], np.full(len(rows), kind), np.full(len(rows), soft))
        better = weight * _quality(other) > np.maximum(_quality(best)[rows], _SURE)
        best = best.updated(rows[better], other.select(better))
    return best


def _quality(circles: Circles) -> FloatArray:
    """(C,) quality of discs, 0 to 1, from the coverage and the roundness of their rims."""
    limit = _MAX_SPREAD * circles.radius + _MAX_SPREAD_PX
    oval = np.sum(circles.oval**2, axis=1) / (_MAX_OVAL * circles.radius) ** 2
    misfit = (circles.spread / limit) ** 2 + oval
    return np.asarray(circles.coverage**2 * np.maximum(1.0 - misfit, 0.0))


def _rank(circles: Circles) -> FloatArray:
    """(C,) quality of discs of which some have ragged or hidden rims."""
    return np.maximum(_quality(circles), _RAGGED * circles.coverage**2)


def _with_lids(rims: Rims, circles: Circles, clear: NDArray[np.bool_], size: float, least: float) -> Circles:
    """Circles with those that show an inner circle instead of a rim, of which touching robots show little.

    A lid on top has a rim of its own, of the other polarity, which counts if most of the `clear` ones of
    radius `size` show it.
    """
    inner = Rims(rims.image, -rims.polarity, rims.min_contrast, rims.sides)
    sharp = np.zeros(len(circles.radius), np.bool_)
    best = circles._replace(coverage=np.zeros(len(sharp)))
    for share in _LIDS:
        kind, radius = np.full(len(sharp), INNER), np.full(len(sharp), share * size)
        other = inner.measure(circles.centre, radius, kind, sharp)
        away = np.linalg.norm(other.centre - circles.centre, axis=1)
        better = (_quality(other) > _quality(best)) & (other.coverage >= least) & (away <= _LID_AWAY * size)
        best = best.updated(np.flatnonzero(better), other.select(better))
    has_lid = best.coverage > 0.0
    if has_lid[clear].mean() < _MOST_LIDS:
        return circles
    usual = commonest(best.radius[has_lid & clear], _quality(best)[has_lid & clear])
    both = 0.5 * (circles.coverage + best.coverage)
    taken = has_lid & ~clear & (np.abs(best.radius / usual - 1.0) <= _SAME_LID) & (both > circles.coverage)
    lids, count = best.select(taken), int(taken.sum())
    lids = lids._replace(
        radius=np.full(count, size),
        coverage=both[taken],
        contrast=np.full(count, np.median(circles.contrast[clear])),
        covariance=lids.covariance + (_LID_SIGMA * size) ** 2 * np.eye(2),
    )
    return circles.updated(np.flatnonzero(taken), lids)


def _inside(grid: Rectification, centre: FloatArray) -> NDArray[np.bool_]:
    """Whether centres (C, 2) lie in the valid area."""
    rows, columns = grid.seen.shape
    cells = np.rint(centre).astype(np.int64)
    inside = np.asarray(((cells >= 0) & (cells < [columns, rows])).all(axis=1))
    cells = np.clip(cells, 0, [columns - 1, rows - 1])
    return np.asarray(inside & grid.seen[cells[:, 1], cells[:, 0]])


def _apart(circles: Circles) -> NDArray[np.int64]:
    """Rows of the circles of highest quality that do not overlap."""
    kept: list[int] = []
    for row in np.argsort(-_rank(circles), kind="stable").tolist():
        away = np.linalg.norm(circles.centre[kept] - circles.centre[row], axis=1)
        if (away >= 2.0 * _LEAST_DISTANCE * circles.radius[row]).all():
            kept.append(row)
    return np.array(kept, np.int64)


def _refined(rims: Rims, circles: Circles, light: Light) -> Circles:
    """Circles with their centres by the steepest counts of their rims, where these agree with the logarithm.

    A part of what uneven blur moves them is an error, as is a part of the parallax of sides left out.
    """
    sharp = np.zeros(len(circles.radius), np.bool_)
    fine = rims.measure(circles.centre, circles.radius, circles.kind, sharp, light, fine=True)
    shift = fine.centre - circles.centre
    sigmas = [np.sqrt(np.trace(one.covariance, axis1=1, axis2=2)) for one in (fine, circles)]
    good = (circles.kind != INNER) & (fine.coverage >= _PART) & (sigmas[0] <= _MAX_GROWTH * sigmas[1])
    good &= np.linalg.norm(shift, axis=1) <= _MAX_SHIFT * circles.radius
    rough = circles.covariance + (_UNREFINED * circles.radius[:, None, None]) ** 2 * np.eye(2)
    spread = np.where(good[:, None, None], fine.covariance + _SHIFT_SHARE * _outer(shift), rough)
    hidden = _HIDDEN_SHARE * np.maximum(_NOTHING_HIDDEN - circles.coverage, 0.0) * circles.radius
    parallax = rims.sides.share * (rims.sides.foot - circles.centre) * (circles.kind != SIDES)[:, None]
    return circles._replace(
        centre=np.where(good[:, None], fine.centre, circles.centre),
        radius=np.where(good, fine.radius, circles.radius),
        oval=np.where(good[:, None], fine.oval, circles.oval),
        covariance=spread + hidden[:, None, None] ** 2 * np.eye(2) + _PARALLAX_SHARE**2 * _outer(parallax),
    )


def _outer(vectors: FloatArray) -> FloatArray:
    """(N, 2, 2) products of vectors (N, 2) with themselves."""
    return np.asarray(vectors[:, :, None] * vectors[:, None])


def _nothing(dropped: Mapping[str, int]) -> AerialDetections:
    none, pairs = np.zeros(0), np.zeros((0, 2))
    return AerialDetections(pairs, none, np.zeros((0, 3, 3)), pairs, none, none, dropped)


_RATIO, _ALIKE = 1.3, 1.1  # Of a diameter that is tried to the one before, and of those of one size


def commonest(diameters: FloatArray, scores: FloatArray) -> float:
    """The diameter that most discs (N,) share, weighted by scores (N,); 0: no discs."""
    if not len(diameters):
        return 0.0
    alike = np.abs(np.log(diameters[:, None] / diameters)) < np.log(_ALIKE)
    best = int(np.argmax(alike @ scores))
    return float(np.median(diameters[alike[best]]))


class AerialCamera(CalibratedCamera):
    """Finds robots in the images of one overhead camera; arguments as of `AerialDetector`.

    Intrinsics of the control points, if any, replace camera_info. `gray_of` reads an image message, see
    `TRANSPORTS`.
    """

    def __init__(self, settings: AerialSettings, polarity: str, ground: Ground, gray_of: GrayOf) -> None:
        super().__init__(gray_of)
        self.used = 0  # Number of images that were searched
        self.robots = 0  # Number of detections
        self.headings = 0  # Number of detections with a heading
        self.control: GroundControl | None = None  # The camera's pose; None before the calibration
        self._settings, self._polarity, self._ground = settings, polarity, ground
        self._detector: tuple[GroundCamera, AerialDetector] | None = None
        self._seeing_trouble = ""
        if ground.camera is not None:
            self.take_over(ground.camera)

    @property
    def diameter(self) -> float:
        """Diameter of the robots [m]; 0: not known yet."""
        return self._detector[1].diameter if self._detector else 0.0

    @property
    def why_nothing(self) -> str:
        """Why no robots can be found, a sentence; empty: they can."""
        if self.control is None:
            return self.trouble or (NO_GROUND if self._ground.is_empty else "")
        return self.control.trouble or self._seeing_trouble

    def use(self, camera: Camera) -> None:
        """Solve for the camera's pose again."""
        self.control = GroundControl(self._ground, camera, self._settings)
        self._detector = None

    def found(self, message: Any) -> bytes:
        """The serialized swarm_loc_msgs/AnonymousDetectionArray of an image, in map."""
        gray = self.gray(message)
        ground = self.control.look(gray) if self.control else None
        if ground is None:
            raise ImageError("no_control_points", self.why_nothing)
        if self._detector is None or self._detector[0] is not ground:
            known = self.diameter
            self._detector = ground, AerialDetector(self._settings, ground, self._polarity)
            self._detector[1].diameter = self._detector[1].diameter or known
        try:
            detections = self._detector[1].detect(gray)
        except RectificationError as error:
            self._seeing_trouble = str(error)
            raise ImageError("not_visible", str(error)) from error
        self._seeing_trouble = ""
        # count and encode
        self.drops.update(detections.dropped)
        self.used += 1
        self.robots += len(detections)
        self.headings += int(np.isfinite(detections.theta).sum())
        rows = np.zeros(len(detections), ANONYMOUS_DTYPE)
        rows["x"], rows["y"] = detections.place.T
        rows["theta"], rows["covariance"] = detections.theta, detections.covariance
        rows["u_px"], rows["v_px"] = detections.pixel.T
        return encode_detections("map", nanoseconds(message.header.stamp), rows)
