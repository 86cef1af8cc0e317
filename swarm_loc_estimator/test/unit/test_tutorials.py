"""The sensor of the tutorial: its code, word by word, with a bag that has its messages."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.bags.writer import BagWriter, typestore
from swarm_loc_estimator.common.messages.cdr import IMU
from swarm_loc_estimator.common.messages.poses import decode_pose_stamped
from swarm_loc_estimator.filter.models import MODELS
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.sensors.inputs import SENSORS
from swarm_loc_estimator.swarm.swarm_file import load_swarm

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "swarm_loc_estimator" / "doc" / "tutorials.md"
BAG = ROOT / "bags" / "eight_one_robot_fast"


@pytest.fixture
def compass() -> Iterator[dict[str, Any]]:
    """The names of the tutorial's code, whose sensor is known during a test."""
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    names: dict[str, Any] = {}
    exec(code, names)  # noqa: S102
    yield names
    del MODELS[SENSORS.pop("compass").model]


def with_compass(folder: Path, sigma: float) -> Path:
    """The bag with messages of a compass beside each true pose, and some that are not finite."""
    rng, types = np.random.default_rng(1), typestore().types
    with BagReader(BAG) as reader, BagWriter(folder) as writer:
        robot = load_swarm(BAG / "swarm.yaml").robots[0].name
        for topic in reader.topics:
            writer.add_topic(topic.name, topic.type)
        writer.add_topic(f"{robot}/compass", IMU)
        for number, (name, _, log_ns, data) in enumerate(reader.messages()):
            writer.write(name, log_ns, bytes(data))
            if not name.endswith("/ground_truth"):
                continue
            truth = decode_pose_stamped(bytes(data))
            half = 0.5 * (truth.pose[2] + sigma * rng.standard_normal())
            vector = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
            message: Any = types[IMU](
                types["std_msgs/msg/Header"](
                    types["builtin_interfaces/msg/Time"](*divmod(truth.stamp_ns, 10**9)), "map"
                ),
                types["geometry_msgs/msg/Quaternion"](0.0, 0.0, np.sin(half), np.cos(half)),
                np.zeros(9),
                vector,
                np.zeros(9),
                vector,
                np.zeros(9),
            )
            if number % 50 == 0:
                message.orientation.w = np.nan
            writer.write(f"{robot}/compass", log_ns, bytes(typestore().serialize_cdr(message, IMU)))
    return folder


def test_the_sensor_of_the_tutorial_improves_headings(tmp_path: Path, compass: dict[str, Any]) -> None:
    swarm = load_swarm(BAG / "swarm.yaml")
    bag = with_compass(tmp_path / "bag", compass["SIGMA"])
    before, after = replay(BAG, swarm), replay(bag, swarm)
    assert after.counters["messages on <robot>/compass"] > 1000
    assert after.counters["compass_non_finite"] > 3
    assert after.counters["measurements used"] > before.counters["measurements used"] + 1000
    assert after.overall.heading_rmse < 0.85 * before.overall.heading_rmse
    assert 1.0 < after.overall.nees < 4.5
