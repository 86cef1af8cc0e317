"""The aerial detector on drawn pictures: what is found, how exactly, under which light and lens.

Pictures are drawn by plain image operations (`pictures.py`), not by the simulator's renderer.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from bench.aerial.pictures import DIAMETER, Look, Picture, control_pixels, draw_picture
from bench.shared.common import Cell, ProgressLine, table
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.aerial.detector import AerialDetections, AerialDetector
from swarm_loc_vision.aerial.ground_control import AerialSettings, ControlPoints, solve_pose

SEEDS = 5
_MATCHED = 0.3  # Of a diameter: a detection so near is of that robot

_WIDE = Look(field_of_view=math.radians(100.0), barrel=-0.12, diameter_px=20.0)
LOOKS: Mapping[str, Look] = {
    "plain": Look(),
    **{f"size_{px}px": Look(diameter_px=float(px)) for px in (7, 10, 15, 48)},
    **{f"tilt_{deg}deg": Look(tilt=math.radians(deg)) for deg in (20, 40)},
    **{f"wide_lens_tilt_{deg}deg": replace(_WIDE, tilt=math.radians(deg)) for deg in (0, 30)},
    **{f"light_{percent}percent": Look(gradient=0.01 * percent) for percent in (40, 10)},
    **{f"shadow_{percent}percent": Look(shadow=0.01 * percent) for percent in (40, 80)},
    **{f"touching_{percent}percent": Look(touching=0.01 * percent, robots=30) for percent in (50, 100)},
    **{f"noise_{counts}": Look(noise=float(counts)) for counts in (8, 16)},
    "texture_10percent": Look(texture=0.1),
    "dark_discs": Look(kind="dark"),
    "dark_discs_shadow_60percent": Look(kind="dark", shadow=0.6),
    "bright_discs": Look(kind="bright", floor=0.3),
    "lights_in_the_dark": Look(kind="led", floor=0.12, diameter_px=12.0),
    "dark_floor": Look(floor=0.12),
    **{f"height_{mm}mm": Look(height=1e-3 * mm, shadow=0.3) for mm in (30, 60)},
    "height_40mm_touching": Look(height=0.04, touching=0.6, robots=24),
    "height_40mm_boards": Look(height=0.04, kind="board", tilt=0.4),
    "height_60mm_narrower_below": Look(height=0.06, taper=0.35, shadow=0.3),
    "height_50mm_grey_sides": Look(height=0.05, wall=0.3),
    **{f"motion_{percent}percent": Look(motion=0.01 * percent) for percent in (15, 25)},
    "motion_20percent_boards": Look(motion=0.2, kind="board", diameter_px=30.0),
    "motion_20percent_height_30mm": Look(motion=0.2, height=0.03, touching=0.3),
    "rails": Look(kind="board", diameter_px=28.0, rails=0.7, robots=8),
    "lids_touching": Look(kind="lid", diameter_px=32.0, touching=1.0, robots=16, shadow=0.4),
    "brown_on_parquet": Look(kind="dark", floor=0.26, boards=0.025, diameter_px=28.0),
    "all_at_once": Look(
        tilt=0.4,
        field_of_view=1.5,
        barrel=-0.1,
        gradient=0.3,
        shadow=0.5,
        touching=0.5,
        noise=5.0,
        texture=0.05,
    ),
}
"""What varies, by name; the rest is as in the first."""
SURVEYED = "plain", "tilt_40deg", "height_60mm"
"""Looks that are also seen with what people measure: control points, and the height of tall robots."""
_CONTROL_POINTS = 8
_LENS_SIGMA_PX = 0.01


@dataclass(frozen=True)
class Score:
    """Detections compared with the truth."""

    robots: int  # How many there are
    missed: int  # Of them, not found
    false: int  # Detections of nothing
    position_m: FloatArray  # (F,) distances of those that were found
    heading: FloatArray  # (H,) errors of the headings found [rad]
    nees: FloatArray  # (F,) normalized squared errors of places; 2 is ideal
    seconds: float = 0.0  # CPU time

    def concatenate(self, other: Score) -> Score:
        """Both together."""
        return Score(
            self.robots + other.robots,
            self.missed + other.missed,
            self.false + other.false,
            np.concatenate([self.position_m, other.position_m]),
            np.concatenate([self.heading, other.heading]),
            np.concatenate([self.nees, other.nees]),
            self.seconds + other.seconds,
        )


def score_picture(picture: Picture, found: AerialDetections, seconds: float = 0.0) -> Score:
    """Detections compared with a picture's truth."""
    return score_places(picture.poses, DIAMETER, found, seconds)


