"""Families of markers: ids read at 30 px, and ids read where there are none, compared with OpenCV."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.shared.common import ProgressLine, new_plot, save_plot
from bench.vision.negatives import black_square
from bench.vision.scenes import CAMERA, HEIGHT, WIDTH, Look, Truth, facing, project, random_scene, render
from swarm_loc_vision.markers.detector import DetectorSettings, MarkerDetector
from swarm_loc_vision.markers.families import CODE_OTHER, Family, families
from swarm_loc_vision.markers.layouts import Layout
from swarm_loc_vision.markers.pose import square

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from bench.vision.scenes import Gray

_Found = tuple[NDArray[np.int64], NDArray[np.float64]]
"""Ids (N,) and corners (N, 4, 2)."""
SIDE_PX = 30.0
_SHARED = Path(__file__).resolve().parents[3] / "shared"
_OWN_MARKERS = {"opencv": "aruco_6x6", "apriltag": "apriltag_36h11"}
"""Folder of photographs -> families of the markers in them."""
_BLACK_SQUARES, _CLUTTERED, _RANDOM_IMAGES = 200, 20, 5
_WORDS = np.random.default_rng(99).integers(0, 1 << 36, 4096, dtype=np.uint64)
_RANDOM = Family("random", CODE_OTHER, Layout(6, 1), _WORDS)
_LENGTH = 0.05


def measure(seeds: Sequence[int], say: ProgressLine) -> Mapping[str, float]:
    """Shares of ids read and numbers of false ids, of all families but the prefixes of larger ones."""
    figures: dict[str, float] = {}
    for name, family in families().items():
        if family.code != CODE_OTHER or name.endswith(("_100", "_250")):
            continue
        own, other = _Reader(family), _opencv(family)
        read, by_opencv, count = 0, 0, 0
        for seed in seeds:
            rng = np.random.default_rng([5, seed])
            ids = rng.permutation(len(family.words))
            for begin in range(0, len(ids), _per_image(family)):
                say(f"{name}, seed {seed}")
                image, truths = _sheet(rng, family, ids[begin : begin + _per_image(family)])
                count += len(truths)
                read += _right(own.read(image), truths)
                by_opencv += _right(other.read(image), truths) if other else 0
        figures[f"families.{name}.read_share"] = read / count
        if other:
            figures[f"families.{name}.opencv_read_share"] = by_opencv / count
        for kind, pictures in (
            ("false_ids", _without_markers(seeds)),
            ("foreign_ids", _of_others(name, seeds)),
        ):
            numbers = np.zeros(2, np.int64)
            for image in pictures:
                numbers += len(own.read(image)[0]), len(other.read(image)[0]) if other else 0
            figures[f"families.{name}.{kind}"] = int(numbers[0])
            if other:
                figures[f"families.{name}.opencv_{kind}"] = int(numbers[1])
    _plot(figures)
    return figures


class _Reader:
    """Reads ids (N,) and corners (N, 4, 2) by our own detector."""

    def __init__(self, family: Family) -> None:
        self._detector = MarkerDetector(DetectorSettings(), {family: None})

    def read(self, image: Gray) -> _Found:
        """The markers in an image."""
        found = self._detector.detect(image)
        return found.id, found.corners


class _OpenCv:
    """Reads them by OpenCV as it comes."""

    def __init__(self, dictionary: int, quarters: int) -> None:
        self._detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(dictionary))
        self._quarters = quarters

    def read(self, image: Gray) -> _Found:
        """The markers in an image."""
        corners, ids, _ = self._detector.detectMarkers(image)
        read: Any = ids  # (N, 1) in 4.x, (N,) in 5.0, None in both
        found = np.array([] if read is None else read, np.int64).ravel()
        return found, np.roll(np.array(corners, float).reshape(-1, 4, 2), self._quarters, axis=1)


def _opencv(family: Family) -> _OpenCv | None:
    """OpenCV's detector of a family; None: it does not have it."""
    kind, _, rest = family.name.partition("_")
    name = f"DICT_APRILTAG_{rest}" if kind == "apriltag" else f"DICT_{rest.upper()}"
    dictionary = getattr(cv2.aruco, name, None)
    return None if dictionary is None else _OpenCv(dictionary, 2 if kind == "apriltag" else 0)


