"""Families of markers: ids read at 30 px, and ids read where there are none, compared with OpenCV."""

from collections.abc import Iterator, Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.aerial.cases import FOLDER, gray_picture
from bench.shared.common import ProgressLine
from bench.vision.comparison import match
from bench.vision.negatives import black_square, random_family
from bench.vision.peers import Found, Peer, as_found, opencv_name, stock
from bench.vision.scenes import (
    CAMERA,
    HEIGHT,
    WIDTH,
    Gray,
    Look,
    Truth,
    facing,
    project,
    random_scene,
    render,
)
from swarm_loc_vision.markers.detector import DetectorSettings, MarkerDetector
from swarm_loc_vision.markers.families import CODE_OTHER, Family, families
from swarm_loc_vision.markers.pose import square

SIDE_PX = 30.0
_OWN_MARKERS = {"opencv": "aruco_6x6", "apriltag": "apriltag_36h11", "charuco": "aruco_4x4"}
"""Folder of photographs -> families of the markers in them."""
_BLACK_SQUARES, _CLUTTERED, _RANDOM_IMAGES = 200, 20, 5
_RANDOM = random_family(np.random.default_rng(99))
_LENGTH = 0.05


def measure(seeds: Sequence[int], say: ProgressLine) -> Mapping[str, float]:
    """Shares of ids read and numbers of false ids.

    Of families without a code of their own; of ArUco's, those with the fewest and the most ids.
    """
    say("pictures")
    without, foreign = [*_without_markers(seeds)], [*_of_makers(seeds)]
    figures: dict[str, float] = {}
    for name, family in families().items():
        if family.code != CODE_OTHER or name.endswith(("_100", "_250")):
            continue
        say(name)
        sheets = [sheet for seed in seeds for sheet in _sheets(family, seed)]
        others = [image for maker, image in foreign if not name.startswith(maker)]
        for who, read in _readers(family).items():
            right = sum(_right(read(image), truths) for image, truths in sheets)
            count = sum(len(truths) for _, truths in sheets)
            figures[f"families.{name}.{who}read_share"] = right / count
            for kind, pictures in (("false_ids", without), ("foreign_ids", others)):
                number = sum(len(read(image).ids) for image in pictures)
                figures[f"families.{name}.{who}{kind}"] = float(number)
    return figures


def _readers(family: Family) -> dict[str, Peer]:
    """Our own detector and, where it has the family, OpenCV's, by the prefix of their figures."""
    detector = MarkerDetector(DetectorSettings(), {family: None})
    readers: dict[str, Peer] = {"": lambda image: as_found(detector.detect(image))}
    if hasattr(cv2.aruco, opencv_name(family)):
        readers["opencv_"] = stock(family)
    return readers


def _right(found: Found, truths: Sequence[Truth]) -> int:
    """How many markers were read with the right id and corners."""
    return sum(match(found, truth, set()) is not None for truth in truths)


def _pitch(family: Family) -> float:
    """Distance of markers in an image [px]."""
    return SIDE_PX * 1.5 * (family.side + 2 * (family.layout.outside + 1)) / family.side


def _per_image(family: Family) -> int:
    return int(WIDTH / _pitch(family)) * int(HEIGHT / _pitch(family))


def _sheets(family: Family, seed: int) -> Iterator[tuple[Gray, list[Truth]]]:
    """Images with all ids of a family."""
    rng = np.random.default_rng([5, seed])
    ids, size = rng.permutation(len(family.words)), _per_image(family)
    for begin in range(0, len(ids), size):
        yield _sheet(rng, family, ids[begin : begin + size])


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
    yield from map(gray_picture, sorted(FOLDER.glob("*/*.png")))
    for _ in range(_BLACK_SQUARES):
        yield black_square(rng)
    for _ in range(_CLUTTERED * len(seeds)):
        yield render(rng, _RANDOM, [], Look(clutter=400))


def _of_makers(seeds: Sequence[int]) -> Iterator[tuple[str, Gray]]:
    """Pictures of markers, and how names of their families begin: photographs, and 6 x 6 random cells."""
    for path in sorted(FOLDER.parent.glob("data/photos/*/*.[jp][pn]g")):
        yield _OWN_MARKERS[path.parent.name], gray_picture(path)
    rng = np.random.default_rng(7)
    for _ in range(_RANDOM_IMAGES * len(seeds)):
        yield _RANDOM.name, random_scene(rng, _RANDOM, 20, Look())[0]
