"""Where a robot is whose odometry has restarted: the one place in the map that explains what it sees.

Robots turn and drive on while nobody hears them, so nothing before the restart tells their pose. All places
that they may have reached are hypotheses: each is moved by odometry, aligned with the map at each stop, and
scored by what the robot sees. One that explains clearly less than the best one is ruled out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.se2 import between, compose, wrap_angle
from swarm_loc_estimator.mapping.grid import OccupancyMap
from swarm_loc_estimator.mapping.scans import ScanStop

# The constants are checked by `make bench-robustness`, part restart: three halls, 20 instants each.
_WALL_SIGMA, _UNKNOWN = 0.06, 0.7
"""Standard deviation of points from walls [m], and how well a beam fits where the map is unknown."""
_FARTHEST, _BEAMS = 1.9, 120  # Distance up to which beams are compared [m], and their number per stop
_NEAREST = 0.15  # Walls nearer than this may not be seen [m]
_NEW_PLACE = 0.2  # Minimum distance of stops whose scans count separately [m]
_SHIFT, RATES = np.array([0.5, math.radians(15.0)]), np.array([0.3, 3.0])
"""How far a robot is moved by hands [m, rad], and how fast it moves by itself [m/s, rad/s]."""
_APART = np.array([0.15, math.radians(8.0)])  # Distance [m] or turn [rad] from which a place is another one
_STEP, _TURN_STEP = 0.1, math.radians(3.0)  # Of the places that are tried first [m], [rad]
_FINE, _FINE_TURN, _FINE_STEPS = 0.03, math.radians(1.5), 3
"""Of the places around these, and of those after each drive [m, rad], and their number to each side."""
_HELD_STEP, _HELD_COST = 0.15, 0.1
"""Of places along a drive where an obstacle may have held a robot whose wheels turned on: step [m], cost."""
_STEP_COST = 0.002  # What a squared step costs: where the map tells little, odometry is followed
_HYPOTHESES = 100  # Maximum number of places
_RULED_OUT, _OVERTAKEN = 0.5, 0.15
"""By how many scans another place explains more than one that is ruled out, and than one that was found."""
_FITS, _CONTRADICTS = 0.88, 0.7
"""Share of the known beams that must fit the places where a robot is found, at all stops, and to keep it."""
_MIN_KNOWN = 0.4  # Minimum share of beams of which the map says something
_PLACES, _CONFIRMED = 2, 6
"""Number of places from which a robot looks before it is found, and in known parts before its test ends."""
_LIGHT_SIGMA = math.radians(3.0)  # Standard deviation of bearings of lights from stops [rad]


class Light(NamedTuple):
    """The light of a located robot that a lost one sees, or the other way around."""

    stop: ScanStop  # Of the lost robot
    there: FloatArray  # (3,) the other robot, with its heading when it sees the light
    is_seen: bool  # Whether the lost robot sees the light
    turn: float  # Turn of the lost robot since its arrival at the stop, if it sees the light [rad]
    bearing: float  # Of the light, in the frame of the robot that sees it [rad]


@dataclass
class Search:
    """The places (h,) where a robot may be, at each of the stops (k,) since its odometry restarted."""

    near: FloatArray  # (3,) its pose in map before
    pause_s: float  # How long it was not heard
    poses: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 3)))  # (h, k, 3)
    fits: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))  # (h, k) share of beams that fit
    known: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))  # (h, k) of which the map tells
    lit: FloatArray = field(default_factory=lambda: np.zeros(0))  # (h,) number of lights that fit
    held: FloatArray = field(default_factory=lambda: np.zeros(0))  # (h,) number of drives that were held
    stops: list[ScanStop] = field(default_factory=list)  # (k,)
    since: FloatArray = field(default_factory=lambda: np.zeros(3))  # (3,) motion since the last arrival
    left: FloatArray | None = None  # (3,) odometry then
    path: float = 0.0  # Length of the drives since the restart [m]
    lights: list[Light] = field(default_factory=list)  # That are not in `lit` yet
    found: int = -1  # The hypothesis that is taken for true
    first: int = -1  # Its first stop in the graph

    def again(self, more_s: float = 0.0) -> Search:
        """A search that begins now; the robot has not been heard for more time."""
        return Search(self.near, self.pause_s + self.path / RATES[0] + more_s)

    def add(self, stop: ScanStop, ratio: float, occupancy: OccupancyMap) -> bool:
        """Compare a stop with a map of others; true turns are `ratio` times those by odometry.

        Returns whether its scan is a whole one; of others only the motion is used.
        """
        self._move(stop, ratio)
        self.left = stop.arrival if stop.reach else stop.departure
        turned = 0.0 if stop.reach else ratio * float(stop.turn[-1])
        is_whole = stop.reach > 0.0 or stop.turned > 2.0 * math.pi
        if is_whole and occupancy.occupied.any():
            view = _View(occupancy, stop, ratio)
            if not len(self.poses):
                self.stops = []
                self._begin(view, occupancy)
            else:
                before, predicted = self.poses[:, -1], compose(self.poses[:, -1], self.since)
                self._append(view, predicted, (predicted - before)[:, :2])
                best = self.poses[int(self._totals().argmax())]
                if math.dist(best[-1, :2], best[-2, :2]) < _NEW_PLACE:
                    # the same place: its newest scan counts
                    self.poses, self.fits = np.delete(self.poses, -2, 1), np.delete(self.fits, -2, 1)
                    self.known, self.stops = np.delete(self.known, -2, 1), self.stops[:-1]
            self.stops.append(stop)
            self.since = np.zeros(3)
            self._thin()
        self.since = compose(self.since, [0.0, 0.0, turned])
        return is_whole

    def verdict(self) -> int:
        """The hypothesis that explains all and has no rival; -1: none."""
        if not len(self.poses) or self.fits.shape[1] < _PLACES:
            return -1
        total = self._totals()
        likely = total - _RULED_OUT * self.held  # a robot is rarely held, but a rival may have been
        best = int(likely.argmax())
        nowhere = _UNKNOWN * self.fits.shape[1]  # it is where the map is unknown
        rival = total[_apart(self.poses[best, -1], self.poses[:, -1])].max(initial=nowhere)
        known, fits = self.known[best], self.fits[best]
        is_seen = known[-_PLACES:].mean() > _MIN_KNOWN
        # the true place may have been ruled out, and a wrong one that is left fits less and less
        fits_all = all(fits[n:].sum() > _FITS * known[n:].sum() for n in (0, -_PLACES))
        return best if is_seen and fits_all and likely[best] - rival > _RULED_OUT else -1

    @property
    def is_contradicted(self) -> bool:
        """Whether the place that was found does not explain what the robot sees, or another does better."""
        total = self._totals()
        return bool(self._contradicts()[self.found]) or bool(total.max() - total[self.found] > _OVERTAKEN)

    @property
    def is_over(self) -> bool:
        """Whether the place that was found has been confirmed, and all others are ruled out."""
        return len(self.poses) == 1 and (self.known[0] > _MIN_KNOWN).sum() >= _CONFIRMED

    def _contradicts(self) -> BoolArray:
        """Whether the newest scans do not fit each hypothesis (h,)."""
        known, fits = self.known[:, -_PLACES:].sum(axis=1), self.fits[:, -_PLACES:].sum(axis=1)
        return np.asarray((known > _MIN_KNOWN * _PLACES) & (fits < _CONTRADICTS * known))

    def _totals(self) -> FloatArray:
        """How many scans and lights each hypothesis (h,) explains."""
        totals: FloatArray = (self.fits + _UNKNOWN * (1.0 - self.known)).sum(axis=1) + self.lit
        return totals

    def _move(self, stop: ScanStop, ratio: float) -> None:
        """Add the drive to a stop."""
        x, y, turn = between(stop.arrival if self.left is None else self.left, stop.arrival)
        length, course = math.hypot(x, y), ratio * math.atan2(y, x)
        motion = [length * math.cos(course), length * math.sin(course), ratio * turn]
        self.since = compose(self.since, motion)
        self.path += length

    def _begin(self, view: _View, occupancy: OccupancyMap) -> None:
        """Try all places that the robot may have reached unheard."""
        step = max(1, round(_STEP / occupancy.cell))
        places = view.places(step * np.argwhere(occupancy.free[::step, ::step]).astype(float) + 0.5)
        shift, turn = _SHIFT + RATES * (self.pause_s + self.path / RATES[0])
        places = places[np.hypot(*(places - self.near[:2]).T) < shift]
        headings = np.arange(0.0, 2.0 * math.pi, _TURN_STEP)
        headings = headings[np.abs(wrap_angle(headings - self.near[2])) < turn]
        scores = _score_places(view.score, view.walls, view.cells(places), headings)
        # the best ones, each apart from all better ones
        poses = np.column_stack([np.repeat(places, len(headings), axis=0), np.tile(headings, len(places))])
        poses = poses[np.argsort(-scores.ravel(), kind="stable")]
        chosen: list[FloatArray] = []
        while len(poses) and len(chosen) < _HYPOTHESES:
            chosen.append(poses[0])
            poses = poses[_apart(poses[0], poses)]
        self.poses, self.fits, self.known = np.zeros((len(chosen), 0, 3)), *np.zeros((2, len(chosen), 0))
        self.lit, self.held = np.zeros((2, len(chosen)))
        self._append(view, np.array(chosen).reshape(-1, 3), np.zeros((len(chosen), 2)))

    def _append(self, view: _View, predicted: FloatArray, way: FloatArray) -> None:
        """Align hypotheses (h, 3) with the map, and note how well they fit.

        An obstacle may have held the robot anywhere on its way (h, 2) there, while its wheels turned on.
        """
        count = math.ceil(np.hypot(*way.T).max(initial=0.0) / _HELD_STEP)
        best, aligned = np.full(len(predicted), -math.inf), np.zeros_like(predicted)
        steps = np.zeros(len(predicted))
        for step in range(count + 1):
            places = predicted[:, :2] - step / max(1, count) * way
            cells = np.column_stack([view.cells(places), predicted[:, 2]])
            there, scores = _align(view.score, view.walls, cells, _FINE / view.cell)
            scores -= _HELD_COST if step else 0.0
            is_better = scores > best
            aligned[is_better], best[is_better], steps[is_better] = there[is_better], scores[is_better], step
        self.held += steps > 0
        poses = np.column_stack([view.places(aligned[:, :2]), aligned[:, 2]])
        fits, known = _compare(view.score, view.occupied, view.ends, view.hits, aligned, _NEAREST / view.cell)
        self.poses = np.concatenate([self.poses, poses[:, None]], axis=1)
        self.fits = np.column_stack([self.fits, fits])
        self.known = np.column_stack([self.known, known])

    def _thin(self) -> None:
        """Compare lights; drop hypotheses that are wrong, ruled out twice, or where better ones are."""
        for light in (one for one in self.lights if one.stop in self.stops):
            self.lit += _light_fits(light, self.poses[:, self.stops.index(light.stop)])
        self.lights = []
        total, wrong = self._totals(), self._contradicts()
        keep: list[int] = []
        for one in np.argsort(-total, kind="stable").tolist():
            others = self.poses[keep, -1]
            is_good = not wrong[one] and _apart(self.poses[one, -1], others).all()
            if one == self.found or (is_good and total.max() - total[one] < 2.0 * _RULED_OUT):
                keep.append(one)
        self.found = keep.index(self.found) if self.found in keep else -1
        self.poses, self.fits = self.poses[keep], self.fits[keep]
        self.known, self.lit, self.held = self.known[keep], self.lit[keep], self.held[keep]


class _View:
    """What a robot sees from a stop, and a map as scores, in cells.

    Attributes:
        score: (nx, ny) how well a point of a wall fits in each cell.
        ends: (n, 2) ends of beams, in the frame of the robot on arrival [cells].
        hits: (n,) whether they are on walls.
        walls: (m, 2) those that are.
    """

    def __init__(self, occupancy: OccupancyMap, stop: ScanStop, ratio: float) -> None:
        self._occupancy, self.cell = occupancy, occupancy.cell
        self.occupied: BoolArray = occupancy.occupied
        away = self.cell * distance_transform_edt(~self.occupied)
        score = np.exp(-0.5 * (away / _WALL_SIGMA) ** 2)
        self.score: FloatArray = np.where(occupancy.free, score, np.where(score > _UNKNOWN, score, np.nan))
        angle = stop.bearing + ratio * stop.turn
        every = max(1, len(angle) // _BEAMS)
        angle, length = angle[::every], 1.0 / np.maximum(stop.inverse[::every], 1.0 / _FARTHEST)
        self.hits: BoolArray = length < _FARTHEST
        self.ends: FloatArray = np.stack([np.cos(angle), np.sin(angle)], -1) * length[:, None] / self.cell
        self.walls: FloatArray = self.ends[self.hits]

    def cells(self, places: FloatArray) -> FloatArray:
        """Places (n, 2) [m] in cells."""
        cells: FloatArray = (places - self._occupancy.corner) / self.cell
        return cells

    def places(self, cells: FloatArray) -> FloatArray:
        """Places (n, 2) in cells in metres."""
        places: FloatArray = self._occupancy.corner + cells * self.cell
        return places


def _apart(pose: FloatArray, others: FloatArray) -> BoolArray:
    """Whether others (n, 3) are another place than a pose (3,)."""
    off = others - pose
    return np.asarray(
        (np.hypot(off[:, 0], off[:, 1]) > _APART[0]) | (np.abs(wrap_angle(off[:, 2])) > _APART[1])
    )


def _light_fits(light: Light, poses: FloatArray) -> FloatArray:
    """How well a light fits poses (h, 3) of the lost robot on arrival at its stop, from 0 to 1."""
    seer, seen = (poses, light.there) if light.is_seen else (light.there, poses)
    x, y, _ = np.moveaxis(seen - seer, -1, 0)
    heading = seer[..., 2] + (light.turn if light.is_seen else 0.0)
    sigma = np.hypot(_LIGHT_SIGMA, _APART[0] / 2.0 / np.maximum(np.hypot(x, y), 1e-3))
    off = wrap_angle(np.arctan2(y, x) - heading - light.bearing)
    fits: FloatArray = np.exp(-0.5 * (off / sigma) ** 2)
    return fits


@cached_njit
def _at(score: FloatArray, x: float, y: float) -> float:
    """The score at a place [cells]; NaN where the map is unknown."""
    i, j = math.floor(x), math.floor(y)
    return float(score[i, j]) if 0 <= i < score.shape[0] and 0 <= j < score.shape[1] else math.nan


@cached_njit
def _mean_score(score: FloatArray, walls: FloatArray, x: float, y: float, heading: float) -> float:
    """How well points (n, 2) of walls fit, seen from a pose [cells, rad]."""
    cos, sin, total = math.cos(heading), math.sin(heading), 0.0
    for k in range(len(walls)):
        value = _at(
            score, x + cos * walls[k, 0] - sin * walls[k, 1], y + sin * walls[k, 0] + cos * walls[k, 1]
        )
        total += _UNKNOWN if math.isnan(value) else value
    return total / max(1, len(walls))


@cached_njit
def _score_places(
    score: FloatArray, walls: FloatArray, places: FloatArray, headings: FloatArray
) -> FloatArray:
    """How well points of walls fit (m, p) at places (m, 2) [cells] and headings (p,)."""
    scores = np.zeros((len(places), len(headings)))
    for m in range(len(places)):
        for p in range(len(headings)):
            scores[m, p] = _mean_score(score, walls, places[m, 0], places[m, 1], headings[p])
    return scores


@cached_njit
def _align(
    score: FloatArray, walls: FloatArray, poses: FloatArray, step: float
) -> tuple[FloatArray, FloatArray]:
    """The poses (h, 3) [cells, rad] near others (h, 3) at which walls' points fit best, and how well (h,)."""
    aligned: FloatArray = poses.copy()
    best = np.full(len(poses), -1.0)
    for h in range(len(poses)):
        for a in range(-_FINE_STEPS, _FINE_STEPS + 1):
            for b in range(-_FINE_STEPS, _FINE_STEPS + 1):
                for c in range(-_FINE_STEPS, _FINE_STEPS + 1):
                    x, y = poses[h, 0] + a * step, poses[h, 1] + b * step
                    heading = poses[h, 2] + c * _FINE_TURN
                    value = _mean_score(score, walls, x, y, heading) - _STEP_COST * (a * a + b * b + c * c)
                    if value > best[h]:
                        best[h] = value
                        aligned[h] = x, y, heading
    return aligned, best


