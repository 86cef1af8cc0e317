"""A run as data for the page on which people watch a swarm: thinned out to a bounded size."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.trajectory import interpolate
from swarm_loc_estimator.offline.export import estimates
from swarm_loc_estimator.watch.about import about
from swarm_loc_estimator.watch.frames import (
    Frame,
    aerial_frame,
    map_frame,
    places_frame,
    poses_frame,
    sightings_frame,
)
from swarm_loc_estimator.watch.recording import recording

if TYPE_CHECKING:
    from swarm_loc_estimator.offline.result import ReplayResult

_Thing = TypeVar("_Thing")
MAX_BYTES = 12_000_000
"""Of poses and sightings before they are packed; maps, goals and aerial images have limits of their own."""
_MAP_BYTES, _GOAL_BYTES, _IMAGE_BYTES = 6_000_000, 1_000_000, 2_000_000
_BYTES_PER_FRAME, _BYTES_PER_ROBOT, _BYTES_PER_SIGHTING = 800, 64, 17
_GAP_NS = 500_000_000


def recorded(result: ReplayResult) -> str:
    """The run as a text for the page; "" where there is nothing to show."""
    if not len(result.stamp_ns) or not result.swarm.robots:
        return ""
    seen = sum(len(one.observer) for _, one in result.sightings) * _BYTES_PER_SIGHTING
    each = _BYTES_PER_FRAME + _BYTES_PER_ROBOT * len(result.swarm.robots)
    stride = -(-(each * len(result.stamp_ns)) // (MAX_BYTES // 2))
    seen_stride = max(1, -(-seen // (MAX_BYTES // 2)))
    frames = [*map(poses_frame, estimates(result, stride)), *_truth(result, stride)]
    frames += [sightings_frame(stamp_ns, one) for stamp_ns, one in result.sightings[::seen_stride]]
    frames += [*_maps(result), *_goals(result), *_images(result)]
    told = about(result.swarm, result.title, commands=False)
    return recording(told, sorted(frames, key=lambda frame: frame.stamp_ns))


def _truth(result: ReplayResult, stride: int) -> Iterator[Frame]:
    """The ground truth at the stamps of the poses."""
    stamps_ns = np.asarray(result.stamp_ns[::stride])
    robots = [index for index, one in enumerate(result.swarm.robots) if one.name in result.truth]
    if not robots:
        return
    names = [result.swarm.robots[index].name for index in robots]
    found = [interpolate(result.truth[name], stamps_ns, _GAP_NS) for name in names]
    pose, known = (np.stack([one[part] for one in found], axis=1) for part in (0, 1))
    for k, stamp_ns in enumerate(stamps_ns.tolist()):
        there = np.flatnonzero(known[k])
        yield places_frame("truth", stamp_ns, [robots[i] for i in there], pose[k, there])


def _maps(result: ReplayResult) -> Iterator[Frame]:
    """The map as it grew, the last one among them."""
    size = max((len(one.data) for one in result.maps), default=1)
    for one in _thinned(result.maps, _MAP_BYTES // size):
        yield map_frame(one.log_ns, one.grid)


def _goals(result: ReplayResult) -> Iterator[Frame]:
    """The goals of all robots at each instant at which one has got another."""
    index_of, newest = result.swarm.index_of, dict[int, FloatArray]()
    rows = [
        (int(track.stamp_ns[k]), index_of[name], track.pose[k])
        for name, track in result.goals.items()
        for k in range(len(track.stamp_ns))
    ]
    frames = []
    for stamp_ns, robot, pose in sorted(rows, key=lambda row: row[:2]):
        newest[robot] = pose
        frames.append(places_frame("goals", stamp_ns, [*newest], np.array([*newest.values()])))
    size = max((len(one.data) for one in frames), default=1)
    yield from _thinned(frames, _GOAL_BYTES // size)


def _images(result: ReplayResult) -> Iterator[Frame]:
    """What cameras above the swarm saw."""
    frames = [aerial_frame(*one) for one in result.images]
    size = max((len(one.data) for one in frames), default=1)
    yield from _thinned(frames, _IMAGE_BYTES // size)


def _thinned(things: Sequence[_Thing], most: int) -> list[_Thing]:
    """So many of them at most, but one at least, evenly, the last among them."""
    stride = max(1, -(-len(things) // max(1, most)))
    return [*things[::-1][::stride]][::-1]
