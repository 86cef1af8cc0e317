"""Write a run with images as a bag: compressed images as in image_transport, and their calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.common.calibration_file import CameraCalibration
from swarm_loc_drivers.sim.recording.bag import Stream, odometry_stream, truth_stream, write_streams
from swarm_loc_drivers.sim.scenarios.eight_images import ImageRun
from swarm_loc_estimator.common.messages.typestore import encode, typestore

COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
JPEG_QUALITY = 85
_SECOND = 1_000_000_000


def write_image_bag(recorded: ImageRun, folder: Path, comment: str) -> int:
    """Write `<robot>/image_raw/compressed`, `camera_info`, `odom` and `ground_truth` of all robots.

    The folder, the comment, the result and the errors are those of `bag.write_bag`.
    """
    run = recorded.run
    frames = run.frames
    headers = [
        _header(run.swarm.robots[robot].name, stamp_ns)
        for robot, stamp_ns in zip(frames["robot"].tolist(), frames["stamp_ns"].tolist(), strict=True)
    ]
    images = [_image(header, image) for header, image in zip(headers, recorded.images(), strict=True)]
    infos = [_info(header, recorded.camera.calibration) for header in headers]
    streams: list[Stream] = []
    for index, robot in enumerate(run.swarm.robots):
        own = np.flatnonzero(frames["robot"] == index)
        arrival_ns = frames["arrival_ns"][own]
        streams += [
            odometry_stream(run, index),
            Stream(f"{robot.name}/camera_info", CAMERA_INFO, arrival_ns, [infos[k] for k in own]),
            Stream(
                f"{robot.name}/image_raw/compressed", COMPRESSED_IMAGE, arrival_ns, [images[k] for k in own]
            ),
            truth_stream(run, index),
        ]
    return write_streams(streams, run.swarm, folder, comment)


def _header(robot: str, stamp_ns: int) -> Any:
    """The header of an image and of its calibration."""
    types = typestore().types
    stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, _SECOND))
    return types["std_msgs/msg/Header"](stamp, f"{robot}/camera_optical_frame")


def _image(header: Any, image: NDArray[np.uint8]) -> bytes:
    """A grey image as sensor_msgs/CompressedImage."""
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    kind = typestore().types[COMPRESSED_IMAGE]
    return encode(kind(header, "mono8; jpeg compressed mono8", data.reshape(-1)), COMPRESSED_IMAGE)


def _info(header: Any, calibration: CameraCalibration) -> bytes:
    """The calibration as sensor_msgs/CameraInfo."""
    types = typestore().types
    message = types[CAMERA_INFO](
        header,
        calibration.height,
        calibration.width,
        calibration.model,
        np.array(calibration.distortion),
        np.array(calibration.matrix),
        np.array(calibration.rectification),
        np.array(calibration.projection),
        binning_x=0,
        binning_y=0,
        roi=types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, do_rectify=False),
    )
    return encode(message, CAMERA_INFO)
