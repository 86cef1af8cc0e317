"""Survey: from a recording to a swarm description with places, and what is badly determined.

Fixed cameras and UWB anchors are placed by the surveyed paths of robots. A fixed camera saw markers on robots
whose poses are known by then, so its pose is that of the perspective from n points. An anchor was measured
from many places, which is multilateration. Both are robust fits (Cauchy). Errors of neighbouring measurements
are alike, so variances are those of a jackknife over spells of time; the error of the map is apart. Nothing
is placed that fits elsewhere as well: places on one line do not tell where about this line a camera or an
anchor is.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.offline.batch.problem import (
    MIN_SIGHTINGS,
    SURVEY,
    BatchProblem,
    all_changed,
    corrections,
    problem_of,
)
from swarm_loc_estimator.offline.batch.solver import (
    ParameterPrior,
    SharedError,
    Solution,
    Solver,
    placed,
    shared_by_places,
)
from swarm_loc_estimator.offline.batch.start import Start, start_of
from swarm_loc_estimator.offline.calibration.recording import CalibrationError, Recording
from swarm_loc_estimator.offline.recorded_bag import Progress, unwatched
from swarm_loc_estimator.offline.report.plots import IN_MAP, INK, SOFT, colour_of, draw_ellipse, save, style
from swarm_loc_estimator.sensors.camera import CONTENT_BEARING, FROM_OPTICAL
from swarm_loc_estimator.swarm.swarm import (
    Anchor,
    FixedCamera,
    Swarm,
    UwbDevice,
)

# Checked by test_survey.py.
MIN_MEASUREMENTS = 30  # Minimum number of sightings or ranges that place a camera or an anchor
_SPELLS = 8  # Spells of time of the jackknife
_DRAWS, _DRAWN = 60, 6  # Starts of an anchor: number of draws, and ranges of each
_OUTLIER = 5.0  # Residuals of more standard deviations contradict the others
_LEAST_SIGMA = 1e-4
_MOST_SIGMA, _MOST_YAW_SIGMA = 1.0, 0.5  # Standard deviations [m], [rad] from which nothing is placed
_TURNS = 16  # Other places are sought in this number of directions about the line of all robots
_EQUAL_FIT, _FAR_SHARE, _FAR_M = 1.2, 0.5, 0.3
"""Another place fits as well if its residuals are larger by no more than this factor. It is farther away than
this share of the distance from the line, and this length."""
_DEPTH = 0.05  # Least depth of a marker in front of a camera, of which its direction is computed [m]


Paths = Callable[[IntArray, IntArray], FloatArray]
"""Poses (k, 3) in map of robots (k,) at instants (k,) [ns]; NaN: not known."""


@dataclass(frozen=True)
class Placed:
    """What was found."""

    cameras: tuple[FixedCamera, ...]  # All cameras, those that were placed with their poses and sigmas
    anchors: tuple[Anchor, ...]  # The described anchors, then those that were found
    lines: list[str]  # A table
    remarks: list[str]  # What is badly determined, one sentence each


def place_fixed(recording: Recording, swarm: Swarm, paths: Paths, *, cameras: bool) -> Placed:
    """Place anchors and, if asked for, cameras that are described.

    Described anchors stay, and other addresses are anchors. The robots of the description are corrected.
    """
    placed = Placed(swarm.cameras, swarm.anchors, [], [])
    if cameras and swarm.cameras:
        placed = _with_cameras(placed, recording, swarm, paths)
    return _with_anchors(placed, recording, swarm, paths) if recording.ranges.robot.size else placed


_AMBIGUOUS = (
    ", since other places fit as well: it has seen robots on one line or at few places only; let them drive"
    " over the whole floor."
)


def _with_cameras(placed: Placed, recording: Recording, swarm: Swarm, paths: Paths) -> Placed:
    """All fixed cameras, located by markers on robots."""
    found, lines = [], ["camera              x [m]     y [m]   z [m]  yaw [deg]  sigma [mm]  contradicting"]
    remarks = []
    for index, camera in enumerate(swarm.cameras, len(swarm.robots)):
        optical, place, stamp_ns = _sighted(recording, swarm, index, camera, paths)
        is_rare = stamp_ns.size < MIN_MEASUREMENTS
        fit = None if is_rare else _located(camera, optical, place, stamp_ns)
        located, wrong = fit or (camera, 0.0)
        found.append(located)
        if fit is None:
            why = ": it has seen robots whose paths are known"
            why += f" {stamp_ns.size} x, and {MIN_MEASUREMENTS} are needed."
            remarks.append(f"Camera {camera.name} stays as it is described{why if is_rare else _AMBIGUOUS}")
            continue
        sigma, yaw = 1e3 * located.position_sigma, math.degrees(located.yaw)
        numbers = (
            f"{located.x:9.3f} {located.y:9.3f} {located.z:7.3f} {yaw:10.1f} {sigma:11.1f} {wrong:14.0%}"
        )
        lines.append(f"{located.name:15s} {numbers}")
    return replace(placed, cameras=tuple(found), lines=[*placed.lines, *lines], remarks=remarks)


def _sighted(
    recording: Recording, swarm: Swarm, index: int, camera: FixedCamera, paths: Paths
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Markers (k, 3) in the optical frame of a camera and in map, and the stamps."""
    rows = recording.detections
    owners = [swarm.owner_of.get(int(one)) for one in rows.detection["id"]]
    of_robot = np.array([one is not None and one.robot_index >= 0 for one in owners], dtype=bool)
    kept = (rows.robot == index) & of_robot & (rows.detection["content"] != CONTENT_BEARING)
    kept &= np.isfinite(rows.detection["position"]).all(axis=1) & (rows.detection["position"][:, 2] > _DEPTH)
    stamp_ns = rows.stamp_ns[kept] + round(1e9 * camera.sensor.time_offset_s)
    chosen = [owner for owner, is_kept in zip(owners, kept, strict=True) if is_kept and owner is not None]
    robot = np.array([one.robot_index for one in chosen], dtype=np.int64)
    faces = np.array([(one.marker.x, one.marker.y, one.marker.z) for one in chosen]).reshape(-1, 3)
    pose = paths(robot, stamp_ns)
    place = np.column_stack([se2.transform_points(pose, faces[:, :2]), faces[:, 2]])
    known = np.isfinite(pose).all(axis=1)
    return rows.detection["position"][kept][known], place[known], stamp_ns[known]


