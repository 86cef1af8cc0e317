"""Mounts of sensors by static transforms: chains of frames, optical frames, what the description says."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mapping_world import LIDAR, LidarRobot, room_map, static
from scipy.spatial.transform import Rotation
from test_lidar_in_map import CELL, sent, swarm_at

from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.cdr import LASER_SCAN, ODOMETRY, TRANSFORMS, encode
from swarm_loc_estimator.doctor.doctor import evidence_of_bag, examine, lines_of
from swarm_loc_estimator.mapping.map_file import save_map
from swarm_loc_estimator.offline.recorded_bag import unwatched
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.sensors.mounts import Mounts
from swarm_loc_estimator.swarm.error_models import ImuModel, LidarModel
from swarm_loc_estimator.swarm.swarm import CameraMount, Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm, save_swarm
from swarm_loc_estimator.timeline.estimator import Status

TURN = 0.5 * math.pi


def mounts_of(robot: Robot, frames: dict[str, str], *messages: bytes, topic: str = "tf_static") -> Mounts:
    """The mounts of a robot in a map, by the topics of its sensors and messages of transforms."""
    mounts = Mounts(Swarm((robot,), map=Path("map.yaml")))
    for message in messages:
        mounts.add_message(topic, message)
    for name, frame in frames.items():
        mounts.add_frame(mounts.topics[f"{robot.name}/{name}"], frame)
    return mounts


@pytest.mark.parametrize("prefix", ["", "a/", "/a/"])
@pytest.mark.parametrize("topic", ["tf_static", "a/tf_static", "/a/tf_static"])
def test_a_lidar_is_where_a_chain_of_joints_leads(prefix: str, topic: str) -> None:
    shell = (f"{prefix}base_link", f"{prefix}shell", (0.1, 0.0, 0.2), (TURN, 0.0, 0.0))
    lidar = (f"{prefix}shell", f"{prefix}laser", (0.05, 0.02, 0.0), (0.3, 0.0, math.pi))
    foot = (f"{prefix}base_footprint", f"{prefix}base_link", (0.5, 0.0, 0.05), (0.0, 0.0, 0.0))
    robot = Robot("a", lidar=LidarModel(range_sigma=0.01))
    mounts = mounts_of(robot, {"scan": f"{prefix}laser"}, static(lidar, foot), static(shell), topic=topic)
    found = mounts.described().robots[0].lidar
    assert (found.x, found.y) == pytest.approx((0.08, 0.05))
    assert (found.yaw, abs(found.roll)) == pytest.approx((TURN + 0.3, math.pi))
    assert found.range_sigma == 0.01
    assert mounts.differences() == []


def test_the_first_transform_to_a_frame_counts() -> None:
    """Else whoever publishes others by turns restarts the estimator again and again."""
    joints = [static(("base_link", "laser", (x, 0.0, 0.0), (0.0, 0.0, 0.0))) for x in (0.1, 0.2)]
    mounts = mounts_of(Robot("a", lidar=LidarModel(range_sigma=0.01)), {"scan": "laser"}, *joints)
    assert mounts.described().robots[0].lidar.x == 0.1


def test_each_lidar_of_a_robot_has_its_own_mount() -> None:
    robot = Robot("a", lidar=LidarModel(range_sigma=0.01, others={"rear": {"x": -0.1}}))
    joints = [
        ("base_link", "laser", (0.3, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ("base_link", "rear_laser", (-0.4, 0.2, 0.0), (math.pi, 0.0, 0.0)),
    ]
    mounts = mounts_of(robot, {"scan": "laser", "rear": "rear_laser"}, static(*joints))
    first, rear = mounts.described().robots[0].lidar.all.values()
    assert (first.x, first.y, first.yaw) == (0.3, 0.0, 0.0)
    assert (rear.x, rear.y, rear.yaw) == pytest.approx((-0.1, 0.2, math.pi))
    assert [(one.key, one.described) for one in mounts.differences()] == [("lidar.others.rear.x", -0.1)]
    assert any("others.rear.yaw 3.142" in remark for remark in mounts.remarks())


def test_the_description_wins_number_by_number_and_differences_are_named() -> None:
    robot = Robot("a", lidar=LidarModel(range_sigma=0.01, x=0.2), said=frozenset({"lidar.yaw"}))
    message = static(("base_link", "laser", (0.1, 0.3, 0.0), (TURN, 0.0, 0.0)))
    mounts = mounts_of(robot, {"scan": "laser"}, message)
    found = mounts.described().robots[0].lidar
    assert (found.x, found.y, found.yaw) == (0.2, 0.3, 0.0)
    assert [(one.key, one.described) for one in mounts.differences()] == [
        ("lidar.x", 0.2),
        ("lidar.yaw", 0.0),
    ]


def test_frames_that_lead_nowhere_change_nothing() -> None:
    robot = Robot("a", lidar=LidarModel(range_sigma=0.01))
    loop = static(("y", "laser", (1.0, 0.0, 0.0), (0.0,) * 3), ("laser", "y", (1.0, 0.0, 0.0), (0.0,) * 3))
    for frame, message in (("laser", loop), ("other", loop), ("laser", static())):
        assert mounts_of(robot, {"scan": frame}, message).described().robots[0] == robot


@pytest.mark.parametrize(("x", "w"), [(1e9, 1.0), (0.1, 1e200), (math.nan, 1.0), (0.1, math.inf)])
def test_joints_that_are_none_change_nothing(x: float, w: float) -> None:
    robot = Robot("a", lidar=LidarModel(range_sigma=0.01))
    joint = {"translation": {"x": x}, "rotation": {"w": w, "z": w}}
    header = {"frame_id": "base_link"}
    one = {"header": header, "child_frame_id": "laser", "transform": joint}
    mounts = mounts_of(robot, {"scan": "laser"}, encode({"transforms": [one]}, TRANSFORMS))
    assert mounts.described().robots[0] == robot


def test_cameras_and_imus_have_their_own_axes() -> None:
    """An optical frame looks along its z axis; of an IMU only what is level matters."""
    robot = Robot("a", camera=CameraMount(), imu=ImuModel(turn_noise_density=0.01))
    looks = Rotation.from_euler("ZYX", (0.4, 0.1, 0.0)) * Rotation.from_euler("ZYX", (-TURN, 0.0, -TURN))
    angles = tuple(looks.as_euler("ZYX").tolist())
    message = static(
        ("base_link", "camera_optical_frame", (0.1, 0.0, 0.3), angles),
        ("base_link", "imu", (0.0, 0.0, 0.0), (1.0, 0.2, 3.0)),
    )
    frames = {"detections": "camera_optical_frame", "imu": "imu"}
    found = mounts_of(robot, frames, message).described().robots[0]
    camera, imu = found.camera, found.imu
    assert camera is not None
    assert (camera.x, camera.z, camera.yaw, camera.pitch) == pytest.approx((0.1, 0.3, 0.4, 0.1))
    assert camera.roll == pytest.approx(0.0, abs=1e-9)
    assert (imu.pitch, imu.roll) == pytest.approx((0.2, 3.0))


def test_a_file_remembers_what_it_says(tmp_path: Path) -> None:
    path = tmp_path / "swarm.yaml"
    path.write_text("fileversion: 1\nrobots: {a: {lidar: {range_sigma: 0.01, yaw: 0.0}}}\n", encoding="utf-8")
    swarm = load_swarm(path)
    assert "lidar.yaw" in swarm.robots[0].said
    assert "lidar.x" not in swarm.robots[0].said
    save_swarm(swarm, path)
    assert "lidar.yaw" in load_swarm(path).robots[0].said


def test_a_bag_is_replayed_with_the_mounts_of_its_transforms(tmp_path: Path) -> None:
    room, _ = save_map(room_map(CELL), tmp_path / "room")
    until_ns = 4_000_000_000
    with BagWriter(tmp_path / "bag") as bag:
        for topic, kind in (("tf_static", TRANSFORMS), ("a/odom", ODOMETRY), ("a/scan", LASER_SCAN)):
            bag.add_topic(topic, kind)
        place, angles = (LIDAR.x, LIDAR.y, 0.2), (LIDAR.yaw, 0.0, 0.0)
        bag.write("tf_static", 0, static(("base_link", "a/base_scan", place, angles)))
        for topic, at_ns, data in sent(until_ns, seed=2):
            bag.write(topic, at_ns, data)
    swarm = swarm_at(room, LidarRobot.start + np.array([0.03, 0.0, 0.0]))
    bare = replace(LIDAR, x=0.0, y=0.0, yaw=0.0)
    without = replace(swarm, robots=(replace(swarm.robots[0], lidar=bare),))
    found, expected = replay(tmp_path / "bag", without), replay(tmp_path / "bag", swarm)
    assert found.status[-1, 0] == Status.TRACKED
    assert found.poses == pytest.approx(expected.poses, abs=1e-6, nan_ok=True)
    wrong = replace(swarm, robots=(replace(swarm.robots[0], lidar=replace(bare, yaw=-1.5)),))
    lines = [
        lines_of(examine(evidence_of_bag(tmp_path / "bag", one, 9.0, unwatched))) for one in (without, wrong)
    ]
    assert "lidar.yaw -1.5 in the description but 1.57 by tf_static" in lines[1][0]
    assert not any("tf_static" in one for one in lines[0])
    assert "Mount of a's lidar by tf_static: x 0.050, y -0.020, yaw 1.571." in found.remarks
