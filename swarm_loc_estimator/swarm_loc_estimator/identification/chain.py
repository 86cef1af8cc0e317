"""Identification of one robot: the posterior over chains of anonymous detections, image after image.

A robot inside the picture is detected with probability P_D or missed; every other detection is another robot
or clutter. So the likelihood of a chain is the product over images of P_D N(z; prediction) / beta where the
chain has a detection and of 1 - P_D where it has none (one target in clutter). The density beta covers other
robots anywhere in the picture, and a robot of the same kind that was at the chain's last detection and moved
about as far. A robot that enters the picture later starts a chain there.

Tracks: chains of detections that may be one robot, each with a Gaussian estimate of (p, c): the position p in
`map`, and c = lambda exp(i theta), which turns the robot's own track into the map, with the image's scale
lambda. In these four real numbers motion and measurement are linear: p <- p + c w for the way w along the
track, z = p. Only a measured heading is not, and is linearised.

Anchors: detections at which chains without a known heading start. A robot that was at z and has moved by |W|
since lies on a circle around z, with equal density in every direction. The density of a detection at distance
|D| follows Rice's distribution, in closed form also for small motions. For larger motions the direction gives
the heading, and the chain becomes a track.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.identification.picture import (
    Picture,
    TrackPoint,
    gathered_between,
    squared_distances,
)

MISSED = -1  # Place of a chain without a detection in the newest image
_FALSE_HEADING = 0.02  # Share of detected headings that are wrong and uniformly distributed
_LOG_TURN = float(np.log(2.0 * np.pi))


class Tracks(NamedTuple):
    """Chains (h,) of detections."""

    mean: FloatArray  # (h, 4) p [m], c [1], real and imaginary parts
    covariance: FloatArray  # (h, 4, 4)
    log_weight: FloatArray  # (h,) log probabilities, up to a common constant
    place: IntArray  # (h,) detection of the newest image at which each ends, or MISSED
    length: IntArray  # (h,) number of detections of each

    def select(self, rows: IntArray) -> Tracks:
        """The tracks of the given rows."""
        return Tracks(*(column[rows] for column in self))  # type: ignore[arg-type] # each keeps its type


_NONE: IntArray = np.zeros(0, dtype=np.int64)
NO_TRACKS = Tracks(np.zeros((0, 4)), np.zeros((0, 4, 4)), np.zeros(0), _NONE, _NONE)


def joined(parts: list[Tracks]) -> Tracks:
    """The tracks of all parts, in one container."""
    return Tracks(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def predicted(tracks: Tracks, way: complex, noise: FloatArray, scale_variance: float) -> Tracks:
    """Tracks (h,) predicted by a displacement along the robot's track, in the frame of that [m].

    It adds a covariance (3, 3) to x, y, heading in this frame, and one of the logarithm of the image's scale.
    """
    move = np.eye(4)
    move[:2, 2:] = [[way.real, -way.imag], [way.imag, way.real]]  # multiplies complex numbers by the way
    mean = tracks.mean @ move.T
    covariance = move @ tracks.covariance @ move.T
    real, imag = mean[:, 2], mean[:, 3]
    drive = np.zeros((len(mean), 4, 3))
    drive[:, 0, 0] = drive[:, 1, 1] = drive[:, 3, 2] = real
    drive[:, 1, 0], drive[:, 0, 1], drive[:, 2, 2] = imag, -imag, -imag
    covariance += drive @ noise @ drive.transpose(0, 2, 1)
    covariance[:, 2:, 2:] += scale_variance * mean[:, 2:, None] * mean[:, None, 2:]
    return tracks._replace(mean=mean, covariance=covariance)


def log_likelihoods(tracks: Tracks, picture: Picture, spread: float = 0.0) -> FloatArray:
    """Log densities (h, n) of detected positions (n,) under the predictions of the tracks (h,) [1/m^2].

    `spread` is an additional standard deviation of x and y [m].
    """
    squared, determinant = squared_distances(tracks.mean, tracks.covariance, picture, spread)
    return np.asarray(-0.5 * squared - _LOG_TURN - 0.5 * np.log(determinant))


def updated(
    tracks: Tracks, picture: Picture, places: IntArray, track_heading: float, turn_spread: float = math.inf
) -> Tracks:
    """Predicted tracks (h,) updated with one detection (h,) each; weights change by headings only.

    The robot has a heading on its own track, and the turn of another one a standard deviation from its own
    [rad].
    """
    s = tracks.covariance[:, :2, :2] + picture.covariance[places][:, :2, :2]
    gain = np.linalg.solve(s, tracks.covariance[:, :2, :]).transpose(0, 2, 1)
    away = picture.pose[places, :2] - tracks.mean[:, :2]
    covariance = tracks.covariance - gain @ tracks.covariance[:, :2, :]
    mean = tracks.mean + (gain @ away[..., None])[..., 0]
    out = Tracks(mean, _symmetric(covariance), tracks.log_weight, places, tracks.length + 1)
    shown = np.flatnonzero(picture.has_heading[places])
    return _with_headings(out, picture, shown, track_heading, turn_spread) if shown.size else out


def _with_headings(
    tracks: Tracks, picture: Picture, rows: IntArray, track_heading: float, turn_spread: float
) -> Tracks:
    """Tracks (h,) after an update of some rows (r,) with the detected headings."""
    mean, covariance = tracks.mean[rows], tracks.covariance[rows]
    places = tracks.place[rows]
    real, imag = mean[:, 2], mean[:, 3]
    jacobian = np.zeros((rows.size, 4))
    jacobian[:, 2], jacobian[:, 3] = -imag / (real**2 + imag**2), real / (real**2 + imag**2)
    predicted_heading = np.arctan2(imag, real) + track_heading
    innovation = wrap_angle(picture.pose[places, 2] - predicted_heading)
    projected = (covariance @ jacobian[..., None])[..., 0]
    variance = picture.covariance[places, 2, 2] + np.sum(projected * jacobian, axis=1)
    right = (1.0 - _FALSE_HEADING) * _times_turn(innovation, variance)
    others = np.ones(rows.size)
    if math.isfinite(turn_spread):
        others = 0.5 + 0.5 * _times_turn(innovation, variance + turn_spread**2)
    share = right / (right + _FALSE_HEADING)
    gain = projected / variance[:, None] * (share > 0.5)[:, None]
    changed = Tracks._make(column.copy() for column in tracks)
    changed.mean[rows] += gain * innovation[:, None]
    changed.covariance[rows] = _symmetric(covariance - gain[:, :, None] * projected[:, None, :])
    changed.log_weight[rows] += np.log((right + _FALSE_HEADING) / others)
    return changed


def _times_turn(innovation: FloatArray, variance: FloatArray) -> FloatArray:
    """Normal densities (k,) of angles relative to the uniform density."""
    return np.asarray(np.exp(-0.5 * innovation**2 / variance) * np.sqrt(2.0 * np.pi / variance))


def _symmetric(covariance: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (covariance + covariance.transpose(0, 2, 1)))


_CONCENTRATED = 8.0  # Concentration from which a von Mises heading is treated as Gaussian: 0.36 rad
_ANY_DIRECTION = 3.0  # Sigma of c along the circle before its direction is known; wide for a linear model


class Scale(NamedTuple):
    """Scale of an image."""

    mean: float  # Units of the image per metre of the robot's own motion
    sigma: float  # Standard deviation of the mean, in the same unit


class Anchors(NamedTuple):
    """Detections (a,) of one image that are candidates for the robot."""

    point: TrackPoint  # The robot's own track at that image
    stamp_ns: int  # Of the image
    position: FloatArray  # (a, 2) [m]
    covariance: FloatArray  # (a, 2, 2)
    log_weight: FloatArray  # (a,) up to the constant of the tracks
    place: IntArray  # (a,) which detection of the newest image each is; MISSED: of an earlier one

    def select(self, rows: IntArray) -> Anchors:
        """The anchors of the given rows."""
        return Anchors(*self[:2], *(column[rows] for column in self[2:]))  # type: ignore[arg-type]


class Circles(NamedTuple):
    """Pairs (a, n) of an anchor and a detection of a later image."""

    log_density: FloatArray  # (a, n) of the detection, if it is the robot that the anchor is [1/m^2]
    log_alike: FloatArray  # (a, n) the same if both are another robot, which moves about as far
    concentration: FloatArray  # (a, n) of the heading that the pair shows


def own_way(anchors: Anchors, point: TrackPoint) -> complex:
    """Displacement of the robot along its track since the image of the anchors, in the track's frame [m]."""
    x, y = point.pose[:2] - anchors.point.pose[:2]
    return complex(x, y)


