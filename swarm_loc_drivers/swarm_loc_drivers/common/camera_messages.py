"""Images and calibrations of cameras as ROS messages."""

from __future__ import annotations

from array import array

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from swarm_loc_drivers.common.calibration_file import CameraCalibration
from swarm_loc_drivers.common.odometry_output import stamp_message


def image_message(pixels: NDArray[np.uint8], stamp_ns: int, frame_id: str) -> Image:
    """Pixels (height, width) of grey or (height, width, 3) of RGB as sensor_msgs/Image."""
    height, width = pixels.shape[:2]
    message = Image(
        header=Header(stamp=stamp_message(stamp_ns), frame_id=frame_id),
        height=height,
        width=width,
        encoding="mono8" if pixels.ndim == 2 else "rgb8",
        step=pixels[0].nbytes,
    )
    message.data = array("B", pixels.tobytes())  # a list would be checked byte by byte
    return message


def camera_info_message(calibration: CameraCalibration, header: Header) -> CameraInfo:
    """The calibration that goes with an image of this header."""
    return CameraInfo(
        header=header,
        height=calibration.height,
        width=calibration.width,
        distortion_model=calibration.model,
        d=list(calibration.distortion),
        k=list(calibration.matrix),
        r=list(calibration.rectification),
        p=list(calibration.projection),
    )