def _located(
    camera: FixedCamera, optical: FloatArray, place: FloatArray, stamp_ns: IntArray
) -> tuple[FixedCamera, float] | None:
    """A camera at the pose from which it sees markers (k, 3) of `map` at (k, 3), and the share of wrong ones.

    Only directions are used: distances of a camera depend on its focal length and on sizes of markers. None:
    other poses fit as well.
    """
    # directions of the markers: perspective from n points
    seen = optical[:, :2] / optical[:, 2:]

    def residual(pose: FloatArray, rows: BoolArray) -> FloatArray:
        level = Rotation.from_rotvec(pose[:3]).apply(place[rows] - pose[3:], inverse=True)
        return np.asarray(level[:, :2] / np.maximum(level[:, 2:], _DEPTH) - seen[rows])

    # the best pose, and whether another fits as well
    start = _aligned(optical, place)
    pose, sigma, wrong = _robust(residual, start, len(seen))
    rotation = Rotation.from_rotvec(pose[:3])

    def turned(turn: Rotation, centre: FloatArray) -> FloatArray:
        return np.append((turn * rotation).as_rotvec(), centre + turn.apply(pose[3:] - centre))

    if not _is_unique(residual, pose, sigma, place, turned, lambda other: other[3:]):
        return None
    # uncertainty where it matters: at the middle of the view, on the floor
    height = float(np.median(place[:, 2]))
    below = np.median(optical, axis=0)

    def shift(other: FloatArray) -> FloatArray:
        """Where the middle of the view is on the floor (2,), and the direction of the image (1,)."""
        turned = Rotation.from_rotvec(other[:3])
        ray = turned.apply(below)
        centre = other[3:5] + ray[:2] * (height - other[5]) / ray[2]
        return np.append(centre, (turned * rotation.inv()).as_rotvec()[2])

    spread = _jackknife(residual, pose, sigma, stamp_ns, shift)
    # the pose as a description states it
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # straight down, yaw and roll are one angle
        angles = Rotation.from_matrix(rotation.as_matrix() @ FROM_OPTICAL.T).as_euler("ZYX")
    x, y, z = np.round(pose[3:], 5).tolist()
    yaw, pitch, roll = np.round(angles, 6).tolist()
    position_sigma = max(math.sqrt(0.5 * float(spread[0] + spread[1])), _LEAST_SIGMA)
    yaw_sigma = max(math.sqrt(float(spread[2])), _LEAST_SIGMA)
    if position_sigma > _MOST_SIGMA or yaw_sigma > _MOST_YAW_SIGMA:
        return None
    found = FixedCamera(camera.name, x, y, z, yaw, pitch, roll, position_sigma, yaw_sigma, camera.sensor)
    return found, wrong


