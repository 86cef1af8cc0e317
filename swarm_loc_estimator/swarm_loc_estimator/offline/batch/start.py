"""Where a batch begins: at known paths, or at joined maps of single robots in the frames of their tracks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.offline.batch.problem import BatchProblem

_AGREES_M = 0.15  # Landmarks closer than this, or a tenth of the distance between them, agree


@dataclass
class Start:
    """Where all begin."""

    transform: FloatArray  # (N, 3) from the common frame to the track of each robot; NaN: not connected
    landmark: FloatArray  # (L, 3) poses; NaN: not connected
    knot: FloatArray | None = None  # (k, 3) transforms of tracks at knots, where paths are known
    parameter: FloatArray | None = None  # (N, p) changes of parameters; None: the mean of their prior


def started_at(problem: BatchProblem, paths: Mapping[str, Trajectory]) -> Start:
    """Begin where robots are by paths in `map`; others as by `start_of`."""
    start = start_of(problem)
    return replace(start, knot=on_paths(problem, paths, start.transform))


def on_paths(problem: BatchProblem, paths: Mapping[str, Trajectory], transform: FloatArray) -> FloatArray:
    """Transforms (k, 3) of tracks at knots, by paths in `map`; those of robots (N, 3) without one."""
    knots = problem.knots
    knot = transform[knots.robot]
    for index, robot in enumerate(problem.swarm.robots):
        own, path = np.flatnonzero(knots.robot == index), paths.get(robot.name)
        if path is None or not path.stamp_ns.size:
            continue
        track = problem.odometry.at(np.full(path.stamp_ns.size, index), path.stamp_ns).pose
        middle = path.stamp_ns[:-1] + np.diff(path.stamp_ns) // 2
        nearest = np.searchsorted(middle, knots.stamp_ns[own])
        knot[own] = se2.compose(path.pose, se2.inverse(track))[nearest]
    return knot


def start_of(problem: BatchProblem) -> Start:
    """Join the maps of all robots that share landmarks or see each other.

    Begins with described landmarks and starts, else with the robot that has seen most landmarks, whose first
    pose is then the origin.
    """
    swarm = problem.swarm
    maps = [_map_of(problem, robot) for robot in range(len(swarm.robots))]
    start = Start(np.full((len(swarm.robots), 3), np.nan), np.full((len(swarm.surveyed), 3), np.nan))
    start.landmark[len(swarm.landmarks) :] = 0.0  # of anchors, the shift and bias
    for index in np.flatnonzero(problem.is_known[: len(swarm.landmarks)]).tolist():
        mark = swarm.landmarks[index]
        start.landmark[index] = (mark.x, mark.y, mark.yaw or 0.0)
    for index, robot in enumerate(swarm.robots):
        if robot.start is not None and (problem.knots.robot == index).any():
            _place(problem, start, maps, index, _at_first(problem, index, np.array(robot.start)))
    if np.isnan(start.transform).all() and not problem.is_known.any():
        seen = [int(np.isfinite(one).all(axis=1).sum()) for one in maps]
        root = int(np.argmax(seen))
        _place(problem, start, maps, root, _at_first(problem, root, np.zeros(3)))
    while True:
        waiting = np.flatnonzero(np.isnan(start.transform[:, 0])).tolist()
        found = [(robot, *_alignment(problem, start, maps, robot)) for robot in waiting]
        found = [one for one in found if one[2] > 0.0]
        if not found:
            return start
        robot, transform, _ = max(found, key=lambda one: one[2])
        _place(problem, start, maps, robot, transform)


def _at_first(problem: BatchProblem, robot: int, pose: FloatArray) -> FloatArray:
    """The transform of a robot's track with a pose (3,) at its first knot."""
    first = int(np.flatnonzero(problem.knots.robot == robot)[0])
    return se2.compose(pose, se2.inverse(problem.knots.sample.pose[first]))


def _map_of(problem: BatchProblem, robot: int) -> FloatArray:
    """Poses (L, 3) of the landmarks that a robot has seen, in the frame of its track; NaN: not seen."""
    sightings, places = problem.sightings, np.full((len(problem.swarm.surveyed), 3), np.nan)
    rows = np.flatnonzero((sightings.observer == robot) & (sightings.landmark >= 0) & problem.is_seen)
    seen = _seen_at(problem, rows, problem.tracks[0, rows])
    for index in np.unique(sightings.landmark[rows]).tolist():
        own = seen[sightings.landmark[rows] == index]
        x, y = np.median(own[:, :2], axis=0)
        heading = own[np.isfinite(own[:, 2]), 2]
        places[index] = (x, y, _median_angle(heading) if heading.size else 0.0)
    return places


