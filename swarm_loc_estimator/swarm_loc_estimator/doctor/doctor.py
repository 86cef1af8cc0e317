"""The doctor: all checks, on a bag or on what was heard live."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.health import listed
from swarm_loc_estimator.common.messages.cdr import TRANSFORMS
from swarm_loc_estimator.doctor.contents import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    check_contents,
    check_estimate,
    check_motion,
    check_pictures,
    check_sources,
)
from swarm_loc_estimator.doctor.evidence import Evidence, Finding, Heard, Message
from swarm_loc_estimator.doctor.topics import DIAGNOSTICS, check_clocks, check_frames, check_topics
from swarm_loc_estimator.offline.recorded_bag import BagLocalizer, Progress, renamed_topics, same_type
from swarm_loc_estimator.sensors.inputs import input_topics, kinds
from swarm_loc_estimator.sensors.mounts import TF_STATIC, Mounts
from swarm_loc_estimator.swarm.swarm import Swarm

CHECKS = (
    *(check_topics, check_clocks, check_frames),
    *(check_pictures, check_motion, check_contents, check_sources),
)
_LOOKED_AT = (
    *(kind.message_type for kind in kinds().values()),
    *(TRANSFORMS, DIAGNOSTICS, IMAGE, COMPRESSED_IMAGE, CAMERA_INFO),
)
MAX_IMAGES = 20  # Maximum number of images of a topic that are kept; what is wrong with one is wrong with all


def examine(evidence: Evidence) -> list[Finding]:
    """All that is wrong, the most basic things first.

    Mounts are those of static transforms where the description says none. What the estimator contradicts
    often follows from the rest, so it is added only where nothing else is.
    """
    mounts = mounts_of(evidence)
    evidence = replace(evidence, swarm=mounts.described())
    found = [
        Finding(
            robot,
            f"has {key} {described:.3g} in the description but {value:.3g} by tf_static",
            "Correct the one that is wrong; without it in the description, the transform is taken",
        )
        for robot, key, described, value in mounts.differences()
    ]
    found += [one for check in CHECKS for one in check(evidence)]
    return found or [*check_estimate(evidence)]


def mounts_of(evidence: Evidence) -> Mounts:
    """Mounts of sensors by static transforms."""
    mounts = Mounts(evidence.swarm)
    for name, heard in evidence.topics.items():
        is_static = name.endswith(TF_STATIC) and same_type(heard.type, TRANSFORMS)
        is_usable = name in mounts.topics and evidence.usable(mounts.topics[name]) is not None
        for message in heard.messages if is_static else heard.messages[:1] if is_usable else ():
            mounts.add_message(name, message.data)
    return mounts


def lines_of(findings: Sequence[Finding]) -> list[str]:
    """One line for each problem, with all that have it."""
    abouts: dict[tuple[str, str], list[str]] = {}
    for one in findings:
        abouts.setdefault((one.problem, one.remedy), []).append(one.about)
    return [
        f"{names[0]} {problem}. {remedy}."
        if len(names) == 1
        else f"{listed(names)}: each {problem}. {remedy}."
        for (problem, remedy), names in abouts.items()
    ]


def evidence_of_bag(
    bag: Path,
    swarm: Swarm,
    seconds: float,
    progress: Progress,
    remap: Mapping[str, str] = MappingProxyType({}),
    namespace: str = "",
    is_wanted: Callable[[str], bool] | None = None,
) -> Evidence:
    """The first `seconds` of a bag; `remap` as in `renamed_topics`, `namespace` of the whole swarm or "".

    Messages of types that `is_wanted` selects are kept; without it, those that a check looks at.

    Raises:
        BagError: Nothing in the bag can be read, or a topic cannot be mapped.
    """
    known = [topic.name for topic in input_topics(swarm)]
    messages: dict[str, list[Message]] = {}
    with BagReader(bag, renamed_topics(remap, swarm, known)) as reader:
        localizer = BagLocalizer(swarm, reader.topics)
        types = {topic.name: topic.type for topic in (*reader.topics, *localizer.outputs.values())}
        end_ns = reader.time_range_ns[0] + round(seconds * 1e9)
        wanted = [name for name, kind in types.items() if (is_wanted or is_looked_at)(kind)]
        for name, _, log_ns, data in reader.messages([*wanted, *localizer.topics]):
            if log_ns > end_ns:
                break
            of_robots = localizer.read(name, log_ns, data) if name in localizer.topics else ()
            for topic, serialized in of_robots:
                messages.setdefault(topic.name, []).append(Message(log_ns, serialized))
            keep(messages.setdefault(name, []), types[name], Message(log_ns, data))
            progress(min(1.0, reader.progress), "reading")
        prefix = f"{namespace.strip('/')}/"
        topics = {
            name.removeprefix(prefix): Heard(kind, messages.get(name, [])) for name, kind in types.items()
        }
        is_cut = end_ns < reader.time_range_ns[1]
        return Evidence(swarm, topics, remarks=tuple(reader.losses), is_cut=is_cut)


def is_looked_at(message_type: str) -> bool:
    """Whether a check looks at messages of a type; of all other topics only names and types matter."""
    return any(same_type(message_type, one) for one in _LOOKED_AT)


def keep(kept: list[Message], message_type: str, message: Message) -> None:
    """Keep a message, unless it is one of many images."""
    is_image = same_type(message_type, IMAGE) or same_type(message_type, COMPRESSED_IMAGE)
    if not is_image or len(kept) < MAX_IMAGES:
        kept.append(message)
