"""Anchors: detections at which chains without a known heading start.

A robot that was at z and has moved by |W| since lies on a circle around z, with equal density in every
direction. The density of a detection at distance |D| follows Rice's distribution, in closed form also for
small motions. For larger motions the direction gives the heading, and the chain becomes a track.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.identification.picture import Picture, TrackPoint, gathered_between
from swarm_loc_estimator.identification.tracks import NO_TRACKS, Tracks, predicted, updated

_CONCENTRATED = 8.0  # Concentration from which a von Mises heading is treated as Gaussian: 0.36 rad
_ANY_DIRECTION = 3.0
"""Standard deviation of c along the circle before its direction is known; wide for a linear model."""


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
        return self._replace(
            position=self.position[rows],
            covariance=self.covariance[rows],
            log_weight=self.log_weight[rows],
            place=self.place[rows],
        )


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
    """Densities of detections on the circles around anchors.

    Args:
        anchors: (a,).
        picture: (n,).
        point: The robot's own track at the picture.
        scale: Of the picture.
        likeness: Relative standard deviation of the distance that another robot moves.
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
    return Tracks(
        mean, matrix, np.zeros(count), np.zeros(count, dtype=np.int64), np.ones(count, dtype=np.int64)
    )