def _seen_at(problem: BatchProblem, rows: IntArray, observer: FloatArray) -> FloatArray:
    """Poses (k, 3) of the markers of sightings by robots at poses (k, 3); heading NaN: not seen."""
    some, is_polar = select(problem.sightings, rows), problem.is_polar[rows]
    value = some.value.copy()
    distance, bearing = value[is_polar, 0].copy(), value[is_polar, 1].copy()
    value[is_polar, 0], value[is_polar, 1] = distance * np.cos(bearing), distance * np.sin(bearing)
    seen = se2.compose(se2.compose(observer, some.sensor), value)
    seen[~some.has_heading, 2] = np.nan
    return seen


def _median_angle(angles: FloatArray) -> float:
    """The angle whose distance to all others is least in sum."""
    some = angles[:: max(1, angles.size // 200)]
    return float(some[np.argmin(np.abs(se2.wrap_angle(some[:, None] - angles)).sum(axis=1))])


def _place(
    problem: BatchProblem, start: Start, maps: list[FloatArray], robot: int, transform: FloatArray
) -> None:
    """Place a robot's track, and the landmarks that nobody has placed before."""
    start.transform[robot] = transform
    new = np.isnan(start.landmark[:, 0]) & np.isfinite(maps[robot][:, 0]) & ~problem.is_known
    start.landmark[new] = se2.compose(transform, maps[robot][new])


def _alignment(
    problem: BatchProblem, start: Start, maps: list[FloatArray], robot: int
) -> tuple[FloatArray, float]:
    """The transform of a robot's track on which most landmarks and robots agree, and how many do so."""
    own = maps[robot]
    both = np.flatnonzero(np.isfinite(own[:, 0]) & np.isfinite(start.landmark[:, 0]))
    candidates = [
        se2.rigid_fit(own[[i, j], :2], start.landmark[[i, j], :2])
        for i in both.tolist()
        for j in both.tolist()
        if i < j
    ]
    by_robots = _by_robots(problem, start, robot)
    candidates += by_robots[:: max(1, len(by_robots) // 50)]
    best, most = np.zeros(3), 0.0
    for candidate in candidates:
        moved = se2.transform_points(candidate, own[both, :2])
        size = 0.1 * np.linalg.norm(np.ptp(start.landmark[both, :2], axis=0)) if both.size else 0.0
        off = np.linalg.norm(moved - start.landmark[both, :2], axis=1)
        votes = float(np.sum(off < max(_AGREES_M, size))) - 1.0
        if len(by_robots):
            others = np.array(by_robots)
            near = np.linalg.norm(others[:, :2] - candidate[:2], axis=1) < 3.0 * _AGREES_M
            near &= np.abs(se2.wrap_angle(others[:, 2] - candidate[2])) < 0.5
            votes += 2.0 * float(near.mean())
        if votes > most:
            best, most = candidate, votes
    return best, most


def _by_robots(problem: BatchProblem, start: Start, robot: int) -> list[FloatArray]:
    """Transforms of a robot's track by sightings with heading, between it and placed robots."""
    sightings = problem.sightings
    placed = np.isfinite(start.transform[:, 0])
    # by robots, and by cameras, whose corrections are in place of poses
    moves, mount = sightings.observer >= 0, sightings.mount
    observed = np.where(moves, placed[sightings.observer], mount >= 0) & (sightings.target == robot)
    seen_by = np.flatnonzero(observed & sightings.has_heading)
    moving = se2.compose(start.transform[sightings.observer[seen_by]], problem.tracks[0, seen_by])
    fixed = np.vstack([start.landmark, np.zeros(3)])  # -1, no camera, is the last row
    observers = np.where(moves[seen_by, None], moving, fixed[mount[seen_by]])
    markers = _seen_at(problem, seen_by, observers)
    bodies = se2.compose(markers, se2.inverse(sightings.marker[seen_by]))
    found = [*se2.compose(bodies, se2.inverse(problem.tracks[1, seen_by]))]
    sees = np.flatnonzero(
        (sightings.observer == robot)
        & (sightings.target >= 0)
        & placed[np.maximum(sightings.target, 0)]
        & sightings.has_heading
    )
    if sees.size:
        targets = se2.compose(start.transform[sightings.target[sees]], problem.tracks[1, sees])
        markers = se2.compose(targets, sightings.marker[sees])
        relative = _seen_at(problem, sees, problem.tracks[0, sees])
        found += [*se2.compose(markers, se2.inverse(relative))]
    return found
