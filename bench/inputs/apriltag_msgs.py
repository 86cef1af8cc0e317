"""Poses by the corners of other detectors, as messages through the bridge, compared with our own detector's.

The same rendered images are seen by all. Corners of our own detector, of OpenCV and of AprilTag's library
go through `ForeignMarkers` as AprilTagDetectionArray; OpenCV's `solvePnP` of its own corners is what
aruco_opencv publishes.
"""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np

from bench.shared.common import ProgressLine, equal_parts, new_plot, rms, save_plot
from bench.vision.comparison import MARKERS, solved_by_opencv
from bench.vision.peers import FAMILY, Found, all_peers, as_found, own_detector
from bench.vision.scenes import CAMERA, HEIGHT, WIDTH, Look, Truth, random_scene
from swarm_loc_estimator.common.messages.cdr import DETECTIONS, decode
from swarm_loc_vision.markers.detector import detection_rows
from swarm_loc_vision.markers.families import family_named
from swarm_loc_vision.markers.foreign_markers import ForeignMarkers, ForeignParameters

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from swarm_loc_estimator.common.arrays import FloatArray

FRAMES = 20
_NOWHERE = np.full(3, np.nan)
_HEADER = SimpleNamespace(frame_id="camera", stamp=SimpleNamespace(sec=0, nanosec=0))
_SIGMA_PX = {"own": 0.05, "cv2.aruco": 0.4, "pupil 1": 0.15}  # Detectors and the error of their corners
_OTHERS = ("cv2.aruco", "pupil 1")


def measure(seeds: Sequence[int], say: ProgressLine) -> Mapping[str, float]:
    """Position errors of all ways over all markers that all of them find, as ratios to our own."""
    family, peers = family_named(FAMILY), all_peers()
    own, others = own_detector(family), {name: peers[name] for name in _OTHERS if name in peers}
    errors: dict[str, list[FloatArray]] = {name: [] for name in ("whole", "own", *others, "solvePnP")}
    depths: list[float] = []
    # the same images for all detectors, ids that are there twice left out
    for seed in seeds:
        rng = np.random.default_rng([7, seed])
        for frame in range(FRAMES):
            say(f"seed {seed}, image {frame}")
            image, shown = random_scene(rng, family, MARKERS, Look())
            ids = Counter(truth.marker_id for truth in shown)
            truths = [truth for truth in shown if ids[truth.marker_id] == 1]
            detections = own.detect(image)
            found = {"own": as_found(detections)} | {name: peer(image) for name, peer in others.items()}
            rows = detection_rows(detections, 0.0)
            poses = dict(zip(rows["id"].tolist(), rows["position"], strict=True))
            for truth in truths:
                scale = truth.length / 0.05  # the detector's default length
                depths.append(float(truth.position[2]))
                errors["whole"].append(scale * poses.get(truth.marker_id, _NOWHERE) - truth.position)
                errors["solvePnP"].append(_by_opencv(found["cv2.aruco"], truth) - truth.position)
            for name, markers in found.items():
                by_bridge = _by_bridge(markers, truths, _SIGMA_PX[name])
                errors[name] += [by_bridge(truth) - truth.position for truth in truths]
    # errors of markers that all have found
    norms = {name: np.linalg.norm(np.array(values), axis=1) for name, values in errors.items()}
    seen = np.isfinite(list(norms.values())).all(axis=0)
    error = {name: rms(values[seen]) for name, values in norms.items()}
    _plot(np.array(depths)[seen], {name: values[seen] for name, values in norms.items()})
    figures = {
        "apriltag_msgs.own_position_mm": 1e3 * error["whole"],
        "apriltag_msgs.position_ratio_to_own": error["own"] / error["whole"],
        "apriltag_msgs.opencv_corners_ratio_to_own": error["cv2.aruco"] / error["whole"],
        "apriltag_msgs.opencv_solvepnp_ratio_to_own": error["solvePnP"] / error["whole"],
        "apriltag_msgs.markers": float(seen.sum()),
    }
    if "pupil 1" in error:
        figures["apriltag_msgs.apriltag_corners_ratio_to_own"] = error["pupil 1"] / error["whole"]
    return figures


def _by_bridge(
    markers: Found, truths: Sequence[Truth], corner_sigma_px: float
) -> Callable[[Truth], NDArray[np.float64]]:
    """Gives the position of a marker (3,) by a message with corners; NaN if it was not found."""
    lengths = tuple(f"{truth.marker_id}:{truth.length:.9f}" for truth in truths)
    parameters = ForeignParameters(
        family=FAMILY, rectified=False, lengths=lengths, corner_sigma_px=corner_sigma_px
    )
    bridge = ForeignMarkers(parameters)
    bridge.calibrate(_camera_info())
    tags = [
        SimpleNamespace(
            id=int(marker_id),
            family="tag36h11",
            corners=[SimpleNamespace(x=u + 0.5, y=v + 0.5) for u, v in corners[::-1]],
        )
        for marker_id, corners in zip(markers.ids, markers.corners, strict=True)
    ]
    message = decode(bridge.detect(SimpleNamespace(header=_HEADER, detections=tags)), DETECTIONS)
    rows = message.detections
    places = dict(zip(rows["id"].tolist(), rows["pose.pose.position"], strict=True)) if len(rows) else {}
    return lambda truth: np.asarray(places.get(truth.marker_id, _NOWHERE), float)


def _camera_info() -> SimpleNamespace:
    roi = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0)
    return SimpleNamespace(
        header=_HEADER,
        width=WIDTH,
        height=HEIGHT,
        k=CAMERA.ravel(),
        d=(),
        p=np.zeros(12),
        distortion_model="",
        roi=roi,
        binning_x=0,
        binning_y=0,
    )


def _by_opencv(markers: Found, truth: Truth) -> NDArray[np.float64]:
    """Position (3,) of a marker by OpenCV alone; NaN if it was not found."""
    (rows,) = np.nonzero(markers.ids == truth.marker_id)
    if not len(rows):
        return _NOWHERE
    found = solved_by_opencv(markers.corners[rows[0]], truth.length)
    return found[1] if found else _NOWHERE


def _plot(depths: FloatArray, errors: Mapping[str, FloatArray]) -> None:
    """Draw the median error of each way by distance."""
    labels = {
        "whole": "our detector",
        "own": "its corners by message",
        "cv2.aruco": "OpenCV's corners by message",
        "pupil 1": "AprilTag's corners by message",
        "solvePnP": "OpenCV alone",
    }
    figure, (axes,) = new_plot(1, width=6.0)
    parts = equal_parts(depths, 8)
    middle = [np.median(depths[part]) for part in parts]
    for name, values in errors.items():
        median = [1e3 * np.median(values[part]) for part in parts]
        axes.plot(middle, median, "o--" if name == "own" else "o-", label=labels[name])
    axes.set(xlabel="distance [m]", ylabel="position, median error [mm]", yscale="log")
    axes.legend()
    save_plot(figure, "inputs-apriltag_msgs")
