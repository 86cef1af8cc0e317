"""The interface of the readers of one bag file, whatever its storage."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

from swarm_loc_estimator.common.parameters import UserError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from swarm_loc_estimator.common.messages.streams import MessageBatch

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


class BagFile(Protocol):
    """One open file."""

    @property
    def topics(self) -> list[BagTopic]:
        """The topics."""

    @property
    def message_count(self) -> int:
        """Number of messages, as far as they can be counted before reading."""

    @property
    def time_range_ns(self) -> tuple[int, int]:
        """First and last log time; (0, 0) without messages."""

    @property
    def losses(self) -> ReadErrors:
        """What could not be read; more may come while reading."""

    @property
    def progress(self) -> float:
        """Share of the file that was read, 0 to 1."""

    def batches(self, number_of: Mapping[BagTopic, int]) -> Iterator[MessageBatch]:
        """The messages of some topics in order of log time, numbered by `number_of`."""

    def close(self) -> None:
        """Close the file."""
