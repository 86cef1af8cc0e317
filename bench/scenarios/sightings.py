"""Simulated detections of coded markers: exposures, view, occlusion, noise, outliers, delay and loss."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.scenarios.lived_run import (
    CAMERA_LATENESS,
    FRAME_DTYPE,
    SIGHTING_DTYPE,
    Records,
    arrival_ns,
    in_order_of_arrival,
    survivors,
)
from swarm_loc_drivers.sim.run import Trajectories
from swarm_loc_drivers.sim.worlds import ErrorModel, HiddenGeometry, hidden_geometry
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.swarm import Swarm

Exposures = tuple[NDArray[np.int64], NDArray[np.int64]]
"""Robot (F,) and stamp (F,) [ns] of images, sorted by stamp."""


@dataclass(frozen=True)
class View:
    """Limits of visibility of a camera."""

    field_of_view: float  # Full horizontal angle [rad]
    nearest: float  # Minimum distance to a marker [m]
    farthest: float  # Maximum distance [m]
    incidence: float  # Maximum angle between a marker's normal and the line to the camera [rad]

    def sees(self, marker: FloatArray) -> NDArray[np.bool_]:
        """Whether markers (..., 3) are in view (...); camera frame: x forward, y left, normal."""
        bearing = np.arctan2(marker[..., 1], marker[..., 0])
        distance = np.hypot(marker[..., 0], marker[..., 1])
        tilt = se2.wrap_angle(marker[..., 2] - bearing - np.pi)
        in_range = (distance >= self.nearest) & (distance <= self.farthest)
        return in_range & (np.abs(bearing) <= 0.5 * self.field_of_view) & (np.abs(tilt) <= self.incidence)


def hidden(camera: FloatArray, marker: FloatArray, discs: FloatArray, radius: float) -> NDArray[np.bool_]:
    """Whether a disc occludes a marker (..., 2) from a camera (..., 2) [m].

    All discs have a radius; (..., D, 2) are their centres, NaN: no disc.
    """
    ray = marker - camera
    length = np.maximum(np.linalg.norm(ray, axis=-1), 1e-12)
    unit = (ray / length[..., None])[..., None, :]
    to_disc = discs - camera[..., None, :]
    along = np.sum(to_disc * unit, axis=-1)
    nearest = np.clip(along, 0.0, length[..., None])[..., None] * unit
    inside: NDArray[np.bool_] = np.linalg.norm(to_disc - nearest, axis=-1) < radius
    return np.asarray(inside.any(axis=-1))


def schedule_exposures(
    rng: np.random.Generator, robots: int, rate_hz: float, start_ns: int, end_ns: int
) -> Exposures:
    """All images of N robots' cameras, each at its own phase."""
    period_ns = round(1e9 / rate_hz)
    phase = rng.integers(0, period_ns, robots)
    count = (end_ns - start_ns - phase) // period_ns + 1
    robot = np.repeat(np.arange(robots), count)
    number = np.concatenate([np.arange(n) for n in count])
    stamp_ns = start_ns + phase[robot] + number * period_ns
    order = np.argsort(stamp_ns, kind="stable")
    return robot[order], stamp_ns[order]


def deliver(
    rng: np.random.Generator,
    exposures: Exposures,
    frame: NDArray[np.int64],
    sightings: Records,
    *,
    end_ns: int,
    loss: float,
) -> tuple[Records, Records]:
    """Delay and reorder images, and lose a share of them; those that arrive after `end_ns` are dropped.

    Sightings (S,) are of SIGHTING_DTYPE, and `frame` (S,) the image of each, ascending. Returns the images
    that arrive, of FRAME_DTYPE, in order of arrival, and their sightings.
    """
    robot, stamp_ns = exposures
    frames = np.zeros(len(robot), FRAME_DTYPE)
    frames["robot"], frames["stamp_ns"] = robot, stamp_ns
    frames["count"] = np.bincount(frame, minlength=len(robot))
    frames["first"] = np.cumsum(frames["count"]) - frames["count"]
    frames["arrival_ns"] = arrival_ns(rng, stamp_ns, CAMERA_LATENESS)
    frames = in_order_of_arrival(frames[survivors(rng, len(frames), loss)], end_ns)
    first = np.cumsum(frames["count"]) - frames["count"]
    kept = np.repeat(frames["first"] - first, frames["count"]) + np.arange(int(frames["count"].sum()))
    frames["first"] = first
    return frames, sightings[kept]


