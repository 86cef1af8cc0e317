"""What the tests of mapping share: a room with one niche, and robots that look around in it."""

from __future__ import annotations

import math

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.cdr import LASER_SCAN, TRANSFORMS, encode
from swarm_loc_estimator.common.se2 import compose, exp, wrap_angle
from swarm_loc_estimator.mapping.grid import OccupancyMap
from swarm_loc_estimator.mapping.messages import ScanMessage
from swarm_loc_estimator.mapping.scans import Readings
from swarm_loc_estimator.swarm.error_models import LidarModel, SingleLidar

PERIOD_NS = 20_000_000
MAX_RANGE = 2.5
SIGMA = 0.1 / 6.3  # A tenth of a pixel [1/m]
ROOM = (0.0, 0.0, 3.4, 2.6)  # Left, lower, right, upper [m]
NICHE = (1.2, 2.6, 2.0, 3.1)
_SPEED, _TURN_RATE = 0.2, 1.0


def distance_in_room(x: float, y: float, angle: float, *, has_niche: bool = True) -> float:
    """Distance along a ray from inside the room, out to its wall or that of the niche [m]."""
    best = _leave(ROOM, x, y, angle)
    at_x, at_y = x + best * math.cos(angle), y + best * math.sin(angle)
    if has_niche and abs(at_y - ROOM[3]) < 1e-9 and NICHE[0] < at_x < NICHE[2]:
        best += _leave(NICHE, at_x, at_y + 1e-12, angle)
    return best


def _leave(box: tuple[float, float, float, float], x: float, y: float, angle: float) -> float:
    cos, sin = math.cos(angle), math.sin(angle)
    along_x = ((box[2] if cos > 0.0 else box[0]) - x) / cos if abs(cos) > 1e-12 else math.inf
    along_y = ((box[3] if sin > 0.0 else box[1]) - y) / sin if abs(sin) > 1e-12 else math.inf
    return min(along_x, along_y)


def inverse_distances(
    pose: FloatArray, angles: FloatArray, rng: np.random.Generator | None, *, has_niche: bool = True
) -> FloatArray:
    """Inverse distances (n,) in directions (n,) of map, 0 beyond the range; with noise if it has a source."""
    distances = np.array([distance_in_room(pose[0], pose[1], angle, has_niche=has_niche) for angle in angles])
    noise = rng.standard_normal(len(angles)) * SIGMA if rng is not None else 0.0
    return np.where(distances < MAX_RANGE, np.maximum(1.0 / distances + noise, 1e-3), 0.0)


class RoomRobot:
    """A robot whose turns are short by its slip, which its odometry does not know; exact without `rng`."""

    has_niche = True  # Whether its room has the niche

    def __init__(
        self, pose: tuple[float, float, float], slip: float, rng: np.random.Generator | None
    ) -> None:
        self.pose = np.array(pose)
        self.odometry = np.zeros(3)
        self._slip, self._rng = slip, rng
        self._stamp_ns = 0

    def turn(self, angle: float, rate: float = _TURN_RATE) -> Readings:
        """Turn by an angle of the odometry [rad]."""
        count = max(1, round(abs(angle) / (rate * PERIOD_NS * 1e-9)))
        turned = angle * np.arange(1, count + 1) / count
        odometry = np.tile(self.odometry, (count, 1))
        odometry[:, 2] += turned
        headings = self.pose[2] + turned * (1.0 - self._slip)
        readings = self._read(odometry, np.tile(self.pose[:2], (count, 1)), headings)
        self.pose[2] = headings[-1]
        return readings

    def rest(self, duration_s: float) -> Readings:
        """Stand still [s]."""
        count = round(1e9 * duration_s / PERIOD_NS)
        places = np.tile(self.pose[:2], (count, 1))
        return self._read(np.tile(self.odometry, (count, 1)), places, np.full(count, self.pose[2]))

    def pass_time(self, duration_s: float) -> None:
        """Let a time pass without readings [s]."""
        self._stamp_ns += round(1e9 * duration_s)

    def catch_up(self, other: RoomRobot) -> None:
        """Let time pass without readings until that of another robot, or that one's until ours."""
        self._stamp_ns = other._stamp_ns = max(self._stamp_ns, other._stamp_ns)

    def drive(self, length: float, moves: float = 1.0) -> Readings:
        """Drive ahead by a length of the odometry [m]; the body moves the first share of it, and is held."""
        count = max(1, round(length / (_SPEED * PERIOD_NS * 1e-9)))
        way = length * np.arange(1, count + 1)[:, None] / count
        odometry = np.tile(self.odometry, (count, 1))
        odometry[:, :2] += way * [math.cos(self.odometry[2]), math.sin(self.odometry[2])]
        moved = np.minimum(way, moves * length)
        places = self.pose[:2] + moved * [math.cos(self.pose[2]), math.sin(self.pose[2])]
        readings = self._read(odometry, places, np.full(count, self.pose[2]))
        self.pose[:2] = places[-1]
        return readings

    def go_to(self, odometry: FloatArray) -> list[Readings]:
        """Turn to a place (2,) in the odom frame and drive there."""
        way = odometry - self.odometry[:2]
        angle = float(wrap_angle(math.atan2(way[1], way[0]) - self.odometry[2]))
        return [self.turn(angle), self.drive(math.hypot(way[0], way[1]))]

    def _read(self, odometry: FloatArray, places: FloatArray, headings: FloatArray) -> Readings:
        stamps = self._stamp_ns + PERIOD_NS * np.arange(1, len(odometry) + 1)
        self._stamp_ns = int(stamps[-1])
        self.odometry = odometry[-1].copy()
        inverse = np.concatenate(
            [
                inverse_distances(place, np.array([heading]), self._rng, has_niche=self.has_niche)
                for place, heading in zip(places, headings, strict=True)
            ]
        )
        reported = odometry.copy()
        reported[:, 2] = wrap_angle(odometry[:, 2])
        return Readings(stamps, reported, inverse, SIGMA)