def score_places(poses: FloatArray, diameter: float, found: AerialDetections, seconds: float) -> Score:
    """Detections compared with true poses (N, 3) of robots, each robot's nearest one."""
    away = np.linalg.norm(found.place[:, None] - poses[None, :, :2], axis=2)
    pairs: dict[int, int] = {}
    for robot in range(len(poses)):
        nearest = int(np.argmin(away[:, robot])) if len(found) else -1
        if nearest >= 0 and away[nearest, robot] < _MATCHED * diameter and nearest not in pairs:
            pairs[nearest] = robot
    rows, robots = list(pairs), list(pairs.values())
    error = found.place[rows] - poses[robots, :2]
    heading = np.asarray(se2.wrap_angle(found.theta[rows] - poses[robots, 2]))
    information = np.linalg.inv(found.covariance[rows][:, :2, :2])
    return Score(
        len(poses),
        len(poses) - len(pairs),
        len(found) - len(pairs),
        np.linalg.norm(error, axis=1),
        heading[np.isfinite(heading)],
        np.einsum("ni,nij,nj->n", error, information, error),
        seconds,
    )


def measure(seed: int, seeds: int = SEEDS) -> dict[str, float]:
    """Print a table of all looks; the figures by name, `detector.LOOK.recall` and so on.

    Args:
        seed: Of the first picture of each look.
        seeds: Pictures of each look.
    """
    figures: dict[str, float] = {}
    say = ProgressLine("pictures")
    rows: list[list[Cell]] = []
    for name in (*LOOKS, *(f"surveyed_{name}" for name in SURVEYED)):
        say(name)
        look = LOOKS[name.removeprefix("surveyed_")]
        scores = []
        for k in range(seeds):
            picture, settings = draw_picture(look, seed + k), exact(look)
            if name not in LOOKS:
                picture, settings = surveyed(picture, look, np.random.default_rng([seed + k, 1]))
            scores.append(_scored(picture, settings))
        score = reduce(Score.concatenate, scores)
        values = _values(score, seeds)
        known = {key: value for key, value in values.items() if math.isfinite(value)}
        figures |= {f"detector.{name}.{key}": value for key, value in known.items()}
        rows.append([name, *(known.get(key) for key in values)])
    print()
    print(table([f"{seeds} pictures each", *_HEADERS], rows))
    return figures


_HEADERS = (
    "recall",
    "false / picture",
    "rms [cm]",
    "heading [deg]",
    "headings found",
    "NEES (2)",
    "CPU [ms]",
)


def _values(score: Score, pictures: int) -> dict[str, float]:
    found = score.robots - score.missed

    def rms(values: FloatArray) -> float:
        return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan

    return {
        "recall": found / score.robots,
        "false_per_picture": score.false / pictures,
        "position_cm": 100.0 * rms(score.position_m),
        "heading_deg": math.degrees(rms(score.heading)),
        "headings_told": len(score.heading) / max(found, 1),
        "nees": float(score.nees.mean()) if found else math.nan,
        "ms_per_picture": 1e3 * score.seconds / pictures,
    }


def exact(look: Look) -> AerialSettings:
    """Settings for robots and a lens that are known, as they are in drawn pictures."""
    known = AerialSettings(robot_diameter=DIAMETER, robot_height_sigma=0.0, pixel_sigma=_LENS_SIGMA_PX)
    return replace(known, robot_height=look.height)


def surveyed(picture: Picture, look: Look, rng: np.random.Generator) -> tuple[Picture, AerialSettings]:
    """A picture with the pose by control points of noise, and settings with a height measured with an error.

    All noise is what the settings say.
    """
    settings = AerialSettings(robot_diameter=DIAMETER, pixel_sigma=_LENS_SIGMA_PX)
    places, pixels = control_pixels(picture.ground, _CONTROL_POINTS, rng)
    places[:, :2] += settings.control_sigma * rng.standard_normal((len(places), 2))
    pixels += settings.control_sigma_px * rng.standard_normal(pixels.shape)
    points = ControlPoints([f"p{k}" for k in range(len(places))], places, pixels)
    ground = solve_pose(picture.ground.camera, points, settings).ground
    if not look.height:
        return replace(picture, ground=ground), replace(settings, robot_height_sigma=0.0)
    height = look.height + settings.robot_height_sigma * float(rng.standard_normal())
    return replace(picture, ground=ground), replace(settings, robot_height=height)


def _scored(picture: Picture, settings: AerialSettings) -> Score:
    """A detector that has seen the picture before, so that what is done once does not count."""
    detector = AerialDetector(settings, picture.ground)
    detector.detect(picture.gray)
    begin_s = time.process_time()
    found = detector.detect(picture.gray)
    return score_picture(picture, found, time.process_time() - begin_s)