def _aligned(points: FloatArray, to: FloatArray) -> FloatArray:
    """Rotation vector and translation (6,) that take most points (k, 3) to others, from distances, too."""
    weight = np.ones(len(points))
    for _ in range(20):
        share = weight / weight.sum()
        centre, goal = share @ points, share @ to
        rotation = Rotation.align_vectors(to - goal, points - centre, weights=weight)[0]
        error = np.linalg.norm(rotation.apply(points - centre) + goal - to, axis=1)
        weight = 1.0 / np.square(1.0 + np.square(error / max(3.0 * float(np.median(error)), 1e-6)))
    return np.concatenate([rotation.as_rotvec(), goal - rotation.apply(centre)])


def _with_anchors(placed: Placed, recording: Recording, swarm: Swarm, paths: Paths) -> Placed:
    """Anchors at all addresses that belong to nobody."""
    # ranges to unknown addresses while the place of the robot's antenna is known
    rows = recording.ranges
    radios = [robot.uwb for robot in swarm.robots]
    known = {one.address for one in (*radios, *swarm.anchors) if one is not None}
    usable = (rows.reference == 0) & np.array([radio is not None for radio in radios])[rows.robot]
    usable &= ~np.isin(rows.device, np.array([*known], dtype=np.uint64)) & (rows.range > 0.0)
    pose = paths(rows.robot, rows.stamp_ns)
    usable &= np.isfinite(pose).all(axis=1) & np.isfinite(rows.range)
    devices = [one or UwbDevice(0) for one in radios]
    of_radio = np.array([(one.x, one.y, one.z, one.range_bias, one.range_scale) for one in devices])
    *antenna, bias, scale = of_radio[rows.robot].T
    at = np.column_stack([se2.transform_points(pose, np.column_stack(antenna[:2])), antenna[2]])
    measured = (rows.range - bias) / scale
    # one anchor after the other
    found, remarks = [*placed.anchors], [*placed.remarks]
    lines = ["anchor              x [m]     y [m]   z [m]             sigma [mm]  contradicting"]
    for address in np.unique(rows.device[usable]).tolist():
        own = usable & (rows.device == address)
        name = f"Anchor {address:#x}"
        if own.sum() < MIN_MEASUREMENTS:
            remarks.append(f"{name} was measured {own.sum()} x only and is left out; drive near it.")
            continue
        if (fit := _multilaterated(at[own], measured[own], rows.stamp_ns[own])) is None:
            remarks.append(
                f"{name} is left out, since other places fit as well: it was measured from one line or few"
                " places only, or its ranges contradict each other; drive over the whole floor."
            )
            continue
        place, sigma, wrong = fit
        x, y, z = (round(float(value), 4) for value in place)
        found.append(Anchor(address, x, y, z, position_sigma=sigma))
        numbers = f"{x:9.3f} {y:9.3f} {z:7.3f} {1e3 * sigma:22.1f} {wrong:14.0%}"
        lines.append(f"{hex(address):15s} {numbers}")
    lines = lines if len(found) > len(placed.anchors) else []
    return replace(placed, anchors=tuple(found), lines=[*placed.lines, *lines], remarks=remarks)


