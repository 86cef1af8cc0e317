"""Messages of the mapper: maps, laser distances and frequencies of lights.

Sweeps of lidars: the beams of a LaserScan that are used, where they end, and how old they are.

A scan in a map shows where the robot was in the middle of its sweep. The motion from one scan to the next is
compared with odometry, at each of many lags: where speed or turn rate changes, only the true one agrees. The
lag is the state of a hidden Markov model, since a driver may fall behind at any time; a robot that drives
straight on tells no lag from another but by the jump back at that moment. Poses are those of all lags
together: what is not known of the lag makes them uncertain along the motion.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.messages.cdr import (
    LASER,
    LASER_SCAN,
    LIGHTS,
    OCCUPANCY_GRID,
    CdrError,
    decode,
    nanoseconds,
)
from swarm_loc_estimator.common.messages.poses import planar_pose
from swarm_loc_estimator.common.parameters import ParameterError
from swarm_loc_estimator.common.se2 import between, compose, transform_points, wrap_angle
from swarm_loc_estimator.swarm.error_models import SingleLidar
from swarm_loc_estimator.swarm.swarm import Robot

MAX_CELLS = 4_000_000  # Maximum number of cells of a valid map
# Of delays
_STEP_S, _COUNT = 0.025, 25  # Lags that are compared
_RIGHT, _CHANGES_PER_S = 0.9, 0.003  # Chance that the described delay is right, and rate of changes
_NEW, _SLIP = 0.3, 0.05  # Share of a match's variance that the next one does not have; error of odometry
_BENT = 0.25  # Error of the heading, as a share of the turn in a sweep that was straightened without it
_DOF = 4.0  # Errors have Student's distribution: wheels slip
_BY_CHANCE = 0.05  # Least likelihood of a lag by one scan, over the greatest: a slip may imitate another
_GAP_NS = 4_000_000_000  # Scans farther apart are not compared
_WILD, _NOISE_SHARE = 400.0, 0.1
"""Squares from which odometry is wrong at any lag and tells nothing, and weight of one in its usual noise."""
_BACKWARDS, _SURE_ORDER = -2.0, 4.0
"""Log odds that the header says the order of the beams wrongly, at first and from which on it is known."""
_NEAR_S, _REFUTED, _LASTS_NS = 0.06, 0.05, 3_000_000_000
"""A delay is refuted if it, and those so near, have had less chance than this for so long."""
_LIKELY = 2**62  # Stamp of what has not happened [ns]
_DOUBTED, _EXCLUDED, _PARDON = 1.0, 10.0, 0.25
"""Numbers of scans that contradict another lidar of the robot from which one is doubted, and is not used any
more, and by how much a scan that agrees lowers its number."""
_NOWHERE = np.full((3, 3), np.nan)


class GridMessage(NamedTuple):
    """A map."""

    stamp_ns: int  # Time of the map
    frame_id: str  # Frame of the origin
    resolution: float  # Side of a cell [m]
    origin: tuple[float, float, float]  # x [m], y [m], yaw [rad] of the outer corner of the first cell
    cells: NDArray[np.int8]  # (height, width), x along the rows: -1 unknown, else occupied by 0 to 100 %


def decode_occupancy_grid(data: bytes) -> GridMessage:
    """Read a nav_msgs/OccupancyGrid; raises CdrError unless the bytes are a valid one."""
    message = decode(data, OCCUPANCY_GRID)
    about, count = message.info, message.data.size
    if not 0 < count <= MAX_CELLS or count != about.width * about.height:
        raise CdrError(f"a map of {about.width} x {about.height} cells has {count} of them.")
    found = grid_message(message)
    if not (found.resolution > 0.0 and all(map(math.isfinite, (found.resolution, *found.origin)))):
        raise CdrError("the place of a map is not finite.")
    return found


def grid_message(message: Any) -> GridMessage:
    """The map of a decoded nav_msgs/OccupancyGrid, which must have as many cells as it says."""
    header, about = message.header, message.info
    cells = message.data.reshape(about.height, about.width)
    stamp_ns, origin = nanoseconds(header.stamp), planar_pose(about.origin)
    return GridMessage(stamp_ns, header.frame_id, about.resolution, origin, cells)


class LaserMessage(NamedTuple):
    """A swarm_loc_msgs/LaserDistance: distance and sigma [m], row of the spot [px]; NaN: no spot."""

    stamp_ns: int
    distance: float
    sigma: float
    row: float


class ScanMessage(NamedTuple):
    """A sensor_msgs/LaserScan; its stamp is the time of the first beam."""

    stamp_ns: int  #: Time of the first beam
    angle_min: float  #: Direction of the first beam [rad]
    angle_max: float  #: Direction of the last beam [rad], which many drivers get wrong: not used
    angle_increment: float  #: From a beam to the next one [rad]
    time_increment: float  #: From a beam to the next one [s]
    range_min: float  #: [m]
    range_max: float  #: [m]
    ranges: FloatArray  #: (b,) [m]
    frame_id: str = ""  #: Of the lidar
    lidar: int = 0  #: Number of the lidar in `LidarModel.all` of its robot


class LightMessage(NamedTuple):
    """One light of swarm_loc_msgs/LightBearingArray."""

    stamp_ns: int
    frequency: float
    bearing: float
    sigma: float


def decode_laser(data: bytes) -> LaserMessage:
    """Read a swarm_loc_msgs/LaserDistance; raises CdrError unless the bytes are a whole one."""
    message = decode(data, LASER)
    return LaserMessage(nanoseconds(message.header.stamp), message.distance, message.sigma, message.v_px)


def decode_scan(data: bytes) -> ScanMessage:
    """Read a sensor_msgs/LaserScan; raises CdrError unless the bytes are a whole one."""
    message = decode(data, LASER_SCAN)
    numbers: dict[str, Any] = {name: float(getattr(message, name)) for name in ScanMessage._fields[1:-3]}
    header, ranges = message.header, message.ranges.astype(float)
    return ScanMessage(nanoseconds(header.stamp), **numbers, ranges=ranges, frame_id=header.frame_id)


def decode_lights(data: bytes) -> list[LightMessage]:
    """Read the finite lights of a LightBearingArray; raises CdrError unless the bytes are a whole one."""
    message = decode(data, LIGHTS)
    lights, stamp_ns = message.lights, nanoseconds(message.header.stamp)
    columns = lights["frequency"], lights["bearing"], np.sqrt(np.maximum(0.0, lights["covariance"][:, 0]))
    is_finite = np.isfinite(columns).all(axis=0)
    rows = zip(*(column[is_finite].tolist() for column in columns), strict=True)
    return [LightMessage(stamp_ns, *row) for row in rows]


def led_frequencies(entries: Collection[str], robots: Collection[str]) -> dict[str, float]:
    """Robot -> frequency of its LEDs [Hz]; raises ParameterError unless each entry is ROBOT=FREQUENCY."""
    found: dict[str, float] = {}
    for entry in entries:
        name, _, value = entry.partition("=")
        try:
            frequency = float(value)
        except ValueError:
            frequency = 0.0
        if name not in robots or not 0.0 < frequency < 1e6:
            raise ParameterError(
                f"parameter led_frequencies: '{entry}' must be the name of a robot that maps, '=' and a"
                " frequency in (0, 1e6) Hz."
            )
        found[name] = frequency
    return found


_MAX_SWEEP_S, _MAX_SWEEP_TURN = 2.0, 7.0
"""Longest time [s] and greatest angle [rad] from the first to the last beam of a scan."""
_AT_RANGE_MAX = 1e-3  # Share of range_max by which ranges of what met nothing may differ from it


class LidarSweep(NamedTuple):
    """Beams (n,) of a scan that are used."""

    stamp_ns: int  # Time of the first beam of the scan
    duration_ns: int  # From its first to its last beam; negative: the last one is measured first
    beam_ns: IntArray  # (n,) times of the beams
    angle: FloatArray  # (n,) directions in the frame of the lidar [rad]
    distance: FloatArray  # (n,) [m]; infinite: nothing up to `reach`
    reach: float  # Range of the lidar [m]
    lidar: SingleLidar  # Its mount and noise
    number: int  # Of the lidar, see `ScanMessage`

    @property
    def seen(self) -> BoolArray:
        """(n,) True for beams that met something."""
        return np.isfinite(self.distance)

    @property
    def last_ns(self) -> int:
        """Time from which on all beams have been measured; stamps may be late."""
        return self.stamp_ns + max(0, self.duration_ns) + round(-1e9 * min(0.0, self.lidar.delay_s))

    def backwards(self) -> LidarSweep:
        """The same beams in the other order of time."""
        return self._replace(beam_ns=2 * self.stamp_ns + self.duration_ns - self.beam_ns)

    def ends(self, motion: FloatArray) -> FloatArray:
        """Ends (n, 2) of the beams, at `reach` where they met nothing.

        `motion` (n, 3) is the pose of the robot at each beam, in the frame of the ends.
        """
        lidar, distance = self.lidar, np.minimum(self.distance, self.reach)
        across = math.cos(lidar.roll)  # walls are vertical, and a lidar upside down sees them mirrored
        ray = distance[:, None] * np.stack([np.cos(self.angle), across * np.sin(self.angle)], axis=-1)
        return transform_points(compose(motion, np.array([lidar.x, lidar.y, lidar.yaw])), ray)


def read_sweep(
    scan: ScanMessage, lidar: SingleLidar, drops: Counter[str], dropped_beams: Counter[str]
) -> LidarSweep | None:
    """The valid beams of a scan; beam i points to angle_min + i * angle_increment, however many there are.

    What met nothing is infinitely far, as in REP 117, or has range_max. NaN, 0 and -inf say nothing.

    Args:
        scan: The message.
        lidar: The lidar that sent it.
        drops: Counts unusable scans by reason.
        dropped_beams: Counts unusable beams by reason.

    Returns:
        The sweep; None if the scan cannot be used.
    """
    # geometry: angles and times of the beams
    count, step = len(scan.ranges), scan.angle_increment
    is_finite = all(map(math.isfinite, (scan.angle_min, step)))
    if not is_finite or step == 0.0 or abs(step) * (count - 1) > _MAX_SWEEP_TURN:
        drops["scan_bad_geometry"] += 1
        return None
    duration_s = scan.time_increment * (count - 1) if count else 0.0
    if not abs(duration_s) <= _MAX_SWEEP_S:
        drops["scan_bad_times"] += 1
        return None
    # ranges that can be true
    far = scan.range_max if math.isfinite(scan.range_max) and scan.range_max > 0.0 else math.inf
    nothing, reach = (1.0 - _AT_RANGE_MAX) * far, min(far, lidar.max_range)
    near = max(scan.range_min, lidar.min_range) if math.isfinite(scan.range_min) else 0.0
    # beams without such a range are counted and left out
    wrong = {
        "beam_not_a_number": np.isnan(scan.ranges),
        "beam_too_near": (scan.ranges < near) | (scan.ranges <= 0.0),
        "beam_too_far": np.isfinite(scan.ranges) & (scan.ranges > (1.0 + _AT_RANGE_MAX) * far),
    }
    for reason, beams in wrong.items():
        dropped_beams[reason] += int(beams.sum())
    used = np.flatnonzero(~np.logical_or.reduce(list(wrong.values())))
    if not len(used):
        drops["scan_without_beams"] += 1
        return None
    # the others, each with its own time
    begin_ns = scan.stamp_ns + round(1e9 * lidar.delay_s)
    beam_ns = begin_ns + np.round(used * (scan.time_increment * 1e9)).astype(np.int64)
    distance = np.where(scan.ranges[used] > min(nothing, reach), math.inf, scan.ranges[used])
    angle = scan.angle_min + used.astype(float) * step
    duration_ns = round(1e9 * duration_s)
    return LidarSweep(begin_ns, duration_ns, beam_ns, angle, distance, reach, lidar, scan.lidar)


class DelayBelief(NamedTuple):
    """What is known of the times of a lidar's beams, and its newest scan."""

    lag_s: FloatArray  # (L,) how much older scans may be than described [s]
    chance: FloatArray  # (L,) of each
    stamp_ns: int  # Stamp of the scan
    seen: FloatArray  # (3,) pose of the robot in the middle of the sweep, in `map`
    covariance: FloatArray  # (3, 3) of this pose, by its own axes
    track: FloatArray  # (L, 3) this pose by odometry, at each lag
    backwards: float = _BACKWARDS  # Log odds that beams are measured in the other order than described
    noise: float = 1.0  # Mean of recent squares: how much worse odometry is than assumed
    unlikely_ns: int = _LIKELY  # Stamp since when the described delay has hardly any chance
    fit_ns: int = -_LIKELY  # Stamp of the newest scan that fit where its robot was
    misses: float = 0.0  # Score of scans that contradict another lidar of the robot
    is_sought: bool = False  # Whether its robot is where a search has put it, and no scan has confirmed that
    #: (3, 3) at its stamp: the pose in `map`, by odometry as it is used, and as it was reported
    anchor: FloatArray = _NOWHERE

    @property
    def is_doubted(self) -> bool:
        """Whether the lidar contradicts another one of its robot and may be right: it had not agreed."""
        return self.misses >= _DOUBTED and (self.misses < _EXCLUDED or self.fit_ns < 0)

    @property
    def is_excluded(self) -> bool:
        """Whether the lidar contradicts another one of its robot again and again."""
        return self.misses >= _EXCLUDED

    def elsewhere(self) -> DelayBelief:
        """The belief after the robot was found elsewhere; a lidar that is excluded stays so."""
        return self if self.is_excluded else self._replace(fit_ns=-_LIKELY, misses=0.0)

    def judged(self, stamp_ns: int, *, fits: bool) -> DelayBelief:
        """The belief after a scan that fits where its robot is, or contradicts another lidar there."""
        if fits:
            return self._replace(fit_ns=stamp_ns, misses=max(0.0, self.misses - _PARDON))
        return self._replace(misses=min(self.misses + 1.0, 2.0 * _EXCLUDED))

    @property
    def is_backwards(self) -> bool:
        """Whether beams are certainly measured in the other order than described."""
        return self.backwards > _SURE_ORDER

    @property
    def mean_s(self) -> float:
        """Mean lag [s]."""
        return float(self.chance @ self.lag_s)

    @property
    def sigma_s(self) -> float:
        """Standard deviation of the lag [s]."""
        return math.sqrt(float(self.chance @ (self.lag_s - self.mean_s) ** 2))

    @property
    def is_refuted(self) -> bool:
        """Whether the described delay is wrong."""
        return self.unlikely_ns + _LASTS_NS <= self.stamp_ns

    @property
    def median(self) -> int:
        """Number of the median lag."""
        return int(np.searchsorted(np.cumsum(self.chance), 0.5))

    def sentence(self, robot: Robot, number: int = 0) -> str:
        """How old the scans of one of the lidars of a robot are, and what to describe."""
        topic, lidar = list(robot.lidar.all.items())[number]
        whose, key = (f"{robot.name}/{topic}", f"others.{topic}.") if number else (robot.name, "")
        older = "older" if self.mean_s > 0.0 else "newer"
        text = f"the scans of {whose} are {abs(self.mean_s):.2f} +- {self.sigma_s:.2f} s {older} than"
        text += f" described: set lidar.{key}delay_s to {lidar.delay_s - self.mean_s:.2f}, or correct their"
        return f"{text} stamps"


