"""QoS profiles of the player: as recorded, else reliable."""

from __future__ import annotations

from collections.abc import Sequence

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Qos, QosDurability, QosLiveliness, QosReliability, QosTime

DEPTH = 1000
"""The player's own, whatever the recorded publisher kept: deep enough for any rate."""
RELIABLE = QoSProfile(depth=DEPTH)
"""Subscribers that ask for reliability hear it, and those that do not."""
LATCHED = QoSProfile(depth=DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_LATCHED_TOPICS = frozenset({"tf_static", "robot_description", "map"})

_RELIABILITY = {
    QosReliability.RELIABLE: ReliabilityPolicy.RELIABLE,
    QosReliability.BEST_EFFORT: ReliabilityPolicy.BEST_EFFORT,
}
_LIVELINESS = {
    QosLiveliness.AUTOMATIC: LivelinessPolicy.AUTOMATIC,
    QosLiveliness.MANUAL_BY_TOPIC: LivelinessPolicy.MANUAL_BY_TOPIC,
}
_LONGEST_NS = 2**63 - 1


def playing_qos(topic: str, recorded: Sequence[Qos]) -> QoSProfile:
    """The profile to publish a topic with.

    Args:
        topic: Its name in the bag.
        recorded: Those of its publishers. Where these differ, or none is known, it is reliable, and latched
            if its name says so.
    """
    profiles = [_profile(one) for one in recorded]
    if profiles and all(one == profiles[0] for one in profiles):
        return profiles[0]
    return LATCHED if topic in _LATCHED_TOPICS else RELIABLE


def _profile(recorded: Qos) -> QoSProfile:
    """A recorded profile; policies that only ask for some default become this player's."""
    latched = recorded.durability is QosDurability.TRANSIENT_LOCAL
    return QoSProfile(
        # of a latched topic, late subscribers get as much as they used to
        depth=recorded.depth if latched and 0 < recorded.depth < DEPTH else DEPTH,
        reliability=_RELIABILITY.get(recorded.reliability, RELIABLE.reliability),
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        liveliness=_LIVELINESS.get(recorded.liveliness, LivelinessPolicy.AUTOMATIC),
        deadline=_duration(recorded.deadline),
        lifespan=_duration(recorded.lifespan),
        liveliness_lease_duration=_duration(recorded.liveliness_lease_duration),
    )


def _duration(time: QosTime) -> Duration:
    return Duration(nanoseconds=min(time.sec * 1_000_000_000 + time.nsec, _LONGEST_NS))
