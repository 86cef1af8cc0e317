"""Marker detectors behind one interface: an image in, ids and corners out, in one convention."""

import importlib
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.vision.scenes import CAMERA, HEIGHT, WIDTH, Gray
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.markers.detector import Detections, DetectorSettings, MarkerDetector
from swarm_loc_vision.markers.families import Family, family_named

FAMILY = "apriltag_36h11"  # The one that all of them read


@dataclass(frozen=True)
class Found:
    """Markers of an image: ids (N,), and corners (N, 4, 2) clockwise from the upper left of the upright tag.

    A pixel's centre has whole coordinates.
    """

    ids: NDArray[np.int64]
    corners: FloatArray


Peer = Callable[[Gray], Found]


def own_detector(family: Family, **numbers: float) -> MarkerDetector:
    """This package's, with all ids and the scenes' camera."""
    camera = Camera.from_matrix((WIDTH, HEIGHT), CAMERA, ())
    return MarkerDetector(DetectorSettings(**numbers), {family: None}, camera)


def as_found(detections: Detections) -> Found:
    """Its result in the common form."""
    return Found(detections.id, detections.corners)


def opencv_name(family: Family) -> str:
    """The name that a family's dictionary has in cv2.aruco, if it is there."""
    kind, _, rest = family.name.partition("_")
    return f"DICT_APRILTAG_{rest}" if kind == "apriltag" else f"DICT_{rest.upper()}"


def stock(family: Family) -> Peer:
    """cv2.aruco as it comes, with its sub-pixel refinement."""
    name = opencv_name(family)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    quarters = 2 if "APRILTAG" in name else 0  # OpenCV's tags are upside down
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(dictionary, parameters)

    def detect(gray: Gray) -> Found:
        corners, ids, _ = detector.detectMarkers(gray)
        stacked = np.array(corners, np.float64).reshape(-1, 4, 2)
        found: Any = ids  # (N, 1) in 4.x, (N,) in 5.0, None in both
        flat = np.array([] if found is None else found, np.int64).ravel()
        return Found(flat, np.roll(stacked, quarters, axis=1))

    return detect


def pupil(decimate: float) -> Peer:
    """AprilTag's own detector; its pixel centres are at halves."""
    module = importlib.import_module("pupil_apriltags")
    module.Detector.__del__ = lambda _: None  # it frees its families twice: the process would end in a crash
    detector = module.Detector(families="tag36h11", nthreads=1, quad_decimate=decimate)

    def detect(gray: Gray) -> Found:
        found = detector.detect(gray)
        corners = [tag.corners[::-1] - 0.5 for tag in found]
        return Found(
            np.array([tag.tag_id for tag in found], np.int64), np.array(corners, float).reshape(-1, 4, 2)
        )

    return detect


def all_peers() -> dict[str, Peer]:
    """By name; pupil-apriltags only where it is installed."""
    family = family_named(FAMILY)
    detector = own_detector(family)
    peers: dict[str, Peer] = {"own": lambda gray: as_found(detector.detect(gray)), "cv2.aruco": stock(family)}
    if importlib.util.find_spec("pupil_apriltags"):
        peers |= {"pupil 1": pupil(1.0), "pupil 2": pupil(2.0)}
    return peers
