"""Survey: from a recording to a swarm description with places, and what is badly determined.

Picture of a survey: landmarks with ellipses, paths of robots, fixed cameras and anchors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.offline.calibration.recording import CalibrationError, Recording
from swarm_loc_estimator.offline.recorded_bag import Progress, unwatched
from swarm_loc_estimator.offline.report.style import INK, SOFT, colour_of, label_map, save, style
from swarm_loc_estimator.offline.survey.cameras_and_anchors import Paths, Placed, place_fixed
from swarm_loc_estimator.offline.survey.problem import MIN_SIGHTINGS, SurveyProblem, problem_of, start_of
from swarm_loc_estimator.offline.survey.solve import Solution, Solver
from swarm_loc_estimator.swarm.swarm import Landmark, Robot, Swarm

_ONE_SIDE = math.radians(45.0)  # Landmarks seen from directions within less than this were seen from one side
_WRONG = 0.3  # Share of sightings that contradict a landmark from which it is named
_VAGUE_M, _VAGUE = 0.01, 3.0
"""A landmark is named if its sigma exceeds this [m] and this multiple of the median sigma."""
_WORSE = 1.5
"""One that was seen from one side is named if its sigma exceeds this multiple of the median sigma."""
_SIGNIFICANT = 3.0  # Parameters are written if they exceed this many of their standard deviations


@dataclass(frozen=True)
class Surveyed:
    """What was found."""

    swarm: Swarm  # The description with all connected landmarks and corrected parameters
    problem: SurveyProblem  # What was solved
    solution: Solution  # How
    path: FloatArray  # (k, 3) poses in map of the robots at the knots; NaN: not connected
    text: str  # Table of the landmarks, corrected parameters, and what is badly determined


def survey(
    recording: Recording, swarm: Swarm, progress: Progress = unwatched, *, cameras: bool = False
) -> Surveyed:
    """Find the landmarks and anchors of a recording in which robots drove around.

    Args:
        recording: Odometry, detections and ranges.
        swarm: The robots. Landmarks that it describes, and starts, give the frame; without any, the first
            pose of the robot that has seen most is the origin.
        progress: Called now and then.
        cameras: Whether described fixed cameras are placed again.

    Raises:
        CalibrationError: Nobody has moved, or no marker that belongs to nobody was seen often enough.
    """
    if not recording.odometry.robot.size:
        raise CalibrationError(f"'{recording.name}' has no odometry, which a survey needs.")
    progress(0.0, "reading")
    problem = problem_of(recording, swarm)
    if not problem.swarm.landmarks or not np.any(problem.sightings.landmark >= 0):
        raise CalibrationError(
            f"'{recording.name}' has no marker that belongs to nobody and was seen {MIN_SIGHTINGS} times."
        )
    solution = Solver(problem, start_of(problem)).solve(progress)
    found = replace(
        swarm,
        landmarks=tuple(_landmarks(problem, solution)),
        robots=tuple(_calibrated(robot, index, solution) for index, robot in enumerate(swarm.robots)),
    )
    frame = max(1.0, solution.variance_ratio) * solution.frame_covariance
    paths = Paths(partial(_poses, problem, solution), frame)
    placed = place_fixed(recording, found, paths, cameras=cameras)
    found = replace(found, cameras=placed.cameras, anchors=placed.anchors)
    path = se2.compose(solution.knot, problem.knots.sample.pose)
    return Surveyed(found, problem, solution, path, _text(problem, solution, swarm, found, placed))


def _poses(problem: SurveyProblem, solution: Solution, robots: IntArray, stamps_ns: IntArray) -> FloatArray:
    """Poses (k, 3) in map of robots (k,) at instants (k,); NaN: not known."""
    knots, poses = problem.knots.nearest(robots, stamps_ns), np.full((robots.size, 3), np.nan)
    end_ns = np.zeros(len(problem.swarm.robots), dtype=np.int64)
    np.maximum.at(end_ns, problem.knots.robot, problem.knots.stamp_ns)
    known = (knots >= 0) & (stamps_ns <= end_ns[robots])
    known[known] = problem.odometry.has_started(robots[known], stamps_ns[known])
    track = problem.odometry.at(robots[known], stamps_ns[known]).pose
    poses[known] = se2.compose(solution.knot[knots[known]], track)
    return poses


def _landmarks(problem: SurveyProblem, solution: Solution) -> list[Landmark]:
    """All landmarks that are connected, with standard deviations for those that were estimated."""
    factor = max(1.0, solution.variance_ratio)
    found = []
    for mark, pose, covariance, is_known in zip(
        problem.swarm.landmarks,
        solution.landmark.tolist(),
        factor * solution.landmark_covariance,
        problem.is_known,
        strict=True,
    ):
        if is_known and not mark.is_estimated:
            found.append(mark)
        elif np.isfinite(pose).all():
            x, y, yaw = pose
            position_sigma = math.sqrt(0.5 * float(covariance[0, 0] + covariance[1, 1]))
            yaw_sigma = 0.0 if mark.yaw is None else math.sqrt(float(covariance[2, 2]))
            place = {"x": x, "y": y, "yaw": None if mark.yaw is None else yaw}
            found.append(replace(mark, **place, position_sigma=position_sigma, yaw_sigma=yaw_sigma))
    return found


def _calibrated(robot: Robot, index: int, solution: Solution) -> Robot:
    """A robot with those parameters corrected that differ significantly from the description."""
    value, sigma = solution.parameter[index], solution.parameter_sigma[index]
    _, path, turn, yaw, scale = np.where(np.abs(value) > _SIGNIFICANT * sigma, value, 0.0).tolist()
    camera, sensor = robot.camera, robot.sensor
    turn_scale = (1.0 + turn) * robot.turn_sensor.turn_scale
    odometry = replace(robot.odometry, distance_scale=(1.0 + path) * robot.odometry.distance_scale)
    return replace(
        robot,
        odometry=odometry if robot.imu.is_used else replace(odometry, turn_scale=turn_scale),
        imu=replace(robot.imu, turn_scale=turn_scale) if robot.imu.is_used else robot.imu,
        camera=camera and replace(camera, yaw=float(se2.wrap_angle(camera.yaw + yaw))),
        sensor=replace(sensor, distance_scale=(1.0 + scale) * sensor.distance_scale),
    )


def _text(problem: SurveyProblem, solution: Solution, before: Swarm, found: Swarm, placed: Placed) -> str:
    places = {mark.id: mark for mark in found.landmarks}
    lines = ["landmark        x [m]     y [m]  yaw [deg]  sigma [mm]  sightings  contradicting"]
    for index, mark in enumerate(problem.swarm.landmarks):
        rows = problem.sightings.landmark == index
        if mark.id not in places or not rows.any():
            continue
        one, wrong = places[mark.id], float(np.mean(_is_wrong(solution)[rows]))
        yaw = "-" if one.yaw is None else f"{math.degrees(one.yaw):.1f}"
        sigma = 1e3 * one.position_sigma
        lines.append(
            f"{one.id:8d} {one.x:12.3f} {one.y:9.3f} {yaw:>10} {sigma:11.1f} {rows.sum():10d} {wrong:13.0%}"
        )
    return "\n".join(
        [
            *(*lines, "", *placed.lines, *([""] if placed.lines else [])),
            *(*_corrections(before, found), *_frame(problem), *_remarks(problem, solution), *placed.remarks),
        ]
    )


def _is_wrong(solution: Solution) -> BoolArray:
    return np.asarray(solution.used & (solution.weight < 0.1))


def _corrections(before: Swarm, found: Swarm) -> list[str]:
    """A sentence for each robot whose parameters were corrected."""
    lines = []
    for old, new in zip(before.robots, found.robots, strict=True):
        pairs = {
            "odometry.distance_scale": (old.odometry.distance_scale, new.odometry.distance_scale),
            "odometry.turn_scale": (old.odometry.turn_scale, new.odometry.turn_scale),
            "imu.turn_scale": (old.imu.turn_scale, new.imu.turn_scale),
            "sensor.distance_scale": (old.sensor.distance_scale, new.sensor.distance_scale),
        }
        if old.camera is not None and new.camera is not None:
            pairs["camera.yaw"] = (old.camera.yaw, new.camera.yaw)
        said = [f"{key} {a:.4f} -> {b:.4f}" for key, (a, b) in pairs.items() if a != b]
        if said:
            lines.append(f"Corrected for {new.name}: {', '.join(said)}.")
    return lines


def _frame(problem: SurveyProblem) -> list[str]:
    """What gives the frame."""
    if problem.is_known.any():
        return [f"The frame is that of the {int(problem.is_known.sum())} described landmarks."]
    if any(robot.start is not None for robot in problem.swarm.robots):
        return ["The frame is that of the described starts of robots."]
    return ["The origin is the first pose of one robot, since no landmark and no start is described."]


def _remarks(problem: SurveyProblem, solution: Solution) -> list[str]:
    """What is badly determined, a sentence each with a remedy."""
    sightings, remarks = problem.sightings, []
    for marker_id, count in sorted(problem.rare.items()):
        remarks.append(f"Marker {marker_id} was seen {count} x only and is left out; drive past it.")
    placed = np.isfinite(solution.landmark[:, 0])
    apart = [str(mark.id) for mark, is_in in zip(problem.swarm.landmarks, placed, strict=True) if not is_in]
    moved = np.unique(problem.knots.robot).tolist()
    located = {robot for robot in moved if np.isfinite(solution.knot[problem.knots.robot == robot]).all()}
    lone = [problem.swarm.robots[robot].name for robot in moved if robot not in located]
    if apart or lone:
        said = _listed([*(f"robot {name}" for name in lone), *(f"landmark {name}" for name in apart)])
        remarks.append(
            f"{said} cannot be placed: nothing connects them with the others; let robots of both parts pass"
            " the same landmarks, or each other."
        )
    sigma = np.sqrt(0.5 * (solution.landmark_covariance[:, 0, 0] + solution.landmark_covariance[:, 1, 1]))
    free = placed & (sigma > 0.0)
    usual = float(np.median(sigma[free])) if free.any() else 0.0
    observers = se2.compose(
        se2.compose(solution.knot[problem.sides[:, 0]], problem.tracks[0]), sightings.sensor
    )
    for index in np.flatnonzero(free).tolist():
        rows = (sightings.landmark == index) & solution.used
        name = f"Landmark {problem.swarm.landmarks[index].id}"
        if not rows.any():
            remarks.append(f"{name} was not seen and stays as it is described.")
            continue
        away = observers[rows, :2] - solution.landmark[index, :2]
        span = _span(np.arctan2(away[:, 1], away[:, 0]))
        wrong = float(np.mean(_is_wrong(solution)[rows]))
        if wrong > _WRONG:
            remarks.append(f"{name}: {wrong:.0%} of its sightings contradict; is its id there twice?")
        elif sigma[index] > max(_VAGUE_M, _VAGUE * usual):
            remarks.append(f"{name} is known to {1e3 * sigma[index]:.0f} mm only; drive past it again.")
        elif span < _ONE_SIDE and sigma[index] > _WORSE * usual:
            degrees = math.degrees(span)
            remarks.append(f"{name} was seen from one side only, within {degrees:.0f} deg; drive past it.")
    return remarks


def _span(angles: FloatArray) -> float:
    """Smallest arc that contains all but 5 % of angles (k,) [rad]."""
    ordered = np.sort(se2.wrap_angle(angles))
    kept = max(1, math.ceil(0.95 * ordered.size))
    turned = np.concatenate([ordered, ordered + 2.0 * np.pi])
    return float(np.min(turned[kept - 1 : kept - 1 + ordered.size] - turned[: ordered.size]))


def _listed(names: Sequence[str]) -> str:
    said = ", ".join(names)
    return said[:1].upper() + said[1:]


_SIGMAS = 3.0
_LEAST_SHARE = 0.02
"""Size of the largest ellipse, as a share of the arena, to which all are enlarged if they are smaller."""


def draw(done: Surveyed, path: Path) -> Path:
    """Write a PNG."""
    problem, solution = done.problem, done.solution
    placed = np.isfinite(solution.landmark[:, 0])
    places = solution.landmark[placed, :2]
    figure = Figure(figsize=(8.0, 7.0))
    axis = figure.subplots()
    style(axis)
    axis.set_aspect("equal")
    label_map(axis)
    for robot in np.unique(problem.knots.robot).tolist():
        own = done.path[problem.knots.robot == robot]
        axis.plot(own[:, 0], own[:, 1], color=colour_of(robot), linewidth=0.8, alpha=0.6)
        name = problem.swarm.robots[robot].name
        if np.isfinite(own).all():
            axis.annotate(name, own[0, :2].tolist(), fontsize=8, color=colour_of(robot))
    size = float(np.ptp(places, axis=0).max()) if len(places) else 1.0
    axes = [np.linalg.eigh(one[:2, :2]) for one in solution.landmark_covariance[placed]]
    largest = max((_SIGMAS * math.sqrt(max(float(one[0][-1]), 0.0)) for one in axes), default=0.0)
    factor = _LEAST_SHARE * size / largest if largest > 0.0 else 1.0
    factor = factor if factor > 1.5 else 1.0
    for pose, (square, direction) in zip(solution.landmark[placed], axes, strict=True):
        width, height = (2.0 * factor * _SIGMAS * np.sqrt(np.maximum(square, 0.0))).tolist()
        angle = math.degrees(math.atan2(direction[1, 0], direction[0, 0]))
        axis.add_patch(Ellipse(pose[:2], width, height, angle=angle, facecolor=SOFT, alpha=0.35))
        ahead = 0.02 * size * np.array([math.cos(pose[2]), math.sin(pose[2])])
        axis.plot(*np.stack([pose[:2], pose[:2] + ahead]).T, color=INK, linewidth=1.5)
    marks = [mark for mark, is_in in zip(problem.swarm.landmarks, placed, strict=True) if is_in]
    for mark, place in zip(marks, places.tolist(), strict=True):
        axis.annotate(str(mark.id), place, (4, 4), textcoords="offset points", fontsize=7, color=INK)
    fixed = [(camera.name, camera.x, camera.y, "s") for camera in done.swarm.cameras]
    fixed += [(hex(anchor.address), anchor.x, anchor.y, "^") for anchor in done.swarm.anchors]
    for name, x, y, symbol in fixed:
        axis.plot(x, y, symbol, color=INK, markersize=7)
        axis.annotate(name, (x, y), (6, 4), textcoords="offset points", fontsize=8, color=INK)
    note = f"3-sigma ellipses, enlarged {factor:.0f} x" if factor > 1.0 else "3-sigma ellipses"
    axis.set_title(f"{len(marks)} landmarks ({note})", loc="left", fontsize=11, color=INK)
    save(figure, path)
    return path
