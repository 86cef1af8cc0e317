"""Faults injected into simulated runs, and what all scenarios share."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from bench.scenarios.eight_run import EightSettings
from bench.scenarios.lived_run import (
    FRAME_DTYPE,
    ODOMETRY_DTYPE,
    SIGHTING_DTYPE,
    LivedRun,
    Records,
    SimulatedRun,
)
from swarm_loc_drivers.sim.run import Trajectories
from swarm_loc_drivers.sim.worlds import W0, W2, ErrorModel
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.swarm.error_models import SensorModel
from swarm_loc_estimator.swarm.swarm import Swarm

DURATION_S = 60.0
FAULT_S = (15.0, 45.0)

DETECTOR = SensorModel(forward_sigma=0.005, left_sigma=0.002, heading_sigma=0.06)  # Noise as described
CLEAN = replace(W0, forward_sigma=0.005, left_sigma=0.002, heading_sigma=0.06, described=DETECTOR)
SYSTEMATIC = replace(W2, forward_sigma=0.005, left_sigma=0.002, heading_sigma=0.06, described=DETECTOR)
"""Systematic errors of w2 that the description does not contain."""


@dataclass(frozen=True)
class Fault:
    """A run with a fault."""

    run: LivedRun  # The run
    # End of the fault, after which the estimate should recover; None: it does not end
    ends_s: float | None = None
    # Begin and end of the time in which no data that has arrived shows the fault
    hidden_s: tuple[float, float] | None = None
    about: str = ""  # Name of the faulty robot or landmark, if it depends on the seed
    # Readings by sensor besides odometry and sightings of the run, or in place of these
    readings: Mapping[str, Any] = field(default_factory=dict)
    healthy: Mapping[str, Any] = field(default_factory=dict)  # The same without the fault
    begins_s: float = 0.0  # Begin of the fault
    guilty: frozenset[str] = frozenset()  # Names that a contradiction may be about
    concerned: frozenset[int] = frozenset()  # Robots that the fault concerns, if not all of them


def settings_of(seed: int, errors: ErrorModel, duration_s: float = DURATION_S) -> EightSettings:
    """Five robots, for a minute unless told otherwise."""
    return EightSettings(seed=seed, duration_s=duration_s, errors=errors)


SightingSource = Callable[[IntArray, Trajectories], FloatArray]
"""Values (k, 3) of false sightings at stamps (k,)."""

_LATENESS_NS = 50_000_000


def seconds(run: LivedRun, stamp_ns: IntArray) -> FloatArray:
    """Time since the run began (k,) [s]."""
    since: FloatArray = (stamp_ns - run.start_ns).astype(np.float64) * 1e-9
    return since


def rescaled_odometry(run: SimulatedRun, robot: int, scale: float) -> SimulatedRun:
    """Scale the odometry of a robot."""
    odometry = run.odometry.copy()
    rows = np.flatnonzero(odometry["robot"] == robot)
    rows = rows[np.argsort(odometry["stamp_ns"][rows], kind="stable")]
    pose = odometry["pose"][rows]
    steps = se2.exp(scale * se2.log(se2.between(pose[:-1], pose[1:])))
    for row, step, before in zip(rows[1:], steps, rows, strict=False):
        odometry["pose"][row] = se2.compose(odometry["pose"][before], step)
    return replace(run, odometry=odometry)


def restarted_driver(run: SimulatedRun, robot: int, begin_s: float, end_s: float) -> SimulatedRun:
    """Remove odometry and images of a robot for a while, and restart its odometry from zero."""
    time_s, mine = seconds(run, run.odometry["stamp_ns"]), run.odometry["robot"] == robot
    kept = ~(mine & (time_s >= begin_s) & (time_s < end_s))
    odometry = run.odometry[kept].copy()
    after = np.flatnonzero((mine & (time_s >= end_s))[kept])
    first = odometry["pose"][after[np.argmin(odometry["stamp_ns"][after])]].copy()
    odometry["pose"][after] = se2.between(first, odometry["pose"][after])
    frame_s = seconds(run, run.frames["stamp_ns"])
    dark = (run.frames["robot"] == robot) & (frame_s >= begin_s) & (frame_s < end_s)
    return replace(run, odometry=odometry).masked(~np.repeat(dark, run.frames["count"]))


def reset_odometry(run: SimulatedRun, robot: int, at_s: float, pose: FloatArray) -> SimulatedRun:
    """Let a robot's odometry go on from another pose (3,) in its odom frame."""
    odometry = run.odometry.copy()
    after = (odometry["robot"] == robot) & (seconds(run, odometry["stamp_ns"]) >= at_s)
    first = odometry["pose"][after][np.argmin(odometry["stamp_ns"][after])].copy()
    odometry["pose"][after] = se2.compose(pose, se2.between(first, odometry["pose"][after]))
    return replace(run, odometry=odometry)


