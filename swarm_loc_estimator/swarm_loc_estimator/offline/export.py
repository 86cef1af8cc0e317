"""Write a run as MCAP for viewers."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.definitions import (
    MARKERS,
    OCCUPANCY_GRID,
    POSE_STAMPED,
    SWARM_POSES,
    TRANSFORMS,
)
from swarm_loc_estimator.common.messages.estimates import (
    EstimateMessage,
    SwarmPosesEncoder,
    TransformsEncoder,
)
from swarm_loc_estimator.common.messages.poses import encode_pose_stamped
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.watch.markers import MarkersEncoder

_MAP = "map"


def write_mcap(result: ReplayResult, path: Path) -> None:
    """Write the file, replacing an existing one.

    Transforms lead from map directly to `<robot>/base_link`; the file holds no odom frames.

    Args:
        result: The run.
        path: Such as run.mcap.

    Raises:
        BagError: It cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".mcap_") as folder:
        bag = Path(folder) / "run"
        with BagWriter(bag, compress=True) as writer:
            _add_estimates(result, writer)
            _add_tracks("ground_truth", result.truth, writer)
            _add_tracks("goal", result.goals, writer)
            if result.maps:
                writer.add_topic("map", OCCUPANCY_GRID, is_latched=True)
            for one in result.maps:
                writer.write("map", one.log_ns, one.data)
        shutil.move(bag / "run.mcap", path)


def _add_tracks(topic: str, tracks: Mapping[str, Trajectory], writer: BagWriter) -> None:
    """Write trajectories as PoseStamped on `<robot>/<topic>`."""
    for name, track in tracks.items():
        writer.add_topic(f"{name}/{topic}", POSE_STAMPED)
        messages = encode_pose_stamped(_MAP, track.stamp_ns, track.pose)
        for stamp_ns, message in zip(track.stamp_ns.tolist(), messages, strict=True):
            writer.write(f"{name}/{topic}", stamp_ns, message)


def _add_estimates(result: ReplayResult, writer: BagWriter) -> None:
    """Write poses, transforms and markers at each stamp."""
    for topic, kind in (("swarm/poses", SWARM_POSES), ("tf", TRANSFORMS), ("swarm/markers", MARKERS)):
        writer.add_topic(topic, kind)
    names = [robot.name for robot in result.swarm.robots]
    poses, markers = SwarmPosesEncoder(names, _MAP), MarkersEncoder(result.swarm, _MAP)
    transforms = TransformsEncoder(_MAP, [f"{name}/base_link" for name in names])
    seen = dict(result.sightings)
    newest = None
    for one in estimates(result):
        newest = seen.get(one.stamp_ns, newest)
        columns = (one.pose, one.covariance, one.fix_age_s, one.status)
        writer.write("swarm/poses", one.stamp_ns, poses.encode(one.stamp_ns, *columns))
        located: BoolArray = ~np.isnan(one.pose[:, 0])
        if located.any():
            writer.write("tf", one.stamp_ns, transforms.encode(one.stamp_ns, located, one.pose))
        writer.write("swarm/markers", one.stamp_ns, markers.encode(one, newest))


def estimates(result: ReplayResult, stride: int = 1) -> Iterator[EstimateMessage]:
    """Every `stride`-th output of a run as a message; ages of fixes are not known."""
    names = tuple(robot.name for robot in result.swarm.robots)
    not_kept = np.full(len(names), np.nan)
    for k in range(0, len(result.stamp_ns), stride):
        pose = result.poses[k]
        stamp_ns, covariance = int(result.stamp_ns[k]), result.covariances[k]
        yield EstimateMessage(stamp_ns, _MAP, names, pose, covariance, not_kept, result.status[k])
