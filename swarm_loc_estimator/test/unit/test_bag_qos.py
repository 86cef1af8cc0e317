"""Profiles of topics from a bag's metadata, as rosbag2 has written them over the years, or damaged."""

from typing import Any

import pytest
from rosbags.interfaces import QosDurability, QosReliability

from swarm_loc_estimator.common.bags.reader import offered_qos

FOREVER = {"sec": 9223372036, "nsec": 854775807}
NEW = {
    "history": "keep_last",
    "depth": 5,
    "reliability": "best_effort",
    "durability": "transient_local",
    "deadline": FOREVER,
    "lifespan": FOREVER,
    "liveliness": "automatic",
    "liveliness_lease_duration": FOREVER,
    "avoid_ros_namespace_conventions": False,
}
OLD = """
- {history: 1, depth: 5, reliability: 2, durability: 1, deadline: {sec: 0, nsec: 0},
   lifespan: {sec: 0, nsec: 0}, liveliness: 1, liveliness_lease_duration: {sec: 0, nsec: 0},
   avoid_ros_namespace_conventions: false}
"""


def _metadata(profiles: object) -> dict[str, Any]:
    topics = [("/a/odom", profiles), ("/b/odom", "")]
    return {
        "topics_with_message_count": [
            {"message_count": 1, "topic_metadata": {"name": name, "offered_qos_profiles": offered}}
            for name, offered in topics
        ]
    }


@pytest.mark.parametrize("profiles", [[NEW], OLD])
def test_profiles_of_all_versions(profiles: object) -> None:
    found = offered_qos(_metadata(profiles))
    (profile,) = found["a/odom"]
    assert (profile.reliability, profile.durability) == (
        QosReliability.BEST_EFFORT,
        QosDurability.TRANSIENT_LOCAL,
    )
    assert profile.depth == 5
    assert found["b/odom"] == []


@pytest.mark.parametrize("damage", ["]", "reliable", [{"depth": 1}], [3], 7, [{**NEW, "deadline": None}]])
def test_damaged_profiles_are_none(damage: object) -> None:
    assert offered_qos(_metadata(damage)) == {"b/odom": []}


@pytest.mark.parametrize("damage", [None, 7, [None], [{"topic_metadata": 3}], [{"topic_metadata": {}}]])
def test_damaged_topics_have_none(damage: object) -> None:
    assert offered_qos({"topics_with_message_count": damage}) == {}
