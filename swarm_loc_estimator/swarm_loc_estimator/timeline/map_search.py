"""Where a robot with a lidar starts in a known map: the one place that explains its scans while it drives.

The first scan is compared with the map at all free places and headings, coarse to fine: a level keeps those
whose beams end near walls, as far as its steps allow. The best are matched, and each that fits is a
hypothesis, moved by odometry and matched again at every new place. A hypothesis that explains clearly less
than the best one is ruled out. Once one is left that has fit at several places, the map is searched with the
newest scan for others that explain all of them. These are followed, too, and the last one is believed.

Each scan goes on with a search by one part, so that it costs no more in a large map; the search takes longer.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.numerics import wrap
from swarm_loc_estimator.common.se2 import between, compose, inverse, wrap_angle
from swarm_loc_estimator.filter.measurements import Measurements, Verdict
from swarm_loc_estimator.filter.state import SwarmState
from swarm_loc_estimator.mapping.grid import LOG_ODDS_CAP, OccupancyMap
from swarm_loc_estimator.mapping.map_file import load_map
from swarm_loc_estimator.mapping.messages import described_delay
from swarm_loc_estimator.swarm.swarm import MAP_BY_TOPIC, Swarm
from swarm_loc_estimator.timeline.map_scans import (
    ALL,
    BLOCKED,
    DECLINE,
    FITS,
    FREE,
    OFF_MAP,
    WALL,
    FoundPlace,
    MapScans,
    Match,
    WallMap,
    match,
    squared_distance,
    wall_map,
)

# The constants are checked by `make bench-lidar`: three halls and a real map, 50 random starts each.
_BEAMS, _ANGLES = 60, 128  # Number of beams and of headings that are compared
_FIRST, _LEAST = 15, 0.4  # So many beams rule a pose out that fits them worse than this
_MATCHED = 120  # Maximum number of beams that are matched
_STEP_M, _LEVELS, _KEPT = 0.4, 3, 3000
"""Distance of the places that are tried first [m], number of levels, and of the best that each one keeps."""
_WIDTH_M = 0.15  # Distance beyond the reach of a level at which a beam fits no wall [m]
_TRIED, _HYPOTHESES = 200, 60  # Maximum numbers of places that are matched, and that are followed
_SPREAD = np.diag(np.square([0.15, 0.15, 0.06]))  # Covariance (3, 3) of the places that are matched
_APART_M, _APART = 0.25, math.radians(12.0)  # Places farther apart are different ones [m], [rad]
_LOOK_M, _LOOK_TURN = 0.3, 0.5  # Drive [m] or turn [rad] after which a scan counts as another look
_SLIP = (0.03, 0.02, 0.06)  # Error of such a drive [m], of its turn [rad], and their growth with both
_RULED_OUT = 0.5  # By how many scans a hypothesis explains less than another that rules it out
_LOOKS, _MEMORY = 3, 8  # Minimum number of looks, and maximum number that are compared
_MIN_FIT = 0.7  # Share of the beams that must fit, on average
_START = np.diag(np.square([0.1, 0.1, 0.05]))
"""Covariance (3, 3) added to that of a place, since the next scans, which see the same walls, replace it."""
_AROUND = np.array([[0.2, 0.2, 0.1], [0.4, 0.4, 0.2]])
"""Least and greatest steps in which a located robot is sought around its prediction [m, m, rad]."""
_OFFSETS = np.stack(np.meshgrid(*[np.arange(-3.0, 4.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
_NEAR_BY, _RIVAL = 12, 25.0  # Places around it that are matched, and squared distance of different ones
_SAME = np.diag(np.square([0.05, 0.05, 0.03]))
_CLEAR_FIT, _CLEAR_THROUGH, _CLEAR_LEAD = 0.9, 0.02, 0.15
"""Minimum share of beams that fit, maximum share that go through walls, and minimum lead over places nearby
of a scan that tells a place alone."""
_COMPARED, _MATCHES = 400_000, 50  # Numbers of poses that are compared, and that are matched, at a scan
_GRADES = 100  # Of nearness to a wall, at the first level
_SEARCH_TURN = 0.1  # Turn during a sweep beyond which it searches no place [rad]
_PAUSE_NS, _LONGEST_PAUSE_NS = 1_000_000_000, 16_000_000_000  # Between searches of a robot
_SILENT_NS = 2_000_000_000  # Silence of a lidar after which another one of the robot searches


class SearchMap(NamedTuple):
    """A map prepared for the search of places."""

    walls: WallMap
    away: NDArray[np.float32]  # (nx, ny) distance from the nearest wall [m]
    near: NDArray[np.uint8]  # (nx, ny) nearness to a wall at the first level, up to `_GRADES`
    places: FloatArray  # (p, 2) that are tried first [m]


class SweptBeams(NamedTuple):
    """A sweep from the pose of the robot at one instant, see `match`."""

    ends: FloatArray  # (n, 2)
    origin: FloatArray  # (2,)
    variance: FloatArray  # (n,)

    @classmethod
    def thinned(cls, ends: FloatArray, origin: FloatArray, variance: FloatArray) -> SweptBeams:
        """Not more of them than are needed here."""
        step = max(1, -(-len(ends) // _MATCHED))
        return cls(np.ascontiguousarray(ends[::step]), origin, np.ascontiguousarray(variance[::step]))


class Look(NamedTuple):
    """A scan that counts."""

    beams: SweptBeams
    track: FloatArray  # (3,) pose by odometry


class PlaceSearch(NamedTuple):
    """A search of the whole map, under way, for the places (m,) that explain k looks."""

    poses: FloatArray = np.zeros((0, 3))  # (n, 3) of the newest look that are matched next, the best first
    score: FloatArray = np.zeros(0)  # (n,) of them
    compared: int = 0  # Number of the map's places that were compared
    transform: tuple[FloatArray, ...] = ()  # (m, 3) from `map` to the track
    fits: tuple[FloatArray, ...] = ()  # (m, k)


class PossiblePlaces(NamedTuple):
    """The places (h,) where a robot may be, and its looks (k,)."""

    transform: FloatArray  # (h, 3) from `map` to the track of its odometry
    fits: FloatArray  # (h, k) share of the beams of each look that fit
    looks: tuple[Look, ...]
    searched_ns: int  # Stamp of the last search from the beginning
    pause_ns: int  # After it
    search: PlaceSearch | None = None  # What is under way; no looks are added meanwhile
    is_complete: bool = False  # Whether a search by several looks has found all of these
    had_rivals: bool = False  # Whether it was ambiguous before the last look
    lidar: int = 0  # Number of the lidar whose scans are these looks
    scan_ns: int = 0  # Stamp of its newest scan

    @property
    def is_sole(self) -> bool:
        """Whether no other place explains what the robot has seen than the only one of these."""
        return self.is_complete and len(self.transform) == 1

    @property
    def is_ambiguous(self) -> bool:
        """Whether several places explain what the robot saw while it drove, or did until the last look."""
        least = 1 if self.had_rivals and not self.is_complete else 2
        return len(self.looks) >= _LOOKS and len(self.transform) >= least


def search_map(walls: WallMap) -> SearchMap:
    """Prepare a map."""
    away = scipy.ndimage.distance_transform_edt(walls.kind != WALL) * walls.cell
    step = max(1, round(_STEP_M / walls.cell))
    nx, ny = (-(-size // step) for size in walls.kind.shape)
    free = np.zeros((nx * step, ny * step), dtype=bool)
    free[: walls.kind.shape[0], : walls.kind.shape[1]] = walls.kind == FREE
    blocks = np.argwhere(free.reshape(nx, step, ny, step).any(axis=(1, 3)))
    places: FloatArray = walls.corner + (blocks + 0.5) * step * walls.cell
    near = np.round(_GRADES * np.clip(1.0 - (away - 0.75 * _STEP_M) / _WIDTH_M, 0.0, 1.0)).astype(np.uint8)
    return SearchMap(walls, away.astype(np.float32), near, places)


def placed_map(drawn: OccupancyMap, origin: FloatArray, path: Path = Path(MAP_BY_TOPIC)) -> SearchMap:
    """Prepare a map about an origin (2,); raises MapFileError if it has no walls or no free space."""
    return search_map(wall_map(replace(drawn, corner=drawn.corner - origin), path))


def described_map(swarm: Swarm) -> SearchMap | None:
    """Read the map of a swarm, if it has a file, and compile what uses maps before data come.

    Raises UserError if the map cannot be read, or has no walls or no free space.
    """
    if swarm.map is None:
        return None
    if isinstance(swarm.map, Path):
        found = placed_map(load_map(swarm.map), np.array(swarm.origin), swarm.map)
    else:
        smallest = OccupancyMap(np.zeros(2), 1.0, np.array([[LOG_ODDS_CAP, -LOG_ODDS_CAP]]))
        found = placed_map(smallest, np.zeros(2))
    match(found.walls, np.zeros((0, 2)), np.zeros(2), np.zeros(0), np.zeros(3), np.eye(3))
    ahead = np.zeros((1, 2))
    _refined(found, ahead, _compared(found, ahead, PlaceSearch()))
    return found if isinstance(swarm.map, Path) else None


class MapSearch:
    """Searches places of robots in the known map; `scans` knows the beams of sweeps."""

    def __init__(self, scans: MapScans, swarm: Swarm) -> None:
        self._scans, self._robots = scans, swarm.robots

    def place_of(self, state: SwarmState, one: Measurements) -> tuple[FoundPlace | None, Verdict]:
        """Search the place of a robot that is not located, by the row of its scan; returns it once found.

        What the state, which has a map, knows of places is changed.
        """
        robot, stamp_ns, scans = int(one.target), int(one.stamp_ns), self._scans
        sweep, described = scans.sweep_of(one), self._robots[robot]
        if sweep is None or described.stands or not scans.tracks.has_started(robot, sweep.stamp_ns):
            return None, Verdict.NOT_LOCALIZED
        before, walls = state.places.get(robot), scans.walls_for(sweep, state.map.walls)
        known = state.map._replace(walls=walls)
        delay = state.delays.get((robot, sweep.number)) or described_delay(sweep.lidar.delay_s)
        # the places are those of one lidar, while it sends scans and there are any
        if before is not None and before.lidar != sweep.number:
            is_under_way = before.search is not None or len(before.transform)
            if is_under_way and stamp_ns - before.scan_ns < _SILENT_NS:
                return None, _why_nowhere(before)
            before = None
        if delay.is_excluded:
            return None, _why_nowhere(before)
        if before is not None:
            before = state.places[robot] = before._replace(scan_ns=stamp_ns)
        if before is not None and before.search is not None:
            state.places[robot] = places = self._advanced(before, before.search, known)
            return None, _why_nowhere(places)
        if scans.turned(robot, sweep) > _SEARCH_TURN:
            return None, _why_nowhere(before)  # its delay and order of beams may be wrong
        sweep = sweep.backwards() if delay.backwards > 0.0 else sweep
        beams, now, _ = scans.beams(robot, stamp_ns, sweep, delay.lag_s, int(delay.chance.argmax()))
        places, found = self._add(before, stamp_ns, SweptBeams.thinned(*beams), now, known)
        if found is not None:
            state.places.pop(robot, None)
            scans.found_elsewhere(state, (robot, sweep.number), delay, stamp_ns)
            return found, Verdict.USED
        state.places[robot] = places._replace(lidar=sweep.number, scan_ns=stamp_ns)
        return None, _why_nowhere(places)

    @staticmethod
    def around(
        known: SearchMap,
        ends: FloatArray,
        origin: FloatArray,
        variance: FloatArray,
        predicted: FloatArray,
        covariance: FloatArray,
        reported: FloatArray | None,
        least: float,
    ) -> FoundPlace | None:
        """The place of a robot that is not where it was predicted; None: it is, or nobody knows.

        Wheels slip, and pauses or steps too fast for their stamps leave out motions that most drivers go on
        counting. Where the scan does not fit, it is sought around the prediction and what odometry reports.

        Args:
            known: The map.
            ends: (n, 2) of its beams, see `match`.
            origin: (2,) of them.
            variance: (n,) of them.
            predicted: (3,) pose.
            covariance: (3, 3) of it.
            reported: (3,) pose by a motion that odometry has left out, if it has.
            least: Share of the beams that must fit.
        """
        # places around the prediction, and around what odometry reports
        beams = SweptBeams.thinned(ends, origin, variance)
        left_out = reported is not None  # maybe the whole turn
        sigma = _AROUND[0] if left_out else np.clip(np.sqrt(np.diag(covariance)), *_AROUND)
        centres = np.array([one for one in (predicted, reported) if one is not None])
        found = _explaining(known, beams, centres, sigma)
        # the one that explains the scan, if no other does
        if not found or found[0].fitting < least:
            return None
        best, rival = found[0], _rival(found[0], found)
        if rival > best.fitting - DECLINE:
            return None
        # walls may not tell all: it may be anywhere between the centres
        way = (centres[-1] - predicted) * [1.0, 1.0, 0.0]
        around = np.linalg.inv(np.diag(sigma**2) + np.outer(way, way))
        covariance = np.linalg.inv(np.linalg.inv(best.covariance) + around)
        # one scan is enough if no place farther away explains it either
        is_certain = best.fitting >= _CLEAR_FIT and best.through <= _CLEAR_THROUGH and best.determined == ALL
        if is_certain:
            rival = max(rival, _rival(best, _explaining(known, beams, centres, _AROUND[1])))
        return FoundPlace(best.pose, covariance, is_certain and best.fitting - rival > _CLEAR_LEAD)

    def _add(
        self,
        before: PossiblePlaces | None,
        stamp_ns: int,
        beams: SweptBeams,
        track: FloatArray,
        known: SearchMap,
    ) -> tuple[PossiblePlaces, FoundPlace | None]:
        """Follow places by a scan at a pose (3,) by odometry; the robot's place, too, once it is found."""
        if before is None or not len(before.transform):
            paused_ns = 0 if before is None else before.pause_ns
            if before is not None and stamp_ns < before.searched_ns + paused_ns:
                return before, None
            pause_ns = min(max(_PAUSE_NS, 2 * paused_ns), _LONGEST_PAUSE_NS)
            look = Look(beams, track)
            begun = PossiblePlaces(np.zeros((0, 3)), np.zeros((0, 1)), (look,), stamp_ns, pause_ns)
            return self._advanced(begun, PlaceSearch(), known), None
        x, y, turn = between(before.looks[-1].track, track)
        away, turn = math.hypot(x, y), abs(float(wrap_angle(turn)))
        is_look = away >= _LOOK_M or turn >= _LOOK_TURN
        if not (is_look or before.is_sole):
            return before, None
        # match each place again, and rule out what explains less
        slip = _SLIP[0] + _SLIP[2] * away
        covariance = np.diag([slip, slip, _SLIP[1] + _SLIP[2] * turn])
        found = [match(known.walls, *beams, compose(one, track), covariance**2) for one in before.transform]
        poses = np.array([one.pose for one in found])
        fits = np.column_stack([before.fits, [_fit(one) for one in found]])
        looks = (*before.looks, Look(beams, track))
        if len(looks) > _MEMORY:  # the first look stays
            looks, fits = (looks[0], *looks[2:]), np.delete(fits, 1, axis=1)
        kept = _best(poses, fits)
        transform = compose(poses, inverse(track))[kept]
        after = before._replace(
            transform=transform, fits=fits[kept], looks=looks, had_rivals=before.is_ambiguous
        )
        nowhere = after._replace(transform=np.zeros((0, 3)), is_complete=False)
        if after.fits[0].mean() < _MIN_FIT and len(looks) >= _LOOKS:
            return nowhere, None
        # believe the last place if it has no rival anywhere
        best = found[kept[0]]
        is_sure = len(looks) >= _LOOKS and best.determined == 3 and best.outcome not in (OFF_MAP, BLOCKED)
        if len(kept) > 1 or not is_sure:
            return after if is_look else before, None
        if not after.is_complete:
            return self._advanced(after, PlaceSearch(), known), None
        if after.fits[0, 0] - after.fits[0, 1:].mean() > DECLINE:  # the first fits wrong places best
            return nowhere, None
        return after, FoundPlace(best.pose, best.covariance + _START)

    @staticmethod
    def _advanced(places: PossiblePlaces, search: PlaceSearch, known: SearchMap) -> PossiblePlaces:
        """Go on with a search by one part."""
        looks, everywhere = places.looks, len(known.places)
        # compare the newest look with the map, at the first level, then at all others
        if search.compared < everywhere:
            points = _spread(looks[-1].beams.ends)
            search = _compared(known, points, search) if len(points) else PlaceSearch(compared=everywhere)
            if search.compared < everywhere:
                return places._replace(search=search)
            search = search._replace(poses=_refined(known, points, search))
        # match all looks, the newest first, as long as they may explain hardly less than the known place
        least = float(places.fits.sum(axis=1).max(initial=-math.inf)) - _RULED_OUT
        now, matches, tried, transform, fits = inverse(looks[-1].track), 0, 0, [], []
        while matches < _MATCHES and tried < len(search.poses):
            then = latest = compose(search.poses[tried], now)
            tried, own = tried + 1, np.ones(len(looks))
            for k in range(len(looks) - 1, -1, -1):
                one = match(known.walls, *looks[k].beams, compose(then, looks[k].track), _SPREAD)
                then, own[k], matches = compose(one.pose, inverse(looks[k].track)), _fit(one), matches + 1
                latest = then if k == len(looks) - 1 else latest
                if own.sum() < least:
                    break
            else:
                transform.append(latest)
                fits.append(own)
        transforms, every = (*search.transform, *transform), (*search.fits, *fits)
        search = search._replace(poses=search.poses[tried:], transform=transforms, fits=every)
        return places._replace(search=search) if len(search.poses) else _searched(places, search)