def circles(anchors: Anchors, picture: Picture, point: TrackPoint, scale: Scale, likeness: float) -> Circles:
    """Densities of detections (n,) on the circles around anchors (a,).

    `point` is of the robot's own track at the picture, `likeness` the relative standard deviation of the
    distance that another robot moves.
    """
    way = abs(own_way(anchors, point))
    gathered = scale.mean**2 * 0.5 * float(np.trace(gathered_between(anchors.point, point)[:2, :2]))
    variance = 0.5 * np.trace(anchors.covariance, axis1=1, axis2=2)[:, None] + picture.variance + gathered
    away = picture.pose[None, :, :2] - anchors.position[:, None]
    distance = np.hypot(away[..., 0], away[..., 1])
    log_density, concentration = _rice(distance, way, variance, scale)
    others = Scale(scale.mean, math.hypot(scale.sigma, likeness * scale.mean))
    return Circles(log_density, _rice(distance, way, variance, others)[0], concentration)


def _rice(
    distance: FloatArray, way: float, variance: FloatArray, scale: Scale
) -> tuple[FloatArray, FloatArray]:
    """Log densities (a, n) at distances from a circle's middle, and concentrations of the direction."""
    along = variance + (scale.sigma * way) ** 2
    likely = scale.mean + scale.sigma**2 * way * (distance - scale.mean * way) / along
    concentration = np.maximum(likely, 0.0) * distance * way / variance
    log_density = (
        np.log(scipy.special.i0e(concentration)) - np.log(2.0 * np.pi) - 0.5 * np.log(variance * along)
    )
    return log_density - 0.5 * (distance - scale.mean * way) ** 2 / along, concentration


