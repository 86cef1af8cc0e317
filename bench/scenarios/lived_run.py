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

from swarm_loc_drivers.sim.differential_drive import Controller, Drive, integrate, roll, twist_of, wheel_paths
from swarm_loc_drivers.sim.run import START_NS, Trajectories
from swarm_loc_estimator.common.arrays import FloatArray
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


@dataclass(frozen=True)
class Driven:
    """True and reported tracks of a drive."""

    truth: FloatArray  # (T + 1, N, 3) true poses in map
    reported: FloatArray  # (T + 1, N, 3) poses by odometry, each robot's own frame, starting at zero


def drive(
    rng: np.random.Generator,
    start: FloatArray,
    control: Controller,
    model: Drive,
    *,
    step_s: float,
    steps: int,
) -> Driven:
    """Drive N robots from `start` (N, 3) for `steps` steps of `step_s`, commanded by `control`."""
    truth = np.empty((steps + 1, *start.shape))
    truth[0] = start
    speeds, turn_rates = np.empty((2, steps, len(start)))
    noise = rng.standard_normal((steps, len(start), 2)) * np.sqrt(model.wheel_noise)
    for k in range(steps):
        speeds[k], turn_rates[k] = control(k, truth[k])
        truth[k + 1] = roll(truth[k], speeds[k], turn_rates[k], model, step_s, noise[k])
    commanded = wheel_paths(speeds, turn_rates, model.wheel_separation, step_s)
    return Driven(truth, integrate(twist_of(commanded, model.wheel_separation)))


def record_drive(
    rng: np.random.Generator,
    start: FloatArray,
    control: Controller,
    model: Drive,
    *,
    step_ns: int,
    duration_s: float,
    odometry_rate_hz: float,
) -> tuple[Trajectories, Records]:
    """Drive N robots from `start` (N, 3) at START_NS: their true tracks, and odometry of ODOMETRY_DTYPE."""
    steps = round(duration_s * 1e9 / step_ns)
    stamp_ns = START_NS + step_ns * np.arange(steps + 1, dtype=np.int64)
    driven = drive(rng, start, control, model, step_s=step_ns * 1e-9, steps=steps)
    every = round(1e9 / odometry_rate_hz / step_ns)
    odometry = report_odometry(rng, stamp_ns, driven.reported, every, ODOMETRY_LATENESS)
    return Trajectories(stamp_ns, driven.truth), odometry


def report_odometry(
    rng: np.random.Generator, stamp_ns: NDArray[np.int64], reported: FloatArray, every: int, late: Lateness
) -> Records:
    """The odometry messages of N robots, each at its own phase of the common clock.

    Args:
        rng: Source of phases and delays.
        stamp_ns: (T,).
        reported: (T, N, 3) in each robot's odom frame.
        every: Steps between two messages of a robot.
        late: Delay on the way.

    Returns:
        (M,) of ODOMETRY_DTYPE in order of arrival. Every robot's first message is at the first stamp.
    """
    robots = reported.shape[1]
    phase = rng.integers(1, every + 1, robots)
    step = np.arange(len(stamp_ns))[:, None]
    chosen, robot = np.nonzero((step == 0) | ((step - phase) % every == 0))
    messages = np.zeros(len(chosen), ODOMETRY_DTYPE)
    messages["robot"] = robot
    messages["stamp_ns"] = stamp_ns[chosen]
    messages["pose"] = reported[chosen, robot]
    messages["arrival_ns"] = arrival_ns(rng, messages["stamp_ns"], late)
    return in_order_of_arrival(messages, int(stamp_ns[-1]))
