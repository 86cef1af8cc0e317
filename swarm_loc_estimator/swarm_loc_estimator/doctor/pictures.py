"""Images of the robots' cameras: calibration and encoding."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from swarm_loc_estimator.doctor.evidence import Evidence, Finding, Heard, decoded, same_type

CAMERA_INFO, IMAGE, COMPRESSED_IMAGE = (
    f"sensor_msgs/msg/{name}" for name in ("CameraInfo", "Image", "CompressedImage")
)
_EIGHT_BITS = (
    *("mono8", "8UC1", "rgb8", "bgr8", "8UC3", "rgba8", "bgra8", "8UC4"),
    *("bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"),
)
IMAGE_ENCODINGS = frozenset(
    [
        *_EIGHT_BITS,
        *(name.replace("8", "16") for name in _EIGHT_BITS),
        *("yuv422", "uyvy", "yuv422_yuy2", "yuyv", "nv12", "nv21", "nv24"),
    ]
)
"""Encodings that the detectors of swarm_loc_vision read."""


def check_pictures(evidence: Evidence) -> Iterator[Finding]:
    """Cameras with images have intrinsics, and an encoding that the detectors read."""
    cameras = tuple(f"{robot.name}/" for robot in evidence.swarm.robots if robot.camera is not None)
    for name, heard in evidence.topics.items():
        is_compressed = same_type(heard.type, COMPRESSED_IMAGE)
        if not is_compressed and not same_type(heard.type, IMAGE):
            continue
        if not name.startswith(cameras) or not name.removesuffix("/compressed").endswith("image_raw"):
            continue
        if "depth" in name:
            continue
        images, malformed = decoded(heard)
        if malformed:
            yield Finding(name, f"has {malformed} messages that are no {heard.type}", "Rebuild its publisher")
        if not images:
            continue
        image = images[-1]
        if not is_compressed and not {image.encoding, image.encoding.lower()} & IMAGE_ENCODINGS:
            remedy = f"Publish one of {', '.join(sorted(IMAGE_ENCODINGS))}"
            yield Finding(
                name, f"has the encoding '{image.encoding}', which the detectors cannot read", remedy
            )
        # image_raw/compressed is a transport of image_raw, which has camera_info beside it
        namespace = name.removesuffix("/compressed").rpartition("/")[0]
        info_name = f"{namespace}/camera_info".lstrip("/")
        found = evidence.topics.get(info_name, Heard(""))
        infos = decoded(found)[0] if same_type(found.type, CAMERA_INFO) else []
        yield from _of_intrinsics(
            name, info_name, infos[-1] if infos else None, None if is_compressed else image
        )


def _of_intrinsics(name: str, info_name: str, info: Any, image: Any) -> Iterator[Finding]:
    """What is wrong with the newest CameraInfo beside an image, which may be None."""
    calibrate = "Calibrate the camera (camera_calibration) and let its driver load the file"
    if info is None:
        yield Finding(name, f"has no intrinsics: no message on {info_name}", calibrate)
    elif not info.k[0] > 0.0 or not info.k[4] > 0.0:
        yield Finding(info_name, "has intrinsics of zeros: the camera is not calibrated", calibrate)
    elif image is not None and (info.width, info.height) != (image.width, image.height):
        problem = f"is of {info.width} x {info.height} pixels but images have {image.width} x {image.height}"
        yield Finding(info_name, problem, "Calibrate at the resolution that the driver publishes")
