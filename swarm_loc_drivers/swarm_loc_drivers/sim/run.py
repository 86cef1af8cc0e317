"""Data of a simulated run, the same for every simulated swarm: true tracks, odometry, images, delays.

Sensor data is kept as flat structured arrays, because a run of a thousand robots has a million entries.
`stamp_ns` is the time of measurement, `arrival_ns` the time of reception; data is sorted by arrival.
Ground truth is separate and only for evaluation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.swarm.swarm import Swarm


@dataclass(frozen=True)
class Trajectories:
    """Poses of N robots at T common stamps; between two stamps a robot keeps its twist."""

    stamp_ns: NDArray[np.int64]  # (T,) int64, evenly spaced
    poses: NDArray[np.float64]  # (T, N, 3), x [m], y [m], theta [rad] in map

    def at(self, robot: NDArray[np.integer] | int, stamp_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """The pose (..., 3) of each `robot` at each `stamp_ns` (broadcast together).

        Raises:
            ValueError: A stamp lies outside the simulated time.
        """
        index, share = self._locate(stamp_ns)
        return _interpolate(self.poses[index, robot], self.poses[index + 1, robot], share)

    def all_at(self, stamp_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """The poses (M, N, 3) of all robots at stamps (M,).

        Raises:
            ValueError: A stamp lies outside the simulated time.
        """
        index, share = self._locate(stamp_ns)
        return _interpolate(self.poses[index], self.poses[index + 1], share[:, None])

    def _locate(self, stamp_ns: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Index of the stamp before each time, and its fraction of the interval to the next, in [0, 1]."""
        stamp_ns = np.asarray(stamp_ns, dtype=np.int64)
        if stamp_ns.size and (stamp_ns.min() < self.stamp_ns[0] or stamp_ns.max() > self.stamp_ns[-1]):
            raise ValueError(
                f"stamps {stamp_ns.min()}..{stamp_ns.max()} ns leave the simulated time "
                f"{self.stamp_ns[0]}..{self.stamp_ns[-1]} ns."
            )
        step_ns = int(self.stamp_ns[1] - self.stamp_ns[0])
        index = np.minimum((stamp_ns - self.stamp_ns[0]) // step_ns, len(self.stamp_ns) - 2)
        return index, (stamp_ns - self.stamp_ns[index]) / step_ns


def _interpolate(
    before: NDArray[np.float64], after: NDArray[np.float64], share: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The pose (..., 3) at the fraction `share` (...) of the constant twist between two poses."""
    return se2.compose(before, se2.exp(share[..., None] * se2.log(se2.between(before, after))))


ODOMETRY_DTYPE = np.dtype(
    [("robot", "<i4"), ("stamp_ns", "<i8"), ("arrival_ns", "<i8"), ("pose", "<f8", (3,))]
)
"""One odometry message: pose x [m], y [m], theta [rad] in the robot's odom frame, which starts at zero."""

FRAME_DTYPE = np.dtype(
    [("robot", "<i4"), ("stamp_ns", "<i8"), ("arrival_ns", "<i8"), ("first", "<i8"), ("count", "<i4")]
)
"""One camera image that arrived: its sightings are `sightings[first : first + count]`; count may be 0."""

SIGHTING_DTYPE = np.dtype([("marker_id", "<u4"), ("value", "<f8", (3,))])
"""One marker: forward [m] and left [m] of the camera, its normal from the optical axis [rad]."""

START_NS = 1_000 * 10**9  # Start time of simulated runs

Records = NDArray[Any]  # A structured array of one of the types above


@dataclass(frozen=True)
class LivedRun:
    """Data common to all simulated swarms."""

    swarm: Swarm  # The description available to a user, without the hidden errors of the world
    truth: Trajectories  # True poses of the robots in map
    odometry: Records  # (M,) of ODOMETRY_DTYPE in order of arrival

    @property
    def start_ns(self) -> int:
        """Start of the simulation."""
        return int(self.truth.stamp_ns[0])

    @property
    def end_ns(self) -> int:
        """End of the simulation; nothing arrives later."""
        return int(self.truth.stamp_ns[-1])

    @property
    def duration_s(self) -> float:
        """Simulated time [s]."""
        return (self.end_ns - self.start_ns) * 1e-9


@dataclass(frozen=True)
class SimulatedRun(LivedRun):
    """A simulated swarm with cameras from start to end."""

    frames: Records  # (F,) of FRAME_DTYPE in order of arrival; lost images are not there
    sightings: Records  # (S,) of SIGHTING_DTYPE, grouped by frame

    def masked(self, kept: NDArray[np.bool_]) -> SimulatedRun:
        """The run with some of its sightings (S,) only; frames stay, empty ones too."""
        frames = self.frames.copy()
        frame = np.repeat(np.arange(len(frames)), frames["count"])
        frames["count"] = np.bincount(frame[kept], minlength=len(frames))
        frames["first"] = np.cumsum(frames["count"]) - frames["count"]
        return replace(self, frames=frames, sightings=self.sightings[kept])


def in_order_of_arrival(records: Records, end_ns: int) -> Records:
    """The records that arrive until `end_ns`, sorted by arrival."""
    ordered = records[np.argsort(records["arrival_ns"], kind="stable")]
    return ordered[ordered["arrival_ns"] <= end_ns]


@dataclass(frozen=True)
class Lateness:
    """Delay between measurement and arrival, uniform between two bounds."""

    low_s: float  # Shortest delay [s]
    high_s: float  # Longest delay [s]


CAMERA_LATENESS = Lateness(0.150, 0.300)
"""Exposure, marker detection and wireless link of the e-puck paper, section V-B."""

ODOMETRY_LATENESS = Lateness(0.002, 0.020)  # A few bytes on the same wireless link


def arrival_ns(rng: np.random.Generator, stamp_ns: NDArray[np.int64], late: Lateness) -> NDArray[np.int64]:
    """Arrival times (M,) of messages with stamps (M,); independent delays may change their order."""
    delay_s = rng.uniform(late.low_s, late.high_s, len(stamp_ns))
    return stamp_ns + np.rint(delay_s * 1e9).astype(np.int64)


def survivors(rng: np.random.Generator, count: int, loss: float) -> NDArray[np.bool_]:
    """Which of `count` messages arrive (count,), when each is lost with probability `loss`."""
    return rng.random(count) >= loss
