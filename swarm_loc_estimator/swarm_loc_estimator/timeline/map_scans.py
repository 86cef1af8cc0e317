"""Localization of robots with lidars in a known map: each scan becomes an absolute fix.

The timeline matches a scan when its turn comes, at its stamp, from the pose predicted then, and again when
older data arrive. So poses do not depend on the order of arrival. Scans of a robot that is not located
search the map for its place, see `map_search.py`.

Each occupied cell gets the line of the wall around it, by the moments of the occupied cells nearby. A beam is
compared with the line at the occupied cell that is nearest to its end: r = n.(p - c). Gauss-Newton steps with
a Cauchy loss begin at the predicted pose, and go no way that the walls do not tell.

Errors of beams are not independent: what is wrong with a piece of wall is wrong for all beams that meet it.
n beams on one piece have the information 1 / (m + s/n) with the variances m of the map and s of a range.
Errors that whole walls share remain for any number of pieces, and are added to the covariance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.se2 import between, compose, wrap_angle
from swarm_loc_estimator.filter.measurements import LossReason, Measurements, Verdict
from swarm_loc_estimator.filter.models import CARTESIAN, POSE_GATE
from swarm_loc_estimator.filter.sources import CONFIRMED, RELIEF
from swarm_loc_estimator.filter.state import SwarmState, robot_columns
from swarm_loc_estimator.mapping.grid import OccupancyMap
from swarm_loc_estimator.mapping.map_file import MapFileError
from swarm_loc_estimator.mapping.messages import (
    DelayBelief,
    LidarSweep,
    at_odometry,
    described_delay,
    learned_delay,
)
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.sensors.fix import about_robots
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.estimate import TrackedLimits, estimate_at
from swarm_loc_estimator.timeline.settings import Settings

# The constants of matching to a map are checked by `make bench-lidar`, part lidar_map.
_WALL_M, _MIN_WINDOW = 0.12, 2
"""Half the side of the window in which the line of a wall is fitted [m], and at least this many cells."""
_SURFACE = 1.5  # Depth in cells up to which occupied cells are the surface of a wall, and not its inside
_MAX_THICKNESS, _MIN_LENGTH = 1.1, 1.6
"""Maximum standard deviation across a line in cells, and minimum ratio of that along it to it."""
REACH_M = 0.6  # Maximum distance from the end of a beam to its wall [m]
_PIECE_M = 0.25  # Side of the squares that share the errors of a map [m]
_SHARED, _SHARED_TURN = 0.5, 0.1
"""Shares of the map's variance that remain in the position, and at the mean distance in the heading."""
_CAUCHY = 6.0  # Square of the scale of the Cauchy loss, in variances
_STEPS, _FINE_FROM = 12, 5  # Number of Gauss-Newton steps, and the one from which only near walls count
_NEAR_M, _NEAR_SIGMAS = 0.05, 3.0  # Up to this distance, two cells and these sigmas a beam fits a wall
_IMITATED = 5.0  # Information over what errors of normals imitate, below which it is no information
_MIN_INFORMATION = 4.0  # Information below which a direction is not determined [1/m^2]
UNDETERMINED_SIGMA = 2.0
"""Standard deviation where walls tell nothing [m, or rad times the mean range]; robots are lost before."""
_THROUGH_M = 0.25  # A beam that ends farther than this beyond a wall has gone through it [m]
_MAX_MISFIT = 9.0  # Of a beam, in variances
_MIN_BEAMS, _MIN_FIT, _MAX_THROUGH = 20, 0.5, 0.1
"""Minimum number and share of beams that fit, and maximum share of beams that go through walls."""

UNKNOWN, FREE, WALL = 0, 1, 2


FITS, OFF_MAP, BLOCKED, FAR = 0, 1, 2, 3
"""Outcomes of a match: it fits; beams go through walls; most beams end where the map is free, or too few are
comparable; it fits, but far from the prediction."""


