"""The marker detector: a picture in, markers with their corners, ids and poses out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_vision.core.bodies import Body, Seen, solve_bodies
from swarm_loc_vision.core.camera import Camera
from swarm_loc_vision.core.decoder import Dictionary
from swarm_loc_vision.core.edges import refine, refine_read
from swarm_loc_vision.core.families import Family
from swarm_loc_vision.core.homographies import homographies
from swarm_loc_vision.core.pose import Poses, Upright, marker_poses
from swarm_loc_vision.core.quads import find_quads
from swarm_loc_vision.core.sampling import GRID, LENS_SIZE, read_cells
from swarm_loc_vision.core.settings import DetectorSettings

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Gray = NDArray[np.uint8]

_ROUGH_PX = 3.0
"""Distance of the profiles across the sides of candidates."""
_LEAST_EDGE = 2.0
"""Contrast of a candidate's sides over `least_contrast`, which counts from the mean and not from dark."""
_SAME = 0.3
"""Readings nearer than this share of a marker's diagonal are of the same one."""


@dataclass(frozen=True)
class Detections:
    """The markers in a picture, one row each.

    Attributes:
        family: Code of its family.
        id: Its id.
        margin: Weighed bits that could still flip before another reading would be nearer.
        errors: Weighed bits by which it differs from its id's word.
        contrast: Light minus dark cells [counts].
        corners: (N, 4, 2) clockwise from the marker's own upper left [raw px].
        poses: Its pose and the mirrored one; None without a camera.
    """

    family: IntArray
    id: IntArray
    margin: FloatArray
    errors: FloatArray
    contrast: FloatArray
    corners: FloatArray
    poses: Poses | None

    def __len__(self) -> int:
        return len(self.id)


class _Markers(NamedTuple):
    """Candidates that were read, one row each; as `Detections`, with ideal corners and their covariance."""

    family: NDArray[Any]
    id: NDArray[Any]
    margin: NDArray[Any]
    errors: NDArray[Any]
    contrast: NDArray[Any]
    corners: NDArray[Any]
    covariance: NDArray[Any]

    def chosen(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> _Markers:
        """Some of the rows."""
        return _Markers(*(column[rows] for column in self))


class MarkerDetector:
    """Finds the markers in use.

    Args:
        settings: Its numbers.
        families: Families in use and for each its ids in use; None: all of its ids.
        camera: What takes the pictures; without one there are no poses, and it has no distortion.
        lengths: Sides of markers that differ from `settings.marker_length`, by id [m].
        up: (3,) direction up in the camera frame, for `settings.tilt_sigma`.
        bodies: Things that carry several markers.
    """

    def __init__(
        self,
        settings: DetectorSettings,
        families: Sequence[tuple[Family, IntArray | None]],
        camera: Camera | None = None,
        *,
        lengths: Mapping[int, float] | None = None,
        up: FloatArray | None = None,
        bodies: Sequence[Body] = (),
    ) -> None:
        self._settings = settings
        self._camera = camera
        self._lens = camera.lens if camera else np.zeros(LENS_SIZE)
        self._lengths = lengths or {}
        self._bodies = bodies
        self._upright = None if up is None or not settings.tilt_sigma else Upright(up, settings.tilt_sigma)
        by_side: dict[int, list[tuple[Family, IntArray]]] = {}
        for family, ids in families:
            used = np.arange(len(family.words)) if ids is None else ids
            by_side.setdefault(family.side, []).append((family, used))
        self._dictionaries = {side: Dictionary(used) for side, used in by_side.items()}

    def detect(self, gray: Gray) -> Detections:
        """The markers in a picture (height, width)."""
        quads = find_quads(gray, self._settings.least_side_px, self._settings.least_contrast)
        if self._camera:
            quads = self._camera.to_ideal(quads)
        found = [self._read(gray, quads, side) for side in self._dictionaries]
        markers = _best(_joined(found))
        corners = self._camera.to_raw(markers.corners) if self._camera else markers.corners
        return Detections(*markers[:5], corners, self._poses(markers))

    def _read(self, gray: Gray, quads: FloatArray, side: int) -> _Markers:
        """The candidates that are markers of so many cells along a side."""
        least_contrast, dictionary = self._settings.least_contrast, self._dictionaries[side]
        rough = refine(gray, self._lens, quads, side, _ROUGH_PX)
        corners = rough.corners[rough.contrast >= _LEAST_EDGE * least_contrast]
        cells = np.empty((len(corners), GRID, GRID))
        read_cells(gray, self._lens, homographies(corners), side, cells)
        readings = dictionary.read(cells, _LEAST_EDGE * least_contrast)
        good = readings.word >= 0
        word, quarters = readings.word[good], readings.quarters[good]
        own = (np.arange(4) - quarters[:, None]) % 4  # the marker's own first corner first
        fine = refine_read(
            gray,
            self._lens,
            np.take_along_axis(corners[good], own[..., None], axis=1),
            dictionary.strips[word],
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
        return markers.chosen(fine.contrast > 0.0)

    def _poses(self, markers: _Markers) -> Poses | None:
        """Poses of all markers, those of bodies together."""
        if self._camera is None:
            return None
        default = self._settings.marker_length
        lengths = np.array([self._lengths.get(int(i), default) for i in markers.id], dtype=float)
        intrinsics = self._camera.intrinsics
        poses = marker_poses(markers.corners, markers.covariance, lengths, intrinsics, self._upright)
        if self._bodies:
            seen = Seen(markers.id, markers.corners, markers.covariance, lengths, poses)
            solve_bodies(seen, self._bodies, intrinsics, self._upright)
        return poses


def _joined(found: Sequence[_Markers]) -> _Markers:
    """All rows."""
    return _Markers(*map(np.concatenate, zip(*found, strict=True)))


def _best(markers: _Markers) -> _Markers:
    """One reading for each place: that with the fewest errors, and of like ones the clearest."""
    order = np.lexsort((-markers.contrast, markers.errors))
    middle = markers.corners.mean(axis=1)
    size = _SAME * np.linalg.norm(markers.corners[:, 0] - markers.corners[:, 2], axis=1)
    near = np.linalg.norm(middle[:, None] - middle, axis=2) < size[:, None]
    kept: list[int] = []
    for i in order:
        if not near[i, kept].any():
            kept.append(int(i))
    return markers.chosen(np.array(sorted(kept), np.int64))
