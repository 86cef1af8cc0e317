"""Messages of robots to the mapper, as they come."""

import math
from typing import Any

import numpy as np
import pytest

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.bags.writer import typestore
from swarm_loc_estimator.common.messages.cdr import LASER
from swarm_loc_estimator.common.messages.poses import UNKNOWN_COVARIANCE, encode_odometry
from swarm_loc_estimator.mapping.mapper import CooperativeMapper
from swarm_loc_estimator.mapping.mapper_feed import MapperFeed, MapperInput
from swarm_loc_estimator.swarm.swarm import Robot

STEP_NS = 20_000_000
DISTANCE, SIGMA = 2.0, 0.05


def odometry(stamp_ns: int, pose: FloatArray) -> bytes:
    stamps = np.array([stamp_ns])
    unknown = UNKNOWN_COVARIANCE
    return encode_odometry("a/odom", "a/base_link", stamps, pose[None], np.zeros((1, 3)), unknown, unknown)[0]


def laser(stamp_ns: int) -> bytes:
    types: Any = typestore().types
    stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    return bytes(
        typestore().serialize_cdr(
            types[LASER](
                header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="a/base_link"),
                distance=DISTANCE,
                sigma=SIGMA,
                u_px=0.0,
                v_px=0.0,
                covariance=np.zeros(4),
                events=1,
            ),
            LASER,
        )
    )


def test_a_robot_joins_where_odometry_has_it_when_it_first_sees_something() -> None:
    """It had turned by a radian, and driven half a metre, before its first distance came."""
    mapper = CooperativeMapper()
    feed = MapperFeed([Robot("a", start=(1.0, 2.0, 0.5 * math.pi))], mapper, {})
    offset = np.array([7.0, -3.0, 0.0])  # odometry need not begin at zero
    way = [(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.5, 0.0, 0.0), (0.5, 0.0, 1.0)]
    way += [(0.5, 0.0, 1.0 + 0.1 * k) for k in range(1, 160)]
    for k, pose in enumerate(way):
        wrapped = np.array([*pose[:2], math.remainder(pose[2], 2.0 * math.pi)]) + offset
        feed.add(0, MapperInput.ODOMETRY, odometry(k * STEP_NS, wrapped))
        if k >= 3:
            feed.add(0, MapperInput.LASER, laser(k * STEP_NS))
    number = feed.number(0)
    assert number is not None
    found = mapper.graph.states[0]
    assert found[:2] == pytest.approx([1.0, 2.5], abs=0.02)
    assert found[2] == pytest.approx(0.5 * math.pi + 1.0, abs=0.05)