def _multilaterated(
    at: FloatArray, measured: FloatArray, stamp_ns: IntArray
) -> tuple[FloatArray, float, float] | None:
    """Place (3,) at distances (k,) from places (k, 3), not below them; its sigma, and share of wrong ones.

    None: other places fit as well.
    """

    def residual(place: FloatArray, rows: BoolArray) -> FloatArray:
        return np.asarray(np.linalg.norm(at[rows] - place, axis=1) - measured[rows])[:, None]

    every = np.ones(measured.size, dtype=bool)
    rng = np.random.default_rng(0)
    starts = [_linear(at, measured, rng.choice(measured.size, _DRAWN, replace=False)) for _ in range(_DRAWS)]
    start = min(starts, key=lambda one: float(np.median(np.abs(residual(one, every)))))
    place, sigma, wrong = _robust(residual, start, measured.size)

    def turned(turn: Rotation, centre: FloatArray) -> FloatArray:
        return np.asarray(centre + turn.apply(place - centre))

    if not _is_unique(residual, place, sigma, at, turned, lambda other: other[:2]):
        return None
    spread = _jackknife(residual, place, sigma, stamp_ns, lambda other: other[:2])
    height = float(np.median(at[:, 2]))
    place[2] = height + abs(place[2] - height)  # ranges in a plane do not tell above from below
    position_sigma = max(math.sqrt(0.5 * float(spread.sum())), _LEAST_SIGMA)
    return None if position_sigma > _MOST_SIGMA else (place, position_sigma, wrong)


def _linear(at: FloatArray, measured: FloatArray, rows: IntArray) -> FloatArray:
    """A place (3,) from a few distances: their squares less those of the places are linear in it."""
    some, level = at[rows], float(np.median(at[:, 2]))
    matrix = np.column_stack([-2.0 * some[:, :2], np.ones(rows.size)])
    x, y, rest = np.linalg.lstsq(matrix, measured[rows] ** 2 - np.sum(some[:, :2] ** 2, axis=1), rcond=None)[
        0
    ]
    return np.array([x, y, level + math.sqrt(max(rest - x * x - y * y, 0.0))])


Residual = Callable[[FloatArray, BoolArray], FloatArray]
"""Residuals (m, r) of m chosen measurements at parameters (p,)."""


def _robust(residual: Residual, start: FloatArray, count: int) -> tuple[FloatArray, float, float]:
    """Best parameters (p,), the standard deviation of residuals, and the share of those that contradict."""
    every = np.ones(count, dtype=bool)
    best = start
    sigma = math.inf
    for _ in range(3):
        error = residual(best, every)
        sigma = max(1.4826 * float(np.median(np.abs(error))), 1e-6)
        best = _fitted(residual, best, sigma, every)
    size = np.linalg.norm(residual(best, every), axis=1)
    return best, sigma, float(np.mean(size > _OUTLIER * sigma))


def _fitted(residual: Residual, start: FloatArray, sigma: float, rows: BoolArray) -> FloatArray:

    def whitened(parameters: FloatArray) -> FloatArray:
        return residual(parameters, rows).ravel() / sigma

    return np.asarray(least_squares(whitened, start, loss="cauchy", x_scale="jac").x)