class WallMap(NamedTuple):
    """A map prepared for matching."""

    corner: FloatArray  # (2,) its lower left corner [m]
    cell: float  # [m]
    kind: NDArray[np.int8]  # (nx, ny) unknown, free or wall
    nearest: NDArray[np.int32]  # (nx, ny) number of the nearest wall cell; -1: none within `REACH_M`
    # (w, 4) a point x, y [m] and the normal x, y of the wall at each wall cell; normal 0: no line
    line: FloatArray
    normal_variance: FloatArray  # (w,) of the direction of the normal [rad^2]
    variance: float  # Of the place of a wall; of `wall_map` that of cells alone [m^2]


class Match(NamedTuple):
    """A sweep matched to a map."""

    outcome: int  # `FITS`, `OFF_MAP`, `BLOCKED` or `FAR`
    pose: FloatArray  # (3,) x [m], y [m], theta [rad]
    covariance: FloatArray  # (3, 3) of the pose, of `UNDETERMINED_SIGMA` where walls tell nothing
    determined: int  # Number of directions that walls tell, of 3
    fitting: float  # Share of the comparable beams that fit walls
    through: float  # Share of those that go through walls
    misfit: float  # Mean squared distance of the comparable beams from walls, in variances


def wall_map(occupancy: OccupancyMap, path: Path) -> WallMap:
    """Prepare a map for matching; its file is for errors.

    Raises MapFileError if no cell is occupied, or none is free.
    """
    occupied, free, cell = occupancy.occupied, occupancy.free, occupancy.cell
    for what, some in (("occupied", occupied), ("free", free)):
        if not some.any():
            raise MapFileError(f"The map '{path}' has {some.size} cells but none that is {what}.")
    surface = occupied & (scipy.ndimage.distance_transform_edt(occupied) <= _SURFACE)
    away, place = scipy.ndimage.distance_transform_edt(~surface, return_indices=True)
    cells: IntArray = np.argwhere(surface)
    number = np.full(occupied.shape, -1, dtype=np.int32)
    number[surface] = np.arange(len(cells))
    nearest = np.where(away * cell <= REACH_M, number[tuple(place)], -1).astype(np.int32)
    line, normal_variance = _lines(surface, cells, max(_MIN_WINDOW, round(_WALL_M / cell)))
    line[:, :2] = occupancy.corner + (line[:, :2] + 0.5) * cell
    kind = np.where(occupied, WALL, np.where(free, FREE, UNKNOWN)).astype(np.int8)
    corner: FloatArray = np.array(occupancy.corner, dtype=float)
    return WallMap(corner, cell, kind, nearest, line, normal_variance, cell**2 / 12.0)


@cached_njit
def _lines(surface: BoolArray, cells: IntArray, window: int) -> tuple[FloatArray, FloatArray]:
    """Lines (w, 4) at wall cells (w, 2) and variances (w,) of their normals, in units of cells."""
    line, normal_variance = np.zeros((len(cells), 4)), np.zeros(len(cells))
    for k in range(len(cells)):
        i, j = cells[k]
        count, x, y, xx, xy, yy = 0, 0.0, 0.0, 0.0, 0.0, 0.0
        for a in range(max(0, i - window), min(surface.shape[0], i + window + 1)):
            for b in range(max(0, j - window), min(surface.shape[1], j + window + 1)):
                if surface[a, b]:
                    u, v = float(a - i), float(b - j)
                    count += 1
                    x, y, xx, xy, yy = x + u, y + v, xx + u * u, xy + u * v, yy + v * v
        x, y = x / count, y / count
        xx, xy, yy = xx / count - x * x, xy / count - x * y, yy / count - y * y
        half, spread = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
        across, along = max(half - spread, 1.0 / 12.0), half + spread
        line[k, 0], line[k, 1] = i + x, j + y
        if across <= _MAX_THICKNESS**2 and along >= _MIN_LENGTH**2 * across and along >= 1.0:
            angle = 0.5 * math.atan2(2.0 * xy, xx - yy) + 0.5 * math.pi
            line[k, 2], line[k, 3] = math.cos(angle), math.sin(angle)
            normal_variance[k] = across / (count * along)
    return line, normal_variance


