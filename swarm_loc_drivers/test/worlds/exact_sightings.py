"""What simulated cameras would have reported without noise."""

import numpy as np
from numpy.typing import NDArray

from bench.scenarios.lived_run import SimulatedRun
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray

IntArray = NDArray[np.integer]


def exact_values(run: SimulatedRun) -> tuple[FloatArray, IntArray, IntArray]:
    """What noise-free sensors would have reported, and the owner (robot or -1) of every sighting."""
    robot = np.repeat(run.frames["robot"], run.frames["count"])
    stamp_ns = np.repeat(run.frames["stamp_ns"], run.frames["count"])
    mounts = np.array([[r.camera.x, r.camera.y, r.camera.yaw] for r in run.swarm.robots if r.camera])
    cameras = se2.compose(run.truth.at(robot, stamp_ns), mounts[robot])
    owners = [run.swarm.owner_of[int(marker)] for marker in run.sightings["marker_id"]]
    own = np.array([owner.robot_index for owner in owners])
    marks = np.array([[owner.marker.x, owner.marker.y, owner.marker.yaw] for owner in owners], dtype=float)
    marks[own >= 0] = se2.compose(run.truth.at(own[own >= 0], stamp_ns[own >= 0]), marks[own >= 0])
    return se2.between(cameras, marks), robot, own