def _explaining(known: SearchMap, beams: SweptBeams, centres: FloatArray, step: FloatArray) -> list[Match]:
    """Places up to three steps (3,) around centres (c, 3) that explain a scan, the best first."""
    points, poses = _spread(beams.ends), (centres[:, None] + _OFFSETS * step).reshape(-1, 3)
    score = _scores(known, points, poses, 0.75 * step[0]) if len(points) else np.zeros(len(poses))
    order = _largest(score, len(score))
    near_by = poses[order[_separate(poses[order], score[order], _NEAR_BY)]]
    found = [match(known.walls, *beams, pose, np.diag(step**2)) for pose in near_by]
    return sorted((one for one in found if one.outcome == FITS), key=_fit, reverse=True)


def _rival(best: Match, found: list[Match]) -> float:
    """Share of the beams that fit the best of the places that are other ones; 0 without any."""
    away = [squared_distance(best.pose, one.pose, best.covariance + one.covariance + _SAME) for one in found]
    return max([one.fitting for one, square in zip(found, away, strict=True) if square > _RIVAL], default=0.0)


def _searched(places: PossiblePlaces, search: PlaceSearch) -> PossiblePlaces:
    """What is known after a search: its places, beside the only one that was known before, if any."""
    transform = np.concatenate([places.transform, np.reshape(search.transform, (-1, 3))])
    fits = np.concatenate([places.fits, np.reshape(search.fits, (-1, len(places.looks)))])
    poses, known = compose(transform, places.looks[-1].track), len(places.transform)
    others = np.arange(len(poses))
    if known:  # other places than the known one
        off = poses - poses[0]
        is_apart = (np.hypot(off[:, 0], off[:, 1]) > _APART_M) | (np.abs(wrap_angle(off[:, 2])) > _APART)
        others = others[is_apart | (others < known)]
    kept = others[_best(poses[others], fits[others])][:_HYPOTHESES]
    kept = kept[fits[kept].sum(axis=1) > 0.0]
    is_complete = len(places.looks) >= _LOOKS
    return places._replace(transform=transform[kept], fits=fits[kept], search=None, is_complete=is_complete)