def odometry_pose(run: SimulatedRun, robot: int, at_s: float) -> FloatArray:
    """Pose (3,) of the first odometry of a robot from an instant on."""
    rows = run.odometry[(run.odometry["robot"] == robot) & (seconds(run, run.odometry["stamp_ns"]) >= at_s)]
    pose: FloatArray = rows["pose"][np.argmin(rows["stamp_ns"])]
    return pose


def twist_only(run: SimulatedRun, robot: int) -> SimulatedRun:
    """Let a robot's odometry report its twist only."""
    odometry = run.odometry.copy()
    odometry["pose"][odometry["robot"] == robot] = 0.0
    return replace(run, odometry=odometry)


def with_twists(run: SimulatedRun) -> SimulatedRun:
    """Fill the mean twist of the step before each odometry message, as wheel odometry does."""
    dtype = np.dtype([*ODOMETRY_DTYPE.descr, ("twist", "<f8", (3,))])
    odometry = np.zeros(len(run.odometry), dtype)
    for name in ODOMETRY_DTYPE.names or ():
        odometry[name] = run.odometry[name]
    for robot in np.unique(odometry["robot"]):
        rows = np.flatnonzero(odometry["robot"] == robot)
        rows = rows[np.argsort(odometry["stamp_ns"][rows], kind="stable")]
        duration_s = np.diff(odometry["stamp_ns"][rows]) * 1e-9
        pose = odometry["pose"][rows]
        odometry["twist"][rows[1:]] = se2.log(se2.between(pose[:-1], pose[1:])) / duration_s[:, None]
    return replace(run, odometry=odometry)


def hide(run: SimulatedRun, robot: int, begin_s: float, end_s: float) -> SimulatedRun:
    """Remove all sightings of and by a robot for a while."""
    ids = [face.id for face in run.swarm.robots[robot].faces]
    of_frame = np.repeat(np.arange(len(run.frames)), run.frames["count"])
    time_s = seconds(run, run.frames["stamp_ns"])[of_frame]
    own = (run.frames["robot"][of_frame] == robot) | np.isin(run.sightings["marker_id"], ids)
    return run.masked(~(own & (time_s >= begin_s) & (time_s < end_s)))


def second_odometry(run: SimulatedRun, robot: int, begin_s: float, rate_hz: float) -> SimulatedRun:
    """Add a second publisher of a robot's odometry, with a constant other pose."""
    stamps_ns = _stamps(run, begin_s, run.duration_s - 1.0, rate_hz)
    rows = np.zeros(stamps_ns.size, ODOMETRY_DTYPE)
    rows["robot"], rows["stamp_ns"], rows["arrival_ns"] = robot, stamps_ns, stamps_ns + _LATENESS_NS
    rows["pose"] = (0.4, -0.3, 1.0)
    both = np.concatenate([run.odometry, rows])
    return replace(run, odometry=both[np.argsort(both["arrival_ns"], kind="stable")])


def false_sightings(
    run: SimulatedRun, sight: tuple[int, int], span_s: tuple[float, float], source: SightingSource
) -> SimulatedRun:
    """Add false sightings at 30 Hz.

    Args:
        run: The run.
        sight: Index of the observer, and id of the marker.
        span_s: Begin and end.
        source: Values of the sightings.
    """
    stamps_ns = _stamps(run, *span_s, 30.0)
    found = np.zeros(stamps_ns.size, SIGHTING_DTYPE)
    found["marker_id"], found["value"] = sight[1], source(stamps_ns, run.truth)
    frames = np.zeros(stamps_ns.size, FRAME_DTYPE)
    frames["robot"], frames["stamp_ns"], frames["arrival_ns"] = sight[0], stamps_ns, stamps_ns + _LATENESS_NS
    frames["first"], frames["count"] = np.arange(stamps_ns.size), 1
    return merged_frames(run, (run.frames, run.sightings), (frames, found))


def changed_cameras(before: SimulatedRun, after: SimulatedRun, robot: int, at_s: float) -> SimulatedRun:
    """The run `before`, with a robot's images of the run `after` from `at_s` on."""
    old = ~(_from(before, robot, at_s))
    new = _from(after, robot, at_s)
    return merged_frames(before, *(_some_frames(run, rows) for run, rows in ((before, old), (after, new))))


