"""What the readers of bag files share, whatever the storage: topics, errors, the range of log times."""

from __future__ import annotations

from typing import NamedTuple

from swarm_loc_estimator.common.parameters import UserError

RawMessage = tuple[str, str, int, bytes]  # Topic, type, log time [ns], serialized message

MAX_LOG_NS = 2**62
"""Log times lie between 0 and here [ns], in the year 2116, so that the difference of any two is a number."""


class BagError(UserError):
    """A bag of which nothing can be read."""


class BagTopic(NamedTuple):
    """A topic of a bag."""

    name: str  # Such as robot1/odom
    type: str  # Such as nav_msgs/msg/Odometry
    encoding: str = "cdr"  # How its messages are serialized: cdr in ROS 2; "" if nothing is said


class ReadErrors(list[str]):
    """One sentence for each thing that could not be read of a file, each once however often it is read."""

    def __init__(self, file: str) -> None:
        super().__init__()
        self._file = file

    def add(self, sentence: str) -> None:
        """Add a sentence about the file."""
        sentence = f"{self._file}: {sentence}"
        if sentence not in self:
            self.append(sentence)