def _is_unique(
    residual: Residual,
    best: FloatArray,
    sigma: float,
    at: FloatArray,
    turned: Callable[[Rotation, FloatArray], FloatArray],
    of: Callable[[FloatArray], FloatArray],
) -> bool:
    """Whether no parameters with another place fit as well.

    If all robots were on a line, distances and directions stay as they are when all is turned about it.

    Args:
        residual: Of measurements at places (k, 3).
        best: (p,) parameters, of which the last three are the place.
        sigma: Of their residuals.
        at: (k, 3) the places.
        turned: The best parameters turned about a point (3,).
        of: (3,) place that belongs to parameters, or (2,) where its height is known badly.
    """
    every = np.ones(len(at), dtype=bool)
    good = at[np.linalg.norm(residual(best, every), axis=1) <= _OUTLIER * sigma]
    centre = good.mean(axis=0)
    line = np.linalg.svd(good - centre, full_matrices=False)[2][0]
    apart = max(_FAR_SHARE * float(np.linalg.norm(np.cross(best[-3:] - centre, line))), _FAR_M)
    bound = _EQUAL_FIT * max(float(np.median(np.abs(residual(best, every)))), sigma / 1.4826)
    for angle in np.linspace(0.0, 2.0 * np.pi, _TURNS, endpoint=False)[1:]:
        other = turned(Rotation.from_rotvec(angle * line), centre)
        fits = float(np.median(np.abs(residual(other, every)))) < bound
        if fits and np.linalg.norm(of(other) - of(best)) > apart:
            return False
    return True


def _jackknife(
    residual: Residual,
    best: FloatArray,
    sigma: float,
    stamp_ns: IntArray,
    of: Callable[[FloatArray], FloatArray],
) -> FloatArray:
    """Variances (q,) of a function of the parameters, by leaving out one spell of time after the other."""
    spell = np.empty(stamp_ns.size, dtype=np.int64)  # by rank, since few stamps may be all there are
    spell[np.argsort(stamp_ns, kind="stable")] = np.arange(stamp_ns.size) * _SPELLS // stamp_ns.size
    values = np.array([of(_fitted(residual, best, sigma, spell != one)) for one in range(_SPELLS)])
    return np.asarray((_SPELLS - 1) / _SPELLS * np.sum(np.square(values - values.mean(axis=0)), axis=0))


# From here on, checked by test_survey.py.
_ONE_SIDE = math.radians(45.0)  # Landmarks seen from directions within less than this were seen from one side
_WRONG = 0.3  # Share of sightings that contradict a landmark from which it is named
_VAGUE_M, _VAGUE = 0.01, 3.0
"""A landmark is named if its sigma exceeds this [m] and this multiple of the median sigma."""
_WORSE = 1.5  # One that was seen from one side is named if its sigma exceeds the median by this factor
_SCALE = [(one.section, one.name) for one in SURVEY].index(("sensor", "distance_scale"))
_POLAR_SIGMA = 0.1  # Standard deviation of scales of cameras that measure ranges and bearings
_LOOSE = (("odometry", "distance_scale"), ("sensor", "distance_scale"), ("sensor", "range_offset"))
"""Parameters whose errors the filter can estimate."""
_LEAST_LOOSE = 1e-3  # Smaller standard deviations of them are left out
_KNOWN_SCALE = 0.01  # Standard deviation of the map's scale up to which they stay as they are described
_LINEAR = 0.04  # Changes of scales from which derivatives are computed again
_SIGNIFICANT = 3.0  # Parameters are written if they exceed this many of their standard deviations


@dataclass(frozen=True)
class Surveyed:
    """What was found."""

    swarm: Swarm  # The description with all connected landmarks and corrected parameters
    problem: BatchProblem  # What was solved
    solution: Solution  # How
    path: FloatArray  # (k, 3) poses in map of the robots at the knots; NaN: not connected
    text: str  # Table of the landmarks, corrected parameters, and what is badly determined


def survey(
    recording: Recording, swarm: Swarm, progress: Progress = unwatched, *, cameras: bool = False
) -> Surveyed:
    """Find the landmarks and anchors of a recording in which robots drove around.

    Landmarks that `swarm` describes, and starts, give the frame; without any, the first pose of the robot
    that has seen most is the origin. With `cameras`, described fixed cameras are placed again.

    Raises:
        CalibrationError: Nobody has moved, or no marker that belongs to nobody was seen often enough.
    """
    if not recording.odometry.robot.size:
        raise CalibrationError(f"'{recording.name}' has no odometry, which a survey needs.")
    progress(0.0, "reading")
    problem = problem_of(recording, swarm, SURVEY)
    if not problem.swarm.landmarks or not np.any(problem.sightings.landmark >= 0):
        raise CalibrationError(
            f"'{recording.name}' has no marker that belongs to nobody and was seen {MIN_SIGHTINGS} times."
        )
    problem, solution = _solved(recording, swarm, problem, progress)
    shared = shared_by_places(solution)
    found = replace(
        _calibrated(swarm, solution, shared),
        landmarks=placed(solution, shared).landmarks,
        map_error=shared.error,
    )
    fixed = place_fixed(recording, found, solution.at, cameras=cameras)
    found = replace(found, cameras=fixed.cameras, anchors=fixed.anchors)
    path = se2.compose(solution.knot, problem.knots.sample.pose)
    return Surveyed(found, problem, solution, path, _text(problem, solution, swarm, found, fixed))


