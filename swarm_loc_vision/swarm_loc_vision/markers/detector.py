"""Detector of square fiducial markers: computes ids, corners and poses from an image.

`CameraDetector` is that of one camera: it converts CameraInfo and images to serialized detections. Messages
may be those of rclpy or of rosbags, whose fields have the same names. `MarkersInUse` are the parameters about
markers of `marker_detector_node` and `marker_bridge_node`, `known_markers` what they describe.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from swarm_loc_estimator import CONTENT_POSE, CONTENT_POSE_TWO
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import note_precompiled
from swarm_loc_estimator.common.messages.cdr import nanoseconds
from swarm_loc_estimator.common.messages.detections import DETECTION_DTYPE, encode_detections
from swarm_loc_estimator.common.parameters import ParameterError, autostart, choice, number, text, texts
from swarm_loc_estimator.swarm.swarm import CameraMount, Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_vision.common.camera import LENS_KIND, LENS_SIZE, STRAIGHT, Camera
from swarm_loc_vision.common.images import TRANSPORTS, CalibratedCamera, Gray, GrayOf
from swarm_loc_vision.markers.decoder import Dictionary
from swarm_loc_vision.markers.families import Family, Layout, draw_marker, families, family_named
from swarm_loc_vision.markers.lines import homographies, read_cells, refine
from swarm_loc_vision.markers.pose import (
    SHIFT,
    Body,
    Placement,
    Poses,
    PoseSettings,
    PoseSolver,
    robot_body,
    up_of,
)
from swarm_loc_vision.markers.quads import apart, find_quads
from swarm_loc_vision.markers.sides import NEW_CAMERA, refine_read


@dataclass(frozen=True)
class DetectorSettings(PoseSettings):
    """Settings of the detector."""

    min_side_px: float = number(8.0, "px", 6.0, 1000.0, "smallest side of markers in the image")
    min_contrast: float = number(4.0, "1", 1.0, 100.0, "least brightness of paper minus that of ink [counts]")


_ROUGH_PX = 3.0  # Distance of the profiles across the sides of candidates [px]
_MIN_EDGE = 2.0  # Minimum contrast of a candidate's sides over `min_contrast`, relative to the local mean
_MAX_CANDIDATES = 8192  # Maximum number of candidates per image; the smallest are dropped
_BLOCK = 256  # Number of candidates decoded at once, to limit memory
_SAME = 0.3  # Maximum distance of duplicate readings, relative to a marker's diagonal


@dataclass(frozen=True)
class Detections:
    """The markers in an image, one row each."""

    family: IntArray  # (N,) codes of families
    id: IntArray  # (N,) ids
    margin: FloatArray  # (N,) weighted bits that could flip before another reading would be nearer
    errors: FloatArray  # (N,) weighted bits by which the cells differ from the word of the id
    contrast: FloatArray  # (N,) light minus dark cells [counts]
    corners: FloatArray  # (N, 4, 2) clockwise from the marker's own upper left [raw px]
    poses: Poses | None  # Poses and mirrored poses; None without a camera
    misfits: int  # Number of markers whose corners do not fit a square: the calibration may be wrong
    dropped: Mapping[str, int]  # Number of candidates that could not be read, by reason

    def __len__(self) -> int:
        return len(self.id)


class _Markers(NamedTuple):
    """Decoded candidates, one row each; as `Detections`, with ideal corners and their covariance."""

    family: NDArray[Any]
    id: NDArray[Any]
    margin: NDArray[Any]
    errors: NDArray[Any]
    contrast: NDArray[Any]
    corners: NDArray[Any]
    covariance: NDArray[Any]

    def select(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> _Markers:
        """A selection of rows."""
        return _Markers(*(column[rows] for column in self))


class MarkerDetector:
    """Finds the markers in use.

    `families` are the ids in use of each family, None for all of its ids. Without a camera there are no poses
    and no distortion. For the other arguments see `PoseSolver`.
    """

    def __init__(
        self,
        settings: DetectorSettings,
        families: Mapping[Family, IntArray | None],
        camera: Camera | None = None,
        *,
        lengths: Mapping[int, float] | None = None,
        up: FloatArray | None = None,
        lying: Sequence[int] = (),
        bodies: Sequence[Body] = (),
    ) -> None:
        self._settings = settings
        self._camera = camera
        self._lens = camera.lens if camera else np.zeros(LENS_SIZE)
        self._displaced = NEW_CAMERA.copy()
        self._solver = PoseSolver(settings, camera, lengths or {}, up, lying, bodies) if camera else None
        by_layout: dict[Layout, dict[Family, IntArray]] = {}
        for family, ids in families.items():
            used = np.arange(len(family.words)) if ids is None else ids
            by_layout.setdefault(family.layout, {})[family] = used
        self._touching = any(family.touching for family in families)
        self._dictionaries = [Dictionary(layout, used) for layout, used in by_layout.items()]

    def detect(self, gray: Gray) -> Detections:
        """The markers in an image (height, width)."""
        dropped: Counter[str] = Counter(too_many_candidates=0, too_far_off_axis=0)
        found: list[_Markers] = []
        for swapped in sorted({dictionary.layout.surrounded for dictionary in self._dictionaries}):
            seen = np.invert(gray) if swapped else gray
            quads = self._candidates(seen, dropped)
            blocks = np.split(quads, range(_BLOCK, len(quads), _BLOCK))
            found += [
                self._read(seen, block, dictionary)
                for dictionary in self._dictionaries
                if dictionary.layout.surrounded == swapped
                for block in blocks
            ]
        # of duplicates the reading with the fewest errors, then the highest contrast
        markers = _Markers(*map(np.concatenate, zip(*found, strict=True)))
        middle, order = markers.corners.mean(axis=1), np.lexsort((-markers.contrast, markers.errors))
        markers = markers.select(apart(middle, _SAME * _diagonals(markers.corners), order))
        corners = self._camera.to_raw(markers.corners) if self._camera else markers.corners
        # poses of all markers, jointly for bodies
        poses, misfits = None, 0
        if self._solver is not None:
            covariance = markers.covariance + (0.0 if self._lens[LENS_KIND] == STRAIGHT else SHIFT)
            poses, misfits = self._solver.solve(markers.id, markers.corners, covariance)
        return Detections(*markers[:5], corners, poses, misfits, dropped)

    def _candidates(self, gray: Gray, dropped: Counter[str]) -> FloatArray:
        """(N, 4, 2) dark quadrangles [ideal px]."""
        settings = self._settings
        quads = find_quads(gray, settings.min_side_px, settings.min_contrast, touching=self._touching)
        surplus = max(len(quads) - _MAX_CANDIDATES, 0)
        if surplus:
            quads = quads[np.sort(np.argsort(_diagonals(quads))[surplus:])]
        count = len(quads)
        if self._camera:
            quads = self._camera.to_ideal(quads)
            quads = quads[np.isfinite(quads).all(axis=(1, 2))]
        dropped["too_many_candidates"] += surplus
        dropped["too_far_off_axis"] += count - len(quads)
        return quads

    def _read(self, gray: Gray, quads: FloatArray, dictionary: Dictionary) -> _Markers:
        """The candidates that are markers of a dictionary."""
        min_contrast, layout = self._settings.min_contrast, dictionary.layout
        rough = refine(gray, self._lens, quads, layout.side, _ROUGH_PX)
        corners = rough.corners[rough.contrast >= _MIN_EDGE * min_contrast]
        cells = np.empty((len(corners), layout.grid, layout.grid))
        read_cells(gray, self._lens, homographies(corners), layout.side, cells)
        readings = dictionary.read(cells, _MIN_EDGE * min_contrast)
        good = readings.word >= 0
        word, quarters = readings.word[good], readings.quarters[good]
        own = (np.arange(4) - quarters[:, None]) % 4  # the marker's own first corner first
        fine = refine_read(
            gray,
            self._lens,
            np.take_along_axis(corners[good], own[..., None], axis=1),
            dictionary.strips[word],
            layout.border,
            self._displaced,
        )
        markers = _Markers(
            dictionary.codes[word],
            dictionary.ids[word],
            readings.margin[good],
            readings.errors[good],
            readings.contrast[good],
            fine.corners,
            fine.covariance,
        )
        return markers.select(fine.contrast > 0.0)


def _diagonals(quads: FloatArray) -> FloatArray:
    """(N,) lengths of a diagonal of quadrangles (N, 4, 2) [px]."""
    return np.asarray(np.linalg.norm(quads[:, 0] - quads[:, 2], axis=1))


def precompile() -> None:
    """Compile the detector by finding two markers of one body, which calls all compiled functions."""
    family = family_named("artoolkit_bch_thin")
    image = np.hstack([draw_marker(family, marker_id, margin=4) for marker_id in (1, 2)])
    height, width = image.shape
    camera = Camera(width, height, 500.0, 500.0, 0.5 * width, 0.5 * height)
    apart = 0.05 * (family.side + 8) / family.side
    body = {i: Placement(np.eye(3), np.array([apart * i, 0.0, 0.0]), 0.001) for i in (1, 2)}
    up = np.array([0.0, -1.0, 0.0])
    settings = DetectorSettings(tilt_sigma=0.1)
    MarkerDetector(settings, {family: np.array([1, 2])}, camera, up=up, bodies=[body]).detect(image)
    note_precompiled(precompile)


CreateDetector = Callable[[Camera], MarkerDetector]


class CameraDetector(CalibratedCamera):
    """The detector of one camera, which `create` creates when its calibration arrives.

    `gray_of` reads an image message, see `TRANSPORTS`; for `ambiguity` see `detection_rows`.
    """

    def __init__(self, create: CreateDetector, gray_of: GrayOf, ambiguity: float) -> None:
        super().__init__(gray_of)
        self.markers = 0  # Number of markers with a pose; `drops` also counts those without, and candidates
        self.misfits = 0  # Number of them whose corners do not fit a square
        self._create = create
        self._ambiguity = ambiguity
        self._detector: MarkerDetector  # set with the calibration, without which images are dropped

    def use(self, camera: Camera) -> None:
        """Create the detector for another calibration."""
        self._detector = self._create(camera)

    def found(self, message: Any) -> bytes:
        """The serialized swarm_loc_msgs/MarkerDetectionArray of an image."""
        gray = self.gray(message)
        detections = self._detector.detect(gray)
        rows = detection_rows(detections, self._ambiguity)
        self.drops["no_pose"] += len(detections) - len(rows)
        self.drops.update(detections.dropped)
        self.markers += len(rows)
        self.misfits += detections.misfits
        return encode_detections(message.header.frame_id, nanoseconds(message.header.stamp), rows)


_MIN_CHI2 = 1e-6


def detection_rows(detections: Detections, ambiguity: float) -> NDArray[np.void]:
    """Rows of `DETECTION_DTYPE`, one per marker that has a pose.

    The mirrored pose is included if its chi square is higher by at most `ambiguity`.

    Raises:
        ValueError: The detector has no camera.
    """
    if detections.poses is None:
        raise ValueError("a detector without a camera finds no poses.")
    solved = np.isfinite(detections.poses.chi2[:, 0])
    rotation, position, covariance, chi2 = (column[solved] for column in detections.poses)
    is_two = chi2[:, 1] - chi2[:, 0] <= ambiguity
    rows = np.zeros(len(chi2), DETECTION_DTYPE)
    rows["id"] = detections.id[solved]
    rows["family"] = detections.family[solved]
    rows["content"] = np.where(is_two, CONTENT_POSE_TWO, CONTENT_POSE)
    rows["id_margin"] = detections.margin[solved]
    rows["corners_px"] = detections.corners[solved]
    rows["position"] = position[:, 0]
    rows["orientation"] = _quaternions(rotation[:, 0])
    rows["covariance"] = covariance[:, 0]
    rows["alternative_orientation"][:, 3] = 1.0
    rows["alternative_position"][is_two] = position[is_two, 1]
    rows["alternative_orientation"][is_two] = _quaternions(rotation[is_two, 1])
    rows["alternative_ratio"] = np.nan
    least = np.maximum(chi2[is_two], _MIN_CHI2)
    rows["alternative_ratio"][is_two] = np.sqrt(least[:, 1] / least[:, 0])
    return rows


def _quaternions(rotations: FloatArray) -> FloatArray:
    """(N, 4) x, y, z, w."""
    return np.asarray(Rotation.from_matrix(rotations).as_quat()) if len(rotations) else np.zeros((0, 4))


_IDS = re.compile(r"(\d+)(?:-(\d+))?")
_LENGTH = re.compile(r"(\d+)(?:-(\d+))?:(\d*\.?\d+)")
_LONGEST_M = 10.0


@dataclass(frozen=True)
class MarkersInUse:
    """Parameters about the markers in use and the camera's mount."""

    family: str = choice("artoolkit_bch_thin", tuple(families()), "kind of marker")
    ids: tuple[str, ...] = texts("ids in use, such as 5 or 0-31; empty: those of swarm_file, or all")
    lengths: tuple[str, ...] = texts(
        "sides that differ from marker_length, such as 100-119:0.08 [m]; not with swarm_file"
    )
    swarm_file: str = text(
        "", "path of the swarm description: ids in use, sizes, faces of robots; empty: none"
    )
    robot: str = text(
        "", "robot in swarm_file that carries the camera, or the fixed camera itself; empty: a level camera"
    )


