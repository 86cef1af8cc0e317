"""Find the markers in the images of a bag, and write a bag with detections for replay.

    detect bags/eight_pictures --output out/detected
    detect recording.mcap --swarm swarm.yaml --output out/detected --set family=aruco_mip_36h12

The images of each camera, <robot>/image_raw or <robot>/image_raw/compressed with <robot>/camera_info, are
replaced by <robot>/detections with the log times of the images; all other messages are copied, so that the
same bag gives the same bytes. The swarm description is the `swarm.yaml` in the folder of the bag unless
--swarm names another; it is copied as well. --set takes the parameters of marker_detector_node.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

from swarm_loc_estimator.common.bags.bag_file import BagError, BagTopic
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.command_line import (
    ProgressLine,
    add_bag,
    add_set,
    argument,
    bag_to_write,
    command,
    parameters_of,
    swarm_beside,
)
from swarm_loc_estimator.common.files import naming
from swarm_loc_estimator.common.messages.cdr import DETECTIONS, CdrError, decode
from swarm_loc_estimator.common.parameters import Value
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_vision.common.camera import CameraError
from swarm_loc_vision.common.images import TRANSPORTS, ImageError, Transport
from swarm_loc_vision.markers.detector import CameraDetector, DetectorParameters, detector_maker

CreateCamera = Callable[[str, Transport], CameraDetector]
Progress = Callable[[float, str], None]

_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"


class ImageBag:
    """A bag with images, to be read once: a rosbag2 folder, .mcap or .db3 file; may be truncated.

    `create` creates the detector of a camera from its namespace and transport.

    Raises:
        BagError: The bag cannot be read, or has no images.
    """

    def __init__(self, bag: Path, create: CreateCamera) -> None:
        self.losses: Sequence[str] = ()  # Unreadable parts of the bag, one sentence each
        self._bag = bag
        with BagReader(bag) as reader:
            topics = reader.topics
        # of two transports of one camera, the uncompressed images are read
        self._images: dict[str, tuple[str, Transport]] = {}
        for transport in reversed(TRANSPORTS.values()):
            ending = f"image_raw{transport.suffix}"
            for name, message_type, _ in topics:
                if message_type == transport.message_type and f"/{name}".endswith(f"/{ending}"):
                    self._images[name.removesuffix(ending)] = (name, transport)
        if not self._images:
            names = " nor ".join(f"image_raw{transport.suffix}" for transport in TRANSPORTS.values())
            raise BagError(f"'{bag}' holds no images: there is neither {names}.")
        self.cameras: Mapping[str, CameraDetector] = {  # By namespace
            space.rstrip("/"): create(space.rstrip("/"), transport)
            for space, (_, transport) in sorted(self._images.items())
        }

    def detect(self, folder: Path, progress: Progress, swarm: Path | None) -> int:
        """Write a new bag with detections in place of images; returns the number of messages.

        `progress` is called with the share done and a word for the activity; `swarm` is copied to the bag.

        Raises:
            BagError: The bag cannot be read, or the new one cannot be created.
        """
        count = 0
        camera_at = {name: self.cameras[space.rstrip("/")] for space, (name, _) in self._images.items()}
        info_at = {f"{space}camera_info": self.cameras[space.rstrip("/")] for space in self._images}
        written = {f"{space}detections" for space in self._images}
        replaced = {f"{space}image_raw{t.suffix}" for space in self._images for t in TRANSPORTS.values()}
        with BagReader(self._bag) as reader, BagWriter(folder) as writer:
            if swarm is not None:
                with naming(folder):
                    shutil.copyfile(swarm, writer.folder / "swarm.yaml")
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
                        try:
                            message = decode(data, _CAMERA_INFO)
                        except CdrError:
                            info_at[name].drops["corrupt calibration"] += 1
                        else:
                            with suppress(CameraError):  # then `trouble` of the camera states why
                                info_at[name].calibrate(message)
                    writer.write(name, log_ns, bytes(data))
                count += 1
            self.losses = reader.losses
        return count


def _detected(camera: CameraDetector, kind: str, data: bytes) -> bytes | None:
    """The detections of an image message; None: it was dropped and counted."""
    try:
        message = decode(data, kind)
    except CdrError:
        camera.images += 1
        camera.drops["corrupt"] += 1
        return None
    try:
        return camera.detect(message)
    except ImageError:
        return None


@command(
    __doc__,
    add_bag,
    argument("--output", type=bag_to_write, required=True, metavar="FOLDER", help="the new bag"),
    partial(add_set, what="parameter of marker_detector_node"),
)
def main(options: argparse.Namespace) -> int:
    """Run the command; returns its exit status."""
    recorded = swarm_beside(options.bag)
    swarm_file = options.swarm or (recorded if recorded.exists() else None)
    given: dict[str, Value] = {"autostart": True, "image_transport": "raw", "robot": ""}
    given["swarm_file"] = "" if swarm_file is None else str(swarm_file)
    parameters = parameters_of(DetectorParameters, options.set, given)
    images = ImageBag(options.bag, camera_maker(parameters))
    with ProgressLine() as progress:
        count = images.detect(options.output, progress, swarm_file)
    for loss in images.losses:
        print(loss)
    for name, camera in images.cameras.items():
        drops = (f", dropped: {reason} {count}" for reason, count in sorted(camera.drops.items()) if count)
        trouble = f" ({camera.trouble})" if camera.trouble else ""
        markers = f"{camera.markers} markers ({camera.misfits} fit no square)"
        print(f"{name or 'camera'}: {markers} in {camera.images} images{''.join(drops)}{trouble}")
    print(f"{count} messages written to {options.output}")
    return 0


def camera_maker(parameters: DetectorParameters) -> CreateCamera:
    """Creates the detectors of a bag's cameras; a namespace names the camera's robot, or the fixed camera."""
    known = load_swarm(Path(parameters.swarm_file)).sources if parameters.swarm_file else ()
    names = {source.name for source in known}

    def create(space: str, transport: Transport) -> CameraDetector:
        own = replace(parameters, robot=space if space in names else "")
        return CameraDetector(detector_maker(own), transport.gray_of, parameters.settings.ambiguity)

    return create


if __name__ == "__main__":
    sys.exit(main())
