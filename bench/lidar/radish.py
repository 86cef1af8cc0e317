"""Logs of real buildings as bags: one robot's wheel odometry and 2-D lidar, without ground truth."""

from __future__ import annotations

import gzip
import math
from pathlib import Path

import numpy as np

from bench.shared.bags import message_header
from bench.shared.common import SHARED
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.cdr import LASER_SCAN, ODOMETRY, encode
from swarm_loc_estimator.common.messages.poses import encode_odometry
from swarm_loc_estimator.swarm.error_models import LidarModel
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import save_swarm

RADISH = SHARED / "data" / "radish"  # Its README says what the files mean
BUILDINGS = ("freiburg-101", "acapulco", "intel", "freiburg-079")
NAME = "robot"
_FARTHEST = 50.0  # Range from which nothing was met, in all of them [m]


def reference(building: str) -> FloatArray:
    """The path (n, 4) that gmapping found: time [s], x [m], y [m], heading [rad] at each scan."""
    rows = np.loadtxt(RADISH / building / "reference.tum")
    return np.column_stack([rows[:, :3], 2.0 * np.arctan2(rows[:, 6], rows[:, 7])])


def write_bag(building: str, folder: Path, until_s: float = math.inf) -> int:
    """Write the first seconds of a log as a bag with its swarm.yaml; returns the number of scans."""
    odometry = np.loadtxt(RADISH / building / "odom.csv", delimiter=",", skiprows=1)
    with gzip.open(RADISH / building / "scans.csv.gz", "rt", encoding="utf-8") as file:
        scans = [np.array(line.split(","), dtype=float) for line in file]
    rows = [(row[0], 0, row[1:]) for row in odometry] + [(row[0], 1, row[1:]) for row in scans]
    rows = sorted((row for row in rows if row[0] - odometry[0, 0] < until_s), key=lambda row: row[:2])
    lidar_x = 0.04 if building.startswith("freiburg") else 0.0
    with BagWriter(folder) as bag:
        bag.add_topic(f"{NAME}/odom", ODOMETRY)
        bag.add_topic(f"{NAME}/scan", LASER_SCAN)
        for stamp_s, kind, values in rows:
            stamp_ns = round(1e9 * stamp_s)
            if kind:
                data = _scan(stamp_ns, np.where(values >= _FARTHEST, math.inf, values))
                bag.write(f"{NAME}/scan", stamp_ns, data)
            else:
                bag.write(f"{NAME}/odom", stamp_ns, _odometry(stamp_ns, values))
    lidar = LidarModel(range_sigma=0.02, range_sigma_per_m=0.005, x=lidar_x, max_range=25.0)
    save_swarm(Swarm((Robot(NAME, lidar=lidar),)), folder / "swarm.yaml")
    return sum(row[1] for row in rows)


def _odometry(stamp_ns: int, pose: FloatArray) -> bytes:
    """A nav_msgs/Odometry of a pose (3,)."""
    stamps = np.array([stamp_ns])
    return encode_odometry(f"{NAME}/odom", f"{NAME}/base_link", stamps, pose[None], np.zeros((1, 3)))[0]


def _scan(stamp_ns: int, ranges: FloatArray) -> bytes:
    """A sensor_msgs/LaserScan of ranges (n,) from right to left [m]."""
    count = len(ranges)
    step = math.pi / (count - count % 2)
    numbers = {"angle_min": -0.5 * math.pi, "angle_max": -0.5 * math.pi + step * (count - 1)}
    numbers |= {"angle_increment": step, "range_min": 0.02, "range_max": _FARTHEST}
    header = message_header(stamp_ns, f"{NAME}/laser")
    return encode({"header": header, **numbers, "ranges": ranges.astype(np.float32)}, LASER_SCAN)
