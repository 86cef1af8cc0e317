"""The aerial detector on pictures of others: tall robots seen from the side, moving ones, and real Kilobots.

The pictures are no part of the workspace. They lie next to it, in `../shared/cases/aerial_*`, each with its
camera and control points. Those without a file of their own with the truth show the same robots at the same
places.
"""

import re
import time
from dataclasses import replace
from functools import reduce
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.aerial.detector import Score, score_places
from bench.shared.common import SHARED, Cell, rms, table
from swarm_loc_vision.aerial.detector import AerialDetector
from swarm_loc_vision.aerial.ground_control import AerialSettings, load_ground, solve_pose

FOLDER = SHARED / "cases"
_DIAMETER = 0.08
_KILOBOT = 0.033  # Diameter and height of a Kilobot [m]
_FLAT_HEIGHT = 0.03  # Height of the tops of robots without visible sides, by their parallax [m]
_PLACES = np.array(
    [
        [-1.2704, -0.5216],
        [-1.2027, -0.4631],
        [-0.8267, -0.4943],
        [-0.7094, -1.0455],
        [-0.3642, 0.5316],
        [-0.0868, -0.4633],
        [-0.0154, 0.1767],
        [-0.0004, -0.4476],
        [0.4283, -1.0675],
        [0.4666, 0.6138],
        [0.9035, 1.1310],
        [1.0240, 0.8830],
        [1.3277, 0.1516],
        [1.3918, 0.6857],
    ]
)
"""Where the robots stand [m]: means over the two pictures with white margins, in which all rims are clear."""


def measure() -> dict[str, float]:
    """Print a table of the pictures; the figures by name, none where there are no pictures."""
    pictures = sorted(FOLDER.glob("aerial_*/*.png"))
    if not pictures:
        print(f"No pictures in {FOLDER}: the cases are skipped.")
        return {}
    scores = [_scored(path) for path in pictures]
    rows: list[list[Cell]] = [
        [
            path.stem,
            score.robots - score.missed,
            score.robots,
            score.false,
            1e3 * rms(score.position_m),
            1e3 * score.seconds,
        ]
        for path, score in zip(pictures, scores, strict=True)
    ]
    print(table(["picture", "found", "of", "false", "rms [mm]", "CPU [ms]"], rows))
    score = reduce(Score.concatenate, scores)
    return {
        "cases.recall": 1.0 - score.missed / score.robots,
        "cases.false_detections": float(score.false),
        "cases.position_mm": 1e3 * rms(score.position_m),
    }


def gray_picture(path: Path) -> NDArray[np.uint8]:
    """A picture as an array (height, width)."""
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)


def _scored(path: Path) -> Score:
    """One picture; a number of millimetres in its name is the robots' height."""
    height = re.search(r"(\d+)_mm", path.stem)
    settings = AerialSettings(
        robot_diameter=_DIAMETER, robot_height=1e-3 * int(height[1]) if height else _FLAT_HEIGHT
    )
    truth = path.with_name(f"{path.stem}_truth.txt")
    if truth.exists():
        settings = replace(settings, robot_diameter=_KILOBOT, robot_height=_KILOBOT)
    ground = load_ground(path.with_suffix(".yaml"))
    if ground.camera is None:
        raise ValueError(f"{path.with_suffix('.yaml')} has no camera.")
    camera = solve_pose(ground.camera, ground.points, settings).ground
    places = camera.places(np.loadtxt(truth), settings.robot_height) if truth.exists() else _PLACES
    detector = AerialDetector(settings, camera)
    gray = gray_picture(path)
    detector.detect(gray)
    begin_s = time.process_time()
    found = detector.detect(gray)
    poses = np.concatenate([places, np.zeros((len(places), 1))], axis=1)
    return score_places(poses, settings.robot_diameter, found, time.process_time() - begin_s)
