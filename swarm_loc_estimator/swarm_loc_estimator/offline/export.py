"""Write a run as MCAP for viewers, or as text in the format of TUM, which evo uses; read ground truth."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.files import check_file, naming, replacing, temporary_folder
from swarm_loc_estimator.common.messages.cdr import (
    MARKERS,
    OCCUPANCY_GRID,
    POSE_STAMPED,
    SWARM_POSES,
    TRANSFORMS,
)
from swarm_loc_estimator.common.messages.poses import (
    EstimateMessage,
    SwarmPosesEncoder,
    TransformsEncoder,
    encode_pose_stamped,
    yaw_of,
)
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.common.trajectory import DEFAULT_GAP_NS, Trajectory, interpolate
from swarm_loc_estimator.common.yaml_tree import read_file
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.watch.markers import MarkersEncoder

_TRUTH = ".truth.tum"
_MAX_BYTES = 1_000_000_000
_MAX_S = 9_000_000_000


class TumError(UserError):
    """Files of trajectories that cannot be used."""


def write_tum(result: ReplayResult, folder: Path) -> None:
    """Write the trajectories of a run, in `map`, to a folder; files of the same names are replaced.

    `<robot>.tum` has the estimated poses, `<robot>.smoothed.tum` the smoothed ones, if there are any, and
    `<robot>.truth.tum` the ground truth at the same instants, as far as it is known there. So evo, which
    pairs the nearest stamps, finds the errors of the report.
    """
    for index, robot in enumerate(result.swarm.robots):
        pose = result.poses[:, index]
        _write(folder / f"{robot.name}.tum", result.stamp_ns, pose)
        if result.smoothed is not None:
            _write(folder / f"{robot.name}.smoothed.tum", result.stamp_ns, result.smoothed.poses[:, index])
        if robot.name in result.truth:
            truth, known = interpolate(result.truth[robot.name], result.stamp_ns, DEFAULT_GAP_NS)
            truth[~known] = np.nan
            _write(folder / f"{robot.name}{_TRUTH}", result.stamp_ns, truth + 0.0 * pose)


def _write(path: Path, stamp_ns: IntArray, pose: FloatArray) -> None:
    with replacing(path) as part, part.open("w", encoding="utf-8") as file:
        for at_ns, (x, y, theta) in zip(stamp_ns.tolist(), pose.tolist(), strict=True):
            if math.isfinite(x + y + theta):
                seconds, rest = divmod(at_ns, 10**9)
                z, w = math.sin(0.5 * theta), math.cos(0.5 * theta)
                file.write(f"{seconds}.{rest:09d} {x:.12g} {y:.12g} 0 0 0 {z:.12g} {w:.12g}\n")


def read_truth(folder: Path | None, swarm: Swarm) -> dict[str, Trajectory]:
    """Robot name -> its ground truth in `map`, of the files `<robot>.truth.tum` in a folder; None has none.

    Raises:
        TumError: There is none, or a line is no pose.
        YamlTreeError: A file cannot be read.
    """
    if folder is None:
        return {}
    names = [f"{robot.name}{_TRUTH}" for robot in swarm.robots]
    truth = {
        robot.name: read_tum(folder / name)
        for robot, name in zip(swarm.robots, names, strict=True)
        if (folder / name).exists()
    }
    if not truth:
        raise TumError(f"'{folder}' has no ground truth of a robot, such as {names[0]}.")
    return truth


def read_tum(path: Path) -> Trajectory:
    """The poses of a file by their stamps; lines that begin with # are comments.

    Poses that are not finite are left out, and counted.

    Raises:
        TumError: A line is no pose, or there is none.
        YamlTreeError: The file cannot be read.
    """
    stamps_ns, poses, left_out = [], [], 0
    lines = read_file(path, _MAX_BYTES).decode("utf-8-sig", "replace").splitlines()
    for number, line in enumerate(map(str.strip, lines), 1):
        if not line or line.startswith("#"):
            continue
        try:
            at_s, *numbers = line.split()
            x, y, z, *turn = map(float, numbers)
            yaw = yaw_of(*turn)
            if not math.isfinite(float(at_s) + x + y + z + yaw):
                left_out += 1
                continue
            stamp_ns = _nanoseconds(at_s)
        except (ValueError, TypeError, InvalidOperation) as error:
            raise TumError(f"'{path}', line {number}: '{line[:60]}' is no pose: {_FORMAT}.") from error
        stamps_ns.append(stamp_ns)
        poses.append((x, y, yaw))
    if not poses:
        raise TumError(f"'{path}' has no pose; one line each: {_FORMAT}.")
    stamp_ns_of, order = np.array(stamps_ns), np.argsort(stamps_ns, kind="stable")
    return Trajectory(stamp_ns_of[order], np.array(poses)[order], left_out)


_FORMAT = "seconds x y z qx qy qz qw"


def _nanoseconds(text: str) -> int:
    """A time in seconds, which a float would round to some hundred nanoseconds."""
    seconds = Decimal(text)
    if not 0 <= seconds <= _MAX_S:
        raise ValueError(text)
    return round(seconds * 10**9)


_MAP = "map"


def write_mcap(result: ReplayResult, path: Path) -> None:
    """Write the file, replacing an existing one.

    Transforms lead from map directly to `<robot>/base_link`; the file holds no odom frames. Raises UserError
    if it cannot be written.
    """
    with naming(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        check_file(path)
    with temporary_folder(parent=path.parent) as folder:
        with BagWriter(folder / "run", compress=True) as writer:
            _add_estimates(result, writer)
            _add_tracks("ground_truth", result.truth, writer)
            _add_tracks("goal", result.goals, writer)
            if result.maps:
                writer.add_topic("map", OCCUPANCY_GRID, is_latched=True)
            for one in result.maps:
                writer.write("map", one.log_ns, one.data)
        with naming(path):
            (folder / "run/run.mcap").replace(path)


def _add_tracks(topic: str, tracks: Mapping[str, Trajectory], writer: BagWriter) -> None:
    for name, track in tracks.items():
        writer.add_topic(f"{name}/{topic}", POSE_STAMPED)
        messages = encode_pose_stamped(_MAP, track.stamp_ns, track.pose)
        for stamp_ns, message in zip(track.stamp_ns.tolist(), messages, strict=True):
            writer.write(f"{name}/{topic}", stamp_ns, message)


def _add_estimates(result: ReplayResult, writer: BagWriter) -> None:
    for topic, kind in (("swarm/poses", SWARM_POSES), ("tf", TRANSFORMS), ("swarm/markers", MARKERS)):
        writer.add_topic(topic, kind)
    names = [robot.name for robot in result.swarm.robots]
    poses, markers = SwarmPosesEncoder(names, _MAP), MarkersEncoder(result.swarm, _MAP)
    transforms = TransformsEncoder(_MAP, [f"{name}/base_link" for name in names])
    seen = dict(result.sightings)
    newest = None
    for one in estimates(result):
        newest = seen.get(one.stamp_ns, newest)
        columns = one[3:]
        writer.write("swarm/poses", one.stamp_ns, poses.encode(one.stamp_ns, *columns))
        located: BoolArray = ~np.isnan(one.pose[:, 0])
        if located.any():
            writer.write("tf", one.stamp_ns, transforms.encode(one.stamp_ns, located, one.pose))
        writer.write("swarm/markers", one.stamp_ns, markers.encode(one, newest))


def estimates(result: ReplayResult, stride: int = 1) -> Iterator[EstimateMessage]:
    """Every `stride`-th output of a run as a message; ages of fixes are not known."""
    names = tuple(robot.name for robot in result.swarm.robots)
    not_kept = np.full(len(names), np.nan)
    columns = result.stamp_ns, result.poses, result.covariances, result.status, result.heading_known
    for stamp_ns, pose, covariance, *states in zip(*(one[::stride] for one in columns), strict=True):
        yield EstimateMessage(int(stamp_ns), _MAP, names, pose, covariance, not_kept, *states)