def _right(found: _Found, truths: Sequence[Truth]) -> int:
    """How many markers were read with the right id and corners."""
    ids, corners = found
    return sum(
        any(
            np.abs(corners[row] - truth.corners).max() < 3.0 for row in np.flatnonzero(ids == truth.marker_id)
        )
        for truth in truths
    )


def _pitch(family: Family) -> float:
    """Distance of markers in an image [px]."""
    return SIDE_PX * 1.5 * (family.side + 2 * (family.layout.outside + 1)) / family.side


def _per_image(family: Family) -> int:
    return int(WIDTH / _pitch(family)) * int(HEIGHT / _pitch(family))


def _sheet(rng: np.random.Generator, family: Family, ids: NDArray[np.int64]) -> tuple[Gray, list[Truth]]:
    """Markers of 30 px, turned at random and tilted by up to 20 degrees, before a cluttered background."""
    pitch, truths = _pitch(family), []
    columns = int(WIDTH / pitch)
    for place, marker_id in enumerate(ids):
        row, column = divmod(place, columns)
        pixel = (np.array([column, row]) + 0.5) * pitch + rng.uniform(-0.5, 0.5, 2)
        depth = CAMERA[0, 0] * _LENGTH / SIDE_PX
        position = depth * np.array([*((pixel - CAMERA[:2, 2]) / CAMERA[0, 0]), 1.0])
        tilt = rng.uniform(0.0, np.radians(20.0))
        rotation = facing(rng.uniform(-np.pi, np.pi), tilt, rng.uniform(-np.pi, np.pi), position)
        corners = project(rotation, position, square(_LENGTH))
        truths.append(Truth(int(marker_id), corners, rotation, position, _LENGTH, tilt, 0.0))
    return render(rng, family, truths, Look()), truths


def _without_markers(seeds: Sequence[int]) -> Iterator[Gray]:
    """Pictures without any marker: overhead pictures, black squares with a speck of light, clutter."""
    rng = np.random.default_rng(6)
    yield from map(_picture, sorted(_SHARED.glob("cases/*/*.png")))
    for _ in range(_BLACK_SQUARES):
        yield black_square(rng)
    for _ in seeds:
        for _ in range(_CLUTTERED):
            yield render(rng, _RANDOM, [], Look(clutter=400))


def _of_others(name: str, seeds: Sequence[int]) -> Iterator[Gray]:
    """Pictures with markers of other families: photographs, and squares with 6 x 6 random cells."""
    for path in sorted(_SHARED.glob("data/photos/*/*.[jp][pn]g")):
        if not name.startswith(_OWN_MARKERS[path.parent.name]):
            yield _picture(path)
    rng = np.random.default_rng(7)
    for _ in seeds:
        for _ in range(_RANDOM_IMAGES):
            yield random_scene(rng, _RANDOM, 20, Look())[0]


def _picture(path: Path) -> Gray:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)


def _plot(figures: Mapping[str, float]) -> None:
    """Draw shares of ids read and numbers of false ids of each family."""
    names = [key.split(".")[1] for key in figures if key.endswith(".read_share")]
    titles = {
        "read_share": "share of ids read at 30 px",
        "false_ids": "ids in pictures without markers",
        "foreign_ids": "ids in pictures of other markers",
    }
    figure, plots = new_plot(3, width=4.4)
    for axes, (kind, title) in zip(plots, titles.items(), strict=True):
        for shift, prefix, who in ((-0.2, "", "our detector"), (0.2, "opencv_", "OpenCV")):
            values = [figures.get(f"families.{name}.{prefix}{kind}", np.nan) for name in names]
            axes.barh(np.arange(len(names)) + shift, values, 0.4, label=who)
        axes.set(xlabel=title, yticks=np.arange(len(names)), yticklabels=names if axes is plots[0] else [])
        axes.invert_yaxis()
    plots[1].legend()
    save_plot(figure, "inputs-families")
