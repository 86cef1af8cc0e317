"""Images of a simulated world that have not become detections yet. No ROS here."""

from __future__ import annotations

from collections import deque


class Unanswered:
    """Keeps a simulated clock from running away from what is made of its images.

    Args:
        within_s: How old an image may get without an answer [s]; 0: any age.
    """

    def __init__(self, within_s: float) -> None:
        self._within_ns = round(1e9 * within_s)
        self._asked: deque[tuple[int, int, int]] = deque()

    def ask(self, robot: int, stamp_ns: int, now_ns: int) -> None:
        """A robot's image with this stamp is shown now."""
        if self._within_ns:
            self._asked.append((robot, stamp_ns, now_ns))

    def answer(self, robot: int, stamp_ns: int) -> None:
        """A robot's image has become detections; older ones of it will not any more."""
        self._asked = deque(one for one in self._asked if one[0] != robot or one[1] > stamp_ns)

    def give_up(self) -> int:
        """Wait for the oldest image no longer; whose it was."""
        return self._asked.popleft()[0]

    def is_late(self, now_ns: int) -> bool:
        """Whether an image has waited too long."""
        return bool(self._asked) and now_ns >= self._asked[0][2] + self._within_ns
