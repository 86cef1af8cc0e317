"""Measured and true values of the sightings of each camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.trajectory import Trajectory, interpolate
from swarm_loc_estimator.filter.measurement_model import Kind
from swarm_loc_estimator.offline.calibration.recording import Recording
from swarm_loc_estimator.sensors.camera import SightingConverter
from swarm_loc_estimator.swarm.swarm import CameraMount, Robot, SensorModel, Swarm

DENSE_GAP_NS = 200_000_000
"""Ground truth with longer gaps is not interpolated."""
OFFSET_REACH_NS = 250_000_000
"""A camera's time offset is looked for this far either way."""

_SAME_NS = 3_000_000
_SAME_VIEW_NS = 4_000_000_000
"""Sightings of a marker err alike for about this long."""
_MAX_SIGHTINGS = 2000


@dataclass(frozen=True)
class Sightings:
    """What one robot's camera saw where the ground truth is known, as logged: nothing of it is calibrated.

    Attributes:
        stamp_ns: (m,).
        polar: (m,) whether range and bearing were logged, else forward, left and heading.
        value: (m, 3) as logged, in the frame of a camera at base_link's origin.
        marker_id: (m,).
        marker: (m, 3) the marker in `map`, or in the target robot's base_link.
        target: (m,) index of the target robot; -1 for a landmark.
        lone: (m, 3) the observer's true pose where it is known at the stamp only, else NaN.
    """

    stamp_ns: IntArray
    polar: BoolArray
    value: FloatArray
    marker_id: IntArray
    marker: FloatArray
    target: IntArray
    lone: FloatArray

    def __getitem__(self, rows: BoolArray | IntArray) -> Sightings:
        return Sightings(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    @property
    def independent_share(self) -> float:
        """How many of the sightings say something of their own, at most 1."""
        views = np.unique(np.column_stack([self.marker_id, self.stamp_ns // _SAME_VIEW_NS]), axis=0)
        return len(views) / max(1, self.stamp_ns.size)


def sightings_of(recording: Recording, swarm: Swarm, observer: int) -> Sightings:
    """A robot's sightings where ground truth is known for it and the target, at most a few thousand."""
    logged = _logged(recording, swarm, observer)
    truth = recording.truth.get(swarm.robots[observer].name)
    if truth is None:
        return logged[np.zeros(logged.stamp_ns.size, dtype=bool)]
    known, lone = _observer_known(truth, logged.stamp_ns)
    for target in np.unique(logged.target[logged.target >= 0]).tolist():
        rows = logged.target == target
        other = recording.truth.get(swarm.robots[target].name)
        known[rows] &= other is not None and _dense_around(other, logged.stamp_ns[rows])
    known &= np.isnan(lone[:, 0]) | (logged.target < 0)  # a lone pose does not say when the picture was taken
    chosen = np.flatnonzero(known)
    chosen = chosen[:: max(1, -(-chosen.size // _MAX_SIGHTINGS))]
    return replace(logged, lone=lone)[chosen]


def true_values(
    sightings: Sightings,
    recording: Recording,
    swarm: Swarm,
    observer: int,
    mount: FloatArray,
    offset_s: float,
) -> FloatArray:
    """What each sighting should have been (m, 3): range and bearing, or forward, left and heading.

    Args:
        sightings: Of the robot `observer`.
        recording: With the ground truth.
        swarm: Whose names the ground truth goes by.
        observer: Index of the robot.
        mount: (3,) the camera's x [m], y [m], yaw [rad] in base_link.
        offset_s: The pictures were taken this much after their stamps.
    """
    stamp_ns = sightings.stamp_ns + round(offset_s * 1e9)
    own, _ = interpolate(recording.truth[swarm.robots[observer].name], stamp_ns, DENSE_GAP_NS)
    lone = np.isfinite(sightings.lone[:, 0])
    own = np.where(lone[:, None], sightings.lone, own)
    marker = sightings.marker.copy()
    for target in np.unique(sightings.target[sightings.target >= 0]).tolist():
        rows = sightings.target == target
        pose, _ = interpolate(recording.truth[swarm.robots[target].name], stamp_ns[rows], DENSE_GAP_NS)
        marker[rows] = se2.compose(pose, sightings.marker[rows])
    seen = se2.between(se2.compose(own, np.broadcast_to(mount, own.shape)), marker)
    polar = sightings.polar
    seen[polar] = np.column_stack(
        [
            np.hypot(seen[polar, 0], seen[polar, 1]),
            np.arctan2(seen[polar, 1], seen[polar, 0]),
            np.zeros(int(polar.sum())),
        ]
    )
    return seen


def _logged(recording: Recording, swarm: Swarm, observer: int) -> Sightings:
    """All of a robot's sightings of known markers."""
    ideal = replace(swarm, robots=tuple(_ideal(robot) for robot in swarm.robots))
    rows = np.flatnonzero(recording.detections.robot == observer)
    found: list[Any] = [recording.detections.data[row] for row in rows.tolist()]
    counts = [len(one) for one in found]
    if not sum(counts):
        empty = np.zeros(0, dtype=np.int64)
        return Sightings(
            empty, empty == 0, np.zeros((0, 3)), empty, np.zeros((0, 3)), empty, np.zeros((0, 3))
        )
    stamps = np.repeat(recording.detections.stamp_ns[rows], counts)
    measured = SightingConverter(ideal).convert(np.full(stamps.size, observer), stamps, np.concatenate(found))
    m = measured.measurements
    return Sightings(
        stamp_ns=m["stamp_ns"].copy(),
        polar=m["kind"] == Kind.POLAR,
        value=m["value"].copy(),
        marker_id=m["marker_id"].copy(),
        marker=m["marker"].copy(),
        target=m["target"].copy(),
        lone=np.full((m.size, 3), np.nan),
    )


def _ideal(robot: Robot) -> Robot:
    """A robot whose sightings come out as logged; only the mount's tilt is taken out."""
    camera = robot.camera and CameraMount(z=robot.camera.z, pitch=robot.camera.pitch, roll=robot.camera.roll)
    return replace(robot, camera=camera, sensor=SensorModel())


def _observer_known(truth: Trajectory, stamp_ns: IntArray) -> tuple[BoolArray, FloatArray]:
    """Where the observer's pose is known (m,), and the poses (m, 3) that are known at the stamp only.

    A true pose that stands alone was found for the picture of that stamp, whenever it was taken.
    """
    lone = np.full((stamp_ns.size, 3), np.nan)
    known = _dense_around(truth, stamp_ns)
    nearest = np.clip(np.searchsorted(truth.stamp_ns, stamp_ns - _SAME_NS), 0, truth.stamp_ns.size - 1)
    same = ~known & (np.abs(truth.stamp_ns[nearest] - stamp_ns) <= _SAME_NS)
    lone[same] = truth.pose[nearest[same]]
    return known | same, lone


def _dense_around(truth: Trajectory, stamp_ns: IntArray) -> BoolArray:
    """Whether the ground truth is dense around stamps, wherever the time offset is looked for."""
    times = truth.stamp_ns
    first = np.searchsorted(times, stamp_ns - OFFSET_REACH_NS, side="right") - 1
    last = np.searchsorted(times, stamp_ns + OFFSET_REACH_NS, side="left")
    inside = (first >= 0) & (last < times.size)
    gaps = np.concatenate([[0], np.cumsum(np.diff(times) > DENSE_GAP_NS)])  # long ones before each time
    known: BoolArray = inside & (gaps[np.minimum(last, times.size - 1)] == gaps[np.maximum(first, 0)])
    return known
