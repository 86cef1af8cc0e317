"""Messages of the mapper: maps, laser distances and frequencies of lights.

Sweeps of lidars: the beams of a LaserScan that are used, and where they end.
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
from swarm_loc_estimator.common.se2 import compose, transform_points
from swarm_loc_estimator.swarm.error_models import LidarModel

MAX_CELLS = 4_000_000  # Maximum number of cells of a valid map


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
    numbers = {name: float(getattr(message, name)) for name in ScanMessage._fields[1:-2]}
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

    @property
    def seen(self) -> BoolArray:
        """(n,) True for beams that met something."""
        return np.isfinite(self.distance)

    def backwards(self) -> LidarSweep:
        """The same beams in the other order of time."""
        return self._replace(beam_ns=2 * self.stamp_ns + self.duration_ns - self.beam_ns)

    def ends(self, lidar: LidarModel, motion: FloatArray) -> FloatArray:
        """Ends (n, 2) of the beams, at `reach` where they met nothing.

        Args:
            lidar: Its mount.
            motion: (n, 3) pose of the robot at each beam, in the frame of the ends.
        """
        distance = np.minimum(self.distance, self.reach)
        across = math.cos(lidar.roll)  # walls are vertical, and a lidar upside down sees them mirrored
        ray = distance[:, None] * np.stack([np.cos(self.angle), across * np.sin(self.angle)], axis=-1)
        return transform_points(compose(motion, np.array([lidar.x, lidar.y, lidar.yaw])), ray)


def read_sweep(
    scan: ScanMessage, lidar: LidarModel, drops: Counter[str], dropped_beams: Counter[str]
) -> LidarSweep | None:
    """The valid beams of a scan; beam i points to angle_min + i * angle_increment, however many there are.

    What met nothing is infinitely far, as in REP 117, or has range_max. NaN, 0 and -inf say nothing.

    Args:
        scan: The message.
        lidar: Its range.
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
    return LidarSweep(begin_ns, round(1e9 * duration_s), beam_ns, angle, distance, reach)
