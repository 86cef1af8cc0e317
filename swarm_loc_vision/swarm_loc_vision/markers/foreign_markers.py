"""Markers that other detectors have found, with poses and covariances of our own.

`apriltag_msgs/AprilTagDetectionArray` has corners, `aruco_opencv_msgs/ArucoDetection` has poses by
`solvePnPGeneric` without covariance; from these the corners follow.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.cdr import nanoseconds
from swarm_loc_estimator.common.messages.detections import encode_detections
from swarm_loc_estimator.common.parameters import ParameterError, autostart, choice, flag, number
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.common.images import Calibration, ImageError, camera_of
from swarm_loc_vision.markers.detector import Detections, MarkersInUse, detection_rows, known_markers
from swarm_loc_vision.markers.families import families
from swarm_loc_vision.markers.pose import SHIFT, PoseSettings, PoseSolver, square

_APRILTAG_CENTRE_PX = 0.5  # Where AprilTag's detector sees the centre of the first pixel; others: at 0
_APRILTAG_NAMES = {
    "apriltag_16h5": "tag16h5",
    "apriltag_25h9": "tag25h9",
    "apriltag_36h11": "tag36h11",
    "apriltag_standard_41h12": "tagStandard41h12",
}
"""Families that AprilTag's detector finds, with the names that it gives them."""
_UPSIDE_DOWN = ("apriltag_16h5", "apriltag_25h9", "apriltag_36h11")  # Families that OpenCV reads upside down
_OPENCV = (*_UPSIDE_DOWN, *(name for name in families() if name.startswith("aruco_")))
"""Families that OpenCV finds."""


class ForeignMarker(NamedTuple):
    """A marker that another detector has found."""

    id: int  # Its id
    family: str  # Name of its family in the message; "": the message does not say
    corners: FloatArray  # (4, 2) clockwise from its own upper left in an image without distortion [px]


@dataclass(frozen=True)
class ForeignKind:
    """Kind of messages of another detector."""

    message_type: str  # Such as apriltag_msgs/msg/AprilTagDetectionArray
    topic: str  # Its topic
    families: Sequence[str]  # Families that the detector finds
    markers: Callable[[Any, Camera, ForeignParameters], Iterator[ForeignMarker]]  # Reads a message


def _of_apriltag(message: Any, camera: Camera, _parameters: ForeignParameters) -> Iterator[ForeignMarker]:
    """AprilTag's corners go counter-clockwise from the lower left."""
    for tag in message.detections:
        corners = np.array([(corner.x, corner.y) for corner in tag.corners])[::-1] - _APRILTAG_CENTRE_PX
        yield ForeignMarker(tag.id, tag.family, camera.to_ideal(corners[None])[0])


def _of_aruco(message: Any, camera: Camera, parameters: ForeignParameters) -> Iterator[ForeignMarker]:
    """Project the square of a marker at its pose; a marker behind the camera has corners that are NaN."""
    fx, fy, cx, cy = camera.intrinsics
    turned = 2 if parameters.family in _UPSIDE_DOWN else 0
    for marker in message.markers:
        place, turn = marker.pose.position, marker.pose.orientation
        quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
        points = np.full((4, 3), np.nan)
        if np.isfinite(quaternion).all() and quaternion.any():
            rotation = Rotation.from_quat(quaternion).as_matrix()
            points = square(parameters.source_marker_length) @ rotation.T + [place.x, place.y, place.z]
        if not (points[:, 2] > 0.0).all():
            points[:] = np.nan
        corners = points[:, :2] / points[:, 2:] * [fx, fy] + [cx, cy]
        yield ForeignMarker(marker.marker_id, "", np.roll(corners, turned, axis=0))


KINDS = {
    "apriltag": ForeignKind(
        "apriltag_msgs/msg/AprilTagDetectionArray",
        "apriltag_detections",
        tuple(_APRILTAG_NAMES),
        _of_apriltag,
    ),
    "aruco_opencv": ForeignKind(
        "aruco_opencv_msgs/msg/ArucoDetection", "aruco_detections", _OPENCV, _of_aruco
    ),
}
"""Kinds of messages by the parameter `source`."""