@cached_njit
def _compare(
    score: FloatArray,
    occupied: BoolArray,
    ends: FloatArray,
    hits: BoolArray,
    poses: FloatArray,
    nearest: float,
) -> tuple[FloatArray, FloatArray]:
    """Share of beams that fit (h,), and of those of which the map says anything (h,), from poses (h, 3).

    A beam does not fit if the map has no wall where it ends at one, or a wall before that. One without a
    reflection tells nothing where the map has a wall that is too near to be seen.
    """
    fits, known = np.zeros(len(poses)), np.zeros(len(poses))
    for h in range(len(poses)):
        cos, sin = math.cos(poses[h, 2]), math.sin(poses[h, 2])
        for k in range(len(ends)):
            dx, dy = cos * ends[k, 0] - sin * ends[k, 1], sin * ends[k, 0] + cos * ends[k, 1]
            length = math.hypot(dx, dy)
            value, room = _at(score, poses[h, 0] + dx, poses[h, 1] + dy), length
            if hits[k]:
                room *= 0.85
            elif not math.isnan(value):
                value = 1.0
            for step in range(1, int(room)):
                i = math.floor(poses[h, 0] + dx * step / length)
                j = math.floor(poses[h, 1] + dy * step / length)
                if 0 <= i < occupied.shape[0] and 0 <= j < occupied.shape[1] and occupied[i, j]:
                    value = 0.0 if hits[k] or step > nearest else math.nan
                    break
            if not math.isnan(value):
                known[h] += 1.0 / len(ends)
                fits[h] += value / len(ends)
    return fits, known