def _why_nowhere(places: PossiblePlaces | None) -> Verdict:
    """Why the scans of a robot do not locate it."""
    if places is None:
        return Verdict.NOT_LOCALIZED
    if not len(places.transform) and places.search is None:
        return Verdict.NO_PLACE
    return Verdict.SEVERAL_PLACES if places.is_ambiguous else Verdict.NOT_LOCALIZED


def _spread(ends: FloatArray) -> FloatArray:
    """Some ends (b, 2) of beams (n, 2), in an order in which any first ones look all around."""
    some = np.linspace(0, len(ends) - 1, _BEAMS if len(ends) else 0).astype(np.int64)
    return ends[some[np.argsort((np.arange(len(some)) * 0.618034) % 1.0)]]


def _compared(search_map: SearchMap, points: FloatArray, search: PlaceSearch) -> PlaceSearch:
    """Go on by a part of the places that are tried first; points (b, 2) are the ends of beams."""
    end = search.compared + max(1, _COMPARED // _ANGLES)
    places = search_map.places[search.compared : end]
    score = _first_scores(search_map, points, places).ravel().astype(np.float64)
    some = np.flatnonzero(score)
    some = some[_largest(score[some], _KEPT)]
    found = np.column_stack([places[some // _ANGLES], (2.0 * math.pi / _ANGLES) * (some % _ANGLES)])
    poses, scores = np.concatenate([search.poses, found]), np.concatenate([search.score, score[some]])
    kept = _largest(scores, _KEPT)
    return PlaceSearch(poses[kept], scores[kept], end)


@cached_njit
def _first_scores(search_map: SearchMap, points: FloatArray, places: FloatArray) -> IntArray:
    """How well points (b, 2) end near walls, at places (p, 2) and all headings; 0 where they do not."""
    walls, out = search_map.walls, np.zeros((len(places), _ANGLES), dtype=np.int64)
    nx, ny = walls.kind.shape
    least = _LEAST * _FIRST * _GRADES
    for m in range(_ANGLES):
        cos, sin = math.cos(2.0 * math.pi / _ANGLES * m), math.sin(2.0 * math.pi / _ANGLES * m)
        shift = np.empty((len(points), 2), dtype=np.int64)  # in cells
        for b in range(len(points)):
            shift[b, 0] = round((cos * points[b, 0] - sin * points[b, 1]) / walls.cell)
            shift[b, 1] = round((sin * points[b, 0] + cos * points[b, 1]) / walls.cell)
        for k in range(len(places)):
            x = math.floor((places[k, 0] - walls.corner[0]) / walls.cell)
            y = math.floor((places[k, 1] - walls.corner[1]) / walls.cell)
            total = 0
            for b in range(len(points)):
                i, j = x + shift[b, 0], y + shift[b, 1]
                if 0 <= i < nx and 0 <= j < ny:
                    total += search_map.near[i, j]
                if b == _FIRST and total < least:
                    total = 0
                    break
            out[k, m] = total
    return out


def _refined(search_map: SearchMap, points: FloatArray, search: PlaceSearch) -> FloatArray:
    """Poses (h, 3) from which points (b, 2) are near walls, the best first, by those of the first level."""
    step, turn, poses, score = _STEP_M, 2.0 * math.pi / _ANGLES, search.poses, search.score
    corners = [(a, b, c) for a in (-1.0, 1.0) for b in (-1.0, 1.0) for c in (-1.0, 1.0)]
    for level in range(1, _LEVELS):
        offsets = np.array(corners) * [0.25 * step, 0.25 * step, 0.25 * turn]
        if level == 1:  # headings are close enough for the first level
            offsets = offsets[::2] * [1.0, 1.0, 0.0]
        poses, step = (poses[:, None] + offsets).reshape(-1, 3), 0.5 * step
        score = _scores(search_map, points, poses, 0.75 * step)
        kept = _largest(score, _KEPT)
        poses, score = poses[kept], score[kept]
    return poses[_separate(poses, score.astype(np.float64), _TRIED)]


@cached_njit
def _scores(search_map: SearchMap, points: FloatArray, poses: FloatArray, reach: float) -> FloatArray:
    """How well (n,) points (b, 2) of poses (n, 3) end within a reach of walls; 0 where no place is free."""
    walls, out = search_map.walls, np.zeros(len(poses))
    x0, y0, scale = walls.corner[0], walls.corner[1], 1.0 / walls.cell
    nx, ny = walls.kind.shape
    for k in range(len(poses)):
        cos, sin = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        x, y, total = (poses[k, 0] - x0) * scale, (poses[k, 1] - y0) * scale, 0.0
        for b in range(len(points)):
            i = math.floor(x + scale * (cos * points[b, 0] - sin * points[b, 1]))
            j = math.floor(y + scale * (sin * points[b, 0] + cos * points[b, 1]))
            if 0 <= i < nx and 0 <= j < ny:
                total += max(0.0, 1.0 - max(0.0, search_map.away[i, j] - reach) / _WIDTH_M)
            if b == _FIRST and total < _LEAST * _FIRST:
                total = 0.0
                break
        out[k] = total / len(points)
    return out


def _largest(score: FloatArray, count: int) -> IntArray:
    """Indices of the largest scores, the largest first."""
    some = np.flatnonzero(score >= np.partition(score, -count)[-count]) if len(score) > count else slice(None)
    numbers: IntArray = np.arange(len(score))[some]
    return numbers[np.argsort(-score[numbers], kind="stable")[:count]]


@cached_njit
def _separate(poses: FloatArray, score: FloatArray, count: int) -> IntArray:
    """Indices of up to `count` poses (n, 3), the best first, none near a better one."""
    kept = np.zeros(min(count, len(poses)), dtype=np.int64)
    size = 0
    for k in range(len(poses)):
        near = score[k] <= 0.0
        for m in range(size):
            if near:
                break
            dx, dy = poses[k, 0] - poses[kept[m], 0], poses[k, 1] - poses[kept[m], 1]
            turn = wrap(poses[k, 2] - poses[kept[m], 2])
            near = math.hypot(dx, dy) < _APART_M and abs(turn) < _APART
        if not near:
            kept[size] = k
            size += 1
            if size == len(kept):
                break
    return kept[:size]


def _fit(found: Match) -> float:
    """Share of the beams of a scan that fit; 0 where they go through walls."""
    return 0.0 if found.outcome == OFF_MAP else found.fitting


def _best(poses: FloatArray, fits: FloatArray) -> IntArray:
    """Indices of places (h, 3) that explain hardly less than the best, the best first, each once."""
    total = fits.sum(axis=1)
    order = _largest(total, len(total))
    each: IntArray = order[_separate(poses[order], total[order] + 1e-9, len(order))]
    kept: IntArray = each[total[each] > total.max(initial=0.0) - _RULED_OUT]
    return kept
