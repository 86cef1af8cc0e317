"""The eight with rendered images in place of sightings, and the ground control on its floor."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.render.rigs import Arena, CameraRig
from swarm_loc_drivers.sim.run import SIGHTING_DTYPE, SimulatedRun
from swarm_loc_drivers.sim.scenarios.eight import ARENA, EightSettings, camera_exposures, drive_eight
from swarm_loc_drivers.sim.sightings import deliver
from swarm_loc_drivers.sim.worlds import HiddenGeometry, hidden_geometry
from swarm_loc_vision.aerial.ground_control import FloorMarker, Ground
from swarm_loc_vision.markers.families import family_named

FAMILY = "artoolkit_bch_thin"


@dataclass(frozen=True)
class ImageRun:
    """A simulated run whose cameras deliver images."""

    # Swarm, truth and odometry; its frames say which images arrive when, and have no sightings
    run: SimulatedRun
    settings: EightSettings  # Settings of the run
    camera: CameraModel  # Of all robots, as calibrated
    hidden: HiddenGeometry  # Where cameras and markers truly are

    def images(self) -> Iterator[NDArray[np.uint8]]:
        """The images (height, width) in the order of `run.frames`, drawn one by one."""
        arena = Arena(ARENA, family_named(FAMILY))
        seed = self.settings.seed
        rig = CameraRig(self.run.swarm, self.hidden, arena, self.camera, seed)
        for frame in self.run.frames:
            robot, stamp_ns = int(frame["robot"]), int(frame["stamp_ns"])
            rng = np.random.default_rng([seed, robot, stamp_ns])
            early_ns = round(1e9 * self.settings.errors.exposure_early_s * rng.random())
            yield rig.take(robot, stamp_ns - early_ns, self.run.truth, rng)


def simulate_eight_images(settings: EightSettings, camera: CameraModel) -> ImageRun:
    """Drive the eight with rendered images, which are delayed and lost as in `simulate_eight`."""
    rng = np.random.default_rng(settings.seed)
    swarm, truth, odometry = drive_eight(rng, settings)
    exposures = camera_exposures(rng, settings.robots, truth)
    hidden = hidden_geometry(rng, swarm, settings.errors)
    frames, nothing = deliver(
        rng,
        exposures,
        np.empty(0, np.int64),
        np.empty(0, SIGHTING_DTYPE),
        end_ns=int(truth.stamp_ns[-1]),
        loss=settings.errors.frame_loss,
    )
    return ImageRun(SimulatedRun(swarm, truth, odometry, frames, nothing), settings, camera, hidden)


_SIZE, _FROM_WALL = 0.12, 0.15


def eight_floor() -> Ground:
    """Six markers along the longer walls; their ids are the last ones of the family."""
    family = family_named(FAMILY)
    x, y = 0.5 * ARENA[0] - _FROM_WALL, 0.5 * ARENA[1] - _FROM_WALL
    places = [(a * x, b * y) for b in (-1.0, 1.0) for a in (-1.0, 0.0, 1.0)]
    first = len(family.words) - len(places)
    markers = tuple(
        FloorMarker(first + k, round(a, 6), round(b, 6), size=_SIZE) for k, (a, b) in enumerate(places)
    )
    return Ground(markers=markers, family=family)
