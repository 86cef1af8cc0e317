"""Data of a simulated run, the same for every simulated world.

Sensor data is kept as flat structured arrays, because a run of a thousand robots has a million entries.
`stamp_ns` is when something happened, `arrival_ns` when a receiver got it; a receiver sees the data in
order of arrival. Ground truth stands apart and is for evaluation only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Iterator

    from swarm_loc_drivers.sim.common.trajectories import Trajectories
    from swarm_loc_estimator.swarm.swarm import Swarm

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

Records = NDArray[Any]
"""A structured array of one of the types above."""


@dataclass(frozen=True)
class LivedRun:
    """What every simulated swarm has.

    Attributes:
        swarm: The description that a user would have; it does not know the hidden errors of the world.
        truth: Where the robots really were, in map.
        odometry: (M,) of ODOMETRY_DTYPE in order of arrival.
    """

    swarm: Swarm
    truth: Trajectories
    odometry: Records

    @property
    def start_ns(self) -> int:
        """First simulated moment."""
        return int(self.truth.stamp_ns[0])

    @property
    def end_ns(self) -> int:
        """Last simulated moment; nothing arrives later."""
        return int(self.truth.stamp_ns[-1])

    @property
    def duration_s(self) -> float:
        """Simulated time [s]."""
        return (self.end_ns - self.start_ns) * 1e-9


@dataclass(frozen=True)
class SimulatedRun(LivedRun):
    """A simulated swarm with cameras from start to end.

    Attributes:
        frames: (F,) of FRAME_DTYPE in order of arrival; lost images are not there.
        sightings: (S,) of SIGHTING_DTYPE, grouped by frame.
    """

    frames: Records
    sightings: Records

    def masked(self, kept: NDArray[np.bool_]) -> SimulatedRun:
        """The run with some of its sightings (S,) only; frames stay, empty ones too."""
        frames = self.frames.copy()
        frame = np.repeat(np.arange(len(frames)), frames["count"])
        frames["count"] = np.bincount(frame[kept], minlength=len(frames))
        frames["first"] = np.cumsum(frames["count"]) - frames["count"]
        return replace(self, frames=frames, sightings=self.sightings[kept])

    def arrivals(self) -> Iterator[tuple[str, int]]:
        """All data in order of arrival: ("odometry" or "frame", index into that array)."""
        count = len(self.odometry)
        arrival_ns = np.concatenate([self.odometry["arrival_ns"], self.frames["arrival_ns"]])
        for index in np.argsort(arrival_ns, kind="stable").tolist():
            yield ("odometry", index) if index < count else ("frame", index - count)


def in_order_of_arrival(records: Records, end_ns: int) -> Records:
    """The records that arrive until `end_ns`, sorted by arrival."""
    ordered = records[np.argsort(records["arrival_ns"], kind="stable")]
    return ordered[ordered["arrival_ns"] <= end_ns]
