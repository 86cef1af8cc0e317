"""Messages of robots to the mapper, as they come."""

import math

import numpy as np
import pytest
from core_messages import odometry_bytes

from swarm_loc_estimator.common.messages.cdr import LASER, encode
from swarm_loc_estimator.mapping.mapper import CooperativeMapper
from swarm_loc_estimator.mapping.mapper_feed import MapperFeed, MapperInput
from swarm_loc_estimator.swarm.swarm import Robot

STEP_NS = 20_000_000
DISTANCE, SIGMA = 2.0, 0.05


def laser(stamp_ns: int) -> bytes:
    return encode({"header": {"stamp": stamp_ns}, "distance": DISTANCE, "sigma": SIGMA, "events": 1}, LASER)


def test_a_robot_joins_where_odometry_has_it_when_it_first_sees_something() -> None:
    """It had turned by a radian, and driven half a metre, before its first distance came."""
    mapper = CooperativeMapper()
    feed = MapperFeed([Robot("a", start=(1.0, 2.0, 0.5 * math.pi))], mapper, {})
    offset = np.array([7.0, -3.0, 0.0])  # odometry need not begin at zero
    way = [(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.5, 0.0, 0.0), (0.5, 0.0, 1.0)]
    way += [(0.5, 0.0, 1.0 + 0.1 * k) for k in range(1, 160)]
    for k, pose in enumerate(way):
        wrapped = np.array([*pose[:2], math.remainder(pose[2], 2.0 * math.pi)]) + offset
        feed.add(0, MapperInput.ODOMETRY, odometry_bytes("a", k * STEP_NS, wrapped))
        if k >= 3:
            feed.add(0, MapperInput.LASER, laser(k * STEP_NS))
    number = feed.number(0)
    assert number is not None
    found = mapper.graph.states[0]
    assert found[:2] == pytest.approx([1.0, 2.5], abs=0.02)
    assert found[2] == pytest.approx(0.5 * math.pi + 1.0, abs=0.05)
