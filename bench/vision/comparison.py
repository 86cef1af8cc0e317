"""Detectors on the same images: recall, corners, poses, false ids and time."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.vision.peers import FAMILY, Found, Peer, all_peers
from bench.vision.scenes import CAMERA, Look, Truth, random_scene
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.markers.families import family_named
from swarm_loc_vision.markers.pose import square

LOOKS = {
    "still": Look(),
    "motion": Look(max_blur=8.0),
    "dim": Look(white=80.0, black=22.0, noise=2.5, gradient=0.8),
    "noisy": Look(noise=8.0),
}
"""Kinds of images."""
MARKERS = 20  # In an image, at most
SIDES_PX = (10.0, 14.0, 18.0, 24.0, 40.0, 80.0, math.inf)
INCIDENCES = tuple(math.radians(a) for a in (0.0, 30.0, 50.0, 70.0))
BLURS_PX = (1.0, 3.0, 5.0, 8.0)
_NEAR_PX = 3.0
_FLIPPED = 0.35  # A rotation further off than this is the mirrored one [rad]


@dataclass
class Score:
    """What one detector made of the images of one kind; the lists have one entry per true marker."""

    truths: list[Truth] = field(default_factory=list)
    corner_px: list[float] = field(default_factory=list)
    """Root mean square distance of the four corners; NaN: not found."""
    position_m: list[FloatArray] = field(default_factory=list)
    """Error in the camera frame; NaN: not found."""
    angle: list[float] = field(default_factory=list)
    false_ids: int = 0
    ms: list[float] = field(default_factory=list)

    @property
    def found(self) -> NDArray[np.bool_]:
        """Which markers were found."""
        return np.isfinite(self.corner_px)

    @property
    def recall(self) -> float:
        """Share of the markers that were found."""
        return float(self.found.mean())

    def recall_within(self, values: FloatArray, low: float, high: float) -> float:
        """Recall of the markers with a value in [low, high); NaN where there are none."""
        chosen = (values >= low) & (values < high)
        return float(self.found[chosen].mean()) if chosen.any() else math.nan

    def of_truths(self, name: str) -> FloatArray:
        """An attribute of all true markers."""
        return np.array([getattr(truth, name) for truth in self.truths])

    def corner_rms(self) -> float:
        """Root mean square of the corners' distances [px]."""
        return float(np.sqrt(np.nanmean(np.square(self.corner_px))))


Scores = dict[str, dict[str, Score]]  # Kind of image -> detector -> score


def compare(seeds: Sequence[int], frames: int) -> Scores:
    """Let all detectors see the same images, in turn image by image; one thread each.

    Args:
        seeds: One run of images each.
        frames: Images of each kind per seed.
    """
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    family, peers = family_named(FAMILY), all_peers()
    scores: Scores = {look: {name: Score() for name in peers} for look in LOOKS}
    warm = random_scene(np.random.default_rng(0), family, MARKERS, Look())[0]
    for peer in peers.values():
        peer(warm)
    for kind, (look_name, look) in enumerate(LOOKS.items()):
        for seed in seeds:
            rng = np.random.default_rng([kind, seed])
            for _ in range(frames):
                image, truths = random_scene(rng, family, MARKERS, look)
                for name, peer in peers.items():
                    _add(scores[look_name][name], peer, image, truths)
    cv2.setNumThreads(threads)
    return scores


def _add(score: Score, peer: Peer, image: NDArray[np.uint8], truths: Sequence[Truth]) -> None:
    """Score one image."""
    begin_s = time.process_time()
    found = peer(image)
    score.ms.append(1e3 * (time.process_time() - begin_s))
    used: set[int] = set()
    for truth in truths:
        row = match(found, truth, used)
        score.truths.append(truth)
        if row is None:
            score.corner_px.append(math.nan)
            score.position_m.append(np.full(3, math.nan))
            score.angle.append(math.nan)
            continue
        used.add(row)
        corners = found.corners[row]
        score.corner_px.append(float(np.sqrt(np.mean(np.sum((corners - truth.corners) ** 2, axis=1)))))
        position, angle = _pose_error(corners, truth)
        score.position_m.append(position)
        score.angle.append(angle)
    score.false_ids += len(found.ids) - len(used)


def match(found: Found, truth: Truth, used: set[int]) -> int | None:
    """The unused detection with the marker's id and all corners near its own."""
    near = max(_NEAR_PX, 0.1 * truth.side_px) + 0.5 * truth.blur
    for row in np.flatnonzero(found.ids == truth.marker_id):
        if row not in used and np.abs(found.corners[row] - truth.corners).max() < near:
            return int(row)
    return None


def solved_by_opencv(corners: FloatArray, length: float) -> tuple[FloatArray, FloatArray] | None:
    """Rotation vector and position (3,) of a marker in the camera by OpenCV's IPPE; None: none is found."""
    # exactly axis-aligned rectangles make IPPE_SQUARE give up
    jittered = corners + 1e-6 * np.arange(8.0).reshape(4, 2)
    found, turns, shifts, _ = cv2.solvePnPGeneric(
        square(length), jittered, CAMERA, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    return (np.ravel(turns[0]), np.ravel(shifts[0])) if found else None


def _pose_error(corners: FloatArray, truth: Truth) -> tuple[FloatArray, float]:
    """Error of the position [m] and of the rotation [rad] by OpenCV's IPPE, the same for all detectors."""
    found = solved_by_opencv(corners, truth.length)
    if found is None:
        return np.full(3, math.nan), math.nan
    rotation, _ = cv2.Rodrigues(found[0])
    cos = 0.5 * (np.trace(rotation.T @ truth.rotation) - 1.0)
    return found[1] - truth.position, math.acos(min(max(cos, -1.0), 1.0))


def share_flipped(score: Score) -> float:
    """Share of the found markers whose rotation is the mirrored one."""
    angles = np.array(score.angle)[score.found]
    return float((angles > _FLIPPED).mean())
