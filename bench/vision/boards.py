"""Covariances of markers: on photographs of ChArUco boards, and on rendered images.

The photographs are no part of the workspace. They lie next to it, in `../shared/data/photos`. The lens is
calibrated by the corners of the chessboard in the same pictures. They also give the pose of the whole board,
with which the pose of each of its markers is compared. The better of the two solutions of a marker counts.
Rendered images are also changed as cameras change theirs: by a tone curve, sharpening, scaling and JPEG.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from bench.aerial.cases import gray_picture
from bench.shared.common import SHARED, Cell, table
from bench.vision.comparison import LOOKS, MARKERS, match
from bench.vision.peers import as_found, own_detector
from bench.vision.scenes import Gray, random_scene
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.markers.detector import Detections, DetectorSettings, MarkerDetector
from swarm_loc_vision.markers.families import family_named

PHOTOS = SHARED / "data" / "photos"
_BOUND_99 = 16.8  # Of chi square with six degrees of freedom
_MIN_CORNERS = 8  # Of a board, in a picture that is used


@dataclass(frozen=True)
class _Set:
    """Pictures of one board by one camera; lengths are in squares."""

    pictures: str
    squares: tuple[int, int]
    marker_length: float
    family: str
    is_legacy: bool  # OpenCV's layout of boards with an even number of rows, until 4.6


SETS = {
    "charuco": _Set("charuco/*.jpg", (8, 8), 0.75, "aruco_4x4_50", False),
    "charuco_opencv": _Set("opencv/img_0*.jpg", (5, 7), 0.5, "aruco_6x6_250", True),
}
"""Name of figures -> pictures."""


def _curved(image: FloatArray, gamma: float) -> FloatArray:
    return np.asarray(255.0 * (np.clip(image, 0.0, 255.0) / 255.0) ** gamma)


def _sharpened(image: FloatArray, share: float) -> FloatArray:
    return np.asarray(image + share * (image - cv2.GaussianBlur(image, (0, 0), 1.0)))


def _enlarged(image: FloatArray) -> FloatArray:
    """An image of half as many rows and columns, enlarged to its size."""
    half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(half, image.shape[::-1], interpolation=cv2.INTER_LINEAR))


def _compressed(image: FloatArray, quality: int) -> FloatArray:
    data = cv2.imencode(".jpg", _counts(image), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), float)


def _counts(image: FloatArray) -> Gray:
    return np.asarray(np.clip(np.rint(image), 0, 255), np.uint8)


CHANGES: Mapping[str, Callable[[FloatArray], FloatArray]] = {
    "gamma_0.45": lambda image: _curved(image, 0.45),
    "gamma_0.6": lambda image: _curved(image, 0.6),
    "sharpened_1": lambda image: _sharpened(image, 1.0),
    "sharpened_2": lambda image: _sharpened(image, 2.0),
    "all": lambda image: _compressed(_sharpened(_curved(image, 0.6), 1.5), 70),
    "enlarged_all": lambda image: _compressed(_sharpened(_curved(_enlarged(image), 0.6), 1.5), 70),
    "enlarged": _enlarged,
    "jpeg_60": lambda image: _compressed(image, 60),
}
"""Name of figures -> what a camera does to a rendered image (height, width) [counts]."""


@dataclass(frozen=True)
class _Scored:
    """One marker."""

    nees: float  # Ideally chi square with six degrees of freedom
    plane_nees: float  # Of x, y and yaw in the marker's plane: three degrees of freedom
    position: float  # Error over range


def measure_covariances(seeds: Sequence[int], photos: Path = PHOTOS) -> Mapping[str, float]:
    """Print a table of the markers' NEES; the figures by name. Sets without pictures are left out."""
    scored = {name: list(_of_board(of_set, photos)) for name, of_set in SETS.items()}
    scored |= {f"rendered_{look}": list(_rendered(look, seeds)) for look in LOOKS}
    scored |= {f"changed_{name}": list(_rendered("still", seeds, change)) for name, change in CHANGES.items()}
    figures: dict[str, float] = {}
    for name, markers in scored.items():
        if markers:
            nees = np.array([marker.nees for marker in markers])
            figures |= {
                f"{name}.markers": float(len(markers)),
                f"{name}.nees_median": float(np.median(nees)),
                f"{name}.beyond_99": float(np.mean(nees > _BOUND_99)),
                f"{name}.plane_nees_median": float(np.median([marker.plane_nees for marker in markers])),
                f"{name}.position_permille": 1e3 * float(np.median([marker.position for marker in markers])),
            }
    rows: list[list[Cell]] = [
        [name, *(v for k, v in figures.items() if k.startswith(f"{name}."))]
        for name, markers in scored.items()
        if markers
    ]
    print(table(["pictures", "markers", "NEES (5.3)", "beyond 99 %", "of x, y, yaw (2.4)", "permille"], rows))
    return figures


