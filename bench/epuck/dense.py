"""Twenty e-pucks shoulder to shoulder: those inside see only each other.

A block of robots drives a small eight in the e-puck paper's arena, all in step. The inner ones never see a
landmark, as in a swarm so dense that neighbours stand in every line of sight.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.scenarios.eight_run import STEP_NS, VIEW, EightSettings, camera_exposures, drive_robots
from bench.scenarios.lived_run import SimulatedRun
from bench.scenarios.sightings import observe_markers
from swarm_loc_drivers.sim.scenarios.eight import Lemniscate, follow
from swarm_loc_drivers.sim.worlds import W0, ErrorModel
from swarm_loc_estimator.common.arrays import FloatArray

PITCH = 0.13
COLUMNS, ROWS = 5, 4
HALF_WIDTH = 0.45
SPEED = 0.06
_FIRST_FACE_ID = 1000


@dataclass(frozen=True)
class DenseSettings:
    """What to simulate."""

    seed: int = 1  # Two runs with the same settings are identical
    duration_s: float = 54.0  # [s]
    errors: ErrorModel = W0  # The imperfections


def blind_robots() -> NDArray[np.int64]:
    """The robots inside the block, who see no landmark."""
    index = np.arange(COLUMNS * ROWS)
    column, row = index % COLUMNS, index // COLUMNS
    return index[(column > 0) & (column < COLUMNS - 1) & (row > 0) & (row < ROWS - 1)]


def simulate_dense(settings: DenseSettings) -> SimulatedRun:
    """Let the robots turn about and record what their sensors say."""
    rng = np.random.default_rng(settings.seed)
    index = np.arange(COLUMNS * ROWS)
    homes = PITCH * np.column_stack(
        [index % COLUMNS - 0.5 * (COLUMNS - 1), index // COLUMNS - 0.5 * (ROWS - 1)]
    )
    path, place = Lemniscate(HALF_WIDTH), np.column_stack([homes, np.zeros(index.size)])
    start = path.at(np.zeros(index.size))[0] + place
    control = follow(path, np.zeros(index.size), SPEED, STEP_NS * 1e-9)

    def in_formation(step: int, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        return control(step, pose - place)

    chosen = EightSettings(duration_s=settings.duration_s, errors=settings.errors)
    swarm, truth, odometry = drive_robots(rng, chosen, start, in_formation, _FIRST_FACE_ID)
    exposures = camera_exposures(rng, index.size, truth)
    frames, sightings = observe_markers(rng, swarm, truth, exposures, VIEW, settings.errors)
    run = SimulatedRun(swarm, truth, odometry, frames, sightings)
    observer = np.repeat(frames["robot"], frames["count"])
    landmarks = [mark.id for mark in swarm.landmarks]
    return run.masked(~(np.isin(observer, blind_robots()) & np.isin(sightings["marker_id"], landmarks)))
