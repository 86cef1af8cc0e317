"""What the metadata of a bag say of the quality of service that its topics were published with."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2.metadata import parse_qos

if TYPE_CHECKING:
    from rosbags.interfaces import Qos


def offered_qos(metadata: dict[str, Any]) -> dict[str, list[Qos]]:
    """The profiles of each topic's publishers, by its name without the leading slash.

    Args:
        metadata: What stands below `rosbag2_bagfile_information`; topics that are not described as they
            should be have no profiles.
    """
    topics = metadata.get("topics_with_message_count")
    profiles: dict[str, list[Qos]] = {}
    for topic in topics if isinstance(topics, list) else []:
        try:
            about = topic["topic_metadata"]
            profiles[str(about["name"]).lstrip("/")] = parse_qos(about["offered_qos_profiles"])
        except (AttributeError, KeyError, ReaderError, TypeError):
            continue
    return profiles