def _of_board(of_set: _Set, photos: Path) -> Iterator[_Scored]:
    """The markers in the photographs of one board."""
    images = [gray_picture(path) for path in sorted(photos.glob(of_set.pictures))]
    if not images:
        print(f"No pictures {photos / of_set.pictures}: they are skipped.")
        return
    kind = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{of_set.family[6:].upper()}"))
    board = cv2.aruco.CharucoBoard(of_set.squares, 1.0, of_set.marker_length, kind)
    board.setLegacyPattern(of_set.is_legacy)
    camera, poses = _calibrated(board, images)
    ids = np.ravel(board.getIds())
    corners = dict(zip(ids.tolist(), np.array(board.getObjPoints(), float), strict=True))
    settings = DetectorSettings(marker_length=of_set.marker_length)
    detector = MarkerDetector(settings, {family_named(of_set.family): ids}, camera)
    for image, turn, place in poses:
        found = detector.detect(image)
        for row, marker_id in enumerate(found.id):
            seen = corners[int(marker_id)] @ Rotation.from_rotvec(turn).as_matrix().T + place
            right, up = seen[1] - seen[0], seen[0] - seen[3]
            rotation = np.stack([right, up, np.cross(right, up) / of_set.marker_length], axis=1)
            yield _scored(found, row, rotation / of_set.marker_length, seen.mean(axis=0), 1.0)


def _calibrated(
    board: cv2.aruco.CharucoBoard, images: Sequence[Gray]
) -> tuple[Camera, list[tuple[Gray, FloatArray, FloatArray]]]:
    """The camera, and the images that show the board, with its rotation vector and position in the camera."""
    detector, used, points, pixels = cv2.aruco.CharucoDetector(board), [], [], []
    for image in images:
        corners, ids = detector.detectBoard(image)[:2]
        if np.size(ids) >= _MIN_CORNERS:
            used.append(image)
            points.append(np.array(board.getChessboardCorners())[np.ravel(ids)])
            pixels.append(corners.reshape(-1, 1, 2))
    height, width = images[0].shape
    start = np.eye(3), np.zeros(5)
    _, matrix, lens, turns, places = cv2.calibrateCamera(points, pixels, (width, height), *start)
    camera = Camera.from_matrix((width, height), np.array(matrix, float), np.ravel(lens).tolist())
    poses = [
        (np.ravel(turn).astype(float), np.ravel(place).astype(float))
        for turn, place in zip(turns, places, strict=True)
    ]
    return camera, [(image, *pose) for image, pose in zip(used, poses, strict=True)]


def _rendered(
    look: str, seeds: Sequence[int], change: Callable[[FloatArray], FloatArray] | None = None
) -> Iterator[_Scored]:
    """The markers in rendered images of one look, changed by one camera."""
    family = family_named("aruco_mip_36h12")
    detector = own_detector(family, marker_length=1.0)
    for seed in seeds:
        image, truths = random_scene(np.random.default_rng([5, seed]), family, MARKERS, LOOKS[look])
        if change is not None:
            image = _counts(change(image.astype(float)))
        found, used = detector.detect(image), set[int]()
        for truth in truths:
            row = match(as_found(found), truth, used)
            if row is not None:
                used.add(row)
                yield _scored(found, row, truth.rotation, truth.position, truth.length)


def _scored(
    found: Detections, row: int, rotation: FloatArray, position: FloatArray, length: float
) -> _Scored:
    """A marker's better solution compared with its true rotation and position.

    Args:
        found: Detections with poses, of markers whose sides are `length` times as long as assumed.
        row: Of the marker.
        rotation: (3, 3) true one.
        position: (3,) true one.
        length: See `found`.

    Raises:
        ValueError: The detector has no camera.
    """
    if found.poses is None:
        raise ValueError("a detector without a camera finds no poses.")
    poses, scores = found.poses, []
    for s in np.flatnonzero(np.isfinite(poses.chi2[row])):
        shift = poses.position[row, s] - position / length
        turn = Rotation.from_matrix(poses.rotation[row, s] @ rotation.T).as_rotvec()
        covariance, error = poses.covariance[row, s], np.concatenate([shift, turn])
        plane = np.zeros((3, 6))
        plane[:2, :3], plane[2, 3:] = rotation.T[:2], rotation.T[2]
        in_plane = plane @ error
        scores.append(
            _Scored(
                float(error @ np.linalg.solve(covariance, error)),
                float(in_plane @ np.linalg.solve(plane @ covariance @ plane.T, in_plane)),
                float(np.linalg.norm(shift) / np.linalg.norm(position / length)),
            )
        )
    return min(scores, key=lambda score: score.nees)