@dataclass(frozen=True)
class ForeignParameters(MarkersInUse):
    """Parameters of `marker_bridge_node`."""

    family: str = choice(
        "apriltag_36h11",
        tuple(dict.fromkeys(name for kind in KINDS.values() for name in kind.families)),
        "kind of marker; apriltag finds no aruco, aruco_opencv no apriltag_standard_41h12",
    )
    autostart: bool = autostart()
    source: str = choice("apriltag", tuple(KINDS), "the other detector")
    rectified: bool = flag(
        True, "whether it sees rectified images, so that P of camera_info counts, not K and distortion"
    )
    corner_sigma_px: float = number(
        0.3, "px", 0.001, 100.0, "standard deviation of each corner along u and v"
    )
    source_marker_length: float = number(
        0.15, "m", 0.001, 10.0, "marker_size of aruco_opencv, in whose poses the true size is not known"
    )
    settings: PoseSettings = field(default_factory=PoseSettings, metadata={"numbers_of": PoseSettings})


class ForeignMarkers(Calibration):
    """The markers that another detector finds in the images of one camera.

    Raises:
        ParameterError: A parameter cannot be used.
        SwarmFileError: The swarm description cannot be used.
    """

    def __init__(self, parameters: ForeignParameters) -> None:
        super().__init__()
        self.markers = self.misfits = 0  # Number of markers with a pose, and of those that fit no square
        self._parameters = parameters
        self._kind = KINDS[parameters.source]
        if parameters.family not in self._kind.families:
            raise ParameterError(
                f"parameter family = '{parameters.family}' must be one that {parameters.source} finds:"
                f" {', '.join(self._kind.families)}."
            )
        self._known = known_markers(parameters)
        self._frame = ""
        self._solver: PoseSolver  # set with the calibration, without which messages are dropped

    def calibrate(self, message: Any) -> None:
        """Use a sensor_msgs/CameraInfo from now on.

        Raises:
            CameraError: The camera is not calibrated; its images are dropped from now on.
        """
        self._frame = message.header.frame_id
        super().calibrate(message)

    def read(self, message: Any) -> Camera:
        """The camera of the images that the other detector sees."""
        return camera_of(message, rectified=self._parameters.rectified)

    def use(self, camera: Camera) -> None:
        """Solve with another calibration from now on."""
        _, _, lengths, up, lying, bodies = self._known
        self._solver = PoseSolver(self._parameters.settings, camera, lengths, up, lying, bodies)

    def found(self, message: Any) -> bytes:
        """The serialized swarm_loc_msgs/MarkerDetectionArray of the markers in an image."""
        camera, frame = self.known_camera(), message.header.frame_id
        if frame != self._frame:
            said = f"markers are in frame '{frame}', but camera_info in '{self._frame}': is output_frame set?"
            raise ImageError("foreign_frame", said)
        detections = self._solved(camera, list(self._used(message, camera)))
        rows = detection_rows(detections, self._parameters.settings.ambiguity)
        self.drops["no_pose"] += len(detections) - len(rows)
        self.markers += len(rows)
        self.misfits += detections.misfits
        return encode_detections(message.header.frame_id, nanoseconds(message.header.stamp), rows)

    def _used(self, message: Any, camera: Camera) -> Iterator[ForeignMarker]:
        """The markers that can be used."""
        family, ids = self._known.family, self._known.ids
        for marker in self._kind.markers(message, camera, self._parameters):
            x, y = marker.corners.T
            if marker.family not in ("", _APRILTAG_NAMES.get(family.name)):
                self.drops["other_family"] += 1
            elif not 0 <= marker.id < len(family.words) or (ids is not None and marker.id not in ids):
                self.drops["unknown_id"] += 1
            elif not np.isfinite(marker.corners).all():
                self.drops["not_finite"] += 1
            elif x @ (np.roll(y, -1) - np.roll(y, 1)) <= 0.0:  # counter-clockwise
                self.drops["corner_order"] += 1
            else:
                yield marker

    def _solved(self, camera: Camera, markers: list[ForeignMarker]) -> Detections:
        count = len(markers)
        ids = np.array([marker.id for marker in markers], np.int64)
        corners = np.array([marker.corners for marker in markers]).reshape(-1, 4, 2)
        covariance = np.tile(self._parameters.corner_sigma_px**2 * np.eye(8) + SHIFT, (count, 1, 1))
        poses, misfits = self._solver.solve(ids, corners, covariance)
        codes, unknown = np.full(count, self._known.family.code), np.full(count, np.nan)
        return Detections(codes, ids, unknown, unknown, unknown, camera.to_raw(corners), poses, misfits, {})
