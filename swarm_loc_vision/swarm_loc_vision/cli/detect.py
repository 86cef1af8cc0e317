"""Find the markers in a bag's pictures: a bag with detections, for replay.

    detect bags/eight_pictures --output out/detected
    detect recording.mcap --swarm swarm.yaml --output out/detected --set family=aruco_mip_36h12

Of every camera in the bag, <robot>/image_raw or <robot>/image_raw/compressed with <robot>/camera_info, the
pictures are replaced by <robot>/detections; all else is copied. The swarm description is the `swarm.yaml`
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

from swarm_loc_estimator.cli.ending import told_in_a_sentence
from swarm_loc_estimator.cli.progress import ProgressLine
from swarm_loc_estimator.cli.replay import swarm_beside
from swarm_loc_estimator.io.bag_file import BagError
from swarm_loc_estimator.io.swarm_file import SwarmFileError, load_swarm
from swarm_loc_estimator.io.typestore import DefinitionsNotFoundError
from swarm_loc_estimator.nodes.parameter_table import ParameterError, Value, from_values, parameter_specs
from swarm_loc_vision.io.camera_detector import CameraDetector, Transport
from swarm_loc_vision.io.picture_bag import CreateCamera, PictureBag
from swarm_loc_vision.nodes.detector_parameters import DetectorParameters, detector_maker

_GIVEN_OTHERWISE = ("image_transport", "swarm_file", "robot")
"""Parameters that follow from the bag and from --swarm."""


@told_in_a_sentence(BagError, ParameterError, SwarmFileError, DefinitionsNotFoundError)
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    options = _parser().parse_args(arguments)
    beside = swarm_beside(options.bag)
    swarm_file = options.swarm or (beside if beside.exists() else None)
    wishes = read_wishes(options.set, "" if swarm_file is None else str(swarm_file))
    pictures = PictureBag(options.bag, camera_maker(wishes))
    with ProgressLine() as progress:
        count = pictures.detect(options.output, progress)
    if swarm_file is not None:
        shutil.copyfile(swarm_file, options.output / "swarm.yaml")
    for loss in pictures.losses:
        print(loss)
    for name, camera in pictures.cameras.items():
        print(_summary(name, camera))
    print(f"{count} messages written to {options.output}")
    return 0


def read_wishes(pairs: Sequence[str], swarm_file: str) -> DetectorParameters:
    """Parameters from texts such as `family=aruco_mip_36h12`.

    Raises:
        ParameterError: There is no such parameter, or a value cannot be used.
    """
    specs = {spec.name: spec for spec in parameter_specs(DetectorParameters)}
    values: dict[str, Value] = {name: spec.default for name, spec in specs.items()}
    for pair in pairs:
        name, _, text = pair.partition("=")
        if name not in specs or name in _GIVEN_OTHERWISE:
            known = ", ".join(name for name in specs if name not in _GIVEN_OTHERWISE)
            raise ParameterError(f"--set {pair}: '{name}' is no parameter; there are {known}.")
        values[name] = specs[name].checked(_value(text, specs[name].default))
    return from_values(DetectorParameters, values | {"swarm_file": swarm_file})


def camera_maker(wishes: DetectorParameters) -> CreateCamera:
    """What makes the detectors of a bag's cameras; a camera in a robot's namespace is the robot's."""
    robots = load_swarm(Path(wishes.swarm_file)).index_of if wishes.swarm_file else {}

    def create(space: str, transport: Transport) -> CameraDetector:
        own = replace(wishes, robot=space if space in robots else "")
        return CameraDetector(detector_maker(own), transport.gray_of, wishes.settings.ambiguity)

    return create


def _value(text: str, default: Value) -> object:
    """A text as the kind of value that the default is; one that is not is left to be refused."""
    if isinstance(default, tuple):
        return [part for part in text.split(",") if part]
    if isinstance(default, float):
        try:
            return float(text)
        except ValueError:
            return text
    return text


def _summary(name: str, camera: CameraDetector) -> str:
    """What came of a camera's pictures."""
    drops: Mapping[str, int] = {reason: count for reason, count in sorted(camera.drops.items()) if count}
    dropped = "".join(f", dropped: {reason} {count}" for reason, count in drops.items())
    trouble = f" ({camera.trouble})" if camera.trouble else ""
    return f"{name or 'camera'}: {camera.markers} markers in {camera.pictures} pictures{dropped}{trouble}"


def _parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="detect", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bag", type=Path, help="rosbag2 folder, .mcap or .db3 file")
    parser.add_argument("--output", type=Path, required=True, metavar="FOLDER", help="the new bag")
    parser.add_argument("--swarm", type=Path, help="swarm description (default: swarm.yaml beside the bag)")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="detector parameter")
    return parser


if __name__ == "__main__":
    sys.exit(main())
