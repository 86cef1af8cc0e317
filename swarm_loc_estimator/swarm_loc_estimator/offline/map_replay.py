"""Replay a bag through the mapper: the code that runs live, message by message in the order of the bag."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.messages.typestore import POSE_STAMPED
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.mapping.mapper import CooperativeMapper
from swarm_loc_estimator.mapping.mapper_feed import MapperFeed, MapperInput
from swarm_loc_estimator.mapping.settings import MapperSettings
from swarm_loc_estimator.offline.truth import read_truth
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

_TELL_EVERY = 1000


def replay_map(
    bag: Path,
    robots: Sequence[Robot],
    settings: MapperSettings,
    frequencies: Mapping[str, float],
    progress: Callable[[float, str], None],
) -> tuple[CooperativeMapper, MapperFeed]:
    """Make the map of a bag; returns the mapper, all solved anew at the end, and what was used and what not.

    Args:
        bag: With `<robot>/odom`, `<robot>/laser` and, if frequencies are given, `<robot>/lights`.
        robots: Those that map.
        settings: Of the mapper.
        frequencies: Robot -> frequency of its LEDs [Hz].
        progress: Is told the share that is done, and what is going on.

    Raises:
        UserError: The bag cannot be read, or the robots cannot start.
    """
    mapper = CooperativeMapper(settings)
    feed = MapperFeed(robots, mapper, frequencies)
    source = {
        f"{robot.name}/{kind.topic}": (k, kind) for k, robot in enumerate(robots) for kind in MapperInput
    }
    with BagReader(bag) as reader:
        for number, (topic, message_type, _, data) in enumerate(reader.messages(source)):
            robot, kind = source[topic]
            if message_type == kind.message_type:
                feed.add(robot, kind, data)
            else:
                feed.drops["other_type"] += 1
            if number % _TELL_EVERY == 0:
                progress(reader.progress, "mapping")
    mapper.finish()
    return mapper, feed


def truth_of(bag: Path, swarm: Swarm) -> dict[str, Trajectory]:
    """Ground truth of a bag by robot, for evaluation only; empty without any."""
    found: dict[str, list[bytes]] = {}
    names = {f"{robot.name}/ground_truth": robot.name for robot in swarm.robots}
    with BagReader(bag) as reader:
        for topic, message_type, _, data in reader.messages(names):
            if message_type == POSE_STAMPED:
                found.setdefault(names[topic], []).append(data)
    return read_truth(swarm, found) if found else {}
