"""Camera model of sightings: exposure times, field of view, occlusion, delay and loss."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.sim.common.record import FRAME_DTYPE, Records, in_order_of_arrival
from swarm_loc_drivers.sim.common.transport import CAMERA_LATENESS, arrival_ns, survivors
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray

Exposures = tuple[NDArray[np.int64], NDArray[np.int64]]
"""Robot (F,) and stamp (F,) [ns] of images, sorted by stamp."""


@dataclass(frozen=True)
class View:
    """What a camera can see.

    Attributes:
        field_of_view: Full horizontal angle [rad].
        nearest: Smallest distance to a marker [m].
        farthest: Largest distance [m].
        incidence: Largest angle between a marker's normal and the line to the camera [rad].
    """

    field_of_view: float
    nearest: float
    farthest: float
    incidence: float

    def sees(self, marker: FloatArray) -> NDArray[np.bool_]:
        """Whether markers (..., 3) are in view (...); camera frame: x forward, y left, normal."""
        bearing = np.arctan2(marker[..., 1], marker[..., 0])
        distance = np.hypot(marker[..., 0], marker[..., 1])
        tilt = se2.wrap_angle(marker[..., 2] - bearing - np.pi)
        in_range = (distance >= self.nearest) & (distance <= self.farthest)
        return in_range & (np.abs(bearing) <= 0.5 * self.field_of_view) & (np.abs(tilt) <= self.incidence)


def hidden(camera: FloatArray, marker: FloatArray, discs: FloatArray, radius: float) -> NDArray[np.bool_]:
    """Whether a disc stands between camera and marker.

    Args:
        camera: (..., 2) [m].
        marker: (..., 2) [m].
        discs: (..., D, 2) centres [m]; NaN is no disc.
        radius: Of every disc [m].

    Returns:
        (...), broadcast.
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
    """Send images on their way: late, in another order, and not all of them.

    Args:
        rng: Source of delays and losses.
        exposures: Who looked when.
        frame: (S,) image of each sighting, ascending.
        sightings: (S,) of SIGHTING_DTYPE.
        end_ns: What would arrive later is left out.
        loss: Share of images that never arrive.

    Returns:
        The images that arrive, of FRAME_DTYPE, in order of arrival, and their sightings.
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
