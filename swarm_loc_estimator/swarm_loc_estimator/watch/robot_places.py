"""Frames of what robots publish of places: ground truth, goals, aerial detections with names."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from swarm_loc_estimator.common.messages.cdr import CdrError, decode_pose_stamped, nanoseconds
from swarm_loc_estimator.watch.frames import Frame, aerial_frame, places_frame
from swarm_loc_msgs.msg import AnonymousDetectionArray, RobotIdentities

_OLD_NS = 500_000_000
_IMAGES = 8


class Places:
    """The newest place of each robot of one kind.

    Args:
        kind: Of the frames.
        keeps: Whether a place holds until the next one comes, however old.
        drop: Is told the reason when a message cannot be used.
    """

    def __init__(self, kind: str, drop: Callable[[str], None], *, keeps: bool) -> None:
        self._kind = kind
        self._drop = drop
        self._keeps = keeps
        self._newest: dict[int, tuple[int, tuple[float, float, float]]] = {}
        self._told_ns = -1

    def take(self, robot: int, data: bytes) -> None:
        """A serialized PoseStamped of a robot."""
        try:
            message = decode_pose_stamped(data)
        except CdrError:
            self._drop("malformed")
            return
        if not np.isfinite(message.pose).all():
            self._drop("not_finite")
            return
        self._newest[robot] = (message.stamp_ns, message.pose)

    def frame(self) -> Frame | None:
        """All places; None when nothing has come since."""
        newest_ns = max((stamp_ns for stamp_ns, _ in self._newest.values()), default=-1)
        if newest_ns == self._told_ns:
            return None
        self._told_ns = newest_ns
        limit_ns = 0 if self._keeps else newest_ns - _OLD_NS
        shown = {robot: pose for robot, (at_ns, pose) in self._newest.items() if at_ns >= limit_ns}
        return places_frame(self._kind, newest_ns, [*shown], np.array([*shown.values()]).reshape(-1, 3))

    def clear(self) -> None:
        """Forget all of them."""
        self._newest.clear()
        self._told_ns = -1


class AerialNames:
    """Joins anonymous detections with who they are believed to be, by the stamp of their image.

    Args:
        index_of: Robot name -> index.
    """

    def __init__(self, index_of: dict[str, int]) -> None:
        self._index_of = index_of
        self._images: dict[int, AnonymousDetectionArray] = {}

    def detections(self, message: AnonymousDetectionArray) -> Frame:
        """An image, of which nobody is known yet."""
        stamp_ns = nanoseconds(message.header.stamp)
        self._images[stamp_ns] = message
        while len(self._images) > _IMAGES:
            del self._images[next(iter(self._images))]
        return self._frame(stamp_ns, {})

    def identities(self, message: RobotIdentities) -> Frame | None:
        """Who is who in one of the newest images; None for an older one."""
        stamp_ns = nanoseconds(message.header.stamp)
        if stamp_ns not in self._images:
            return None
        return self._frame(
            stamp_ns,
            {
                one.detection: (self._index_of[one.name], one.probability)
                for one in message.identities
                if one.detection >= 0 and one.name in self._index_of
            },
        )

    def _frame(self, stamp_ns: int, known: dict[int, tuple[int, float]]) -> Frame:
        seen = self._images[stamp_ns].detections
        position = np.array([(one.x, one.y) for one in seen]).reshape(-1, 2)
        return aerial_frame(stamp_ns, position, known)
