"""Radios of real robots: python -m bench robots [--parts two_robots ...].

TurtleBots with UWB, motion capture and odometry (TIERS), whose starts are those of the motion capture when
their odometry begins, and a robot between metal walls (labyrinth). "ratio" is the error of all robots over
that of their odometry alone; "bias" is the estimated sum of both biases of a pair minus its mean error.
"""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.shared.common import SHARED, options_of, rms, table, write_figures
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.cdr import (
    ODOMETRY,
    POSE_STAMPED,
    RANGE,
    CdrError,
    decode,
    nanoseconds,
)
from swarm_loc_estimator.common.messages.poses import decode_pose_stamped
from swarm_loc_estimator.common.trajectory import DEFAULT_GAP_NS, Trajectory, interpolate
from swarm_loc_estimator.offline.metrics import compare, nees, pool
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.swarm.error_models import OdometryModel
from swarm_loc_estimator.swarm.swarm import Robot, Swarm, UwbDevice
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.estimate import Status

_DATA = SHARED / "data"
_PATTERN = "uwb/tof/{from}/{to}/distance"
_TWO = {
    "turtle01": (2, "/vrpn_client_node/turtlebot01_cap/pose"),
    "turtle03": (3, "/vrpn_client_node/turtlebot03_cap/pose"),
}
_FOUR = {
    f"turtle0{k}": (node, f"/vrpn_client_node/turtlebot{k}_cap/pose")
    for k, node in ((1, 7), (3, 3), (4, 4), (5, 5))
}
_BEHIND_NS = 4_160_411_020_000_000  # Header stamps of the second recording are so much before its log times


def _turtlebots(bag: Path, nodes: Mapping[str, tuple[int, str]], odometry: str) -> dict[str, float]:
    """Figures of TurtleBots: name -> number of its radio, and topic of its motion capture."""
    remap = {f"{name}/ground_truth": topic for name, (_, topic) in nodes.items()}
    remap |= {f"{name}/odom": odometry.format(name) for name in nodes}
    truth, begins_ns, ranges = _recorded(bag, remap)
    starts = {name: _at(truth[name], begins_ns[name]) for name in nodes}
    robots = tuple(
        Robot(
            name,
            odometry=OdometryModel(wheel_separation=0.233),
            camera=None,
            start=starts[name],
            uwb=UwbDevice(node, name=f"n_{node}"),
        )
        for name, (node, _) in nodes.items()
    )
    alone = tuple(replace(robot, uwb=None) for robot in robots)
    result = replay(bag, Swarm(robots, range_topic=_PATTERN), remap=remap)
    found, odometry_only = _figures(result), _figures(replay(bag, Swarm(alone), remap=remap))
    learned = result.self_calibrated or result.swarm
    biases = {robot.name: robot.uwb.range_bias for robot in learned.robots if robot.uwb is not None}
    of_node = {f"n_{node}": name for name, (node, _) in nodes.items()}
    errors = []
    for (one, other), measured in ranges.items():
        if one in of_node and other in of_node:
            a, b = of_node[one], of_node[other]
            stamps, values = np.array([t for t, _ in measured]), np.array([value for _, value in measured])
            (p, known), (q, too) = (interpolate(truth[x], stamps, DEFAULT_GAP_NS) for x in (a, b))
            error = (values - np.hypot(*(p - q)[:, :2].T))[known & too]
            errors.append(biases[a] + biases[b] - float(error.mean()))
    return found | {
        "odometry_rmse_m": odometry_only["position_rmse_m"],
        "position_ratio_to_odometry": found["position_rmse_m"] / odometry_only["position_rmse_m"],
        "bias_error_m": rms(errors),
    }


def _at(track: Trajectory, stamp_ns: int) -> tuple[float, float, float]:
    """Its pose at an instant, or the first one."""
    pose, _ = interpolate(track, np.array([max(stamp_ns, int(track.stamp_ns[0]))]), DEFAULT_GAP_NS)
    x, y, theta = pose[0].tolist()
    return x, y, theta


