"""A drive at a wall from a bag: odometry, and the rows of the laser's spot."""

from __future__ import annotations

import math
from pathlib import Path

from swarm_loc_estimator import LASER, BadMessageError, decode_laser
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.messages.cdr import CdrError, decode_odometry
from swarm_loc_estimator.common.messages.typestore import ODOMETRY
from swarm_loc_vision.laser.fit import CalibrationError
from swarm_loc_vision.laser.wall_drive import WallDrive


def recorded_drive(bag: Path, robot: str, drive: WallDrive) -> WallDrive:
    """Fill a drive from a bag, until it has come as near to the wall as it should; the drive.

    Args:
        bag: With `<robot>/odom` and `<robot>/laser`; the distance to the wall counts at the first odometry.
        robot: Its name; "" where topics have none before them.
        drive: Empty as yet.

    Raises:
        CalibrationError: A topic has nothing usable, or the robot turns on its way.
        UserError: The bag cannot be read.
    """
    prefix = f"{robot}/" if robot else ""
    types = {f"{prefix}odom": ODOMETRY, f"{prefix}laser": LASER}
    seen = dict.fromkeys(types, 0)
    with BagReader(bag) as reader:
        for topic, message_type, _, data in reader.messages(types):
            if message_type != types[topic] or drive.is_done:
                continue
            seen[topic] += _take(drive, data, is_laser=message_type == LASER)
    for topic, count in seen.items():
        if not count:
            raise CalibrationError(f"'{bag}' has nothing usable on {topic}.")
    return drive


def _take(drive: WallDrive, data: bytes, *, is_laser: bool) -> bool:
    """Take a message; whether it could be used."""
    try:
        if is_laser:
            seen = decode_laser(data)
            drive.take_row(seen.stamp_ns, seen.row)
            return math.isfinite(seen.row)
        odometry = decode_odometry(data)
    except (CdrError, BadMessageError):
        return False
    if not all(map(math.isfinite, odometry.pose)):
        return False
    drive.take_odometry(odometry.stamp_ns, *odometry.pose)
    return True
