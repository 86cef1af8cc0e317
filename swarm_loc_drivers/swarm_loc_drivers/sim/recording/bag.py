"""Write a simulated run as a bag, as a recorder of the real swarm would have left it."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.sim.recording.detections import as_detections
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.encoders import (
    UNKNOWN_COVARIANCE,
    encode_detections,
    encode_odometry,
    encode_pose_stamped,
)
from swarm_loc_estimator.common.messages.typestore import DETECTIONS, ODOMETRY, POSE_STAMPED
from swarm_loc_estimator.swarm.swarm_writer import save_swarm

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from swarm_loc_drivers.sim.common.record import LivedRun, Records, SimulatedRun
    from swarm_loc_estimator.swarm.swarm import Swarm

TRUTH_PERIOD_NS = 100_000_000


class Stream(NamedTuple):
    """The messages of one topic with their times of arrival."""

    topic: str
    type: str
    arrival_ns: NDArray[np.int64]
    data: list[bytes]


def write_bag(run: SimulatedRun, folder: Path, comment: str) -> int:
    """Write `<robot>/odom`, `<robot>/detections` and `<robot>/ground_truth` of all robots.

    Args:
        run: What to write; log times are times of arrival, so that lateness is real on replay.
        folder: The bag, created; must not exist.
        comment: First lines of `swarm.yaml`, where the run comes from.

    Returns:
        Number of messages.

    Raises:
        BagError: The folder is there already, or cannot be created.
    """
    detections = as_detections(run)
    streams: list[Stream] = []
    for index in range(len(run.swarm.robots)):
        streams += [
            odometry_stream(run, index),
            _detections(run, index, detections),
            truth_stream(run, index),
        ]
    return write_streams(streams, run.swarm, folder, comment)


def write_streams(streams: Sequence[Stream], swarm: Swarm, folder: Path, comment: str) -> int:
    """Write topics in order of arrival, and `swarm.yaml`; arguments and errors as for `write_bag`."""
    arrival_ns = np.concatenate([stream.arrival_ns for stream in streams])
    owner = np.repeat(np.arange(len(streams)), [len(stream.data) for stream in streams])
    place = np.concatenate([np.arange(len(stream.data)) for stream in streams])
    order = np.argsort(arrival_ns, kind="stable")
    with BagWriter(folder, compress=True) as bag:
        for stream in streams:
            bag.add_topic(stream.topic, stream.type)
        for which, at_ns, one in zip(
            owner[order].tolist(), arrival_ns[order].tolist(), place[order].tolist(), strict=True
        ):
            bag.write(streams[which].topic, at_ns, streams[which].data[one])
    save_swarm(swarm, folder / "swarm.yaml", comment)
    return len(order)


def odometry_stream(run: LivedRun, robot: int) -> Stream:
    """The robot's odometry; velocities are those of the step before each message."""
    name = run.swarm.robots[robot].name
    rows = run.odometry[run.odometry["robot"] == robot]
    by_stamp = np.argsort(rows["stamp_ns"], kind="stable")
    stamps_s = (rows["stamp_ns"][by_stamp] - run.start_ns) * 1e-9
    pose = rows["pose"][by_stamp]
    twist = np.zeros((len(rows), 3))
    motion = se2.log(se2.between(pose[:-1], pose[1:]))
    twist[by_stamp[1:]] = motion / np.diff(stamps_s)[:, None]
    data = encode_odometry(
        f"{name}/odom",
        f"{name}/base_link",
        rows["stamp_ns"],
        rows["pose"],
        twist,
        UNKNOWN_COVARIANCE,
        UNKNOWN_COVARIANCE,
    )
    return Stream(f"{name}/odom", ODOMETRY, rows["arrival_ns"], data)


def _detections(run: SimulatedRun, robot: int, detections: Records) -> Stream:
    """The robot's images, also those that show nothing: they tell that the camera is alive."""
    name = run.swarm.robots[robot].name
    frames = run.frames[run.frames["robot"] == robot]
    optical_frame = f"{name}/camera_optical_frame"
    data = [
        encode_detections(optical_frame, stamp_ns, detections[first : first + count])
        for _, stamp_ns, _, first, count in frames.tolist()
    ]
    return Stream(f"{name}/detections", DETECTIONS, frames["arrival_ns"], data)


def truth_stream(run: LivedRun, robot: int) -> Stream:
    """Where the robot really was, ten times a second."""
    stamp_ns = np.arange(run.start_ns, run.end_ns + 1, TRUTH_PERIOD_NS)
    data = encode_pose_stamped("map", stamp_ns, run.truth.at(robot, stamp_ns))
    return Stream(f"{run.swarm.robots[robot].name}/ground_truth", POSE_STAMPED, stamp_ns, data)
