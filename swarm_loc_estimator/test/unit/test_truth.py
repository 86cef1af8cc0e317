"""Ground truth that was heard: by robot, in order of its stamps, and only what can be."""

from __future__ import annotations

import numpy as np
import pytest

from swarm_loc_estimator.common.messages.poses import encode_pose_stamped
from swarm_loc_estimator.offline.recorded_bag import read_truth
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

SWARM = Swarm((Robot("a"), Robot("b"), Robot("silent")))


def test_truth_is_read_by_robot_in_order_of_its_stamps() -> None:
    stamp_ns = np.array([30, 10, 20], np.int64)
    poses = np.array([[0.3, 0.0, 0.1], [0.1, -1.0, 3.0], [np.nan, 0.0, 0.0]])
    messages = encode_pose_stamped("map", stamp_ns, poses)
    tracks = read_truth(SWARM, {"b": messages, "a": [messages[1], b"cut off"], "silent": []})
    assert set(tracks) == {"a", "b"}
    assert tracks["a"].stamp_ns.tolist() == [10]
    assert tracks["b"].stamp_ns.tolist() == [10, 30]
    assert tracks["b"].pose == pytest.approx(poses[[1, 0]])