@dataclass(frozen=True)
class DetectorParameters(MarkersInUse):
    """Parameters of `marker_detector_node`."""

    autostart: bool = autostart()
    image_transport: str = choice("raw", tuple(TRANSPORTS), "transport: uncompressed images, or JPEG or PNG")
    settings: DetectorSettings = field(
        default_factory=DetectorSettings, metadata={"numbers_of": DetectorSettings}
    )


class KnownMarkers(NamedTuple):
    """What a description says of markers: `MarkersInUse` with the contents of its files."""

    family: Family  # The family
    ids: IntArray | None  # (N,) ids in use, ascending; None: all
    lengths: Mapping[int, float]  # Sides by id [m]
    up: FloatArray  # (3,) up in the camera frame
    lying: Sequence[int]  # Ids of markers that lie flat
    bodies: Sequence[Body]  # Faces of the other robots


def known_markers(parameters: MarkersInUse) -> KnownMarkers:
    """The markers that parameters describe.

    Raises:
        ParameterError: A parameter cannot be used.
        SwarmFileError: The swarm description cannot be used.
    """
    family = family_named(parameters.family)
    swarm = load_swarm(Path(parameters.swarm_file)) if parameters.swarm_file else Swarm()
    # the robot that carries the camera, or the fixed camera itself
    name, file, carriers = parameters.robot, parameters.swarm_file, {one.name: one for one in swarm.sources}
    if name and not file:
        raise ParameterError(f"parameter robot = '{name}' needs the parameter swarm_file, too.")
    if name and name not in carriers:
        raise ParameterError(
            f"parameter robot = '{name}' must be a robot or fixed camera of the swarm: {', '.join(carriers)}."
        )
    carrier = carriers.get(name)
    mount = carrier.camera if isinstance(carrier, Robot) else carrier
    # the ids in use
    count, owners = len(family.words), swarm.owner_of
    ids = np.array(sorted(owners), np.int64) if owners else None
    if parameters.ids:
        ids = parse_ids("ids", parameters.ids, count)
    elif unknown := [marker_id for marker_id in owners if marker_id >= count]:
        raise ParameterError(
            f"{file} has marker id {unknown[0]}, but {family.name} has only 0 to {count - 1}."
        )
    # sides by id, from the swarm or from the parameter
    if parameters.lengths and file:
        raise ParameterError(
            "parameter lengths cannot be given along with swarm_file, which has the size of each marker."
        )
    lengths = {marker_id: owner.marker.size for marker_id, owner in owners.items()}
    return KnownMarkers(
        family,
        ids,
        lengths if file else parse_lengths(parameters.lengths, count),
        up_of(mount or CameraMount()),
        [face.id for other in swarm.robots for face in other.faces if face.lies],
        [robot_body(other) for other in swarm.robots if other is not carrier],
    )


