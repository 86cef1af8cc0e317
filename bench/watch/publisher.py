"""Publish what an estimator would of a wandering swarm, stamped by the wall clock: python -m ... SWARM_FILE.

Poses twenty times a second, sightings of neighbours five times, diagnostics once a second; a thousand robots
cost a small part of a core, so that a page can be measured without an estimator beside it.
"""

import math
import sys
import time
from pathlib import Path

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.poses import SwarmPosesEncoder
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.sightings import Sightings, encode_sightings
from swarm_loc_msgs.msg import SwarmPoses, SwarmSightings

PERIOD_S = 0.05
_SIGHTINGS_EVERY, _DIAGNOSTICS_EVERY = 4, 20
_VALUES = 24
_SPACING_M = 0.5


def homes(robots: int) -> FloatArray:
    """(robots, 2) middles of a square grid [m]."""
    side = math.ceil(math.sqrt(robots))
    k = np.arange(robots)
    return _SPACING_M * np.column_stack([k % side, k // side]).astype(float)


def main() -> None:
    """Publish until a signal ends the process."""
    # the topics of an estimator
    names = [robot.name for robot in load_swarm(Path(sys.argv[1])).robots]
    rclpy.init()
    node = rclpy.create_node("estimator")
    poses = node.create_publisher(SwarmPoses, "swarm/poses", QoSProfile(depth=10))
    sightings = node.create_publisher(SwarmSightings, "swarm/sightings", QoSProfile(depth=10))
    diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))
    encoder, places, n = SwarmPosesEncoder(names, "map"), homes(len(names)), len(names)
    # robots on circles, and what stays as it is
    random = np.random.default_rng(1)
    phase, speed = random.uniform(-math.pi, math.pi, n), random.uniform(0.2, 0.6, n)
    covariance = np.tile(np.diag([4e-4, 1e-4, 1e-3]), (n, 1, 1))
    status = np.where(random.random(n) < 0.9, 1, 4).astype(np.uint8)
    seen = Sightings(
        np.arange(n, dtype=np.int32).repeat(2),
        ((np.arange(n)[:, None] + [1, math.ceil(math.sqrt(n))]) % n).astype(np.int32).reshape(-1),
        np.where(random.random(2 * n) < 0.9, 1, 2).astype(np.uint8),
        np.ones(2 * n, np.float32),
        np.full(2 * n, 0.2, np.float32),
    )
    report = serialized_diagnostics(names)
    # publish at a fixed rate
    began_s, count = time.monotonic(), 0
    while rclpy.ok():
        count += 1
        time.sleep(max(0.0, began_s + count * PERIOD_S - time.monotonic()))
        angle = phase + speed * count * PERIOD_S
        at = places + 0.15 * np.column_stack([np.cos(angle), np.sin(angle)])
        pose, now_ns = np.column_stack([at, angle + math.pi / 2.0]), time.time_ns()
        poses.publish(encoder.encode(now_ns, pose, covariance, np.full(n, 0.3), status, status > 0))
        if count % _SIGHTINGS_EVERY == 0:
            sightings.publish(encode_sightings("map", now_ns, seen))
        if count % _DIAGNOSTICS_EVERY == 0:
            diagnostics.publish(report)


def serialized_diagnostics(names: list[str]) -> bytes:
    """As much as the estimator tells of each robot."""
    values = [KeyValue(key=f"figure {k} [1]", value="0.1234") for k in range(_VALUES)]
    values.append(KeyValue(key="NIS mean", value="1.9"))
    told = [DiagnosticStatus(name=f"estimator: {name}", message="tracked", values=values) for name in names]
    data: bytes = serialize_message(DiagnosticArray(status=told))
    return data


if __name__ == "__main__":
    main()