def _solved(
    recording: Recording, swarm: Swarm, problem: BatchProblem, progress: Progress
) -> tuple[BatchProblem, Solution]:
    """The solution, and the problem: with derivatives at other cameras, if these differ much as described."""
    # scales of cameras that measure ranges and bearings are known less
    sigma = np.tile([one.sigma for one in SURVEY], (len(swarm.robots), 1))
    polar = np.unique(problem.sightings.observer[problem.is_polar])
    sigma[polar, _SCALE] = _POLAR_SIGMA
    prior = ParameterPrior(np.zeros_like(sigma), sigma)
    solution = Solver(problem, start_of(problem), prior).solve(progress)
    if np.abs(solution.parameter[polar, _SCALE]).max(initial=0.0) < _LINEAR:
        return problem, solution
    # again
    change = np.where([one.moves for one in SURVEY], 0.0, solution.parameter)
    problem = problem_of(recording, all_changed(swarm, SURVEY, change), SURVEY)
    nowhere = np.full((len(swarm.robots), 3), np.nan)
    start = Start(nowhere, solution.landmark, solution.knot, solution.parameter - change)
    solution = Solver(problem, start, prior._replace(mean=-change)).solve(progress)
    return problem, replace(solution, parameter=solution.parameter + change)


def _calibrated(swarm: Swarm, solution: Solution, shared: SharedError) -> Swarm:
    """The swarm with those parameters corrected that differ significantly; turn biases are not constant.

    Those that share the error of the map's scale are left to the filter. It takes them as independent, so
    they are less certain, lest all together they tell the scale of the map better than the survey does.
    """
    is_clear = np.abs(solution.parameter) > _SIGNIFICANT * solution.parameter_sigma
    is_clear &= np.array([one.name != "turn_bias" for one in SURVEY])
    found = all_changed(swarm, SURVEY, np.where(is_clear, solution.parameter, 0.0))
    if shared.error.scale_sigma < _KNOWN_SCALE:
        return found
    sigma, robots = math.sqrt(len(_LOOSE) * len(found.robots)) * np.abs(shared.parameter), []
    for index, robot in enumerate(found.robots):
        models = {section: getattr(robot, section) for section, _ in _LOOSE}
        for column, (section, name, _) in enumerate(SURVEY):
            key, wanted = f"{name}_sigma", min(float(sigma[index, column]), 1.0)
            if (section, name) in _LOOSE and wanted > max(_LEAST_LOOSE, getattr(models[section], key)):
                models[section] = replace(models[section], **{key: wanted})
        robots.append(replace(robot, **models))
    return replace(found, robots=tuple(robots))


def _text(problem: BatchProblem, solution: Solution, before: Swarm, found: Swarm, placed: Placed) -> str:
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
            *(
                *corrections(before, found, SURVEY),
                *_frame(problem),
                *_remarks(problem, solution),
                *placed.remarks,
            ),
        ]
    )


def _is_wrong(solution: Solution) -> BoolArray:
    return np.asarray(solution.used & (solution.weight < 0.1))


def _frame(problem: BatchProblem) -> list[str]:
    if problem.is_known.any():
        return [f"The frame is that of the {int(problem.is_known.sum())} described landmarks."]
    if any(robot.start is not None for robot in problem.swarm.robots):
        return ["The frame is that of the described starts of robots."]
    return ["The origin is the first pose of one robot, since no landmark and no start is described."]