def tracks_of(
    anchors: Anchors, rows: IntArray, picture: Picture, places: IntArray, point: TrackPoint, scale: Scale
) -> Tracks:
    """The tracks (k,) that pairs of an anchor (of rows) and a detection (of places) give.

    Their weights are those of the anchors, changed by the detections' headings alone.
    """
    if not rows.size:
        return NO_TRACKS
    way = own_way(anchors, point)
    start = anchors.position[rows]
    away = (picture.pose[places, :2] - start) @ [1.0, 1.0j]
    direction = np.exp(1j * (np.angle(away) - np.angle(way)))
    tracks = _tracks_from(start, anchors.covariance[rows], direction, scale, _ANY_DIRECTION)
    tracks = tracks._replace(log_weight=anchors.log_weight[rows])
    moved = predicted(tracks, way, gathered_between(anchors.point, point), 0.0)
    return updated(moved, picture, places, float(point.pose[2]))


def shown_by_heading(picture: Picture, places: IntArray, point: TrackPoint, scale: Scale) -> Tracks:
    """The tracks (k,) that begin with detections which show a heading; their weights are zero."""
    direction = np.exp(1j * (picture.pose[places, 2] - point.pose[2]))
    covariance = picture.covariance[places]
    sigma = np.sqrt(covariance[:, 2, 2])
    tracks = _tracks_from(picture.pose[places, :2], covariance[:, :2, :2], direction, scale, sigma)
    return tracks._replace(place=places)


def is_concentrated(concentration: FloatArray) -> BoolArray:
    """Whether pairs show a heading well enough for a track."""
    return np.asarray(concentration > _CONCENTRATED)


def merged(
    place: IntArray, log_weight: FloatArray, picture: Picture, point: TrackPoint, stamp_ns: int
) -> Anchors:
    """Anchors at the newest image, one for each detection of `place` (k,), which may name one repeatedly."""
    places = np.unique(place)
    weight = np.array([scipy.special.logsumexp(log_weight[place == one]) for one in places])
    covariance = picture.covariance[places][:, :2, :2]
    return Anchors(point, stamp_ns, picture.pose[places, :2], covariance, weight, places)


def _tracks_from(
    position: FloatArray,
    covariance: FloatArray,
    direction: np.typing.NDArray[np.complex128],
    scale: Scale,
    across: float | FloatArray,
) -> Tracks:
    """Tracks (k,) at positions, with directions of c that are unsure by `across` [rad]."""
    count = len(position)
    along = np.column_stack([direction.real, direction.imag])
    normal = np.column_stack([-direction.imag, direction.real])
    matrix = np.zeros((count, 4, 4))
    matrix[:, :2, :2] = covariance
    turn = np.broadcast_to((scale.mean * np.asarray(across)) ** 2, (count,))
    matrix[:, 2:, 2:] = scale.sigma**2 * along[:, :, None] * along[:, None, :]
    matrix[:, 2:, 2:] += turn[:, None, None] * normal[:, :, None] * normal[:, None, :]
    mean = np.hstack([position, scale.mean * along])
    place, length = np.zeros(count, dtype=np.int64), np.ones(count, dtype=np.int64)
    return Tracks(mean, matrix, np.zeros(count), place, length)