ROBOT_RADIUS = 0.036
GROSS_RANGE = 0.5


def observe_markers(
    rng: np.random.Generator,
    swarm: Swarm,
    truth: Trajectories,
    exposures: Exposures,
    view: View,
    errors: ErrorModel,
) -> tuple[Records, Records]:
    """Frames in order of arrival, of FRAME_DTYPE, and their sightings, of SIGHTING_DTYPE.

    `swarm` is the described geometry; each exposure is of a robot at a stamp.
    """
    geometry = hidden_geometry(rng, swarm, errors)
    robot, stamp_ns = exposures
    early_ns = np.rint(rng.uniform(0.0, 1e9 * errors.exposure_early_s, len(stamp_ns))).astype(np.int64)
    poses = truth.all_at(stamp_ns - early_ns)
    cameras = se2.compose(poses[np.arange(len(robot)), robot], geometry.mounts[robot])
    marks = _marker_poses(geometry, poses)
    in_camera = se2.between(cameras[:, None], marks)
    seen = view.sees(in_camera) & ~_occluded(geometry, robot, cameras, marks, poses)
    frame, mark = np.nonzero(seen)
    sightings = np.zeros(len(frame), SIGHTING_DTYPE)
    sightings["marker_id"] = geometry.ids[mark]
    sightings["value"] = _disturb(rng, in_camera[frame, mark], geometry.scales[robot[frame]], errors)
    return deliver(rng, exposures, frame, sightings, end_ns=int(truth.stamp_ns[-1]), loss=errors.frame_loss)


def _marker_poses(geometry: HiddenGeometry, poses: FloatArray) -> FloatArray:
    """All markers (F, L + K, 3) in map, for robots at (F, N, 3)."""
    walls = np.broadcast_to(geometry.landmarks, (len(poses), *geometry.landmarks.shape))
    return np.concatenate([walls, se2.compose(poses[:, geometry.face_owner], geometry.faces)], axis=1)


def _occluded(
    geometry: HiddenGeometry,
    robot: NDArray[np.int64],
    cameras: FloatArray,
    marks: FloatArray,
    poses: FloatArray,
) -> NDArray[np.bool_]:
    """Markers (F, M) occluded by a third robot; a robot's own markers count as occluded."""
    frames, count = marks.shape[:2]
    owner = np.concatenate([np.full(count - len(geometry.face_owner), -1), geometry.face_owner])
    discs = np.broadcast_to(poses[:, None, :, :2], (frames, count, poses.shape[1], 2)).copy()
    discs[np.arange(frames), :, robot] = np.nan
    own_face = np.flatnonzero(owner >= 0)
    discs[:, own_face, owner[own_face]] = np.nan
    with np.errstate(invalid="ignore"):
        behind = hidden(cameras[:, None, :2], marks[..., :2], discs, ROBOT_RADIUS)
    own: NDArray[np.bool_] = owner[None, :] == robot[:, None]
    return behind | own


def _disturb(
    rng: np.random.Generator, exact: FloatArray, scale: FloatArray, errors: ErrorModel
) -> FloatArray:
    """Add noise and outliers to exact sightings (S, 3)."""
    count = len(exact)
    value: FloatArray = exact.copy()
    flipped = rng.random(count) < errors.flip_probability
    towards = np.arctan2(exact[:, 1], exact[:, 0]) + math.pi
    value[:, 2] = np.where(flipped, 2.0 * towards - exact[:, 2], exact[:, 2])
    value[:, :2] *= scale[:, None]
    value += rng.standard_normal((count, 3)) * [errors.forward_sigma, errors.left_sigma, errors.heading_sigma]
    gross = rng.random(count) < errors.gross_probability
    value += gross[:, None] * rng.uniform(-1.0, 1.0, (count, 3)) * [GROSS_RANGE, GROSS_RANGE, math.pi]
    value[:, 2] = se2.wrap_angle(value[:, 2])
    return value