def described_delay(delay_s: float) -> DelayBelief:
    """The belief before the first scan; the described delay [s] is negative if scans are stamped late."""
    before = min(_COUNT - 1, round(max(0.0, -delay_s) / _STEP_S))  # no scan is newer than its arrival
    lag_s = _STEP_S * (np.arange(_COUNT, dtype=float) - before)
    nothing = np.zeros(3), np.eye(3), np.zeros((_COUNT, 3))
    return DelayBelief(lag_s, _delay_prior(lag_s), -_GAP_NS, *nothing)


def _delay_prior(lag_s: FloatArray) -> FloatArray:
    """Chances (L,) of lags without any scan."""
    chance = np.full(_COUNT, (1.0 - _RIGHT) / (_COUNT - 1))
    chance[np.argmin(np.abs(lag_s))] = _RIGHT
    return chance


def learned_delay(
    before: DelayBelief, stamp_ns: int, seen: FloatArray, covariance: FloatArray, track: FloatArray
) -> DelayBelief:
    """The belief after another scan, of which `DelayBelief` tells the arguments; `covariance` is in `map`."""
    turn, cos, sin = np.eye(3), math.cos(seen[2]), math.sin(seen[2])
    turn[:2, :2] = [[cos, sin], [-sin, cos]]
    own, chance, since_ns = turn @ covariance @ turn.T, before.chance, stamp_ns - before.stamp_ns
    noisiness = before.noise
    if 0 < since_ns < _GAP_NS:
        # (L, L, 3) errors of the motion from a lag of the scan before to one of this scan
        error = between(track, compose(before.track, between(before.seen, seen))[:, None])
        slip = _SLIP * (chance @ between(before.track, track))
        noise = _NEW * (own + before.covariance) + np.diag(slip**2)
        squares = (error @ np.linalg.inv(noise) * error).sum(axis=-1)
        usual = min(float(chance @ np.diag(squares)) / 3.0, _WILD)
        noisiness = max(1.0, noisiness + _NOISE_SHARE * (usual - noisiness))
        # a sweep that turned otherwise than at the likeliest lag was straightened wrongly
        turned = np.gradient(np.unwrap(track[:, 2])) * (1e-9 * since_ns / _STEP_S)
        bent = 1.0 + (_BENT * (turned - turned[chance.argmax()])) ** 2 / noise[2, 2]
        # changes are rare, and more often to what is described
        change = 1.0 - math.exp(-1e-9 * since_ns * _CHANGES_PER_S)
        transition = (1.0 - change) * np.eye(_COUNT) + change * _delay_prior(before.lag_s)
        likely = (1.0 + squares / (noisiness * bent * _DOF)) ** (-0.5 * (_DOF + 3.0)) / np.sqrt(bent)
        chance = chance @ (transition * (likely + _BY_CHANCE * np.diag(likely).max()))
        chance = chance / chance.sum() if squares.min() < _WILD else before.chance
    is_unlikely = chance[np.abs(before.lag_s) <= _NEAR_S].sum() < _REFUTED
    since_ns = min(before.unlikely_ns, stamp_ns) if is_unlikely else _LIKELY
    before = before._replace(chance=chance, noise=noisiness, unlikely_ns=since_ns)
    return before._replace(stamp_ns=stamp_ns, seen=seen, covariance=own, track=track)


def at_odometry(belief: DelayBelief, now: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The pose (3,) in `map` at a pose (3,) by odometry, and its covariance (3, 3) by the lag alone."""
    poses = compose(belief.seen, between(belief.track, now))
    off = poses - poses[0]
    off[:, 2] = wrap_angle(off[:, 2])
    mean = belief.chance @ off
    off -= mean
    return poses[0] + mean, (belief.chance * off.T) @ off
