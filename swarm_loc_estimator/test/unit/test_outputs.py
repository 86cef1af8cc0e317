"""Ready bytes are the messages that they stand for."""

from typing import Any

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from swarm_loc_estimator.common.bags.writer import typestore
from swarm_loc_estimator.common.messages.poses import SwarmPosesEncoder, TransformsEncoder, encode_poses

STAMP_NS = 1_234_567_890_123_456_789
NAMES = ["a", "robot17", "x" * 40]
POSES = np.array([[1.0, 2.0, 0.3], [-4.0, 5.0, -3.0], [np.nan, np.nan, np.nan]])
COVARIANCES = np.arange(27.0).reshape(3, 3, 3)


def read(data: bytes, message_type: str) -> Any:
    """The message object; equal to the bytes again when serialized, so nothing is missing or too much."""
    store = typestore()
    if message_type not in store.fielddefs:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", message_type))
    message = store.deserialize_cdr(data, message_type)
    assert bytes(store.serialize_cdr(message, message_type)).rstrip(b"\x00") == data.rstrip(b"\x00")
    return message


def stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def yaw(quaternion: Any) -> float:
    assert quaternion.x == quaternion.y == 0.0
    return float(2.0 * np.arctan2(quaternion.z, quaternion.w))


@pytest.mark.parametrize("frame", ["map", "world", ""])
def test_swarm_poses(frame: str) -> None:
    encoder = SwarmPosesEncoder(NAMES, frame)
    ages, status = np.array([0.5, 1.5, -1.0]), np.array([1, 2, 0], np.uint8)
    known = np.array([False, True, False])
    for stamp in (5, STAMP_NS):
        message = read(
            encoder.encode(stamp, POSES, COVARIANCES, ages, status, known), "swarm_loc_msgs/msg/SwarmPoses"
        )
        assert (stamp_ns(message), message.header.frame_id) == (stamp, frame)
    assert [robot.name for robot in message.robots] == NAMES
    for k, robot in enumerate(message.robots):
        assert np.array_equal([robot.x, robot.y, robot.theta], POSES[k], equal_nan=True)
        assert np.array_equal(robot.covariance, COVARIANCES[k].ravel())
        assert (robot.fix_age_s, robot.status, robot.heading_known) == (ages[k], status[k], known[k])


def test_robot_poses_are_sure_of_the_plane_but_not_beyond_doubt() -> None:
    messages = encode_poses("map", np.full(2, STAMP_NS), POSES[:2], COVARIANCES[:2])
    for k, data in enumerate(messages):
        message = read(data, "geometry_msgs/msg/PoseWithCovarianceStamped")
        assert (stamp_ns(message), message.header.frame_id) == (STAMP_NS, "map")
        place = message.pose.pose.position
        assert (place.x, place.y, place.z) == (*POSES[k, :2], 0.0)
        assert yaw(message.pose.pose.orientation) == pytest.approx(POSES[k, 2])
        covariance = np.array(message.pose.covariance).reshape(6, 6)
        assert np.array_equal(covariance[np.ix_((0, 1, 5), (0, 1, 5))], COVARIANCES[k])
        assert (np.diagonal(covariance)[2:5] > 0.0).all()
        assert not covariance[2:5, [0, 1, 5]].any()


def test_transforms_of_those_that_are_chosen() -> None:
    encoder = TransformsEncoder("map", [f"{name}/odom" for name in NAMES])
    for chosen in ([True, False, False], [True, True, False], [False, True, False]):
        data = encoder.encode(STAMP_NS, np.array(chosen), POSES)
        transforms = read(data, "tf2_msgs/msg/TFMessage").transforms
        rows = np.flatnonzero(chosen)
        assert [t.child_frame_id for t in transforms] == [f"{NAMES[row]}/odom" for row in rows]
        for row, transform in zip(rows, transforms, strict=True):
            assert (stamp_ns(transform), transform.header.frame_id) == (STAMP_NS, "map")
            assert transform.transform.translation.x == POSES[row, 0]
            assert yaw(transform.transform.rotation) == pytest.approx(POSES[row, 2])
