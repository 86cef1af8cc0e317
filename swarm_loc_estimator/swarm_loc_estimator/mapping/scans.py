"""Scans: readings of a laser, the beams of a turn, the lines of walls, and the stops of a robot.

A wall at distance D with normal n is met by a beam of direction u at the inverse distance (n.u)/D, which is
A cos(a) + B sin(a) with (A, B) = n/D: linear least squares with noise that is the same everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.se2 import wrap_angle

UNSEEN = 0.0  #: Inverse distance of a beam without reflection


class Readings(NamedTuple):
    """Readings (n,) of one robot in order of time.

    A camera next to a laser measures the inverse of a distance: it is linear in the pixel at which the
    reflection is seen, d = f b / (p - p_inf), so its noise does not depend on the distance.
    """

    stamp_ns: IntArray  #: (n,)
    odometry: FloatArray  #: (n, 3) pose by odometry at each stamp, in the robot's own odom frame
    #: (n,) inverse distance along x of the robot, from its centre [1/m]; `UNSEEN`: nothing
    inverse: FloatArray
    #: Standard deviation of an inverse distance, sigma_px / (f b) [1/m]; NaN before the first reflection
    sigma: float


class LightSightings(NamedTuple):
    """Sightings (m,) of lights of other robots by one robot."""

    stamp_ns: IntArray  #: (m,)
    target: IntArray  #: (m,) number of the robot whose light it is
    bearing: FloatArray  #: (m,) in the frame of the robot that saw it [rad]
    sigma: FloatArray  #: (m,) its standard deviation [rad]


MAX_BEAMS = 768  # Maximum number of beams per stop; if exceeded, every second one is dropped


class Beams(NamedTuple):
    """Beams of stops (k,)."""

    turn: FloatArray  # (k, MAX_BEAMS) turn by odometry since arrival at the stop [rad]
    inverse: FloatArray  # (k, MAX_BEAMS) inverse distance [1/m], 0: no reflection
    counts: IntArray  # (k,) number of beams
    sigma: FloatArray  # (k,) standard deviation of an inverse distance [1/m]
    reach: FloatArray  # (k,) range of the laser [m]


def no_beams(capacity: int) -> Beams:
    """Memory for the beams of `capacity` stops."""
    shape = (capacity, MAX_BEAMS)
    counts = np.zeros(capacity, dtype=np.int64)
    return Beams(np.zeros(shape), np.zeros(shape), counts, np.ones(capacity), np.ones(capacity))


class Scan(NamedTuple):
    """What was measured at one place, beams (n,)."""

    turn: FloatArray  # As in `Beams`
    inverse: FloatArray
    bearing: FloatArray | float = 0.0  # Direction in the frame of the robot [rad]; 0 of a laser pointer
    weight: FloatArray | float = 1.0  # Variance sigma^2 over that of this beam; 1 of a laser pointer


def set_beams(beams: Beams, stop: int, scan: Scan) -> None:
    """Set the beams of a stop."""
    every = -(-len(scan.turn) // MAX_BEAMS) or 1
    count = len(scan.turn[::every])
    beams.turn[stop, :count], beams.inverse[stop, :count] = scan.turn[::every], scan.inverse[::every]
    beams.counts[stop] = count


BINS = 360
UNKNOWN, FREE, POINT, LINE = 0, 1, 2, 3  # Kinds of a direction; POINT: reflection without a line

_SEEN, _CC, _CS, _SS, _YC, _YS, _YY, _C, _S, _Y, _ALL = range(11)
"""Sums over the beams of a direction; y is the inverse distance."""
# The constants below are checked by `make bench-pushbot`: corridor, office and ring, 20 seeds each.
_WINDOWS = (40, 28, 20, 14, 9, 6)  # Widths in degrees of the windows that may be a line, longest first
_MIN_BEAMS, _MIN_SEEN_SHARE = 5, 0.85  # Minimum number of reflections in a window, and their share of beams
_MAX_THIRD_SIGMAS = 2.2
"""Maximum distance of the mean of a third of a window from the line; beyond it the wall has a step."""
_MIN_INCIDENCE = 0.15  # Minimum cosine between beam and normal
_MAX_NORMAL_SIGMA = 0.08  # Maximum standard deviation of the normal of a usable line [rad]
_RANGE_SIGMAS = 2.5  # Lines nearer to the laser's range than this are left out [sigma]


class Lines(NamedTuple):
    """Lines of stops (k,), per degree of direction relative to the heading on arrival."""

    kind: NDArray[np.int8]  # (k, BINS) `UNKNOWN`, `FREE`, `POINT` or `LINE`
    a: FloatArray  # (k, BINS) normal over distance, along x [1/m]
    b: FloatArray  # (k, BINS) normal over distance, along y [1/m]
    distance: FloatArray  # (k, BINS) along the direction [m]
    variance: FloatArray  # (k, BINS) of the line's inverse distance along the direction [1/m^2]
    turn: FloatArray  # (k, BINS) turn by odometry at which the direction was scanned [rad]
    normal_variance: FloatArray  # (k, BINS) of the direction of the normal [rad^2]
    usable: NDArray[np.bool_]  # (k, BINS) whether the normal is accurate enough for scan matching


def no_lines(capacity: int) -> Lines:
    """Memory for the lines of `capacity` stops."""
    shape = (capacity, BINS)
    a, b, distance, variance, turn, normal = np.zeros((6, *shape))
    kind, usable = np.zeros(shape, dtype=np.int8), np.zeros(shape, dtype=bool)
    return Lines(kind, a, b, distance, variance, turn, normal, usable)


@cached_njit
def fit_lines(stop: int, ratio: float, max_range: float, beams: Beams, lines: Lines) -> None:
    """Fit the lines of one stop.

    Args:
        stop: Its number.
        ratio: True turn over turn by odometry.
        max_range: Maximum range of the laser [m].
        beams: Of all stops.
        lines: Of all stops; those of this one are written.
    """
    sums, turns = _sums_per_bin(stop, ratio, beams)
    total = np.zeros((3 * BINS + 1, 11))  # three periods, since windows cross the seam
    for m in range(3 * BINS):
        total[m + 1] = total[m] + sums[m % BINS]
    sigma = beams.sigma[stop]
    least = 1.0 / max_range + _RANGE_SIGMAS * sigma
    for m in range(BINS):
        seen, looked = sums[m, _SEEN], sums[m, _ALL]
        lines.turn[stop, m] = turns[m] / looked if looked > 0 else (m + 0.5) * 2.0 * math.pi / BINS / ratio
        lines.usable[stop, m] = False
        if _fit_bin(stop, m, total, sigma, least, lines):
            continue
        lines.kind[stop, m] = UNKNOWN
        if _is_free(total, m):
            lines.kind[stop, m] = FREE
        elif seen > 0:
            lines.kind[stop, m] = POINT
            lines.distance[stop, m] = 1.0 / math.sqrt(sums[m, _YY] / seen)


@cached_njit
def _sums_per_bin(stop: int, ratio: float, beams: Beams) -> tuple[FloatArray, FloatArray]:
    """Sums (BINS, 11), and sums of turns by odometry (BINS,)."""
    sums, turns = np.zeros((BINS, 11)), np.zeros(BINS)
    for i in range(beams.counts[stop]):
        angle = ratio * beams.turn[stop, i]
        m = math.floor(angle * BINS / (2.0 * math.pi)) % BINS
        y = beams.inverse[stop, i]
        sums[m, _ALL] += 1.0
        turns[m] += beams.turn[stop, i]
        if y > 0.0:
            c, s = math.cos(angle), math.sin(angle)
            row = sums[m]
            row[_SEEN] += 1.0
            row[_CC] += c * c
            row[_CS] += c * s
            row[_SS] += s * s
            row[_YC] += y * c
            row[_YS] += y * s
            row[_YY] += y * y
            row[_C] += c
            row[_S] += s
            row[_Y] += y
    return sums, turns


@cached_njit
def _fit_bin(stop: int, m: int, total: FloatArray, sigma: float, least: float, lines: Lines) -> bool:
    """Fit the longest window around a bin that is consistent with a line; returns whether there is one."""
    here = BINS + m
    if total[here + 3, _SEEN] - total[here - 2, _SEEN] == 0.0:
        return False
    angle = (m + 0.5) * 2.0 * math.pi / BINS
    c, s = math.cos(angle), math.sin(angle)
    for width in _WINDOWS:
        best = math.inf
        for position in range(3):
            low = here - (width // 2 if position == 0 else (width - 2 if position == 1 else 1))
            misfit, a, b, vaa, vab, vbb = _fit_window(total, low, low + width, sigma)
            if misfit >= best:
                continue
            y, square = a * c + b * s, a * a + b * b
            if y < least or y < _MIN_INCIDENCE * math.sqrt(square):
                continue
            best = misfit
            lines.a[stop, m], lines.b[stop, m] = a, b
            lines.distance[stop, m] = 1.0 / y
            lines.variance[stop, m] = c * c * vaa + 2.0 * c * s * vab + s * s * vbb
            normal_variance = (b * b * vaa - 2.0 * a * b * vab + a * a * vbb) / (square * square)
            lines.normal_variance[stop, m] = normal_variance
            lines.usable[stop, m] = normal_variance < _MAX_NORMAL_SIGMA**2
        if best < math.inf:
            lines.kind[stop, m] = LINE
            return True
    return False


@cached_njit
def _fit_window(
    total: FloatArray, low: int, high: int, sigma: float
) -> tuple[float, float, float, float, float, float]:
    """Misfit (infinite: no line), a, b, and their covariance aa, ab, bb."""
    none = (math.inf, 0.0, 0.0, 0.0, 0.0, 0.0)
    d = total[high] - total[low]
    n = d[_SEEN]
    if n < _MIN_BEAMS or n < _MIN_SEEN_SHARE * d[_ALL]:
        return none
    det = d[_CC] * d[_SS] - d[_CS] * d[_CS]
    if det < 1e-9:
        return none
    a = (d[_SS] * d[_YC] - d[_CS] * d[_YS]) / det
    b = (d[_CC] * d[_YS] - d[_CS] * d[_YC]) / det
    misfit = (d[_YY] - a * d[_YC] - b * d[_YS]) / (sigma * sigma * max(1.0, n - 2.0))
    if misfit >= 1.0 + 2.0 * math.sqrt(2.0 / n):
        return none
    width = high - low
    for part in range(3):
        first, last = low + part * width // 3, low + (part + 1) * width // 3
        count = total[last, _SEEN] - total[first, _SEEN]
        if count > 0.0:
            off = total[last, _Y] - total[first, _Y]
            off -= a * (total[last, _C] - total[first, _C]) + b * (total[last, _S] - total[first, _S])
            if abs(off) > _MAX_THIRD_SIGMAS * sigma * math.sqrt(count):
                return none
    v = sigma * sigma / det
    return misfit, a, b, v * d[_SS], -v * d[_CS], v * d[_CC]


@cached_njit
def _is_free(total: FloatArray, m: int) -> bool:
    """Whether the beams around a bin show no obstacle within range."""
    here = BINS + m
    looked = total[here + 2, _ALL] - total[here - 1, _ALL]
    seen = total[here + 2, _SEEN] - total[here - 1, _SEEN]
    if looked == 0.0 or seen > 0.2 * looked:
        return False
    around = total[here + 3, _ALL] - total[here - 2, _ALL]
    return bool(total[here + 3, _SEEN] - total[here - 2, _SEEN] <= 0.34 * around)


MIN_OVERLAP = 50  # Minimum number of beams of the first turn with a neighbour in the second
_LOW, _HIGH, _STEP = 0.90, 1.02, 0.0005  # Range and step of the turn ratios that are tried
_OUTLIER = 9.0  # Maximum squared difference of two beams, in variances


@cached_njit
def turn_ratio(turn: FloatArray, inverse: FloatArray, sigma: float) -> float:
    """The turn ratio at which beams (n,) agree best with those one turn later; NaN if too few see a wall.

    Args:
        turn: (n,) by odometry, increasing or decreasing throughout [rad].
        inverse: (n,) inverse distances, 0: no reflection [1/m].
        sigma: Standard deviation of an inverse distance [1/m].
    """
    forward = np.abs(turn - turn[0])
    best, found = math.inf, math.nan
    if np.sum(inverse > 0.0) < 2 * MIN_OVERLAP:
        return found
    for m in range(round((_HIGH - _LOW) / _STEP) + 1):
        ratio = _HIGH - m * _STEP
        cost, count = _disagreement(forward, inverse, sigma, 2.0 * math.pi / ratio)
        if count >= MIN_OVERLAP and cost / count < best:
            best, found = cost / count, ratio
    return found


@cached_njit
def _disagreement(turn: FloatArray, inverse: FloatArray, sigma: float, later: float) -> tuple[float, int]:
    """Sum of capped squared differences of beams and those a turn `later` [rad], and their number."""
    cost, count, j = 0.0, 0, 0
    for i in range(len(turn)):
        wanted = turn[i] + later
        while j + 1 < len(turn) and turn[j + 1] < wanted:
            j += 1
        if j + 1 >= len(turn):
            break
        count += 1
        if (inverse[i] > 0.0) != (inverse[j] > 0.0):
            cost += _OUTLIER
        elif inverse[i] > 0.0 and inverse[j + 1] > 0.0:
            gap = turn[j + 1] - turn[j]
            share = (wanted - turn[j]) / gap if gap > 0.0 else 0.0
            off = (inverse[i] - (1.0 - share) * inverse[j] - share * inverse[j + 1]) / (1.3 * sigma)
            cost += min(off * off, _OUTLIER)
    return cost, count


MIN_TURN = 0.5  # Minimum turn of a scan [rad]
_STAND_SPEED = 0.02  # Maximum speed of a stopped robot [m/s]
_DEPARTED = 0.01  # Maximum distance from the arrival position within a stop [m]
_MAX_READINGS = 4096  # Maximum number of readings per stop; if exceeded, every second one is dropped
_REST_NS, _REST_TURN = 1_000_000_000, 0.01  # A robot rests if it turns less than this [rad] within this time
_DRIVES, _STANDS, _ARRIVES, _JUMPS = 0, 1, 2, 3
_MAX_SPEED, _MAX_STEP, _MAX_RATE, _MAX_TURN = 3.0, 0.05, 20.0, 0.3
"""Limits beyond which odometry counts as restarted: rate and offset of position, and of heading."""
_PAUSE_S = 0.5  # Pause after which odometry near zero has restarted, since its driver has [s]
_UNHEARD_S, _UNHEARD_TURN = 2.0, 0.05
"""Pause [s] in which turns [rad] may be whole ones, of which slip is unknown; `stop_and_go` has it, too."""


class ScanStop:
    """A stop of a robot with its readings.

    Attributes:
        arrival: (3,) pose by odometry on arrival.
        departure: (3,) pose by odometry at the last reading.
        stamp_ns: (n,) of its readings.
        turn: (n,) turn by odometry since arrival [rad].
        inverse: (n,) inverse distances [1/m].
        sigma: Standard deviation of an inverse distance [1/m]; undefined before the first reflection.
        begin: Number of readings that belong to earlier nodes.
        looked: Number of readings when it became a node; 0: not a node yet.
        total: Number of all readings, including dropped ones.
        reach: Range of the lidar of which this is a sweep [m]; 0: readings of a laser pointer.
    """

    bearing: FloatArray | float = 0.0
    weight: FloatArray | float = 1.0
    reach = 0.0

    def __init__(self, arrival: FloatArray) -> None:
        self.arrival = self.departure = arrival
        self.stamp_ns: IntArray = np.zeros(0, dtype=np.int64)
        self.turn = np.zeros(0)
        self.inverse = np.zeros(0)
        self.sigma = 1.0
        self.begin = self.looked = self.total = 0

    @classmethod
    def of_sweep(cls, stamp_ns: int, pose: FloatArray, scan: Scan, sigma: float, reach: float) -> ScanStop:
        """A sweep of a lidar as a stop of no duration.

        Args:
            stamp_ns: Time of the first beam.
            pose: (3,) by odometry then.
            scan: Its beams, from where the robot was then.
            sigma: Standard deviation of an inverse distance with a weight of 1 [1/m].
            reach: Range of the lidar [m].
        """
        stop = cls(pose)
        stop.turn, stop.inverse, stop.bearing, stop.weight = scan
        stop.stamp_ns = np.full(len(scan.turn), stamp_ns)
        stop.sigma, stop.reach = sigma, reach
        return stop

    @property
    def ends(self) -> FloatArray:
        """(n, 2) ends of the beams of a sweep in the frame of its robot, at its reach without a wall [m]."""
        angle = self.turn + self.bearing
        distance = 1.0 / np.where(self.inverse > 0.0, self.inverse, 1.0 / self.reach)
        return np.stack([np.cos(angle), np.sin(angle)], axis=-1) * distance[:, None]

    def chosen(self, beams: BoolArray) -> ScanStop:
        """A sweep with some of its beams (n,) only."""
        bearing, weight = (np.broadcast_to(one, beams.shape)[beams] for one in (self.bearing, self.weight))
        some = Scan(self.turn[beams], self.inverse[beams], bearing, weight)
        return ScanStop.of_sweep(int(self.stamp_ns[0]), self.arrival, some, self.sigma, self.reach)

    def scan(self, first: int, last: int) -> Scan:
        """The beams from `first` on and before `last`, with turns since the one before."""
        before = self.turn[first - 1] if first else 0.0
        turn, inverse = self.turn[first:last] - before, self.inverse[first:last]
        return Scan(turn, inverse, self.bearing, self.weight)

    def extend(self, readings: Readings) -> None:
        """Append readings."""
        headings = np.concatenate([self.departure[2:], readings.odometry[:, 2]])
        turned = self.turn[-1:] if len(self.turn) else np.zeros(1)
        steps = np.concatenate([turned, wrap_angle(np.diff(headings))])
        self.turn = np.concatenate([self.turn, np.cumsum(steps)[1:]])  # independent of how readings are split
        self.stamp_ns = np.concatenate([self.stamp_ns, readings.stamp_ns])
        self.inverse = np.concatenate([self.inverse, readings.inverse])
        self.departure = readings.odometry[-1]
        self.total += len(readings.stamp_ns)
        if not math.isnan(readings.sigma):
            self.sigma = readings.sigma
        if len(self.turn) > _MAX_READINGS:
            self.turn, self.stamp_ns, self.inverse = (
                np.concatenate([one[:-1:2], one[-1:]]) for one in (self.turn, self.stamp_ns, self.inverse)
            )
            self.begin, self.looked = (self.begin + 1) // 2, (self.looked + 1) // 2

    @property
    def turned(self) -> float:
        """Maximum turn by odometry [rad]."""
        return float(np.abs(self.turn).max(initial=0.0))

    @property
    def begin_turn(self) -> float:
        """Turn by odometry at which its node begins [rad]."""
        return float(self.turn[self.begin - 1]) if self.begin else 0.0

    def split(self, around: float) -> ScanStop | None:
        """Split off the readings since it became a node as a new stop, if they turn by `around` [rad]."""
        if not self.looked or self.looked == len(self.turn):
            return None
        before = float(self.turn[self.looked - 1])
        if np.abs(self.turn[self.looked :] - before).max() < around:
            return None
        heading = wrap_angle(self.arrival[2] + before)
        other = ScanStop(np.array([*self.arrival[:2], heading]))
        other.departure, other.sigma = self.departure, self.sigma
        other.turn = self.turn[self.looked :] - before
        other.stamp_ns, other.inverse = self.stamp_ns[self.looked :], self.inverse[self.looked :]
        other.total = len(other.turn)
        self.total -= other.total
        self.turn, self.inverse = self.turn[: self.looked], self.inverse[: self.looked]
        self.stamp_ns = self.stamp_ns[: self.looked]
        self.departure = other.arrival
        return other

    def completed(self, full: float) -> int:
        """Number of readings until the turn reached `full` [rad], or rested after a scan; 0: not yet."""
        return _completed(self.stamp_ns, self.turn, full)

    def turn_at(self, stamp_ns: int) -> float:
        """Turn by odometry at an instant during the stop [rad]."""
        since = (self.stamp_ns - self.stamp_ns[0]) * 1e-9
        return float(np.interp((stamp_ns - self.stamp_ns[0]) * 1e-9, since, self.turn))


class Run(NamedTuple):
    """Consecutive readings with the same motion state."""

    stands: bool  # Whether the robot is stopped
    arrives: bool  # Whether it has just arrived
    jumps: bool  # Whether odometry has restarted, so that the motion to this place is unknown
    readings: Readings  # The readings


class MotionTracker:
    """Classifies the readings of one robot as stopped or driving."""

    def __init__(self) -> None:
        self._state = np.full(6, np.nan)  # anchor x, y; previous x, y; whether stopped; previous heading
        self._before_ns = 0

    def runs(self, readings: Readings) -> Iterator[Run]:
        """Split readings (n,) at arrivals and departures, and after motion of which too little is known."""
        unheard_s = math.inf if math.isnan(readings.sigma) else _UNHEARD_S  # a lidar measures turns itself
        labels = _labels(readings.stamp_ns, readings.odometry, self._state, self._before_ns, unheard_s)
        self._before_ns = int(readings.stamp_ns[-1])
        changes = (labels[1:] >= _ARRIVES) | ((labels[1:] == _DRIVES) != (labels[:-1] == _DRIVES))
        bounds = [0, *(np.flatnonzero(changes) + 1).tolist(), len(labels)]
        for begin, end in pairwise(bounds):
            part = slice(begin, end)
            columns = (readings.stamp_ns[part], readings.odometry[part], readings.inverse[part])
            label, some = int(labels[begin]), Readings(*columns, readings.sigma)
            yield Run(label != _DRIVES, label >= _ARRIVES, label == _JUMPS, some)


@cached_njit
def _labels(
    stamp_ns: IntArray, odometry: FloatArray, state: FloatArray, before_ns: int, unheard_s: float
) -> IntArray:
    """Label each reading as driving, stopped, arriving or jump; updates the state."""
    labels = np.zeros(len(stamp_ns), dtype=np.int64)
    for k in range(len(stamp_ns)):
        x, y = odometry[k, 0], odometry[k, 1]
        elapsed_s = (stamp_ns[k] - before_ns) * 1e-9
        step = math.hypot(x - state[2], y - state[3])
        turn = abs((odometry[k, 2] - state[5] + math.pi) % (2.0 * math.pi) - math.pi)
        at_zero = math.hypot(x, y) < _MAX_STEP and abs(odometry[k, 2]) < _MAX_TURN
        restarts = at_zero and elapsed_s > _PAUSE_S and step + turn > 0.0
        restarts |= elapsed_s > unheard_s and (step > _DEPARTED or turn > _UNHEARD_TURN)
        if restarts or step > _MAX_SPEED * elapsed_s + _MAX_STEP or turn > _MAX_RATE * elapsed_s + _MAX_TURN:
            labels[k] = _JUMPS
            state[0], state[1], state[4] = x, y, 1.0
        elif state[4] == 1.0 and math.hypot(x - state[0], y - state[1]) <= _DEPARTED:
            labels[k] = _STANDS
        elif math.isnan(state[4]) or (state[4] == 0.0 and step < _STAND_SPEED * elapsed_s):
            labels[k] = _ARRIVES
            state[0], state[1], state[4] = x, y, 1.0
        else:
            labels[k] = _DRIVES
            state[4] = 0.0
        state[2], state[3], state[5] = x, y, odometry[k, 2]
        before_ns = stamp_ns[k]
    return labels


@cached_njit
def _completed(stamp_ns: IntArray, turn: FloatArray, full: float) -> int:
    furthest, rest_turn, rest_ns = 0.0, math.inf, 0
    for k in range(len(turn)):
        furthest = max(furthest, abs(turn[k]))
        if abs(turn[k] - rest_turn) > _REST_TURN:
            rest_turn, rest_ns = turn[k], stamp_ns[k]
        if furthest >= full or (furthest >= MIN_TURN and stamp_ns[k] - rest_ns >= _REST_NS):
            return k + 1
    return 0
