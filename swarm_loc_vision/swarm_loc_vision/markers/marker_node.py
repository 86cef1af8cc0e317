"""Base of the nodes that publish the markers of one camera."""

from __future__ import annotations

from typing import Any, Protocol

from swarm_loc_estimator.common.node import Parameters
from swarm_loc_vision.common.camera_node import CameraNode

_MAX_MISFIT_SHARE = 0.1
"""Largest share of misfits since the last diagnostics; above it the calibration may be wrong."""


class MarkerSource(Protocol):
    """Finds markers; see `CameraDetector` and `ForeignMarkers`."""

    markers: int
    misfits: int


class MarkerNode(CameraNode[Parameters]):
    """Publishes the markers of a camera; subclasses set `camera`."""

    camera: MarkerSource

    def __init__(self, name: str, parameters: type[Parameters], **node_arguments: Any) -> None:
        super().__init__(name, parameters, **node_arguments)
        self._told = (0, 0)  # markers and misfits

    def figures(self) -> dict[str, str]:
        """Numbers of markers."""
        return {
            "markers": str(self.camera.markers),
            "markers that fit no square": str(self.camera.misfits),
        }

    def trouble(self) -> str:
        """A warning if many markers since the last call do not fit a square."""
        markers, misfits = self.camera.markers - self._told[0], self.camera.misfits - self._told[1]
        self._told = self.camera.markers, self.camera.misfits
        if misfits <= _MAX_MISFIT_SHARE * markers:
            return ""
        return f"{misfits} of {markers} markers fit no square: is camera_info that of this camera?"