LIDAR = LidarModel(
    range_sigma=0.01, range_sigma_per_m=0.01, x=0.05, y=-0.02, yaw=0.5 * math.pi, map_sigma=0.02
)
"""Of `LidarRobot`, on a mount off the centre, in exact maps."""
SWEEP_NS, BEAMS = 200_000_000, 360


class LidarRobot:
    """A robot that drives a circle in the room without slip, and its lidar; exact without `rng`."""

    start = np.array([1.7, 0.8, 0.0])
    has_niche = True  # Whether its room has the niche

    def __init__(self, rng: np.random.Generator | None = None) -> None:
        self._rng = rng

    def odometry(self, stamp_ns: NDArray[np.int64]) -> FloatArray:
        """Poses (n, 3) by odometry at times (n,); it drives at 0.2 m/s and turns by 0.4 rad/s."""
        return exp(np.multiply.outer(stamp_ns * 1e-9, [0.2, 0.0, 0.4]))

    def pose(self, stamp_ns: int) -> FloatArray:
        """The true pose (3,)."""
        return compose(self.start, self.odometry(np.array([stamp_ns]))[0])

    def scan(self, stamp_ns: int, lidar: SingleLidar = LIDAR) -> ScanMessage:
        """The sweep that begins at a time; every beam leaves from where the robot then is."""
        beam_ns = stamp_ns + SWEEP_NS // BEAMS * np.arange(BEAMS)
        step = 2.0 * math.pi / BEAMS
        beams = np.stack([np.zeros(BEAMS), np.zeros(BEAMS), step * np.arange(BEAMS)], axis=-1)
        mounted = compose(compose(self.start, self.odometry(beam_ns)), [lidar.x, lidar.y, lidar.yaw])
        ranges = np.array(
            [distance_in_room(*ray, has_niche=self.has_niche) for ray in compose(mounted, beams).tolist()]
        )
        if self._rng is not None:
            sigma = lidar.range_sigma + lidar.range_sigma_per_m * ranges
            ranges += sigma * self._rng.standard_normal(BEAMS)
        return ScanMessage(stamp_ns, 0.0, 2.0 * math.pi, step, SWEEP_NS // BEAMS * 1e-9, 0.12, 3.5, ranges)


def scan_bytes(scan: ScanMessage) -> bytes:
    header = {"stamp": scan.stamp_ns, "frame_id": scan.frame_id or "a/base_scan"}
    fields = {**scan._asdict(), "header": header, "ranges": scan.ranges.astype(np.float32)}
    del fields["stamp_ns"], fields["frame_id"], fields["lidar"]
    return encode(fields, LASER_SCAN)


def room_map(cell: float, *, has_niche: bool = True) -> OccupancyMap:
    """The exact map of the room: with cells of 5 cm, its walls are on centres of cells."""
    corner = np.array([-0.325, -0.325])
    count = np.ceil((np.array([ROOM[2], NICHE[3]]) + 0.7) / cell).astype(int)
    x, y = np.meshgrid(*(corner[k] + (np.arange(count[k]) + 0.5) * cell for k in (0, 1)), indexing="ij")
    outside = np.ones(x.shape, dtype=bool)
    boxes = (ROOM, (NICHE[0], ROOM[1], *NICHE[2:])) if has_niche else (ROOM,)
    for left, lower, right, upper in boxes:
        inside = (x > left + 1e-6) & (x < right - 1e-6) & (y > lower + 1e-6) & (y < upper - 1e-6)
        outside &= ~inside
    distance = scipy.ndimage.distance_transform_edt(outside)
    return OccupancyMap(corner, cell, np.where(~outside, -5.0, np.where(distance <= 1.0, 5.0, 0.0)))


def static(*joints: tuple[str, str, tuple[float, ...], tuple[float, ...]]) -> bytes:
    """A message of transforms: parent, child, place [m], and yaw, pitch, roll [rad]."""
    transforms = []
    for parent, child, place, angles in joints:
        rotation = Rotation.from_euler("ZYX", angles).as_quat()
        transform = {
            "translation": dict(zip("xyz", place, strict=True)),
            "rotation": dict(zip("xyzw", rotation.tolist(), strict=True)),
        }
        header = {"stamp": 0, "frame_id": parent}
        transforms.append({"header": header, "child_frame_id": child, "transform": transform})
    return encode({"transforms": transforms}, TRANSFORMS)