@cached_njit
def _cell_of(walls: WallMap, x: float, y: float) -> tuple[int, int]:
    """The cell of a point; (-1, -1) outside of the map."""
    i, j = math.floor((x - walls.corner[0]) / walls.cell), math.floor((y - walls.corner[1]) / walls.cell)
    inside = 0 <= i < walls.kind.shape[0] and 0 <= j < walls.kind.shape[1]
    return (i, j) if inside else (-1, -1)


@cached_njit
def match(
    walls: WallMap,
    ends: FloatArray,
    origin: FloatArray,
    variance: FloatArray,
    predicted: FloatArray,
    covariance: FloatArray,
) -> Match:
    """Match a sweep to a map from a predicted pose (3,) with its covariance (3, 3).

    `ends` (n, 2) are of beams that met something, in the frame of the robot, `origin` (2,) is the lidar there
    [m], `variance` (n,) that of the distances [m^2].
    """
    pose, scale = predicted.copy(), 1.0
    for k in range(len(ends)):
        scale += math.hypot(ends[k, 0], ends[k, 1])
    scale /= 1.0 + len(ends)
    spread = math.sqrt(covariance[0, 0] + covariance[1, 1] + scale * scale * covariance[2, 2])
    inverse, result, determined = np.zeros((3, 3)), np.zeros((3, 3)), 0
    for step in range(_STEPS):
        reach = min(REACH_M, 3.0 * spread) if step < _FINE_FROM else 0.0
        information, imitated, gradient = normal_equations(walls, ends, origin, variance, pose, reach)
        inverse, result, determined = _inverted(information, imitated, scale)
        change = np.dot(inverse, gradient)
        for i in range(3):
            pose[i] += change[i]
        if step >= _FINE_FROM and np.dot(change[:2], change[:2]) + (scale * change[2]) ** 2 < 1e-8:
            break
    for i in range(3):
        result[i, i] += walls.variance * (_SHARED_TURN / (scale * scale) if i == 2 else _SHARED)
    fitting, blocked, through, misfit = _classified(walls, ends, origin, variance, pose)
    tried = max(fitting + blocked + through, 1)
    result *= max(1.0, misfit / tried)  # the map errs more than is described
    shift = pose - predicted
    distance = np.dot(shift, np.linalg.solve(covariance + result, shift))
    outcome = FITS
    if through > _MAX_THROUGH * tried and through >= _MIN_BEAMS / 2:
        outcome = OFF_MAP
    elif fitting < _MIN_BEAMS or fitting < _MIN_FIT * tried:
        outcome = BLOCKED
    elif distance > POSE_GATE:
        outcome = FAR
    return Match(outcome, pose, result, determined, fitting / tried, through / tried, misfit / tried)


