"""A run with pictures as a bag: compressed images as image_transport names them, and their calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.io.typestore import encode, typestore

from .bag import Stream, odometry_stream, truth_stream, write_streams
from .pictures import PicturedRun
from .render.lens import CameraModel

COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
JPEG_QUALITY = 85
_SECOND = 1_000_000_000


def write_picture_bag(pictured: PicturedRun, folder: Path, comment: str) -> int:
    """Write `<robot>/image_raw/compressed`, `camera_info`, `odom` and `ground_truth` of all robots.

    The folder, the comment, the result and the errors are those of `bag.write_bag`.
    """
    run = pictured.run
    frames = run.frames
    headers = [
        _header(run.swarm.robots[robot].name, stamp_ns)
        for robot, stamp_ns in zip(frames["robot"].tolist(), frames["stamp_ns"].tolist(), strict=True)
    ]
    images = [_image(header, picture) for header, picture in zip(headers, pictured.pictures(), strict=True)]
    infos = [_info(header, pictured.camera) for header in headers]
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
    """The header of a picture and of its calibration."""
    types = typestore().types
    stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, _SECOND))
    return types["std_msgs/msg/Header"](stamp, f"{robot}/camera_optical_frame")


def _image(header: Any, picture: NDArray[np.uint8]) -> bytes:
    """A grey picture as sensor_msgs/CompressedImage."""
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    kind = typestore().types[COMPRESSED_IMAGE]
    return encode(kind(header, "mono8; jpeg compressed mono8", data.reshape(-1)), COMPRESSED_IMAGE)


def _info(header: Any, camera: CameraModel) -> bytes:
    """The calibration as sensor_msgs/CameraInfo."""
    types = typestore().types
    message = types[CAMERA_INFO](
        header=header,
        **camera.camera_info(),
        binning_x=0,
        binning_y=0,
        roi=types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, do_rectify=False),
    )
    return encode(message, CAMERA_INFO)
