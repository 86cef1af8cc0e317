"""Locate a fixed camera by ground control points, and print its section of the swarm description.

    locate_camera ceiling1 control_points.yaml
    locate_camera ceiling1 control_points.yaml empty_arena_*.png --height 0.105 --set control_sigma=0.002

The file of control points, as of aerial_camera_node, must have the section `camera`. Where it has floor
markers, these are found in pictures of the camera and averaged over them. --set takes control_sigma_px,
control_sigma and max_residual, parameters of aerial_camera_node.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2

from swarm_loc_estimator.common.command_line import (
    add_set,
    command_parser,
    exit_with_message,
    number_in,
    parameters_of,
)
from swarm_loc_estimator.common.parameters import number_specs
from swarm_loc_estimator.common.yaml_tree import tree_text
from swarm_loc_estimator.swarm.swarm import FixedCamera
from swarm_loc_vision.aerial.control_points import ControlPointError
from swarm_loc_vision.aerial.fixed_camera import LocateError, fixed_camera
from swarm_loc_vision.aerial.ground_control import located
from swarm_loc_vision.aerial.ground_file import load_ground
from swarm_loc_vision.aerial.parameters import AerialSettings
from swarm_loc_vision.common.images import Gray


@exit_with_message
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    options = _parser().parse_args(arguments)
    ground = load_ground(options.control_points)
    if ground.camera is None:
        raise LocateError(f"{options.control_points} lacks camera, the intrinsics of the camera.")
    if ground.markers and not options.pictures:
        raise LocateError(f"{options.control_points} has floor markers, so pictures of them must be given.")
    settings = parameters_of(AerialSettings, options.set)
    size = (ground.camera.height, ground.camera.width)
    pictures = [_picture(path, size) for path in options.pictures]
    try:
        fit = located(ground, ground.camera, pictures, settings)
    except ControlPointError as error:
        raise LocateError(f"{options.control_points}: {error}") from error
    camera = fixed_camera(options.name, fit.ground, options.height)
    section = {name: getattr(camera, name) for name in number_specs(FixedCamera)}
    print(f"# {len(fit.names)} control points, {fit.rms_px:.2g} px rms")
    print(tree_text({"cameras": {camera.name: section}}), end="")
    return 0


def _picture(path: Path, size: tuple[int, int]) -> Gray:
    """A picture (height, width) of a size."""
    gray = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if gray is None:
        raise LocateError(f"{path} is no picture.")
    if gray.shape != size:
        raise LocateError(
            f"{path} has {gray.shape[1]} x {gray.shape[0]} pixels but the camera {size[1]} x {size[0]}."
        )
    return gray.astype("uint8", copy=False)


def _parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = command_parser(__doc__)
    parser.add_argument("name", help="the camera's name in the swarm description")
    parser.add_argument("control_points", type=Path, help="file of control points")
    parser.add_argument("pictures", type=Path, nargs="*", help="pictures of the camera with floor markers")
    height = number_in(0.0, 10.0, "m")
    parser.add_argument("--height", type=height, default=0.0, help="of the robots' lying markers [m]")
    add_set(parser, "parameter of aerial_camera_node about control points")
    return parser


if __name__ == "__main__":
    sys.exit(main())
