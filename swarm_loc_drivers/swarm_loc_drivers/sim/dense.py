"""Twenty e-pucks shoulder to shoulder: those inside see only each other.

A block of robots drives a small eight in the e-puck paper's arena, all in step. The inner ones never see a
landmark, as in a swarm so dense that neighbours stand in every line of sight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .camera import exposures
from .differential_drive import Drive, drive, report_odometry
from .eight import CAMERA_RATE_HZ, START_NS, STEP_NS, VIEW, WHEEL_SEPARATION, EightSettings, describe, follow
from .lemniscate import Lemniscate
from .markers import sight_markers
from .record import SimulatedRun
from .trajectories import Trajectories
from .transport import ODOMETRY_LATENESS
from .worlds import W0, World

FloatArray = NDArray[np.float64]

PITCH = 0.13
COLUMNS, ROWS = 5, 4
HALF_WIDTH = 0.45
SPEED = 0.06
_ODOMETRY_EVERY = 10
_FIRST_FACE_ID = 1000


@dataclass(frozen=True)
class DenseSettings:
    """What to simulate.

    Attributes:
        seed: Two runs with the same settings are identical.
        duration_s: [s].
        world: The imperfections.
    """

    seed: int = 1
    duration_s: float = 54.0
    world: World = W0


def blind_robots() -> NDArray[np.int64]:
    """The robots inside the block, who see no landmark."""
    index = np.arange(COLUMNS * ROWS)
    column, row = index % COLUMNS, index // COLUMNS
    return index[(column > 0) & (column < COLUMNS - 1) & (row > 0) & (row < ROWS - 1)]


def simulate_dense(settings: DenseSettings) -> SimulatedRun:
    """Let the robots turn about and record what their sensors say."""
    rng = np.random.default_rng(settings.seed)
    steps = round(settings.duration_s * 1e9 / STEP_NS)
    stamp_ns = START_NS + STEP_NS * np.arange(steps + 1, dtype=np.int64)
    index = np.arange(COLUMNS * ROWS)
    homes = PITCH * np.column_stack(
        [index % COLUMNS - 0.5 * (COLUMNS - 1), index // COLUMNS - 0.5 * (ROWS - 1)]
    )
    path, place = Lemniscate(HALF_WIDTH), np.column_stack([homes, np.zeros(index.size)])
    start = path.at(np.zeros(index.size))[0] + place
    model = Drive(WHEEL_SEPARATION, settings.world.wheel_noise, settings.world.turn_slip)
    control = follow(path, np.zeros(index.size), SPEED, STEP_NS * 1e-9)

    def in_formation(step: int, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        return control(step, pose - place)

    driven = drive(rng, start, in_formation, model, step_s=STEP_NS * 1e-9, steps=steps)
    truth = Trajectories(stamp_ns, driven.truth)
    odometry = report_odometry(rng, stamp_ns, driven.reported, _ODOMETRY_EVERY, ODOMETRY_LATENESS)
    swarm = describe(EightSettings(world=settings.world), start, _FIRST_FACE_ID)
    pictures = exposures(rng, index.size, CAMERA_RATE_HZ, int(stamp_ns[0]) + 200_000_000, int(stamp_ns[-1]))
    frames, sightings = sight_markers(rng, swarm, truth, pictures, VIEW, settings.world)
    run = SimulatedRun(swarm, truth, odometry, frames, sightings)
    observer = np.repeat(frames["robot"], frames["count"])
    landmarks = [mark.id for mark in swarm.landmarks]
    return run.masked(~(np.isin(observer, blind_robots()) & np.isin(sightings["marker_id"], landmarks)))
