"""Convert a bag with images to one with detections, by the very code that runs live.

Detections get the log time of their image, everything else stays as it was recorded; so the same bag gives
the same bytes every time.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from rosbags.serde import SerdeError

from swarm_loc_estimator.common.bags.bag_file import BagError, BagTopic
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.typestore import DETECTIONS, typestore
from swarm_loc_vision.common.camera import CameraError
from swarm_loc_vision.common.gray import ImageError
from swarm_loc_vision.common.transports import TRANSPORTS, Transport
from swarm_loc_vision.markers.camera_detector import CameraDetector

CreateCamera = Callable[[str, Transport], CameraDetector]
Progress = Callable[[float, str], None]

_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_NOT_A_MESSAGE = (SerdeError, struct.error, ValueError)
"""What the type store raises at bytes that are not a whole message."""


class ImageBag:
    """A bag with images, to be read once.

    Args:
        bag: rosbag2 folder, .mcap or .db3 file; may have been cut off.
        create: Makes the detector of the camera in a namespace, whose images come in a certain way.

    Attributes:
        cameras: The detectors by namespace of their camera.
        losses: What could not be read, a sentence each.

    Raises:
        BagError: The bag cannot be read, or it holds no images.
    """

    def __init__(self, bag: Path, create: CreateCamera) -> None:
        self.losses: Sequence[str] = ()
        self._bag = bag
        with BagReader(bag) as reader:
            topics = reader.topics
        # where a camera's images come in two ways those with all their bytes are read
        self._images: dict[str, tuple[str, Transport]] = {}
        for transport in reversed(TRANSPORTS.values()):
            for space in _spaces(topics, f"image_raw{transport.suffix}", transport.message_type):
                self._images[space] = (f"{space}image_raw{transport.suffix}", transport)
        if not self._images:
            names = " nor ".join(f"image_raw{transport.suffix}" for transport in TRANSPORTS.values())
            raise BagError(f"'{bag}' holds no images: there is neither {names}.")
        self.cameras: Mapping[str, CameraDetector] = {
            space.rstrip("/"): create(space.rstrip("/"), transport)
            for space, (_, transport) in sorted(self._images.items())
        }

    def detect(self, folder: Path, progress: Progress) -> int:
        """Write a bag with detections in place of images.

        Args:
            folder: The new bag, created; must not exist.
            progress: Called now and then with the share done and what is being done.

        Returns:
            Number of messages.

        Raises:
            BagError: The bag cannot be read, or the new one not be created.
        """
        count = 0
        camera_at = {name: self.cameras[space.rstrip("/")] for space, (name, _) in self._images.items()}
        info_at = {f"{space}camera_info": self.cameras[space.rstrip("/")] for space in self._images}
        written = {f"{space}detections" for space in self._images}
        replaced = {f"{space}image_raw{t.suffix}" for space in self._images for t in TRANSPORTS.values()}
        with BagReader(self._bag) as reader, BagWriter(folder) as writer:
            kept = [topic for topic in reader.topics if topic.name not in written | replaced]
            for topic in (*kept, *(BagTopic(name, DETECTIONS) for name in sorted(written))):
                writer.add_topic(topic.name, topic.type)
            for name, kind, log_ns, data in reader.messages([*(topic.name for topic in kept), *camera_at]):
                progress(reader.progress, "detecting")
                if name in camera_at:
                    detections = _detected(camera_at[name], kind, data)
                    if detections is None:
                        continue
                    writer.write(f"{name.partition('image_raw')[0]}detections", log_ns, detections)
                else:
                    if name in info_at:
                        _calibrate(info_at[name], data)
                    writer.write(name, log_ns, bytes(data))
                count += 1
            self.losses = reader.losses
        return count


def _spaces(topics: Sequence[BagTopic], name: str, message_type: str) -> list[str]:
    """The namespaces, with their slash, in which there is a topic of a name and type."""
    return [
        topic.name.removesuffix(name)
        for topic in topics
        if topic.type == message_type and f"/{topic.name}".endswith(f"/{name}")
    ]


def _detected(camera: CameraDetector, kind: str, data: bytes) -> bytes | None:
    """The detections of an image's message; None: it was dropped, and counted."""
    try:
        message: Any = typestore().deserialize_cdr(data, kind)
    except _NOT_A_MESSAGE:
        camera.images += 1
        camera.drops["corrupt"] += 1
        return None
    try:
        return camera.detect(message)
    except ImageError:
        return None


def _calibrate(camera: CameraDetector, data: bytes) -> None:
    """Take over a calibration; one that cannot be used is told by the camera's `trouble`."""
    try:
        message: Any = typestore().deserialize_cdr(data, _CAMERA_INFO)
    except _NOT_A_MESSAGE:
        camera.drops["corrupt calibration"] += 1
        return
    with suppress(CameraError):
        camera.calibrate(message)
