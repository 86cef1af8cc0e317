"""Mounts of sensors from static transforms, as of a URDF's fixed joints, where the description says none.

The frame of a sensor is that of its messages. Transforms lead from it to `base_link` of its robot, with or
without the name of the robot before it. What the description says of a mount wins, number by number.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.health import listed
from swarm_loc_estimator.common.messages.cdr import TRANSFORMS, decode
from swarm_loc_estimator.sensors.camera import FROM_OPTICAL
from swarm_loc_estimator.sensors.inputs import SENSORS, InputTopic, input_topics
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

TF_STATIC = "tf_static"
_BASES = ("base_link", "base_footprint", "base")  # Frames that stand for the robot, the best first
_SECTIONS: Mapping[str, tuple[str, tuple[str, ...]]] = MappingProxyType(
    {
        "scans": ("lidar", ("x", "y", "yaw", "roll")),
        "detections": ("camera", ("x", "y", "z", "yaw", "pitch", "roll")),
        "imu": ("imu", ("roll", "pitch")),
        "ranges": ("uwb", ("x", "y", "z")),
    }
)
"""Sensor -> section of the description with its mount, and the numbers of this mount."""
_APART = MappingProxyType({"x": 0.03, "y": 0.03, "z": 0.03, "yaw": 0.09, "pitch": 0.09, "roll": 0.09})
"""Differences of a description from transforms that are named [m], [rad]."""
_MAX_FRAMES, _MAX_CHAIN, _FAR = 10_000, 50, 1e3  # Numbers of `_FAR` or more, or NaN, are no joint of a robot


class _Joint(NamedTuple):
    """A static transform from a frame to its parent."""

    parent: str
    rotation: FloatArray  # (3, 3)
    place: FloatArray  # (3,) [m]


class Said(NamedTuple):
    """A number of a mount that transforms and the description say differently."""

    robot: str
    key: str  # Such as "lidar.yaw" or "lidar.others.scan_rear.yaw"
    described: float
    by_transforms: float


class Mounts:
    """Collects static transforms and the frames of sensors of a described swarm."""

    def __init__(self, swarm: Swarm) -> None:
        self._swarm = swarm
        self._joints: dict[str, dict[str, _Joint]] = {}  # By the prefix of the topic
        self._frames: dict[tuple[int, str, int], str] = {}  # Of a sensor of a robot, and its `device`
        self.topics: dict[str, InputTopic] = {
            topic.name: topic
            for topic in input_topics(swarm, maps=True)
            if topic.kind.name in _SECTIONS and 0 <= topic.robot < len(swarm.robots)
            if getattr(swarm.robots[topic.robot], _SECTIONS[topic.kind.name][0]) is not None
        }

    def add_transforms(self, topic: str, message: Any) -> None:
        """Add a decoded tf2_msgs/TFMessage of `tf_static`, or of one below the namespace of a robot.

        The first transform to a frame counts: a later one must not restart the estimator.
        """
        joints = self._joints.setdefault(topic.strip("/").removesuffix(TF_STATIC), {})
        for one in message.transforms:
            turn, place = one.transform.rotation, one.transform.translation
            quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
            numbers = [*quaternion, place.x, place.y, place.z]
            if (np.abs(numbers) < _FAR).all() and quaternion.any() and len(joints) < _MAX_FRAMES:
                parent, child = (name.lstrip("/") for name in (one.header.frame_id, one.child_frame_id))
                joints.setdefault(
                    child, _Joint(parent, Rotation.from_quat(quaternion).as_matrix(), np.array(numbers[4:]))
                )

    def add_frame(self, topic: InputTopic, frame: str) -> None:
        """Add the frame of a sensor's messages."""
        self._frames[topic.robot, topic.kind.name, topic.device] = frame.lstrip("/")

    def add_message(self, topic: str, data: bytes) -> None:
        """Add a serialized message of transforms or of a sensor; what is no whole message is left out."""
        with suppress(ValueError, LookupError, struct.error):
            if topic in self.topics:
                one = self.topics[topic]
                self.add_frame(one, SENSORS[one.kind.name].decode(data).frame_id)
            else:
                self.add_transforms(topic, decode(data, TRANSFORMS))

    def described(self) -> Swarm:
        """The swarm with all mounts, where the description says nothing of them."""
        robots = list(self._swarm.robots)
        for index, section, key, value in self._known():
            if _said(self._swarm.robots[index], section, key) is None:
                model: Any = getattr(robots[index], section)
                changed: Any = {section: _changed(model, key, value)}
                robots[index] = replace(robots[index], **changed)
        return replace(self._swarm, robots=tuple(robots))

    def differences(self) -> list[Said]:
        """What the description says otherwise."""
        found = []
        for index, section, key, value in self._known():
            robot = self._swarm.robots[index]
            said = _said(robot, section, key)
            described = 0.0 if said is None else said
            off, number = value - described, key.rpartition(".")[2]
            if number not in ("x", "y", "z"):
                off = math.remainder(off, 2.0 * math.pi)
            if said is not None and abs(off) > _APART[number]:
                found.append(Said(robot.name, f"{section}.{key}", described, value))
        return found

    def remarks(self) -> list[str]:
        """A sentence for each mount that is not as described."""
        after: dict[tuple[int, str], list[str]] = {}
        for index, section, key, value in self._known():
            if _said(self._swarm.robots[index], section, key) is None and value:
                after.setdefault((index, section), []).append(f"{key} {value:.3f}")
        names = [robot.name for robot in self._swarm.robots]
        return [
            f"Mount of {names[index]}'s {section} by tf_static: {listed(numbers)}."
            for (index, section), numbers in after.items()
        ]

    def _known(self) -> Iterator[tuple[int, str, str, float]]:
        """Index of the robot, section, key and value of all numbers of mounts that transforms tell."""
        for (index, sensor, device), frame in sorted(self._frames.items()):
            mount = self._mount(index, frame)
            if mount is None:
                continue
            section, keys = _SECTIONS[sensor]
            inside = f"others.{list(self._swarm.robots[index].lidar.all)[device]}." if device else ""
            if section == "camera" and "optical" in frame:
                mount = mount._replace(rotation=mount.rotation @ FROM_OPTICAL.T)
            r = mount.rotation
            angles = {
                "yaw": math.atan2(r[1, 0], r[0, 0]),
                "pitch": -math.asin(min(1.0, max(-1.0, r[2, 0]))),
                "roll": math.atan2(r[2, 1], r[2, 2]),
            }
            values = dict(zip(("x", "y", "z"), mount.place.tolist(), strict=True)) | angles
            for key in keys:
                yield index, section, inside + key, round(values[key], 9) + 0.0

    def _mount(self, robot: int, frame: str) -> _Joint | None:
        """The pose of a frame in that of its robot; None if no transforms lead there."""
        own = self._joints.get(f"{self._swarm.robots[robot].name}/", {})
        joints = self._joints.get("", {}) | own
        found: dict[str, _Joint] = {}
        here = _Joint(frame, np.eye(3), np.zeros(3))
        for _ in range(_MAX_CHAIN):
            found.setdefault(here.parent.rpartition("/")[2], here)
            joint = joints.get(here.parent)
            if joint is None:
                break
            place = joint.place + joint.rotation @ here.place
            here = _Joint(joint.parent, joint.rotation @ here.rotation, place)
        return next((found[base] for base in _BASES if base in found), None)


def _said(robot: Robot, section: str, key: str) -> float | None:
    """A number that the description says; None: it does not."""
    model: Any = getattr(robot, section)
    others, _, number = key.rpartition(".")
    if others:
        return robot.lidar.others[others.partition(".")[2]].get(number)
    default = type(model).__dataclass_fields__[key].default
    is_said = f"{section}.{key}" in robot.said or getattr(model, key) != default
    return float(getattr(model, key)) if is_said else None


def _changed(model: Any, key: str, value: float) -> Any:
    """A section with a number."""
    others, _, number = key.rpartition(".")
    if not others:
        return replace(model, **{key: value})
    topic = others.partition(".")[2]
    return replace(model, others={**model.others, topic: {**model.others[topic], number: value}})