def detector_maker(parameters: DetectorParameters) -> CreateDetector:
    """Creates the detector for a camera; raises what `known_markers` does."""
    family, ids, lengths, up, lying, bodies = known_markers(parameters)

    def create(camera: Camera) -> MarkerDetector:
        return MarkerDetector(
            parameters.settings, {family: ids}, camera, lengths=lengths, up=up, lying=lying, bodies=bodies
        )

    return create


def parse_ids(name: str, selected: Sequence[str], count: int) -> NDArray[np.int64]:
    """Ids (N,), ascending, of ids or ranges such as 0-31; there are `count`, and `name` is the parameter's.

    Raises:
        ParameterError: A text is not one, or an id does not exist.
    """
    chosen: set[int] = set()
    for one in selected:
        match = _IDS.fullmatch(one.strip())
        if match is None:
            raise ParameterError(
                f"parameter {name}: '{one}' must be an id such as 5 or a range such as 0-31."
            )
        first, last = int(match[1]), int(match[2] or match[1])
        if not first <= last < count:
            raise ParameterError(f"parameter {name}: '{one}' must ascend within 0-{count - 1}.")
        chosen.update(range(first, last + 1))
    return np.array(sorted(chosen), np.int64)


def parse_lengths(selected: Sequence[str], count: int) -> dict[int, float]:
    """Marker id -> side [m], of texts with an id or a range, a colon, and a length in metres.

    Raises:
        ParameterError: A text is not one, an id does not exist, or a length is out of range.
    """
    lengths: dict[int, float] = {}
    for one in selected:
        match = _LENGTH.fullmatch(one.strip())
        if match is None:
            raise ParameterError(
                f"parameter lengths: '{one}' must be ids and a length in metres, such as 100-119:0.08."
            )
        length = float(match[3])
        if not 0.0 < length <= _LONGEST_M:
            raise ParameterError(f"parameter lengths: '{one}' must give a length in (0, {_LONGEST_M:g}] m.")
        ids = one.partition(":")[0]
        lengths.update(dict.fromkeys(parse_ids("lengths", [ids], count).tolist(), length))
    return lengths