def merged_frames(run: SimulatedRun, *parts: tuple[Records, Records]) -> SimulatedRun:
    """A run with the frames and sightings of several parts, in order of arrival."""
    frames = np.concatenate([part[0] for part in parts])
    offsets = np.cumsum([0, *(len(part[1]) for part in parts[:-1])])
    first = np.concatenate([part[0]["first"] + offset for part, offset in zip(parts, offsets, strict=True)])
    order = np.argsort(frames["arrival_ns"], kind="stable")
    frames, first = frames[order], first[order]
    rows = np.concatenate(
        [begin + np.arange(count) for begin, count in zip(first, frames["count"], strict=True)]
    )
    frames["first"] = np.cumsum(frames["count"]) - frames["count"]
    sightings = np.concatenate([part[1] for part in parts])[rows.astype(np.int64)]
    return replace(run, frames=frames, sightings=sightings)


def busiest_landmark(run: SimulatedRun) -> int:
    """The id of the landmark that is seen most often."""
    landmarks = {mark.id for mark in run.swarm.landmarks}
    ids, counts = np.unique(run.sightings["marker_id"], return_counts=True)
    seen: dict[int, int] = dict(zip(ids.tolist(), counts.tolist(), strict=True))
    return max(landmarks, key=lambda marker_id: seen.get(marker_id, 0))


def moved_landmark(swarm: Swarm, marker_id: int, step: Sequence[float]) -> Swarm:
    """The swarm with a landmark moved by `step` (2,) [m]."""
    return Swarm(
        swarm.robots,
        tuple(
            replace(mark, x=mark.x + step[0], y=mark.y + step[1]) if mark.id == marker_id else mark
            for mark in swarm.landmarks
        ),
    )


def turned_camera(swarm: Swarm, robot: int, yaw: float) -> Swarm:
    """The swarm with a robot's camera turned to the left by `yaw` [rad]."""
    robots = list(swarm.robots)
    camera = robots[robot].camera
    robots[robot] = replace(robots[robot], camera=camera and replace(camera, yaw=camera.yaw + yaw))
    return Swarm(tuple(robots), swarm.landmarks)


def kidnapped(robot: int, at_s: float) -> Callable[[Trajectories], Trajectories]:
    """Move a robot to the opposite side of the eight, where it keeps driving."""

    def change(truth: Trajectories) -> Trajectories:
        poses = truth.poses.copy()
        since = truth.stamp_ns - truth.stamp_ns[0] >= at_s * 1e9
        poses[since, robot] = se2.compose(np.array([0.0, 0.0, math.pi]), poses[since, robot])
        return replace(truth, poses=poses)

    return change


def next_sighting_s(run: SimulatedRun, robot: int, at_s: float) -> float:
    """Arrival of the first image with a marker that a robot takes from `at_s` on [s]."""
    frames = run.frames[_from(run, robot, at_s) & (run.frames["count"] > 0)]
    return float(seconds(run, frames["arrival_ns"]).min(initial=run.duration_s))


def wrong_starts(run: SimulatedRun, rng: np.random.Generator) -> SimulatedRun:
    """Describe wrong starts for all robots but the last."""
    robots = [
        replace(robot, start=_random_start(rng, robot.start)) if k + 1 < len(run.swarm.robots) else robot
        for k, robot in enumerate(run.swarm.robots)
    ]
    return replace(run, swarm=Swarm(tuple(robots), run.swarm.landmarks))


def _random_start(
    rng: np.random.Generator, start: tuple[float, float, float] | None
) -> tuple[float, float, float]:
    x, y, theta = start or (0.0, 0.0, 0.0)
    dx, dy, turn = rng.uniform([-0.8, -0.5, -3.0], [0.8, 0.5, 3.0]).tolist()
    return x + dx, y + dy, float(se2.wrap_angle(theta + turn))


def _from(run: SimulatedRun, robot: int, at_s: float) -> BoolArray:
    mine: BoolArray = (run.frames["robot"] == robot) & (seconds(run, run.frames["stamp_ns"]) >= at_s)
    return mine


def _some_frames(run: SimulatedRun, kept: BoolArray) -> tuple[Records, Records]:
    """Some of the frames (F,), with their sightings."""
    frames = run.frames[kept].copy()
    sightings = run.sightings[np.repeat(kept, run.frames["count"])]
    frames["first"] = np.cumsum(frames["count"]) - frames["count"]
    return frames, sightings


def _stamps(run: SimulatedRun, begin_s: float, end_s: float, rate_hz: float) -> IntArray:
    stamps: IntArray = run.start_ns + (np.arange(begin_s, end_s, 1.0 / rate_hz) * 1e9).astype(np.int64)
    return stamps
