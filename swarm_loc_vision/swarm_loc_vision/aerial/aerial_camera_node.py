"""Finds robots in the images of an overhead camera, without identity, as a ROS 2 node.

    ./run swarm_loc_vision aerial_camera_node --ros-args -r __ns:=/aerial -p control_points_file:=points.yaml

The node subscribes to `camera_info` and to `image_raw` or `image_raw/compressed`, and publishes `detections`
in `map` with the stamps of the images, and `/diagnostics`. Parameters: see `doc/aerial_camera_node.md`.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from swarm_loc_estimator.common.node import run_node
from swarm_loc_msgs.msg import AnonymousDetectionArray
from swarm_loc_vision.aerial.detector import AerialCamera
from swarm_loc_vision.aerial.ground_control import AerialParameters, Ground, load_ground
from swarm_loc_vision.common.camera_node import CameraNode
from swarm_loc_vision.common.images import TRANSPORTS


class AerialCameraNode(CameraNode[AerialParameters]):
    """Receives overhead images and publishes detections."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("aerial_camera", AerialParameters, **node_arguments)
        self.autostart()

    def prepare(self) -> None:
        """Read the control points."""
        params, path = self.params, self.params.control_points_file
        ground = load_ground(Path(path)) if path else Ground()
        gray_of = TRANSPORTS[params.image_transport].gray_of
        self._camera = AerialCamera(params.settings, params.polarity, ground, gray_of)
        self._said = ""
        self.use(self._camera, self.images(params.image_transport), AnonymousDetectionArray)

    def begin(self) -> None:
        """Publish detections, or say why there will be none."""
        super().begin()
        self.trouble()

    def figures(self) -> dict[str, str]:
        """Robots per image, and the camera's pose."""
        camera = self._camera
        fit = camera.control.fit if camera.control else None
        mean = camera.robots / camera.used if camera.used else 0.0
        pose = {"control points": "0"}
        if fit is not None:
            worst = int(fit.residuals.argmax())
            pose = {
                "control points": str(len(fit.names)),
                "reprojection residual [px]": f"{fit.rms_px:.3g}",
                "largest residual [px]": f"{fit.residuals[worst]:.3g} of {fit.names[worst]}",
                "camera height [m]": f"{fit.ground.centre[2]:.4g}",
            }
        return {
            "images used": str(camera.used),
            "robots per image": f"{mean:.3g}",
            "robots with heading": str(camera.headings),
            "robot diameter [m]": f"{camera.diameter:.4g}" if camera.diameter else "not known yet",
            **pose,
            "moves of the camera": str(camera.control.moves if camera.control else 0),
        }

    def trouble(self) -> str:
        """Why no robots can be found; logged whenever it changes."""
        why = self._camera.why_nothing
        if why and why != self._said:
            self._said = why
            self.get_logger().error(why)
        return why


main = partial(run_node, "aerial_camera_node", AerialCameraNode)