_NEGLIGIBLE = 12.0  # Chains whose log weight lies this far below the largest one are dropped
_MAX_TRACKS = 3000
_MAX_ANCHORED_IMAGES = 6  # Images after their last detection at which chains without heading end
_LIKENESS = 0.5  # Relative standard deviation of distance and turn of another robot of the same kind
_LEAST_TURN_SPREAD = 0.1
_OUTSIDE = 0.5  # Factor on the detection probability outside the area of all detections so far


METRIC = Scale(1.0, 0.02)  # Scale of a calibrated camera: metres, with a standard deviation of 2 %


@dataclass(frozen=True)
class ChainModel:
    """Assumptions about images and robots."""

    detection_probability: float = 0.95  # Probability that a robot in the picture is detected
    absent: float = 0.05  # Probability that a robot is not in the first image
    entering: float = 0.05  # Probability that a robot not in the picture is in the next one
    false_detections: float = 0.2  # Mean number of false detections per image
    scale: Scale = METRIC  # Scale of the image and its standard deviation
    scale_drift: float = 0.0  # Relative random walk of the scale [1/s^0.5]


class Identity(NamedTuple):
    """The most probable detection of a robot."""

    place: int  # Index of the detection in the newest image
    probability: float  # Probability that it is the robot
    pose: FloatArray  # (3,) x [m], y [m], heading [rad] there
    covariance: FloatArray  # (3, 3) of it
    scale: float  # Of the image


class _Starts(NamedTuple):
    """Parts of the anchors of the newest image."""

    place: list[IntArray]
    log_weight: list[FloatArray]


