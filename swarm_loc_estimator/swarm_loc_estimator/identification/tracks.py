"""Tracks: chains of detections that may be one robot, each with a Gaussian estimate.

A chain's state is (p, c): the position p in `map`, and c = lambda exp(i theta), which turns the robot's own
track into the map, with the image's scale lambda. In these four real numbers motion and measurement are
linear: p <- p + c w for the way w along the track, z = p. Only a measured heading is not, and is
linearised.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.identification.picture import Picture

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


NO_TRACKS = Tracks(
    np.zeros((0, 4)),
    np.zeros((0, 4, 4)),
    np.zeros(0),
    np.zeros(0, dtype=np.int64),
    np.zeros(0, dtype=np.int64),
)


def joined(parts: list[Tracks]) -> Tracks:
    """The tracks of all parts, in one container."""
    return Tracks(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def turning(w: complex) -> FloatArray:
    """The matrix (2, 2) that multiplies a complex number, as two real ones, by w."""
    return np.array([[w.real, -w.imag], [w.imag, w.real]])


def predicted(tracks: Tracks, way: complex, noise: FloatArray, scale_variance: float) -> Tracks:
    """Tracks predicted by the robot's own motion.

    Args:
        tracks: (h,).
        way: Displacement along the robot's track, in the track's frame [m].
        noise: (3, 3) covariance that the motion adds to x, y, heading in the track's frame.
        scale_variance: Variance of the change of the logarithm of the image's scale.
    """
    move = np.eye(4)
    move[:2, 2:] = turning(way)
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
    away = picture.pose[None, :, :2] - tracks.mean[:, None, :2]
    s = tracks.covariance[:, None, :2, :2] + picture.covariance[None, :, :2, :2] + spread**2 * np.eye(2)
    a, b, d = s[..., 0, 0], s[..., 0, 1], s[..., 1, 1]
    x, y = away[..., 0], away[..., 1]
    determinant = a * d - b * b
    squared = (d * x * x - 2.0 * b * x * y + a * y * y) / determinant
    return np.asarray(-0.5 * squared - _LOG_TURN - 0.5 * np.log(determinant))


def updated(
    tracks: Tracks, picture: Picture, places: IntArray, track_heading: float, turn_spread: float = math.inf
) -> Tracks:
    """Tracks (h,) updated with one detection each; weights change by headings only.

    Args:
        tracks: Predicted, with the weights of the positions.
        picture: The newest image.
        places: (h,) detection of each track.
        track_heading: Heading of the robot on its own track [rad].
        turn_spread: Standard deviation of the turn of another robot relative to this one [rad].
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
    changed = tracks._replace(
        mean=tracks.mean.copy(), covariance=tracks.covariance.copy(), log_weight=tracks.log_weight.copy()
    )
    changed.mean[rows] += gain * innovation[:, None]
    changed.covariance[rows] = _symmetric(covariance - gain[:, :, None] * projected[:, None, :])
    changed.log_weight[rows] += np.log((right + _FALSE_HEADING) / others)
    return changed


def _times_turn(innovation: FloatArray, variance: FloatArray) -> FloatArray:
    """Normal densities (k,) of angles relative to the uniform density."""
    return np.asarray(np.exp(-0.5 * innovation**2 / variance) * np.sqrt(2.0 * np.pi / variance))


def _symmetric(covariance: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (covariance + covariance.transpose(0, 2, 1)))
