"""Base of the nodes that publish the markers of one camera."""

from __future__ import annotations

from typing import TypeVar

from swarm_loc_estimator.common.jit import is_precompiled
from swarm_loc_msgs.msg import MarkerDetectionArray
from swarm_loc_vision.common.camera_node import CameraNode, Input
from swarm_loc_vision.markers.camera_detector import CameraDetector
from swarm_loc_vision.markers.detector import precompile
from swarm_loc_vision.markers.foreign_markers import ForeignMarkers
from swarm_loc_vision.markers.parameters import MarkersInUse

Markers = TypeVar("Markers", bound=MarkersInUse)

_MAX_MISFIT_SHARE = 0.1
"""Largest share of misfits since the last diagnostics; above it the calibration may be wrong."""


class MarkerNode(CameraNode[Markers]):
    """Publishes the markers of a camera."""

    def use_markers(self, camera: CameraDetector | ForeignMarkers, source: Input) -> None:
        """Publish the markers in messages while the node is active, and compile what that needs.

        Args:
            camera: Finds them.
            source: Its messages.
        """
        self._camera = camera
        self._told = (0, 0)  # markers and misfits
        if not is_precompiled(precompile):
            self.get_logger().info("compiling for this machine: about half a minute")
        precompile()
        self.use(camera, source, MarkerDetectionArray)

    def begin(self) -> None:
        """Publish the markers in messages."""
        super().begin()
        self.get_logger().info(f"ready: markers of family {self.params.family}")

    def figures(self) -> dict[str, str]:
        """Numbers of markers."""
        return {
            "markers": str(self._camera.markers),
            "markers that fit no square": str(self._camera.misfits),
        }

    def trouble(self) -> str:
        """A warning if many markers since the last call do not fit a square."""
        markers, misfits = self._camera.markers - self._told[0], self._camera.misfits - self._told[1]
        self._told = self._camera.markers, self._camera.misfits
        if misfits <= _MAX_MISFIT_SHARE * markers:
            return ""
        return f"{misfits} of {markers} markers fit no square: is camera_info that of this camera?"
