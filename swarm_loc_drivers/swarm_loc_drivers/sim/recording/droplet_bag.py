"""Write a simulated run of Droplets as a bag."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from swarm_loc_drivers.sim.common.transport import CAMERA_LATENESS, arrival_ns, survivors
from swarm_loc_drivers.sim.recording.bag import Stream, odometry_stream, truth_stream, write_streams
from swarm_loc_drivers.sim.scenarios.droplet_run import FIX_SIGMAS, DropletRun
from swarm_loc_estimator.common.messages.encoders import encode_brightness, encode_fix
from swarm_loc_estimator.common.messages.typestore import BRIGHTNESS, POSE_WITH_COVARIANCE

SATURATION = 240
"""As the drivers say it: full scale less the largest ambient light [count]."""
LOSS = 0.05
"""Share of matrices and fixes that never arrive."""


def write_droplet_bag(run: DropletRun, folder: Path, comment: str, seed: int) -> int:
    """Write `<robot>/odom`, `brightness`, `fix` and `ground_truth` of all robots.

    Args:
        run: What to write; log times are times of arrival.
        folder: The bag, created; must not exist.
        comment: First lines of `swarm.yaml`, where the run comes from.
        seed: Fixes what is late and what is lost.

    Returns:
        Number of messages.

    Raises:
        BagError: The folder is there already, or cannot be created.
    """
    streams: list[Stream] = []
    for index in range(len(run.swarm.robots)):
        rng = np.random.default_rng([seed, index])
        streams.append(odometry_stream(run, index))
        streams.append(_arriving(rng, run, _brightness(run, index)))
        fixes = _fixes(run, index)
        if fixes.data:
            streams.append(_arriving(rng, run, fixes))
        streams.append(truth_stream(run, index))
    return write_streams(streams, run.swarm, folder, comment)


def _arriving(rng: np.random.Generator, run: DropletRun, stream: Stream) -> Stream:
    """What of a stream arrives, and when; its times are those of publication."""
    late_ns = arrival_ns(rng, stream.arrival_ns, CAMERA_LATENESS)
    kept = np.flatnonzero(survivors(rng, len(stream.data), LOSS) & (late_ns <= run.end_ns))
    return stream._replace(arrival_ns=late_ns[kept], data=[stream.data[k] for k in kept])


def _brightness(run: DropletRun, robot: int) -> Stream:
    """What the robot's sensors read, when it was published."""
    name, board = run.swarm.robots[robot].name, run.swarm.robots[robot].ir
    assert board is not None  # noqa: S101 - all Droplets have one
    own = [one for one in run.matrices if one.receiver == robot]
    data = [
        encode_brightness(
            f"{name}/base_link",
            one.brightness.stamp_ns,
            (board.id, one.brightness.transmitter),
            one.brightness.readings,
            int(one.brightness.power),
            SATURATION,
        )
        for one in own
    ]
    published_ns = np.array([one.published_ns for one in own], dtype=np.int64)
    return Stream(f"{name}/brightness", BRIGHTNESS, published_ns, data)


def _fixes(run: DropletRun, robot: int) -> Stream:
    """Where a tracker has seen the robot."""
    own = [fix for fix in run.fixes if fix.robot == robot]
    position, heading = FIX_SIGMAS
    covariance = np.diag([position**2, position**2, heading**2])
    data = [encode_fix("map", fix.stamp_ns, fix.pose, covariance) for fix in own]
    stamps_ns = np.array([fix.stamp_ns for fix in own], dtype=np.int64)
    return Stream(f"{run.swarm.robots[robot].name}/fix", POSE_WITH_COVARIANCE, stamps_ns, data)
