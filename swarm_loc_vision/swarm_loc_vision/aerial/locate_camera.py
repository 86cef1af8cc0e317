"""Locate a fixed camera by ground control points, and print its section of the swarm description.

    locate_camera ceiling1 control_points.yaml
    locate_camera ceiling1 control_points.yaml empty_arena_*.png --height 0.105 --set control_sigma=0.002

The file of control points, as of aerial_camera_node, must have the section `camera`. Where it has floor
markers, these are found in pictures of the camera and averaged over them. --set takes control_sigma_px,
control_sigma and max_residual, parameters of aerial_camera_node.

A fixed camera of a swarm description, from the pose that ground control points determine.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.command_line import add_set, argument, command, number_in, parameters_of
from swarm_loc_estimator.common.parameters import UserError, number_specs
from swarm_loc_estimator.common.yaml_tree import read_file, tree_text
from swarm_loc_estimator.swarm.swarm import FixedCamera
from swarm_loc_vision.aerial.ground_control import (
    POSE_SIZE,
    AerialSettings,
    ControlPointError,
    GroundCamera,
    load_ground,
    located,
)
from swarm_loc_vision.common.images import Gray, ImageError, Size, decoded_image

_FROM_OPTICAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Columns: forward, left and up of a camera in its optical frame."""
_GRID = (9, 7)
_MAX_BYTES = 200_000_000
_BESIDE_PX, _STEP = 20.0, 1e-5


class LocateError(UserError):
    """A camera that cannot be located; the message is one sentence."""


def fixed_camera(name: str, ground: GroundCamera, height: float = 0.0) -> FixedCamera:
    """The description of a camera over the floor, named like the namespace of its topics.

    Its sigmas are those of `floor_sigmas`, for markers on robots at a height above the floor [m].
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # straight down, yaw and roll are one angle
        turn = Rotation.from_matrix(ground.rotation.T @ _FROM_OPTICAL)
        yaw, pitch, roll = (round(float(angle), 6) for angle in turn.as_euler("ZYX"))
    x, y, z = (round(float(value), 5) for value in ground.centre)
    position, heading = floor_sigmas(ground, height)
    return FixedCamera(name, x, y, z, yaw, pitch, roll, max(position, 1e-5), max(heading, 1e-6))


def floor_sigmas(ground: GroundCamera, height: float) -> tuple[float, float]:
    """Largest standard deviations in the image, by the pose: of a coordinate [m] and of a direction [rad].

    Raises:
        LocateError: The camera does not see the plane from above.
    """
    camera = ground.camera
    u, v = np.meshgrid(
        np.linspace(0.0, camera.width - 1.0 - _BESIDE_PX, _GRID[0]),
        np.linspace(0.0, camera.height - 1.0, _GRID[1]),
    )
    here = np.stack([u.ravel(), v.ravel()], axis=-1)
    pixels = np.stack([here, here + np.array([_BESIDE_PX, 0.0])])

    def seen(step: FloatArray) -> FloatArray:
        moved = GroundCamera(camera, ground.pose + step, ground.covariance)
        place, next_to_it = moved.places(pixels, height)
        along = next_to_it - place
        return np.column_stack([place, np.arctan2(along[:, 1], along[:, 0])])

    changes = np.stack([seen(step) - seen(-step) for step in _STEP * np.eye(POSE_SIZE)], axis=-1)
    changes[:, 2] = se2.wrap_angle(changes[:, 2])
    slopes = changes / (2.0 * _STEP)
    slopes = slopes[np.isfinite(slopes).all(axis=(1, 2))]
    if height >= ground.centre[2] or not len(slopes):
        raise LocateError(
            f"A camera {ground.centre[2]:.3g} m above the floor does not see markers lying at {height:g} m."
        )
    spread = slopes @ ground.covariance @ np.swapaxes(slopes, -1, -2)
    position = np.sqrt(np.linalg.eigvalsh(spread[:, :2, :2]).max())
    return float(position), float(np.sqrt(spread[:, 2, 2].max()))


@command(
    __doc__,
    argument("name", help="the camera's name in the swarm description"),
    argument("control_points", type=Path, help="file of control points"),
    argument("pictures", type=Path, nargs="*", help="PNG or JPEG with floor markers"),
    argument(
        "--height", type=number_in(0.0, 10.0, "m"), default=0.0, help="of the robots' lying markers [m]"
    ),
    partial(add_set, what="parameter of aerial_camera_node about control points"),
)
def main(options: argparse.Namespace) -> int:
    """Run the command; returns its exit status."""
    ground = load_ground(options.control_points)
    if ground.camera is None:
        raise LocateError(f"{options.control_points} lacks camera, the intrinsics of the camera.")
    if ground.markers and not options.pictures:
        raise LocateError(f"{options.control_points} has floor markers, so pictures of them must be given.")
    settings = parameters_of(AerialSettings, options.set)
    size = (ground.camera.width, ground.camera.height)
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


def _picture(path: Path, size: Size) -> Gray:
    """A picture (height, width) of a width and height, a PNG or JPEG."""
    message = SimpleNamespace(format="", data=read_file(path, _MAX_BYTES))
    try:
        return decoded_image(message, size)
    except ImageError as error:
        raise LocateError(f"{path} cannot be used: {error}") from error


if __name__ == "__main__":
    sys.exit(main())
