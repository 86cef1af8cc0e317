"""What the reader of one bag file offers, whatever its storage."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

RawMessage = tuple[str, str, int, bytes]
"""Topic, type, log time [ns], serialized message."""


class BagError(ValueError):
    """A bag of which nothing can be read; the message is one sentence."""


class BagTopic(NamedTuple):
    """A topic of a bag: its name, such as robot1/odom, and its type, such as nav_msgs/msg/Odometry."""

    name: str
    type: str


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
    def losses(self) -> list[str]:
        """One sentence for each thing that could not be read; more may come while reading."""

    @property
    def progress(self) -> float:
        """Share of the file that was read, 0 to 1."""

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """All messages in order of log time; with `topics`, only of these."""

    def close(self) -> None:
        """Close the file."""
