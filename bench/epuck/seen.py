"""Compare detections in a rendered world with the markers that are visible in its images."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.epuck.rendered import WORLD, RenderedRun
from bench.epuck.views import Views, views_of
from swarm_loc_drivers.sim.epuck.world import EpuckWorld, EpuckWorldParameters, make_world
from swarm_loc_estimator.common.trajectory import DEFAULT_GAP_NS, interpolate

_PENDING_NS = 300_000_000
"""Images of the last moments of a run may still be in transport; the world waits for older ones."""
MAX_INCIDENCE, MIN_SIDE_PX, MIN_MARGIN_PX = math.radians(70.0), 10.0, 6.0
"""Limits of visible markers, as in the comparison of detectors."""
_NEAR_PX, _NEAR = 12.0, 0.3
"""Largest distance of a detection from its marker, in pixels or in sides of the marker.

True poses are known twenty times a second, and wheels slip in between.
"""


@dataclass(frozen=True)
class Seen:
    """Statistics of the images of a run."""

    frames: int  # Images taken while the robots drove, except the last ones
    lost: int  # Images without a message of detections
    detections: int  # Detections in the others
    visible: int  # Visible markers in the others
    found: int  # Visible markers that were detected
    false_ids: int  # Detections of markers that are not there


def count_seen(run: RenderedRun) -> Seen:
    """Compare detections of a run with the true positions of the markers."""
    wishes = EpuckWorldParameters(swarm_file=str(run.swarm_file), world=WORLD, seed=run.seed)
    swarm, world = make_world(wishes)
    counts = np.zeros(6, np.int64)
    for robot, one in enumerate(swarm.robots):
        counts += _of_robot(run, world, robot, one.name)
    return Seen(*counts.tolist())


def _of_robot(run: RenderedRun, world: EpuckWorld, robot: int, name: str) -> NDArray[np.int64]:
    """The counts of `Seen` of one camera."""
    end_ns = run.end_ns - _PENDING_NS
    frames = _taken_before(world, robot, end_ns) - _taken_before(world, robot, run.begin_ns)
    messages = [one for one in run.seen[name] if one.stamp_ns < end_ns]
    exposures = [world.exposure_of(robot, one.stamp_ns) for one in messages]
    poses = _poses(run, np.array([one.middle_ns for one in exposures], np.int64))
    detections = visible = found = false_ids = 0
    for message, there in zip(messages, poses, strict=True):
        detections += len(message.detections)
        if not np.isfinite(there).all():
            continue
        views = views_of(world.rig, robot, there)
        clear = is_visible(views)
        matched = _matched(views, message.detections)
        visible += int(clear.sum())
        found += int(np.isin(views.id[clear], message.detections["id"][matched]).sum())
        false_ids += int((~matched).sum())
    return np.array([frames, frames - len(messages), detections, visible, found, false_ids])


def _taken_before(world: EpuckWorld, robot: int, stamp_ns: int) -> int:
    """Number of images of a camera with an earlier stamp."""
    nearest = world.exposure_of(robot, stamp_ns)
    return nearest.number + (nearest.stamp_ns < stamp_ns)


def is_visible(views: Views) -> NDArray[np.bool_]:
    """Whether markers are visible."""
    return np.asarray(
        (views.margin > MIN_MARGIN_PX)
        & (views.incidence < MAX_INCIDENCE)
        & (views.side_px > MIN_SIDE_PX)
        & ~views.hidden
    )


def _matched(views: Views, detections: NDArray[np.void]) -> NDArray[np.bool_]:
    """Whether detections are close to their marker."""
    place = {int(marker): k for k, marker in enumerate(views.id)}
    matched = np.zeros(len(detections), bool)
    for row, one in enumerate(detections):
        k = place.get(int(one["id"]))
        if k is not None:
            shift = np.linalg.norm(one["corners_px"].reshape(4, 2) - views.corners[k], axis=1).max()
            matched[row] = shift < max(_NEAR_PX, _NEAR * views.side_px[k])
    return matched


def _poses(run: RenderedRun, stamp_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """True poses of all robots (K, N, 3); NaN where unknown."""
    tracks = (run.live.truth[robot.name] for robot in run.live.swarm.robots)
    return np.stack([interpolate(track, stamp_ns, DEFAULT_GAP_NS)[0] for track in tracks], axis=1)
