"""Find the markers in a bag's images: a bag with detections, for replay.

    detect bags/eight_pictures --output out/detected
    detect recording.mcap --swarm swarm.yaml --output out/detected --set family=aruco_mip_36h12

Of every camera in the bag, <robot>/image_raw or <robot>/image_raw/compressed with <robot>/camera_info, the
images are replaced by <robot>/detections; all else is copied. The swarm description is the `swarm.yaml`
inside the bag's folder unless --swarm names another, and is copied, too. --set takes the parameters of
marker_detector_node.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from swarm_loc_estimator.common.command_line import (
    ProgressLine,
    add_bag,
    add_set,
    command_parser,
    exit_with_message,
    parameters_of,
    swarm_beside,
)
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_vision.common.transports import Transport
from swarm_loc_vision.markers.camera_detector import CameraDetector
from swarm_loc_vision.markers.detector_parameters import DetectorParameters, detector_maker
from swarm_loc_vision.markers.image_bag import CreateCamera, ImageBag


@exit_with_message
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    options = _parser().parse_args(arguments)
    beside = swarm_beside(options.bag)
    swarm_file = options.swarm or (beside if beside.exists() else None)
    described = "" if swarm_file is None else str(swarm_file)
    given = {"image_transport": "raw", "robot": "", "swarm_file": described}
    parameters = parameters_of(DetectorParameters, options.set, given)
    images = ImageBag(options.bag, camera_maker(parameters))
    with ProgressLine() as progress:
        count = images.detect(options.output, progress)
    if swarm_file is not None:
        shutil.copyfile(swarm_file, options.output / "swarm.yaml")
    for loss in images.losses:
        print(loss)
    for name, camera in images.cameras.items():
        print(_summary(name, camera))
    print(f"{count} messages written to {options.output}")
    return 0


def camera_maker(parameters: DetectorParameters) -> CreateCamera:
    """What makes the detectors of a bag's cameras; a camera in a robot's namespace is the robot's."""
    robots = load_swarm(Path(parameters.swarm_file)).index_of if parameters.swarm_file else {}

    def create(space: str, transport: Transport) -> CameraDetector:
        own = replace(parameters, robot=space if space in robots else "")
        return CameraDetector(detector_maker(own), transport.gray_of, parameters.settings.ambiguity)

    return create


def _summary(name: str, camera: CameraDetector) -> str:
    """What came of a camera's images."""
    drops: Mapping[str, int] = {reason: count for reason, count in sorted(camera.drops.items()) if count}
    dropped = "".join(f", dropped: {reason} {count}" for reason, count in drops.items())
    trouble = f" ({camera.trouble})" if camera.trouble else ""
    markers = f"{camera.markers} markers ({camera.misfits} fit no square)"
    return f"{name or 'camera'}: {markers} in {camera.images} images{dropped}{trouble}"


def _parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = command_parser("detect", __doc__)
    add_bag(parser)
    parser.add_argument("--output", type=Path, required=True, metavar="FOLDER", help="the new bag")
    add_set(parser, "parameter of marker_detector_node")
    return parser


if __name__ == "__main__":
    sys.exit(main())
