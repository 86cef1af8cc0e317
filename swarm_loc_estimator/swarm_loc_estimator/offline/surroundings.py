"""What people see of a run beside poses: maps, goals of robots, aerial images with who is who in them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.cdr import CdrError, decode_pose_stamped
from swarm_loc_estimator.common.messages.message_batch import MessageBatch
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.identification.memory import Identities
from swarm_loc_estimator.mapping.grid_messages import GridMessage, decode_occupancy_grid
from swarm_loc_estimator.sensors.messages import AerialRows
from swarm_loc_estimator.swarm.swarm import Swarm

MAX_MAP_BYTES = 48_000_000
"""More maps are thinned out, evenly over time."""
MAX_GOALS = 20_000
"""Of one robot; those after them are not kept."""
MAX_DETECTIONS = 200_000
"""In all aerial images that are kept; of a very long run only the beginning."""


class RecordedMap(NamedTuple):
    """A message of `map`, and when it was recorded."""

    log_ns: int
    data: bytes

    @property
    def grid(self) -> GridMessage:
        """What it says."""
        return decode_occupancy_grid(self.data)


class AerialImage(NamedTuple):
    """What an image from above shows.

    Attributes:
        stamp_ns: Of the image.
        position: (n, 2) of its detections in map [m].
        known: Detection -> index of the robot that it is believed to be, and the probability of that.
    """

    stamp_ns: int
    position: FloatArray
    known: Mapping[int, tuple[int, float]]


class MapReader:
    """Collects the maps and goals of a bag; nothing of them reaches the estimator.

    Args:
        swarm: Whose goals.
        max_bytes: How much maps may hold.

    Attributes:
        topics: Topics; their place here is the topic's number in a batch.
    """

    def __init__(self, swarm: Swarm, max_bytes: int = MAX_MAP_BYTES) -> None:
        self._names = [robot.name for robot in swarm.robots]
        self.topics = ["map", *(f"{name}/goal" for name in self._names)]
        self._max_bytes = max_bytes
        self._maps: list[RecordedMap] = []
        self._newest: RecordedMap | None = None
        self._spacing_ns = 0
        self._goals: dict[str, list[tuple[int, tuple[float, float, float]]]] = {}
        self._malformed = 0

    def add(self, batch: MessageBatch) -> None:
        """Take messages in."""
        for topic, log_ns, data in batch.messages():
            try:
                if topic:
                    self._add_goal(self._names[topic - 1], data)
                else:
                    decode_occupancy_grid(data)
                    self._add_map(RecordedMap(log_ns, data))
            except CdrError:
                self._malformed += 1

    def maps(self) -> tuple[RecordedMap, ...]:
        """In the order of time, the newest among them."""
        newest = [self._newest] if self._newest and self._newest not in self._maps[-1:] else []
        return (*self._maps, *newest)

    def goals(self) -> dict[str, Trajectory]:
        """Per robot that has had any."""
        found = {}
        for name, goals in self._goals.items():
            stamps, poses = zip(*sorted(goals), strict=True)
            found[name] = Trajectory(np.array(stamps, dtype=np.int64), np.array(poses))
        return found

    def remarks(self) -> tuple[str, ...]:
        """What else must be said."""
        return (f"{self._malformed} messages of maps or goals are malformed.",) if self._malformed else ()

    def _add_goal(self, name: str, data: bytes) -> None:
        goal = decode_pose_stamped(data)
        if not np.isfinite(goal.pose).all():
            raise CdrError("a goal is not finite.")
        goals = self._goals.setdefault(name, [])
        if len(goals) < MAX_GOALS:
            goals.append((goal.stamp_ns, goal.pose))

    def _add_map(self, recorded: RecordedMap) -> None:
        self._newest = recorded
        if self._maps and recorded.log_ns < self._maps[-1].log_ns + self._spacing_ns:
            return
        self._maps.append(recorded)
        while len(self._maps) > 1 and sum(len(one.data) for one in self._maps) > self._max_bytes:
            self._maps = self._maps[::2]
            span_ns = recorded.log_ns - self._maps[0].log_ns
            self._spacing_ns = max(2 * self._spacing_ns, span_ns // len(self._maps))


class AerialImages:
    """Collects aerial images, and who is who in them as it becomes known."""

    def __init__(self) -> None:
        self._positions: dict[int, FloatArray] = {}
        self._identities: dict[int, Identities] = {}
        self._left = MAX_DETECTIONS

    def add(self, rows: AerialRows) -> None:
        """Take the detections of images in."""
        for stamp_ns in np.unique(rows.stamp_ns).tolist():
            if self._left <= 0:
                return
            chosen = rows.stamp_ns == stamp_ns
            position = np.full((int(rows.number[chosen].max()) + 1, 2), np.nan)
            position[rows.number[chosen]] = rows.pose[chosen, :2]
            self._positions[stamp_ns] = position
            self._left -= len(position)

    def note(self, identities: Identities | None) -> None:
        """Take in who is who in an image; late data may change it."""
        if identities is not None and identities.stamp_ns in self._positions:
            self._identities[identities.stamp_ns] = identities

    def images(self) -> tuple[AerialImage, ...]:
        """In the order of their stamps."""
        return tuple(
            AerialImage(stamp_ns, position, _known(self._identities.get(stamp_ns)))
            for stamp_ns, position in sorted(self._positions.items())
        )


def _known(identities: Identities | None) -> dict[int, tuple[int, float]]:
    """Detection -> robot and probability."""
    if identities is None:
        return {}
    found = np.flatnonzero(identities.place >= 0)
    return {int(identities.place[k]): (int(k), float(identities.probability[k])) for k in found}
