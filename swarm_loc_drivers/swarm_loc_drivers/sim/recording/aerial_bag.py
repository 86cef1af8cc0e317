"""Write a simulated run of a swarm that is seen from above as a bag."""

from __future__ import annotations

from typing import TYPE_CHECKING

from swarm_loc_drivers.sim.recording.bag import Stream, odometry_stream, truth_stream, write_streams
from swarm_loc_estimator.common.messages.encoders import encode_anonymous
from swarm_loc_estimator.common.messages.typestore import ANONYMOUS_DETECTIONS

if TYPE_CHECKING:
    from pathlib import Path

    from swarm_loc_drivers.sim.scenarios.wandering import AerialRun


def write_aerial_bag(run: AerialRun, folder: Path, comment: str) -> int:
    """Write `aerial/detections`, and `<robot>/odom` and `<robot>/ground_truth` of all robots.

    Args:
        run: What to write; log times are times of arrival.
        folder: The bag, created; must not exist.
        comment: First lines of `swarm.yaml`, where the run comes from.

    Returns:
        Number of messages.

    Raises:
        BagError: The folder is there already, or cannot be created.
    """
    data = [
        encode_anonymous("map", stamp_ns, image)
        for stamp_ns, image in zip(run.stamp_ns.tolist(), run.images, strict=True)
    ]
    streams = [Stream("aerial/detections", ANONYMOUS_DETECTIONS, run.arrival_ns, data)]
    for index in range(len(run.swarm.robots)):
        streams += [odometry_stream(run, index), truth_stream(run, index)]
    return write_streams(streams, run.swarm, folder, comment)
