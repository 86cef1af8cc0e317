"""Simulated detections of coded markers: noise, ambiguous headings, outliers, occlusion."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.sim.common.camera import Exposures, View, deliver, hidden
from swarm_loc_drivers.sim.common.hidden_geometry import HiddenGeometry, hidden_geometry
from swarm_loc_drivers.sim.common.record import SIGHTING_DTYPE, Records
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray

if TYPE_CHECKING:
    from swarm_loc_drivers.sim.common.error_model import ErrorModel
    from swarm_loc_drivers.sim.common.trajectories import Trajectories
    from swarm_loc_estimator.swarm.swarm import Swarm


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
    """What the images show.

    Args:
        rng: Source of every imperfection.
        swarm: Geometry as described.
        truth: Where the robots are.
        exposures: Who looked when, by the stamps.
        view: What a camera can see.
        errors: The imperfections.

    Returns:
        Frames in order of arrival, of FRAME_DTYPE, and their sightings, of SIGHTING_DTYPE.
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
    """Which markers (F, M) a third robot hides; a robot's own markers count as hidden from it."""
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
    """Exact sightings (S, 3) turned into reported ones."""
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