@dataclass(frozen=True)
class Chains:
    """All chains of one robot after some images."""

    model: ChainModel = ChainModel()  # Assumptions
    point: TrackPoint | None = None  # The robot's own track at the newest image; None before the first
    stamp_ns: int = 0  # Of that image
    images: int = 0  # Number of images so far
    detections: int = 0  # Number of detections in the newest image
    tracks: Tracks = NO_TRACKS  # Chains with a heading
    anchors: tuple[Anchors, ...] = ()  # Chains without, newest image last
    log_absent: float = 0.0  # Log probability that the robot is not in the picture
    low: tuple[float, float] = (math.inf, math.inf)  # Smallest x and y of all detections so far [m]
    high: tuple[float, float] = (-math.inf, -math.inf)  # Largest x and y [m]
    reach: float = 0.0  # Longest displacement of the robot between images [m]

    def advanced(self, picture: Picture, point: TrackPoint, stamp_ns: int) -> Chains:
        """The chains after a later image, taken where the robot's own track has come to a point."""
        reach, low, high = self.reach, self.low, self.high
        if self.point is not None:
            reach = max(reach, math.hypot(*(point.pose[:2] - self.point.pose[:2])))
        if len(picture.pose):
            x, y = picture.pose[:, 0], picture.pose[:, 1]
            low = min(low[0], float(x.min())), min(low[1], float(y.min()))
            high = max(high[0], float(x.max())), max(high[1], float(y.max()))
        bounded = replace(self, low=low, high=high, reach=reach)
        return bounded._with(picture, point, stamp_ns)  # noqa: SLF001 # of its own class

    def _with(self, picture: Picture, point: TrackPoint, stamp_ns: int) -> Chains:
        """The chains, whose bounds hold for the image already, after it."""
        tracks, anchors = self._continued(picture, point, stamp_ns, self._log_density(picture))
        return self._normalised(picture, point, stamp_ns, tracks, anchors)

    @property
    def probabilities(self) -> FloatArray:
        """(n,) probability of each detection of the newest image; the remainder is that of none."""
        out = np.zeros(self.detections)
        parts = [(self.tracks.place, self.tracks.log_weight)]
        parts += [(one.place, one.log_weight) for one in self.anchors]
        for place, log_weight in parts:
            here = place >= 0
            np.add.at(out, place[here], np.exp(log_weight[here]))
        return out

    def answer(self) -> Identity | None:
        """The most probable detection; None unless a chain with a heading ends there."""
        here = np.flatnonzero(self.tracks.place >= 0)
        if not here.size:
            return None
        place = int(np.argmax(self.probabilities))
        rows = here[self.tracks.place[here] == place]
        if not rows.size:
            return None
        weight = np.exp(self.tracks.log_weight[rows])
        pose, covariance, scale = self._mixed(self.tracks.select(rows), weight / weight.sum())
        return Identity(place, float(weight.sum()), pose, covariance, scale)

    def _log_density(self, picture: Picture) -> float:
        """Log density of other robots and false detections [1/m^2].

        The area is that of all detections so far, extended by the displacement of the robot.
        """
        others = max(len(picture.pose) - 1, 0) + self.model.false_detections
        extent = np.maximum(np.subtract(self.high, self.low), 0.0) + self.reach
        sigma = math.sqrt(float(picture.variance.max(initial=1e-12)))
        return math.log(others / float(np.prod(np.maximum(extent, 10.0 * sigma))))

    def _log_other_share(self, picture: Picture) -> float:
        """Log prior probability that a detection is another robot or false."""
        others = max(len(picture.pose) - 1, 0) + self.model.false_detections
        return math.log(others / max(others, len(picture.pose)))

    def _continued(
        self, picture: Picture, point: TrackPoint, stamp_ns: int, log_density: float
    ) -> tuple[list[Tracks], list[Anchors]]:
        """Every chain continued with each likely detection of the newest image, and without one."""
        probability = self.model.detection_probability
        log_hit = math.log(probability)
        tracks: list[Tracks] = [NO_TRACKS]
        if self.tracks.place.size and self.point is not None:
            tracks += self._tracks_continued(picture, point, stamp_ns, log_density)
        starts = _Starts([np.zeros(0, dtype=np.int64)], [np.zeros(0)])
        anchors: list[Anchors] = []
        for old in self.anchors:
            pairs = circles(old, picture, point, self._scale_since(old.stamp_ns, stamp_ns), _LIKENESS)
            alike = pairs.log_alike + self._log_other_share(picture)
            log_ratio = pairs.log_density - np.logaddexp(log_density, alike)
            weight = old.log_weight[:, None] + log_ratio + log_hit
            likely = weight > self._threshold()
            rows, places = np.nonzero(likely & is_concentrated(pairs.concentration))
            scale = self._scale_since(old.stamp_ns, stamp_ns)
            some = old._replace(log_weight=np.zeros_like(old.log_weight))
            headed = tracks_of(some, rows, picture, places, point, scale)
            tracks.append(headed._replace(log_weight=headed.log_weight + weight[rows, places]))
            rows, places = np.nonzero(likely & ~is_concentrated(pairs.concentration))
            starts.place.append(places)
            starts.log_weight.append(weight[rows, places])
            missed = np.full(old.place.size, MISSED)
            anchors.append(old._replace(log_weight=old.log_weight + math.log1p(-probability), place=missed))
        self._start_chains(picture, point, tracks, starts)
        place, log_weight = np.concatenate(starts.place), np.concatenate(starts.log_weight)
        if place.size:
            anchors.append(merged(place, log_weight, picture, point, stamp_ns))
        return tracks, anchors[-_MAX_ANCHORED_IMAGES:]

    def _tracks_continued(
        self, picture: Picture, point: TrackPoint, stamp_ns: int, log_density: float
    ) -> list[Tracks]:
        """The tracks continued with each likely detection of the newest image, and without one."""
        before = self.point or point
        x, y = point.pose[:2] - before.pose[:2]
        drift = self.model.scale_drift**2 * (stamp_ns - self.stamp_ns) * 1e-9
        moved = predicted(self.tracks, complex(x, y), gathered_between(before, point), drift)
        spread = _LIKENESS * self.model.scale.mean * math.hypot(x, y)
        alike = log_likelihoods(moved, picture, spread) + self._log_other_share(picture)
        log_ratio = log_likelihoods(moved, picture) - np.logaddexp(log_density, alike)
        weight = moved.log_weight[:, None] + log_ratio + math.log(self.model.detection_probability)
        rows, places = np.nonzero(weight > self._threshold())
        hits = moved.select(rows)._replace(log_weight=weight[rows, places])
        turn_spread = max(_LIKENESS * abs(point.pose[2] - before.pose[2]), _LEAST_TURN_SPREAD)
        found = updated(hits, picture, places, point.pose[2], turn_spread)
        inside = np.all((moved.mean[:, :2] >= self.low) & (moved.mean[:, :2] <= self.high), axis=1)
        probability = self.model.detection_probability * np.where(inside, 1.0, _OUTSIDE)
        missed = moved._replace(
            log_weight=moved.log_weight + np.log1p(-probability), place=np.full(len(inside), MISSED)
        )
        return [found, missed]

    def _start_chains(
        self, picture: Picture, point: TrackPoint, tracks: list[Tracks], starts: _Starts
    ) -> None:
        """Add chains that start in the newest image, with equal weights."""
        count = len(picture.pose)
        if not count:
            return
        entering = self.model.entering if self.images else 1.0 - self.model.absent
        others = max(count - 1, 0) + self.model.false_detections
        weight = self.log_absent + math.log(entering * self.model.detection_probability / others)
        shown = np.flatnonzero(picture.has_heading)
        if shown.size:
            headed = shown_by_heading(picture, shown, point, self.model.scale)
            tracks.append(headed._replace(log_weight=np.full(shown.size, weight)))
        hidden = np.flatnonzero(~picture.has_heading)
        starts.place.append(hidden)
        starts.log_weight.append(np.full(hidden.size, weight))

    def _scale_since(self, begin_ns: int, end_ns: int) -> Scale:
        """The scale with its drift between two instants."""
        mean, sigma = self.model.scale
        drift = self.model.scale_drift * mean * math.sqrt(max(0, end_ns - begin_ns) * 1e-9)
        return Scale(mean, math.hypot(sigma, drift))

    def _threshold(self) -> float:
        """Log weight below which a continuation is negligible."""
        return math.log1p(-self.model.detection_probability) - _NEGLIGIBLE

    def _normalised(
        self, picture: Picture, point: TrackPoint, stamp_ns: int, tracks: list[Tracks], anchors: list[Anchors]
    ) -> Chains:
        """The chains that are kept, normalised to a total probability of one."""
        entering = self.model.entering if self.images else 1.0 - self.model.absent
        log_absent = self.log_absent + math.log1p(-entering * self.model.detection_probability)
        whole = joined(tracks)
        weights = np.concatenate([whole.log_weight, *(one.log_weight for one in anchors), [log_absent]])
        total, least = float(scipy.special.logsumexp(weights)), float(weights.max()) - _NEGLIGIBLE
        kept = np.flatnonzero(whole.log_weight > least)
        if kept.size > _MAX_TRACKS:
            order = np.argsort(whole.log_weight[kept], kind="stable")[-_MAX_TRACKS:]
            kept = kept[np.sort(order)]
        tracks_kept = whole.select(kept)
        some = [one.select(np.flatnonzero(one.log_weight > least)) for one in anchors]
        return replace(
            self,
            point=point,
            stamp_ns=stamp_ns,
            images=self.images + 1,
            detections=len(picture.pose),
            tracks=tracks_kept._replace(log_weight=tracks_kept.log_weight - total),
            anchors=tuple(one._replace(log_weight=one.log_weight - total) for one in some if one.place.size),
            log_absent=log_absent - total,
        )

    def _mixed(self, tracks: Tracks, weight: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Pose (3,), covariance (3, 3) and scale of a mixture of tracks (k,)."""
        real, imag = tracks.mean[:, 2], tracks.mean[:, 3]
        squared = real**2 + imag**2
        jacobian = np.zeros((weight.size, 3, 4))
        jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
        jacobian[:, 2, 2], jacobian[:, 2, 3] = -imag / squared, real / squared
        covariance = jacobian @ tracks.covariance @ jacobian.transpose(0, 2, 1)
        heading = np.arctan2(imag, real)
        poses = np.column_stack([tracks.mean[:, :2], heading])
        mean = weight @ poses
        mean[2] = np.angle(weight @ np.exp(1j * heading))
        away = poses - mean
        away[:, 2] = wrap_angle(away[:, 2])
        spread = np.einsum("k,kij->ij", weight, covariance + away[:, :, None] * away[:, None, :])
        if self.point is not None:
            mean[2] += self.point.pose[2]
        mean[2] = wrap_angle(mean[2])
        return mean, spread, float(weight @ np.sqrt(squared))
