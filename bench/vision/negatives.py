"""False-positive rates: squares that are no markers, and how many of them are read as an id."""

from collections.abc import Sequence

import cv2
import numpy as np

from bench.vision.peers import FAMILY, own_detector
from bench.vision.scenes import Gray, Look, random_scene
from swarm_loc_vision.markers.detector import DetectorSettings, MarkerDetector
from swarm_loc_vision.markers.families import CODE_OTHER, Family, Layout, families, family_named

_INK, _PAPER, _MARGIN_PX = 25.0, 225.0, 20
_FEW_IDS = np.arange(16)
_FINE = 4  # Points per pixel, each way


def random_squares(seeds: Sequence[int], frames: int, markers: int) -> tuple[int, int]:
    """How many squares with random cells were seen, and how many ids were read from them."""
    squares = ids = 0
    detector = own_detector(family_named(FAMILY))
    for seed in seeds:
        rng = np.random.default_rng([99, seed])
        family = random_family(rng)
        for _ in range(frames):
            image, truths = random_scene(rng, family, markers, Look())
            squares += len(truths)
            ids += len(detector.detect(image))
    return squares, ids


def random_family(rng: np.random.Generator) -> Family:
    """Squares with 6 x 6 random cells."""
    return Family("random", CODE_OTHER, Layout(6, 1), rng.integers(0, 1 << 36, 4096, dtype=np.uint64))


def black_squares(count: int) -> dict[str, int]:
    """How many of black squares with a speck are read as an id, by family and number of ids."""
    rng = np.random.default_rng(98)
    images = [black_square(rng) for _ in range(count)]
    return {
        f"{family.name}, {'all' if ids is None else len(ids)}": sum(
            len(detector.detect(image)) > 0 for image in images
        )
        for family in families().values()
        for ids in (None, _FEW_IDS)
        for detector in [MarkerDetector(DetectorSettings(), {family: ids})]
    }


def black_square(rng: np.random.Generator) -> Gray:
    """A black square of 24 to 60 px on paper with one light speck inside, blurred and noisy."""
    side = int(rng.integers(24, 61))
    size = side + 2 * _MARGIN_PX
    image = np.full((_FINE * size, _FINE * size), _PAPER, np.float32)
    begin, end = _FINE * _MARGIN_PX, _FINE * (_MARGIN_PX + side)
    image[begin:end, begin:end] = _INK
    middle = _FINE * (_MARGIN_PX + side * rng.uniform(0.1, 0.9, 2))
    axes = _FINE * rng.uniform(0.5, 0.1 * side, 2)
    speck = cv2.ellipse(
        np.zeros_like(image),
        (tuple(middle.tolist()), tuple((2.0 * axes).tolist()), rng.uniform(0.0, 180.0)),
        1.0,
        cv2.FILLED,
    )
    image[begin:end, begin:end][speck[begin:end, begin:end] > 0.0] = rng.uniform(60.0, 220.0)
    turn = cv2.getRotationMatrix2D((0.5 * _FINE * size,) * 2, rng.choice([0.0, rng.uniform(0.0, 90.0)]), 1.0)
    turned = cv2.warpAffine(image, turn, image.shape, borderValue=_PAPER)
    blurred = cv2.GaussianBlur(
        cv2.resize(turned, (size, size), interpolation=cv2.INTER_AREA), (0, 0), rng.uniform(0.3, 1.5)
    )
    noisy = blurred + rng.normal(0.0, rng.uniform(0.1, 2.5), blurred.shape)
    return np.asarray(np.clip(np.rint(noisy), 0, 255), np.uint8)