def _recorded(
    bag: Path, remap: Mapping[str, str]
) -> tuple[dict[str, Trajectory], dict[str, int], dict[tuple[str, ...], list[tuple[int, float]]]]:
    """Ground truth and first stamp of the odometry of each robot, and stamps and ranges of each pair."""
    named = {stored.lstrip("/"): expected for expected, stored in remap.items()}
    poses: dict[str, list[tuple[int, list[float]]]] = {}
    begins: dict[str, int] = {}
    ranges: dict[tuple[str, ...], list[tuple[int, float]]] = {}
    with BagReader(bag) as reader:
        types = {topic.name: topic.type for topic in reader.topics}
        wanted = [name for name in types if name in named or types[name] == RANGE]
        for name, _, _, data in reader.messages(wanted):
            robot = named.get(name, "").partition("/")[0]
            if types[name] == POSE_STAMPED:
                pose = decode_pose_stamped(data)
                poses.setdefault(robot, []).append((pose.stamp_ns, list(pose.pose)))
            elif types[name] == ODOMETRY:
                begins.setdefault(robot, nanoseconds(decode(data, ODOMETRY).header.stamp))
            else:
                try:
                    message = decode(data, RANGE)
                except CdrError:
                    message = decode(bytes(data) + bytes(4), RANGE)
                pair = tuple(name.split("/")[2:4])
                ranges.setdefault(pair, []).append((nanoseconds(message.header.stamp), message.range))
    return (
        {
            name: Trajectory(np.array([t for t, _ in rows]), np.array([pose for _, pose in rows]))
            for name, rows in poses.items()
        },
        begins,
        ranges,
    )


def _restamped(folder: Path) -> Path:
    """The second recording, which was played and recorded again, with log times as its stamps are."""
    with BagReader(_DATA / "tiers_turtlebots" / "four_robots") as reader, BagWriter(folder) as writer:
        types = {one.name: one.type for one in reader.topics if one.type in (ODOMETRY, RANGE, POSE_STAMPED)}
        for name, message_type in types.items():
            writer.add_topic(name, message_type)
        for name, _, log_ns, data in reader.messages([*types]):
            message, now_ns = bytearray(data), log_ns - _BEHIND_NS
            if not any(message[4:12]):  # one robot stamps its odometry with zeros
                struct.pack_into("<iI", message, 4, *divmod(now_ns, 10**9))
            writer.write(name, now_ns, bytes(message))
    return folder


def _figures(result: ReplayResult) -> dict[str, float]:
    """Errors of x and y of all robots, while they are located, and how far they are claimed."""
    errors, squared, misleading, tracked = [], [], [], []
    for k, robot in enumerate(result.swarm.robots):
        track = Trajectory(result.stamp_ns, result.poses[:, k])
        error = compare(track, result.covariances[:, k], result.truth[robot.name])
        rows = np.searchsorted(result.stamp_ns, error.stamp_ns).clip(max=len(result.stamp_ns) - 1)
        claimed = result.status[rows, k] == Status.TRACKED
        errors.append(error)
        squared.append(nees(error.error[:, :2], result.covariances[rows, k, :2, :2]))
        misleading.append(error.misleading & claimed)
        tracked.append(result.status[:, k] == Status.TRACKED)
    return {
        "position_rmse_m": rms(pool(errors).position),
        "nees_xy": float(np.nanmean(np.concatenate(squared))),
        "misleading_share": float(np.mean(np.concatenate(misleading))),
        "tracked_share": float(np.mean(tracked)),
    }


def _two_robots() -> dict[str, float]:
    return _turtlebots(_DATA / "tiers_turtlebots" / "two_robots", _TWO, "/{}/odom")


def _four_robots() -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        return _turtlebots(_restamped(Path(folder) / "bag"), _FOUR, "/cali/{}/odom")


def _labyrinth() -> dict[str, float]:
    bag = _DATA / "labyrinth"
    known = load_swarm(bag / "swarm.yaml")
    unknown = replace(known, robots=tuple(replace(robot, start=None) for robot in known.robots))
    starts = {"known_start": known, "unknown_start": unknown}
    return {
        f"{name}.{key}": value
        for name, swarm in starts.items()
        for key, value in _figures(replay(bag, swarm)).items()
    }


_PARTS: Mapping[str, Callable[[], dict[str, float]]] = {
    "two_robots": _two_robots,
    "four_robots": _four_robots,
    "labyrinth": _labyrinth,
}


def main() -> None:
    """Measure, print the table, write the figures."""
    parts = tuple(_PARTS)
    names = options_of(__doc__, parts=(parts, "what to measure", parts)).parts
    figures = {f"{name}.{key}": value for name in names for key, value in _PARTS[name]().items()}
    print(table(["figure", "value"], [[key, value] for key, value in figures.items()]))
    print(f"Written: {write_figures('robots', figures)}")


if __name__ == "__main__":
    main()
