"""An e-puck's measurements as ROS messages."""

from __future__ import annotations

import math

import numpy as np
from geometry_msgs.msg import Transform, TransformStamped, Vector3
from numpy.typing import NDArray
from sensor_msgs.msg import Range
from std_msgs.msg import Header

from swarm_loc_drivers.common.odometry_output import stamp_message, yaw_quaternion
from swarm_loc_drivers.epuck.hardware import PROXIMITY_BEARINGS, PROXIMITY_RADIUS_M
from swarm_loc_drivers.epuck.proximity import FIELD_OF_VIEW, MAX_RANGE_M, MIN_RANGE_M, range_of_raw

PROXIMITY_NAMES = tuple(f"ps{sensor}" for sensor in range(len(PROXIMITY_BEARINGS)))


def _proximity_frames(prefix: str) -> list[str]:
    """Names of the sensors' frames, x out of the sensor."""
    return [f"{prefix}{name}" for name in PROXIMITY_NAMES]


def proximity_transforms(stamp_ns: int, base_frame: str, prefix: str) -> list[TransformStamped]:
    """Where the proximity sensors sit."""
    header = Header(stamp=stamp_message(stamp_ns), frame_id=base_frame)
    transforms = []
    for frame, bearing in zip(_proximity_frames(prefix), PROXIMITY_BEARINGS, strict=True):
        place = Vector3(x=PROXIMITY_RADIUS_M * math.cos(bearing), y=PROXIMITY_RADIUS_M * math.sin(bearing))
        transform = Transform(translation=place, rotation=yaw_quaternion(bearing))
        transforms.append(TransformStamped(header=header, child_frame_id=frame, transform=transform))
    return transforms


def range_messages(stamp_ns: int, raw: NDArray[np.int64], prefix: str) -> list[Range]:
    """The proximity sensors' raw values (8,) as ranges, ps0 first."""
    stamp = stamp_message(stamp_ns)
    return [
        Range(
            header=Header(stamp=stamp, frame_id=frame),
            radiation_type=Range.INFRARED,
            field_of_view=FIELD_OF_VIEW,
            min_range=MIN_RANGE_M,
            max_range=MAX_RANGE_M,
            range=distance,
        )
        for frame, distance in zip(_proximity_frames(prefix), range_of_raw(raw).tolist(), strict=True)
    ]
