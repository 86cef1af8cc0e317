"""The eight once more, with rendered pictures in place of sightings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarm_loc_vision.core.families import family_named

from .camera import deliver
from .eight import ARENA, EightSettings, drive_eight, take_pictures
from .hidden_geometry import HiddenGeometry, hidden_geometry
from .photographer import Photographer, Stage
from .record import SIGHTING_DTYPE, SimulatedRun
from .render.lens import CameraModel

FAMILY = "artoolkit_bch_thin"


@dataclass(frozen=True)
class PicturedRun:
    """A simulated run whose cameras deliver pictures.

    Attributes:
        run: Swarm, truth and odometry; its frames say which pictures arrive when, and have no sightings.
        settings: What was simulated.
        camera: Of all robots, as calibrated.
        hidden: Where cameras and markers truly are.
    """

    run: SimulatedRun
    settings: EightSettings
    camera: CameraModel
    hidden: HiddenGeometry

    def pictures(self) -> Iterator[NDArray[np.uint8]]:
        """The pictures (height, width) in the order of `run.frames`, drawn one by one."""
        stage = Stage(ARENA, family_named(FAMILY))
        seed = self.settings.seed
        photographer = Photographer(self.run.swarm, self.hidden, stage, self.camera, seed)
        for frame in self.run.frames:
            robot, stamp_ns = int(frame["robot"]), int(frame["stamp_ns"])
            rng = np.random.default_rng([seed, robot, stamp_ns])
            early_ns = round(1e9 * self.settings.world.exposure_early_s * rng.random())
            yield photographer.take(robot, stamp_ns - early_ns, self.run.truth, rng)


def photograph_eight(settings: EightSettings, camera: CameraModel) -> PicturedRun:
    """Drive the eight and let the cameras look; pictures get late and lost as in `simulate_eight`."""
    rng = np.random.default_rng(settings.seed)
    swarm, truth, odometry = drive_eight(rng, settings)
    pictures = take_pictures(rng, settings.robots, truth)
    hidden = hidden_geometry(rng, swarm, settings.world)
    frames, nothing = deliver(
        rng,
        pictures,
        np.empty(0, np.int64),
        np.empty(0, SIGHTING_DTYPE),
        end_ns=int(truth.stamp_ns[-1]),
        loss=settings.world.frame_loss,
    )
    return PicturedRun(SimulatedRun(swarm, truth, odometry, frames, nothing), settings, camera, hidden)
