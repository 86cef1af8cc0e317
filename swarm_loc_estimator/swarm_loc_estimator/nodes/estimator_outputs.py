"""Publish swarm/poses, swarm/sightings, <robot>/pose, aerial/identities, and /tf from map to <robot>/odom."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile
from tf2_msgs.msg import TFMessage

from swarm_loc_estimator.common.messages.encoders import encode_identities, encode_poses
from swarm_loc_estimator.common.messages.estimates import encode_sightings
from swarm_loc_estimator.common.messages.outputs import SwarmPosesEncoder, TransformsEncoder
from swarm_loc_estimator.identification.memory import Identities
from swarm_loc_estimator.nodes.estimator_parameters import EstimatorParameters
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator, Status
from swarm_loc_estimator.timeline.sightings import newest_sightings
from swarm_loc_msgs.msg import RobotIdentities, SwarmPoses, SwarmSightings

_RELIABLE = QoSProfile(depth=10)
_SIGHTINGS_PERIOD_NS = 180_000_000
"""Of swarm/sightings, which people look at."""
_TF = QoSProfile(depth=100)  # what tf2's own broadcaster offers


class EstimateOutputs:
    """Publishes estimates.

    Args:
        node: Whose publishers they are.
        swarm: Names of the robots.
        parameters: Frames, and what is wanted.
    """

    def __init__(self, node: Node, swarm: Swarm, parameters: EstimatorParameters) -> None:
        names = [robot.name for robot in swarm.robots]
        frame = parameters.map_frame
        self._swarm_poses = node.create_publisher(SwarmPoses, "swarm/poses", _RELIABLE)
        self._swarm_poses_encoder = SwarmPosesEncoder(names, frame)
        self._frame = frame
        self._names = names
        self._sightings = node.create_publisher(SwarmSightings, "swarm/sightings", _RELIABLE)
        self._sightings_ns = 0
        self._identities = node.create_publisher(RobotIdentities, "aerial/identities", _RELIABLE)
        self._told: Identities | None = None
        self._robot_poses = [
            node.create_publisher(PoseWithCovarianceStamped, f"{name}/pose", _RELIABLE)
            for name in (names if parameters.publish_robot_poses and not parameters.shared_topics else [])
        ]
        # tf2's listeners know this one absolute name, whatever the namespace
        self._tf = node.create_publisher(TFMessage, "/tf", _TF) if parameters.publish_tf else None
        self._tf_encoder = TransformsEncoder(frame, [f"{name}/{parameters.odom_frame}" for name in names])

    def publish(self, estimate: Estimate) -> None:
        """Publish all poses; robots that wait for a fix are in `swarm/poses` only, as waiting."""
        e = estimate
        located = e.status != Status.WAITING
        self._swarm_poses.publish(
            self._swarm_poses_encoder.encode(e.stamp_ns, e.poses, e.covariances, e.fix_age_s, e.status)
        )
        if self._tf is not None and located.any():
            self._tf.publish(self._tf_encoder.encode(e.stamp_ns, located, e.map_to_odom))
        # a large swarm's single topics cost most of all to publish, and are seldom heard
        heard = [k for k, one in enumerate(self._robot_poses) if located[k] and one.get_subscription_count()]
        if heard:
            stamps_ns = np.full(len(heard), e.stamp_ns)
            messages = encode_poses(self._frame, stamps_ns, e.poses[heard], e.covariances[heard])
            for robot, message in zip(heard, messages, strict=True):
                self._robot_poses[robot].publish(message)

    def publish_identities(self, identities: Identities | None) -> None:
        """Publish who is who in the newest aerial image, whenever that changes; late data may change it."""
        if identities is None or (self._told is not None and _are_equal(identities, self._told)):
            return
        self._told = identities
        probability = identities.probability
        self._identities.publish(
            encode_identities(self._frame, identities.stamp_ns, self._names, identities.place, probability)
        )

    def publish_sightings(self, estimator: Estimator, now_ns: int) -> None:
        """Publish what the robots see and what became of it, a few times a second and if somebody listens."""
        if abs(now_ns - self._sightings_ns) < _SIGHTINGS_PERIOD_NS:
            return
        self._sightings_ns = now_ns
        if self._sightings.get_subscription_count():
            sightings = newest_sightings(estimator.recent(), now_ns)
            self._sightings.publish(encode_sightings(self._frame, now_ns, sightings))


def _are_equal(one: Identities, other: Identities) -> bool:
    """Whether both say the same of the same image."""
    if one is other:
        return True
    same = np.array_equal(one.place, other.place) and np.array_equal(one.probability, other.probability)
    return same and one.stamp_ns == other.stamp_ns
