"""Read a bag of a swarm once: raw inputs in order of arrival, and ground truth apart from them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from swarm_loc_estimator.common.bags.reader import BagReader, BagTopic
from swarm_loc_estimator.common.messages.message_batch import MessageBatch
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.offline.surroundings import MapReader, RecordedMap
from swarm_loc_estimator.offline.truth import TruthReader
from swarm_loc_estimator.sensors.ingest import Ingest
from swarm_loc_estimator.sensors.messages import RawInputs
from swarm_loc_estimator.sensors.topics import InputKind
from swarm_loc_estimator.swarm.swarm import Swarm

Progress = Callable[[float, str], None]
"""Takes the share done, 0 to 1, and what is being done."""


def unwatched(_share: float, _what: str) -> None:
    """Progress that nobody watches."""


@dataclass(frozen=True)
class BagSummary:
    """What is known of a bag beside its inputs.

    Attributes:
        range_ns: First and last log time.
        truth: Robot name -> ground truth; robots without are missing.
        received: Messages for the estimator by kind of topic.
        remarks: What could not be read or used, one sentence each.
        maps: What was recorded of `map`, thinned out where it is very much.
        goals: Robot name -> where it was to go, by the instants at which that was decided.
    """

    range_ns: tuple[int, int]
    truth: Mapping[str, Trajectory]
    received: Mapping[str, int]
    remarks: tuple[str, ...]
    maps: tuple[RecordedMap, ...] = ()
    goals: Mapping[str, Trajectory] = field(default_factory=dict)


def read_bag(bag: Path, swarm: Swarm, take: Callable[[RawInputs], None], progress: Progress) -> BagSummary:
    """Read a bag once.

    Args:
        bag: rosbag2 folder, .mcap or .db3 file.
        swarm: Whose messages are wanted.
        take: Is handed the inputs, one stretch of time after the other.
        progress: Called now and then.

    Raises:
        BagError: Nothing in the bag can be read.
    """
    ingest, truth, maps = Ingest(swarm), TruthReader(swarm), MapReader(swarm)
    first_truth = len(ingest.topics)
    first_map = first_truth + len(truth.topics)
    with BagReader(bag) as reader:
        range_ns = reader.time_range_ns
        for batch in reader.batches([*ingest.handle_of, *truth.topics, *maps.topics]):
            for inputs in ingest.read(batch.chosen(batch.topic < first_truth)):
                take(inputs)
            truth.add(_from(batch.chosen(batch.topic < first_map), first_truth))
            maps.add(_from(batch, first_map))
            progress(reader.progress, "reading")
        found = (*_strangers(reader.topics, ingest), *_missing(ingest))
        remarks = (*reader.losses, *found, *truth.remarks(), *maps.remarks())
        return BagSummary(range_ns, truth.tracks(), ingest.received(), remarks, maps.maps(), maps.goals())


def _from(batch: MessageBatch, first: int) -> MessageBatch:
    """The messages whose topics have such a number or a higher one, with numbers that begin at 0."""
    others = batch.chosen(batch.topic >= first)
    return others._replace(topic=others.topic - first)


def _missing(ingest: Ingest) -> list[str]:
    """One sentence for every input that the bag does not have, nor one of all robots in its place."""
    pairs = [*zip(ingest.topics, ingest.statistics, strict=True)]
    shared = {topic.kind.stands_for for topic, statistics in pairs if statistics.received}
    return [
        f"The bag holds no message on {topic.name}."
        for topic, statistics in pairs
        if topic.expected and not statistics.received and topic.kind.rows not in shared
    ]


def _strangers(topics: Iterable[BagTopic], ingest: Ingest) -> list[str]:
    """A sentence when there are inputs of robots that the swarm does not have."""
    kinds = {kind.topic: kind.message_type for kind in InputKind}
    names = [t.name for t in topics if kinds.get(t.name.rpartition("/")[2]) == t.type]
    strange = sorted(set(names) - set(ingest.handle_of))
    return [f"No robot of the swarm description has the topics {', '.join(strange)}."] if strange else []
