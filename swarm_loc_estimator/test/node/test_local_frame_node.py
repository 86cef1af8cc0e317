"""The estimator node without a map: poses are in the frame of a robot until landmarks come."""

from pathlib import Path

import numpy as np
import pytest
from node_world import (
    LANDMARKS,
    SECOND,
    SETTINGS,
    STEP_NS,
    SWARM_YAML,
    T0_NS,
    Robots,
    Ros,
    detection_bytes,
    odometry_bytes,
    overrides,
    sight,
    stamp_ns,
    xytheta,
)
from rcl_interfaces.msg import Log
from tf2_msgs.msg import TFMessage

from swarm_loc_estimator.nodes.estimator_node import EstimatorNode


def test_poses_without_a_map_are_in_a_frame_of_a_robot_until_landmarks_come(
    ros: Ros, swarm_file: Path
) -> None:
    swarm_file.write_text(SWARM_YAML.replace(", start: {x: 0.0, y: 0.0, theta: 0.0}", ""), encoding="utf-8")
    parameters = overrides(swarm_file=str(swarm_file), use_sim_time=True, origin_after_s=0.5, **SETTINGS)
    ros.add(EstimatorNode(parameter_overrides=parameters))
    robots, alpha, beta = Robots(ros), (1.0, 1.0, np.pi), (0.0, 1.0, 0.0)
    robots.wait_for_estimator()
    transforms, log = ros.listen(TFMessage, "/tf"), ros.listen(Log, "/rosout")
    ros.until(lambda: ros.tester.count_publishers("/tf"))
    now_ns = T0_NS

    def step(ids: tuple[int, ...]) -> int:
        nonlocal now_ns
        now_ns, heard = now_ns + STEP_NS, len(robots.poses)
        robots.tell_time(now_ns)
        robots.odometry("alpha", odometry_bytes("alpha", now_ns))
        robots.odometry("beta", odometry_bytes("beta", now_ns))
        seen = sight(alpha, ids, {2: beta, **LANDMARKS})
        robots.detections("alpha", detection_bytes("alpha", now_ns, seen))
        ros.until(lambda: any(stamp_ns(pose) == now_ns for pose in robots.poses[heard:]))
        return now_ns

    while robots.poses[-1:] == [] or robots.poses[-1].header.frame_id == "map":
        assert step((2,)) < T0_NS + 20 * SECOND
    frame = robots.poses[-1].header.frame_id
    assert frame in {"alpha/start", "beta/start"}
    while not robots.located("beta"):
        assert step((2,)) < T0_NS + 20 * SECOND
    ros.until(lambda: transforms and stamp_ns(transforms[-1].transforms[0]) == now_ns)
    assert {one.header.frame_id for one in transforms[-1].transforms} == {frame}
    ros.until(lambda: any(f"poses are relative to {frame[:-6]}, in '{frame}'" in one.msg for one in log))
    while robots.poses[-1].header.frame_id != "map":
        assert step((2, *LANDMARKS)) < T0_NS + 40 * SECOND
    assert xytheta(robots.newest("beta")) == pytest.approx(beta, abs=0.1)
    ros.until(lambda: any(f"poses are in 'map' now, no longer in '{frame}'" in one.msg for one in log))