def _remarks(problem: BatchProblem, solution: Solution) -> list[str]:
    """What is badly determined, a sentence each with a remedy."""
    sightings, remarks = problem.sightings, []
    # markers that were seen rarely
    for marker_id, count in sorted(problem.rare.items()):
        remarks.append(f"Marker {marker_id} was seen {count} x only and is left out; drive past it.")
    # what nothing connects with the rest
    placed = np.isfinite(solution.landmark[:, 0])
    apart = [str(mark.id) for mark, is_in in zip(problem.swarm.landmarks, placed, strict=True) if not is_in]
    moved = np.unique(problem.knots.robot).tolist()
    located = {robot for robot in moved if np.isfinite(solution.knot[problem.knots.robot == robot]).all()}
    lone = [problem.swarm.robots[robot].name for robot in moved if robot not in located]
    if apart or lone:
        said = ", ".join([*(f"robot {name}" for name in lone), *(f"landmark {name}" for name in apart)])
        remarks.append(
            f"{said[:1].upper()}{said[1:]} cannot be placed: nothing connects them with the others; let"
            " robots of both parts pass the same landmarks, or each other."
        )
    # landmarks that are contradicted, vague, or seen from one side
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


_LEAST_SHARE = 0.02
"""Size of the largest ellipse, as a share of the arena, to which all are enlarged if they are smaller."""


def draw(done: Surveyed, path: Path) -> Path:
    """Write a PNG."""
    problem, solution = done.problem, done.solution
    placed = np.isfinite(solution.landmark[:, 0])
    places = solution.landmark[placed, :2]
    # paths of the robots
    figure = Figure(figsize=(8.0, 7.0))
    axis = figure.subplots()
    axis.set_aspect("equal")
    for robot in np.unique(problem.knots.robot).tolist():
        own = done.path[problem.knots.robot == robot]
        axis.plot(own[:, 0], own[:, 1], color=colour_of(robot), linewidth=0.8, alpha=0.6)
        name = problem.swarm.robots[robot].name
        if np.isfinite(own).all():
            axis.annotate(name, own[0, :2].tolist(), fontsize=8, color=colour_of(robot))
    # landmarks with ellipses, enlarged if the largest is small
    size = float(np.ptp(places, axis=0).max()) if len(places) else 1.0
    covariances = solution.landmark_covariance[placed]
    largest = 3.0 * math.sqrt(np.linalg.eigvalsh(covariances[:, :2, :2]).max(initial=0.0))
    factor = _LEAST_SHARE * size / largest if largest > 0.0 else 1.0
    factor = factor if factor > 1.5 else 1.0
    for pose, covariance in zip(solution.landmark[placed], covariances, strict=True):
        draw_ellipse(axis, pose, covariance, factor, SOFT)
        ahead = 0.02 * size * np.array([math.cos(pose[2]), math.sin(pose[2])])
        axis.plot(*np.stack([pose[:2], pose[:2] + ahead]).T, color=INK, linewidth=1.5)
    # ids of landmarks, cameras and anchors
    marks = [mark for mark, is_in in zip(problem.swarm.landmarks, placed, strict=True) if is_in]
    for mark, place in zip(marks, places.tolist(), strict=True):
        axis.annotate(str(mark.id), place, (4, 4), textcoords="offset points", fontsize=7, color=INK)
    fixed = [(one.name, one.x, one.y, "s") for one in done.swarm.cameras]
    fixed += [(hex(one.address), one.x, one.y, "^") for one in done.swarm.anchors]
    for name, x, y, symbol in fixed:
        axis.plot(x, y, symbol, color=INK, markersize=7)
        axis.annotate(name, (x, y), (6, 4), textcoords="offset points", fontsize=8, color=INK)
    note = f"3-sigma ellipses, enlarged {factor:.0f} x" if factor > 1.0 else "3-sigma ellipses"
    style(axis, f"{len(marks)} landmarks ({note})", *IN_MAP)
    save(figure, path)
    return path