@cached_njit
def normal_equations(
    walls: WallMap, ends: FloatArray, origin: FloatArray, variance: FloatArray, pose: FloatArray, reach: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The information (3, 3) of a sweep on a pose (3,), the part that normals imitate, and the gradient (3,).

    `reach` is the maximum distance from a wall [m]; 0: each beam's own. For the sweep see `match`.
    """
    count, cos, sin = len(ends), math.cos(pose[2]), math.sin(pose[2])
    rows, residual, noise = np.zeros((count, 6)), np.zeros(count), np.zeros(count)
    piece, imitation = np.full(count, -1), np.zeros(count)
    size = walls.cell * walls.kind.shape[1]
    width = int(size / _PIECE_M) + 1
    beams = np.zeros((int(walls.cell * walls.kind.shape[0] / _PIECE_M) + 1) * width, dtype=np.int64)
    # each beam that ends near a wall: its residual r = n.(p - c), derivatives, noise, and piece of wall
    for k in range(count):
        arm_x, arm_y = cos * ends[k, 0] - sin * ends[k, 1], sin * ends[k, 0] + cos * ends[k, 1]
        i, j = _cell_of(walls, pose[0] + arm_x, pose[1] + arm_y)
        wall = walls.nearest[i, j] if i >= 0 else -1
        if wall < 0 or (walls.line[wall, 2] == 0.0 and walls.line[wall, 3] == 0.0):
            continue
        x, y, nx, ny = walls.line[wall]
        off = nx * (pose[0] + arm_x - x) + ny * (pose[1] + arm_y - y)
        if abs(off) > (reach if reach > 0.0 else _near(walls, variance[k])):
            continue
        ux, uy = ends[k, 0] - origin[0], ends[k, 1] - origin[1]
        incidence = (nx * (cos * ux - sin * uy) + ny * (sin * ux + cos * uy)) / max(math.hypot(ux, uy), 1e-9)
        residual[k], noise[k] = -off, variance[k] * incidence * incidence
        rows[k, 0], rows[k, 1], rows[k, 2] = nx, ny, -nx * arm_y + ny * arm_x
        rows[k, 3], rows[k, 4], rows[k, 5] = -ny, nx, ny * arm_y + nx * arm_x
        imitation[k] = walls.normal_variance[wall]
        piece[k] = int((x - walls.corner[0]) / _PIECE_M) * width + int((y - walls.corner[1]) / _PIECE_M)
        beams[piece[k]] += 1
    # sums over beams; n on a piece have the information 1 / (m + s/n) together, and the loss is Cauchy's
    information, imitated, gradient = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
    for k in range(count):
        if piece[k] < 0:
            continue
        loss_scale = max(walls.variance + noise[k], (reach / 3.0) ** 2)
        weight = 1.0 / (beams[piece[k]] * walls.variance + noise[k])
        weight /= 1.0 + residual[k] * residual[k] / (_CAUCHY * loss_scale)
        for a in range(3):
            gradient[a] += weight * rows[k, a] * residual[k]
            for b in range(3):
                information[a, b] += weight * rows[k, a] * rows[k, b]
                imitated[a, b] += weight * imitation[k] * rows[k, 3 + a] * rows[k, 3 + b]
    return information, imitated, gradient


@cached_njit
def _near(walls: WallMap, variance: float) -> float:
    """Distance up to which a beam with this variance fits a wall [m]."""
    sigmas = _NEAR_SIGMAS * math.sqrt(variance + walls.variance)
    return max(_NEAR_M, 2.0 * walls.cell, sigmas)


@cached_njit
def _inverted(
    information: FloatArray, imitated: FloatArray, scale: float
) -> tuple[FloatArray, FloatArray, int]:
    """The inverse (3, 3) of an information, 0 where it tells nothing; the covariance; directions known."""
    unit = np.diag(np.array([1.0, 1.0, 1.0 / scale]))
    values, axes = np.linalg.eigh(np.dot(unit, np.dot(information, unit)))
    vectors = np.ascontiguousarray(axes.T)
    inverse, covariance, determined = np.zeros((3, 3)), np.zeros((3, 3)), 0
    for m in range(3):
        axis = np.dot(unit, vectors[m])
        known = values[m] > max(_MIN_INFORMATION, _IMITATED * np.dot(axis, np.dot(imitated, axis)))
        value = 1.0 / values[m] if known else UNDETERMINED_SIGMA**2
        determined += int(known)
        for a in range(3):
            for b in range(3):
                covariance[a, b] += value * axis[a] * axis[b]
                inverse[a, b] += value * axis[a] * axis[b] if known else 0.0
    return inverse, covariance, determined


@cached_njit
def _classified(
    walls: WallMap, ends: FloatArray, origin: FloatArray, variance: FloatArray, pose: FloatArray
) -> tuple[int, int, int, float]:
    """Numbers of beams that fit, end where it is free, and go through walls; the sum of squared distances."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    from_x = pose[0] + cos * origin[0] - sin * origin[1]
    from_y = pose[1] + sin * origin[0] + cos * origin[1]
    fitting, blocked, through, misfit = 0, 0, 0, 0.0
    for k in range(len(ends)):
        x = pose[0] + cos * ends[k, 0] - sin * ends[k, 1]
        y = pose[1] + sin * ends[k, 0] + cos * ends[k, 1]
        i, j = _cell_of(walls, x, y)
        wall, near = (walls.nearest[i, j] if i >= 0 else -1), _near(walls, variance[k])
        away = _distance(walls.line[wall], x, y) if wall >= 0 else math.inf
        if away <= near:
            fitting += 1
            misfit += min(away * away / (variance[k] + walls.variance), _MAX_MISFIT)
        elif _goes_through(walls, from_x, from_y, x, y, max(_THROUGH_M, near)):
            through += 1
        elif i >= 0 and walls.kind[i, j] == FREE:
            blocked += 1
    return fitting, blocked, through, misfit + _MAX_MISFIT * (blocked + through)


@cached_njit
def _distance(line: FloatArray, x: float, y: float) -> float:
    """Distance of a point from a wall, or from its place where it has no line [m]."""
    if line[2] == 0.0 and line[3] == 0.0:
        return math.hypot(x - line[0], y - line[1])
    across: float = line[2] * (x - line[0]) + line[3] * (y - line[1])
    return abs(across)


@cached_njit
def are_near_walls(walls: WallMap, points: FloatArray, near: float) -> BoolArray:
    """Which points (n, 2) are nearer to a wall than this [m]."""
    out = np.zeros(len(points), dtype=np.bool_)
    for k in range(len(points)):
        i, j = _cell_of(walls, points[k, 0], points[k, 1])
        wall = walls.nearest[i, j] if i >= 0 else -1
        out[k] = wall >= 0 and _distance(walls.line[wall], points[k, 0], points[k, 1]) < near
    return out


@cached_njit
def _goes_through(walls: WallMap, from_x: float, from_y: float, x: float, y: float, margin: float) -> bool:
    """Whether a wall cell lies on the way to a point, farther than a margin before it [m]."""
    way = math.hypot(x - from_x, y - from_y)
    count = int((way - margin) / (0.7 * walls.cell))
    for k in range(count + 1 if way > margin else 0):
        share = k * 0.7 * walls.cell / way
        i, j = _cell_of(walls, from_x + share * (x - from_x), from_y + share * (y - from_y))
        if i >= 0 and walls.kind[i, j] == WALL:
            return True
    return False


_SYSTEMATIC_SHARE = 0.7
"""Share of a match's variance that the next scans have, too: what is wrong with the map at a place."""
_ALIKE_M, _ROUGH_M = 2.0, 0.02
"""Distance within which errors of a map are alike, and their part that is not alike from scan to scan [m]."""
_MAX_MISSED, _MAX_AT_START = 10.0, 3.0
"""Fault scores at which a robot is lost whose scans contradict the map, and before its start is confirmed."""
ALL, SURE_FIT = 3, 0.65
"""Number of directions and share of fitting beams with which a scan confirms a start: elsewhere, walls like
those at home are seen now and then."""
_LEFT_OUT, _LEFT_OUT_SHARE = np.array([0.1, 0.1, 0.1]), 0.2
"""Motion that odometry has left out [m, m, rad], and share of a motion by which calibration changes it."""
_NEARLY_LOST = 0.7  # Standard deviation, over that of a lost robot, from which nothing is known of a motion
_ORDER_TURN, _ORDER_KNOWN = 0.03, 12.0
"""Turn during a sweep that tells in which order its beams are measured [rad], and log odds that settle it."""
_ORDER_WEIGHT, _ORDER_NEWS, _ORDER_SLACK = 10.0, 4.0, 0.5
"""Log odds of this order by the misfit of a scan, whose beams err together, the most by a scan, and what
of a difference of misfits errors of a wall imitate again and again."""
_BACKED_NS = 1_000_000_000  # How long another lidar's scan that fits speaks for the pose
_GATED = 12.0  # Squared distance of a scan from the prediction from which it is of little use to the filter
DECLINE = 0.07  # How much better than others a place explains the scan by which it was found: it fits it best
Sweeps = Mapping[tuple[int, int], LidarSweep]  # Sweeps by robot and stamp of the first beam [ns]
SoughtAround = Callable[..., "FoundPlace | None"]  # As `MapSearch.around`


class FoundPlace(NamedTuple):
    """The place where a robot is."""

    pose: FloatArray  # (3,)
    covariance: FloatArray  # (3, 3)
    is_certain: bool = False  # Whether the one scan by which it was found tells it alone


class MapScans:
    """Matches scans to the known map; sweeps are by robot and stamp."""

    def __init__(self, swarm: Swarm, settings: Settings, tracks: OdometryTracks, sweeps: Sweeps) -> None:
        self.tracks, self._sweeps = tracks, sweeps
        self._limits = TrackedLimits.of(swarm, settings)

    @staticmethod
    def walls_for(sweep: LidarSweep, walls: WallMap) -> WallMap:
        """The map with the error that the description of a lidar says."""
        return walls._replace(variance=walls.variance + sweep.lidar.map_sigma**2)

    def fix_of(
        self, state: SwarmState, one: Measurements, sweep: LidarSweep, sought: SoughtAround
    ) -> tuple[Measurements | FoundPlace | None, Verdict, bool]:
        """Match the scan of a located robot; its fix (1,), or None and why, and if it confirms a pose.

        `sweep` has its beams that may end at walls. The place of a robot that was elsewhere than predicted is
        `sought`, see `MapSearch.around`, and returned. Once a scan contradicts its pose, the robot is not
        tracked until one scan alone tells its place, or the motion between two scans agrees with odometry, of
        which the second tells all directions if the robot was found elsewhere. A lidar that contradicts
        another one of its robot moves nothing, and is not used once it does so again and again.
        Fault scores of the state, which has a map, and what is known of the times of the beams are changed.
        """
        robot, stamp_ns, driven = int(one.target), int(one.stamp_ns), 0.0
        lidar = robot, sweep.number
        estimate = estimate_at(state, self.tracks.arrays, self._limits, stamp_ns)
        pose, covariance = estimate.poses[robot], estimate.covariances[robot]
        walls = self.walls_for(sweep, state.map.walls)
        # The scan may be older than its stamp says.
        delay = state.delays.get(lidar) or described_delay(sweep.lidar.delay_s)
        best = int(delay.chance.argmax())
        beams, now, track = self.beams(robot, stamp_ns, sweep, delay.lag_s, best)
        back = between(now, track[best])
        _, doubt = at_odometry(delay._replace(seen=compose(pose, back), track=track), now)
        covariance = covariance + doubt
        found = match(walls, *beams, pose, covariance)
        # Its beams may be measured in the other order.
        is_open = abs(delay.backwards) < _ORDER_KNOWN and self.turned(robot, sweep) > _ORDER_TURN
        if is_open or delay.backwards > 0.0:
            reversed_beams, _, _ = self.beams(robot, stamp_ns, sweep.backwards(), delay.lag_s, best)
            other = match(walls, *reversed_beams, pose, covariance)
            less = found.misfit - other.misfit
            news = _ORDER_WEIGHT * math.copysign(max(0.0, abs(less) - _ORDER_SLACK), less)
            news = min(max(news, -_ORDER_NEWS), _ORDER_NEWS)
            is_clear = any(one.outcome == FITS and one.fitting >= SURE_FIT for one in (found, other))
            delay = delay._replace(backwards=delay.backwards + (news if is_open and is_clear else 0.0))
            if delay.backwards > 0.0:
                found, beams = other, reversed_beams
        state.delays[lidar] = delay
        # Another lidar of the robot may have fit just now, which this one contradicts.
        others = [one for key, one in state.delays.items() if key[0] == robot and key != lidar]
        is_backed = any(stamp_ns - one.fit_ns < _BACKED_NS and not one.is_doubted for one in others)
        if found.outcome == FITS and found.fitting >= SURE_FIT:
            delay = state.delays[lidar] = delay.judged(stamp_ns, fits=True)
        elif found.outcome in (OFF_MAP, FAR) and is_backed:
            delay = state.delays[lidar] = delay.judged(stamp_ns, fits=False)
            if delay.is_doubted:
                state.sources.confirmations[robot] = min(state.sources.confirmations[robot], CONFIRMED)
            return None, Verdict.OFF_MAP, False
        if delay.is_excluded or (found.outcome == BLOCKED and is_backed):
            return None, Verdict.BLOCKED if found.outcome == BLOCKED else Verdict.OFF_MAP, False
        # Odometry may have left out a motion, which it reports or not, or the pose was wrong before.
        anchor = np.stack([found.pose, now, self.tracks.at(np.array([robot]), np.array([stamp_ns])).raw[0]])
        reported, follows = self._left_out(delay, anchor, covariance)
        fits = found.outcome in (FITS, FAR) and found.fitting >= SURE_FIT
        away = squared_distance(found.pose, pose, covariance + found.covariance)
        is_known = reported is not None or (follows and fits and away > _GATED)
        confirmations = state.sources.confirmations[robot]
        confirmed, is_doubted = confirmations >= CONFIRMED, confirmations == CONFIRMED
        is_lost = is_known or not fits
        may_search = confirmed and (reported is not None or not is_backed)
        if may_search and (is_lost or is_doubted or found.outcome == FAR):
            least = SURE_FIT if is_known or fits else max(SURE_FIT, found.fitting + DECLINE)
            place = sought(state.map._replace(walls=walls), *beams, pose, covariance, reported, least)
            if place is not None and (is_lost or place.is_certain):
                anchor[0] = place.pose
                delay = state.delays[lidar] = delay._replace(anchor=anchor, stamp_ns=-1)
                if squared_distance(place.pose, pose, covariance + place.covariance) > _GATED:
                    delay = delay._replace(is_sought=not place.is_certain)
                    self.found_elsewhere(state, lidar, delay, stamp_ns)
                return place, Verdict.USED, place.is_certain
        # It tells the lag, and is scored.
        if found.outcome == FITS or (found.outcome == FAR and confirmed):
            if delay.stamp_ns > 0:
                best = int(delay.chance.argmax())
                driven = math.dist(delay.track[best, :2], track[best, :2])
            # of the errors of the map, scans share those that are alike where both were
            own = min(1.0, (state.map.walls.variance + _ROUGH_M**2) / walls.variance)
            own += (1.0 - own) * min(1.0, driven / _ALIKE_M)
            delay = learned_delay(delay, stamp_ns, compose(found.pose, back), own * found.covariance, track)
            delay = state.delays[lidar] = delay._replace(anchor=anchor)
        if found.outcome in (OFF_MAP, FAR):
            state.sources.score[robot] += 1.0
            state.sources.confirmations[robot] = min(confirmations, CONFIRMED)
            if state.sources.score[robot] >= (_MAX_MISSED if confirmed else _MAX_AT_START):
                # later ones may fit by chance, elsewhere
                state.deinitialize(robot, LossReason.OFF_MAP, stamp_ns)
            return None, Verdict.OFF_MAP, False
        if found.outcome == BLOCKED:
            return None, Verdict.BLOCKED, False
        state.sources.score[robot] = max(0.0, state.sources.score[robot] - 4.0 * RELIEF)
        # Walls err otherwise where it is now than where it was: the error that it shares with them fades.
        fading = 2.0 * _SYSTEMATIC_SHARE * walls.variance * min(1.0, driven / _ALIKE_M)
        state.filter.add(robot_columns(np.array([robot]))[0], np.diag([fading, fading, 0.0]))
        seen, doubt = at_odometry(delay, now)
        fix = about_robots(robot, stamp_ns, seen[None], (found.covariance + doubt)[None], CARTESIAN)
        fix.systematic_share[:] = _SYSTEMATIC_SHARE
        # With a second solution it locates no robot alone: it was sought near the pose that may be wrong.
        fix.has_second[:], fix.second[:] = True, fix.value
        tells = found.determined >= (ALL - 1 if is_doubted and not delay.is_sought else ALL)
        tells = tells and found.fitting >= SURE_FIT and (follows or not is_doubted)
        tells = tells and not any(one.is_doubted for one in others)
        state.delays[lidar] = delay._replace(is_sought=delay.is_sought and not tells)
        return fix, Verdict.OPEN, tells

    def _left_out(
        self, delay: DelayBelief, anchor: FloatArray, covariance: FloatArray
    ) -> tuple[FloatArray | None, bool]:
        """The pose (3,) by a motion that odometry has left out; whether the scan follows the one before.

        It does if it is matched where that one and odometry put it. `anchor` (3, 3) is that of `DelayBelief`.
        """
        if np.isnan(delay.anchor).any():
            return None, False
        motions = between(delay.anchor, anchor)  # in the map, as odometry is used, and as reported
        motions[:, 2] = wrap_angle(motions[:, 2])
        seen, used, moved = motions
        path, turn = math.hypot(moved[0], moved[1]), abs(moved[2])
        slack = _LEFT_OUT + _LEFT_OUT_SHARE * np.array([path, path, turn])
        limits = self._limits.position_sigma, self._limits.position_sigma, self._limits.heading_sigma
        is_unknown = (np.diag(covariance) > np.square(_NEARLY_LOST * np.array(limits))).any()
        has_left_out = is_unknown or (np.abs(moved - used) > slack).any()
        reported = compose(delay.anchor[0], moved) if has_left_out else None
        return reported, bool((np.abs(seen - used) < slack).all())

    @staticmethod
    def found_elsewhere(state: SwarmState, lidar: tuple[int, int], delay: DelayBelief, stamp_ns: int) -> None:
        """Forget that other lidars of a robot agreed before it was found elsewhere by this one."""
        for key in [key for key in state.delays if key[0] == lidar[0]]:
            state.delays[key] = state.delays[key].elsewhere()._replace(is_sought=delay.is_sought)
        state.delays[lidar] = delay.elsewhere().judged(stamp_ns, fits=True)

    def sweep_of(self, one: Measurements) -> LidarSweep | None:
        """The sweep of a row of a scan; None: it is not kept any more."""
        return self._sweeps.get((int(one.target), int(one.reading)))

    def turned(self, robot: int, sweep: LidarSweep) -> float:
        """How far a robot turned during a sweep, by odometry [rad]."""
        ends_ns = np.array([sweep.stamp_ns, sweep.stamp_ns + sweep.duration_ns])
        first, last = self.tracks.at(np.array([robot, robot]), ends_ns).pose[:, 2]
        return abs(float(last - first))

    def beams(
        self, robot: int, stamp_ns: int, sweep: LidarSweep, lag_s: FloatArray, best: int
    ) -> tuple[tuple[FloatArray, FloatArray, FloatArray], FloatArray, FloatArray]:
        """Beams of a sweep at a lag that met something, from the robot's pose at an instant, see `match`.

        And poses by odometry: then (3,), and in the middle of the sweep at each lag (L, 3).
        """
        lidar, seen, beams = sweep.lidar, sweep.seen, sweep.beam_ns.size
        lag_ns, middle_ns = np.round(1e9 * lag_s).astype(np.int64), sweep.stamp_ns + sweep.duration_ns // 2
        at_ns = np.concatenate([sweep.beam_ns - lag_ns[best], [stamp_ns], middle_ns - lag_ns])
        poses = self.tracks.at(np.full(at_ns.size, robot), at_ns).pose
        ends = sweep.ends(between(poses[beams], poses[:beams]))[seen]
        sigma = lidar.range_sigma + lidar.range_sigma_per_m * sweep.distance[seen]
        return (ends, np.array([lidar.x, lidar.y]), sigma**2), poses[beams], poses[beams + 1 :]


def squared_distance(pose: FloatArray, other: FloatArray, covariance: FloatArray) -> float:
    """Squared distance of two poses (3,), in variances (3, 3)."""
    off = other - pose
    off[2] = wrap_angle(off[2])
    return float(off @ np.linalg.solve(covariance, off))
