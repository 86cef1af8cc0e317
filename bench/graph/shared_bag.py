"""Write a simulated run as a bag with topics that carry the readings of many robots."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bench.shared.bags import SharedHead, encode_shared_detections, encode_shared_numbers
from swarm_loc_drivers.sim.run import SimulatedRun
from swarm_loc_drivers.sim.scenarios.bags import as_detections, truth_stream, write_swarm_bag
from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.bags.writer import Stream
from swarm_loc_estimator.common.messages.cdr import SWARM_DETECTIONS, SWARM_ODOMETRY
from swarm_loc_estimator.common.messages.detections import swarm_key

PERIOD_NS = 10_000_000  # All that arrives within this goes out together, at its end


def write_shared_bag(run: SimulatedRun, folder: Path, comment: str) -> int:
    """Write `swarm/odom`, `swarm/detections`, and `<robot>/ground_truth` of all robots.

    The folder, the comment, the result and the errors are those of `bag.write_bag`.
    """
    robots = run.swarm.robots
    truth = [truth_stream(run, index) for index in range(len(robots))]
    key = swarm_key(robot.name for robot in robots)
    return write_swarm_bag([_odometry(run, key), _detections(run, key), *truth], run.swarm, folder, comment)


def _odometry(run: SimulatedRun, key: int) -> Stream:
    rows, sent_ns, data = run.odometry, [], []
    for at_ns, some in _together(rows["arrival_ns"]):
        head = SharedHead(at_ns, "odom", key, rows["robot"][some], rows["stamp_ns"][some])
        data.append(encode_shared_numbers(head, rows["pose"][some]))
        sent_ns.append(at_ns)
    return Stream("swarm/odom", SWARM_ODOMETRY, np.array(sent_ns, dtype=np.int64), data)


def _detections(run: SimulatedRun, key: int) -> Stream:
    detections, frames = as_detections(run), run.frames
    columns = (np.repeat(frames[name], frames["count"]) for name in ("robot", "stamp_ns", "arrival_ns"))
    robot, stamp_ns, arrival_ns = columns
    sent_ns, data = [], []
    for at_ns, some in _together(arrival_ns):
        head = SharedHead(at_ns, "", key, robot[some], stamp_ns[some])
        data.append(encode_shared_detections(head, detections[some]))
        sent_ns.append(at_ns)
    return Stream("swarm/detections", SWARM_DETECTIONS, np.array(sent_ns, dtype=np.int64), data)


def _together(arrival_ns: IntArray) -> Iterator[tuple[int, IntArray]]:
    """When a message goes out, and which readings (n,) it carries, in order of arrival."""
    order = np.argsort(arrival_ns, kind="stable")
    period = -(-arrival_ns[order] // PERIOD_NS)
    starts = np.flatnonzero(np.diff(period, prepend=-1))
    for begin, end in zip(starts, [*starts[1:], order.size], strict=True):
        yield int(period[begin]) * PERIOD_NS, order[begin:end]
