"""Simulated sensors as messages: each says what it measures of a true world, how often and how late.

Noise and mounts are those of the description. Errors that last, such as biases of radios, are drawn from its
standard deviations and hidden. No ROS here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from swarm_loc_drivers.sim.pushbot.floor_plan import ray_distance
from swarm_loc_drivers.sim.room.world import VIEW, RoomWorld
from swarm_loc_drivers.sim.worlds import WorldError
from swarm_loc_estimator import CONTENT_POSE, FROM_OPTICAL
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.messages.cdr import (
    DETECTIONS,
    IMU,
    LASER_SCAN,
    ODOMETRY,
    POSE_STAMPED,
    POSE_WITH_COVARIANCE,
    RANGE,
    RANGES,
    TRANSFORMS,
    encode,
)
from swarm_loc_estimator.common.messages.detections import blank_detections, encode_detections
from swarm_loc_estimator.common.messages.poses import (
    encode_fix,
    encode_odometry,
    encode_pose_stamped,
    position_and_quaternion,
)
from swarm_loc_estimator.swarm.error_models import SingleLidar
from swarm_loc_estimator.swarm.swarm import BODY, BODY_TOPIC, Anchor, Face, FixedCamera, UwbDevice

Message = tuple[str, bytes]  # Topic, serialized message


class SimulatedSensor:
    """One kind of sensor of a swarm; without `topics` the swarm has none of it.

    Args:
        world: Whose true state it measures.
        rng: Of its noise and hidden errors.
    """

    message_type: ClassVar[str]
    rate_hz: ClassVar[float]
    late_s: ClassVar[float] = 0.02

    def __init__(self, world: RoomWorld, rng: np.random.Generator) -> None:
        self._world, self._rng = world, rng
        self._period_ns, self._late_ns = round(1e9 / self.rate_hz), round(1e9 * self.late_s)
        self._due_ns = world.now_ns + self._period_ns
        self.topics = self._prepared()

    def messages(self) -> Iterator[tuple[int, Message]]:
        """What it measures now, if it is due, each with its time of arrival [ns]."""
        if self._world.now_ns >= self._due_ns:
            self._due_ns += self._period_ns
            for message in self._measure():
                yield self._world.now_ns + self._late_ns, message

    def _prepared(self) -> list[str]:
        """Its topics, after hidden errors were drawn."""
        raise NotImplementedError

    def _measure(self) -> Iterator[Message]:
        """The messages of now."""
        raise NotImplementedError

    def _noise(self, *sigma: float) -> FloatArray:
        return np.array(sigma) * self._rng.standard_normal(len(sigma))


class ReportedMotion(SimulatedSensor):
    """Reports the motion as it was commanded."""

    message_type, rate_hz = ODOMETRY, 20.0

    def _prepared(self) -> list[str]:
        swarm = self._world.swarm
        return [swarm.topic(one.name, "odom") for one in swarm.robots if not one.stands]

    def _measure(self) -> Iterator[Message]:
        world = self._world
        moving = [k for k, robot in enumerate(world.swarm.robots) if not robot.stands]
        for topic, k in zip(self.topics, moving, strict=True):
            name, (speed, turn_rate) = world.swarm.robots[k].name, world.velocities[k]
            twist = np.array([[speed, 0.0, turn_rate]])
            stamp, pose = np.array([world.now_ns]), world.reported[k : k + 1]
            yield topic, encode_odometry(f"{name}/odom", f"{name}/base_link", stamp, pose, twist)[0]


class Gyroscope(SimulatedSensor):
    """Measures turn rates, mean ones since the last message, with a bias."""

    message_type, rate_hz, late_s = IMU, 50.0, 0.005

    def _prepared(self) -> list[str]:
        swarm = self._world.swarm
        self._robots = [k for k, robot in enumerate(swarm.robots) if robot.imu.is_used]
        sigmas = [[one.imu.turn_bias_sigma, one.imu.turn_scale_sigma] for one in swarm.robots]
        self._bias, self._scale = self._world.hidden(self._rng, sigmas).T
        self._before = self._world.poses
        mounts = [Rotation.from_euler("ZYX", [0.0, one.imu.pitch, one.imu.roll]) for one in swarm.robots]
        self._up = np.array([one.inv().apply([0.0, 0.0, 1.0]) for one in mounts])
        return [swarm.topic(swarm.robots[k].name, "imu") for k in self._robots]

    def _measure(self) -> Iterator[Message]:
        world = self._world
        turned = se2.wrap_angle(world.poses[:, 2] - self._before[:, 2]) * self.rate_hz
        self._before = world.poses
        for topic, k in zip(self.topics, self._robots, strict=True):
            imu = world.swarm.robots[k].imu
            rate = (turned[k] - imu.turn_bias - self._bias[k]) / (imu.turn_scale * (1.0 + self._scale[k]))
            rate += self._noise(imu.turn_noise_density * math.sqrt(self.rate_hz))[0]
            header = {"stamp": world.now_ns, "frame_id": f"{world.swarm.robots[k].name}/imu_link"}
            velocity = dict(zip("xyz", (rate * self._up[k]).tolist(), strict=True))
            fields = {"header": header, "angular_velocity": velocity}
            yield topic, encode({**fields, "orientation_covariance": [-1.0] + [0.0] * 8}, IMU)


class Lidar(SimulatedSensor):
    """Sweeps once around between two messages; walls and the bodies of other robots are seen.

    A mount that the description does not say is that of a TurtleBot 4, which static transforms tell.
    """

    message_type, rate_hz = LASER_SCAN, 5.0
    _BEAMS, _MOUNT = 360, (-0.04, 0.0, 0.5 * math.pi)

    def _prepared(self) -> list[str]:
        swarm, keys = self._world.swarm, {f"lidar.{key}" for key in ("x", "y", "yaw")}
        self._lidars: list[tuple[int, SingleLidar]] = []
        self._frames, topics, mounts = [], [], []
        for k, robot in enumerate(swarm.robots):
            for topic, lidar in robot.lidar.all.items() if robot.lidar.is_used else ():
                is_first = lidar is robot.lidar
                self._lidars.append((k, lidar))
                self._frames.append(f"{robot.name}/{'laser' if is_first else f'{topic}_laser'}")
                topics.append(swarm.topic(robot.name, topic))
                is_unknown = is_first and not keys & robot.said
                mounts.append(self._MOUNT if is_unknown else (lidar.x, lidar.y, lidar.yaw))
        self._mounts = np.array(mounts).reshape(-1, 3)
        self._track = [self._world.poses]  # Of each step of the sweep
        return topics

    def messages(self) -> Iterator[tuple[int, Message]]:
        """As of each sensor; beams are measured where the robot is at each step."""
        self._track.append(self._world.poses)
        yield from super().messages()

    def transforms(self) -> bytes:
        """The tf2_msgs/TFMessage of all mounts."""
        rows = position_and_quaternion(self._mounts)
        rolls = Rotation.from_euler("X", [[lidar.roll] for _, lidar in self._lidars])
        rows[:, 3:] = (Rotation.from_quat(rows[:, 3:]) * rolls).as_quat()
        found = [
            {
                "header": {"stamp": self._world.now_ns, "frame_id": f"{frame.partition('/')[0]}/base_link"},
                "child_frame_id": frame,
                "transform": {
                    "translation": dict(zip("xyz", row[:3], strict=True)),
                    "rotation": dict(zip("xyzw", row[3:], strict=True)),
                },
            }
            for frame, row in zip(self._frames, rows.tolist(), strict=True)
        ]
        return encode({"transforms": found}, TRANSFORMS)

    def _measure(self) -> Iterator[Message]:
        world, step, share = self._world, 2.0 * math.pi / self._BEAMS, np.arange(self._BEAMS) / self._BEAMS
        track, self._track = np.unwrap(self._track, axis=0), self._track[-1:]
        steps, angles = np.arange(len(track)), 2.0 * math.pi * share - math.pi
        rows = zip(self.topics, self._lidars, self._mounts, self._frames, strict=True)
        for topic, (k, lidar), mount, frame in rows:
            poses = np.stack([np.interp(share * steps[-1], steps, one) for one in track[:, k].T], axis=-1)
            others = np.delete(world.poses[:, :2], k, axis=0)
            rays = se2.compose(poses, mount)
            radius = float(world.radii.max())
            ranges = cast(
                world.walls, others, radius, rays[:, :2], rays[:, 2] + math.cos(lidar.roll) * angles
            )
            sigma = lidar.range_sigma + lidar.range_sigma_per_m * np.where(np.isfinite(ranges), ranges, 0.0)
            ranges = ranges + sigma * self._rng.standard_normal(self._BEAMS)
            ranges[ranges > lidar.max_range] = math.inf
            fields = {
                "header": {"stamp": world.now_ns - self._period_ns, "frame_id": frame},
                "angle_min": -math.pi,
                "angle_max": math.pi - step,
                "angle_increment": step,
                "time_increment": 1.0 / self.rate_hz / self._BEAMS,
                "scan_time": 1.0 / self.rate_hz,
                "range_min": max(0.05, lidar.min_range),
                "range_max": lidar.max_range,
                "ranges": ranges.astype(np.float32),
            }
            yield topic, encode(fields, LASER_SCAN)


@cached_njit
def cast(
    walls: FloatArray, discs: FloatArray, radius: float, places: FloatArray, angles: FloatArray
) -> FloatArray:
    """Distances (B,) to walls (S, 4) or discs (D, 2) from places (B, 2) along angles (B,)."""
    found = np.empty(len(angles))
    for k in range(len(angles)):
        found[k] = ray_distance(walls, discs, radius, places[k, 0], places[k, 1], angles[k])
    return found


class Radios(SimulatedSensor):
    """Each radio ranges with one other device at a time, in turn; biases of both ends are added."""

    message_type, rate_hz = RANGE, 5.0

    def _prepared(self) -> list[str]:
        world, swarm = self._world, self._world.swarm
        self._robots = [k for k, robot in enumerate(swarm.robots) if robot.uwb is not None]
        radios = [robot.uwb for robot in swarm.robots if robot.uwb is not None]
        self._devices: list[UwbDevice | Anchor] = [*radios, *swarm.anchors]
        if len(self._devices) < 2:
            return []
        self._bias = [one.range_bias for one in self._devices]
        self._bias += world.hidden(self._rng, [one.range_bias_sigma for one in self._devices])
        self._hidden = world.hidden(self._rng, [[one.position_sigma] * 2 for one in swarm.anchors])
        self._turn = 0
        if not swarm.range_topic:
            self.message_type = RANGES  # type: ignore[misc]  # of the robot's own radio
            return [swarm.topic(swarm.robots[k].name, "ranges") for k in self._robots]
        return [self._pair(a, b) for a in range(len(radios)) for b in range(a + 1, len(self._devices))]

    def _pair(self, one: int, other: int) -> str:
        """The topic of two devices, that of a robot first."""
        words = [self._devices[k].word for k in sorted((one, other))]
        return self._world.swarm.range_topic.format(**dict(zip(("from", "to"), words, strict=True)))

    def _measure(self) -> Iterator[Message]:
        world = self._world
        antennas = [one for one in self._devices if isinstance(one, UwbDevice)]
        mounts = np.array([(one.x, one.y, one.z) for one in antennas])
        places = np.column_stack(
            [se2.transform_points(world.poses[self._robots], mounts[:, :2]), mounts[:, 2]]
        )
        fixed = np.array([(one.x, one.y, one.z) for one in world.swarm.anchors]).reshape(-1, 3)
        fixed[:, :2] += self._hidden.reshape(-1, 2)
        places = np.concatenate([places, fixed])
        self._turn += 1
        for k, radio in enumerate(antennas):
            other = (k + 1 + self._turn % (len(places) - 1)) % len(places)
            true = math.dist(places[k], places[other])
            value = radio.range_scale * true + self._bias[k] + self._bias[other]
            value = max(0.0, value + self._noise(radio.range_sigma)[0])
            header = {"stamp": world.now_ns, "frame_id": world.swarm.robots[self._robots[k]].name}
            if world.swarm.range_topic:
                yield self._pair(k, other), encode({"header": header, "range": value}, RANGE)
            else:
                one = {"device": self._devices[other].address, "range": value}
                yield self.topics[k], encode({"header": header, "ranges": [one]}, RANGES)


class CeilingCameras(SimulatedSensor):
    """Detections of lying markers, as a detector makes them from images of 1280 columns and 60 degrees."""

    message_type, rate_hz, late_s = DETECTIONS, 5.0, 0.1
    _FOCAL_PX, _CORNER_PX, _TILT, _SEEN = 1108.0, 0.2, 0.05, 0.97

    def _prepared(self) -> list[str]:
        world, swarm = self._world, self._world.swarm
        sigmas = [[one.position_sigma] * 2 + [one.yaw_sigma] for one in swarm.cameras]
        self.offsets = world.hidden(self._rng, sigmas)
        faces = [(k, face) for k, robot in enumerate(swarm.robots) for face in robot.faces if face.lies]
        self._faces: Sequence[tuple[int, Face]] = faces
        return [swarm.topic(camera.name, "detections") for camera in swarm.cameras]

    def _measure(self) -> Iterator[Message]:
        for topic, camera, off in zip(self.topics, self._world.swarm.cameras, self.offsets, strict=True):
            seen = [one for owned in self._faces if (one := self._seen(camera, off, *owned)) is not None]
            rows = blank_detections([face.id for face, _, _ in seen], CONTENT_POSE)
            for row, (face, place, turn) in zip(rows, seen, strict=True):
                # a corner that is off by a pixel is off by so much on the marker's plane
                metres = self._CORNER_PX * place[2] / self._FOCAL_PX
                sigmas = [metres, metres, metres * place[2] / face.size, self._TILT, self._TILT]
                sigmas.append(metres / face.size)
                noise = self._noise(*sigmas)
                row["position"] = place + noise[:3]
                row["orientation"] = (Rotation.from_rotvec(noise[3:]) * turn).as_quat()
                row["covariance"] = np.diag(np.square(sigmas))
            yield topic, encode_detections(f"{camera.name}/optical", self._world.now_ns, rows)

    def _seen(
        self, camera: FixedCamera, off: FloatArray, robot: int, face: Face
    ) -> tuple[Face, FloatArray, Rotation] | None:
        """A face, where it is in the optical frame and how it is turned; None if it is not seen."""
        x, y, theta = self._world.poses[robot]
        yaw = camera.yaw + float(off[2])
        looks = Rotation.from_euler("ZYX", [yaw, camera.pitch, camera.roll])
        into = (looks * Rotation.from_matrix(FROM_OPTICAL)).inv()
        at = se2.transform_points(np.array([x, y, theta]), np.array([face.x, face.y]))
        away = [at[0] - camera.x - off[0], at[1] - camera.y - off[1], face.z - camera.z]
        place: FloatArray = into.apply(away)
        is_seen = place[2] > 0.0 and all(abs(place[k]) < VIEW[k] * place[2] for k in (0, 1))
        if not is_seen or self._rng.random() > self._SEEN:
            return None
        return face, place, into * Rotation.from_euler("Z", theta + (face.yaw or 0.0))


class MotionCapture(SimulatedSensor):
    """Poses of bodies as vrpn_mocap publishes them."""

    message_type, rate_hz = POSE_STAMPED, 30.0

    def _prepared(self) -> list[str]:
        swarm, localizer = self._world.swarm, self._world.swarm.localizer
        if localizer is None:
            return []
        if localizer.source != "pose":
            raise WorldError(
                f"localizer.source is '{localizer.source}', and simulated motion capture has only 'pose'."
            )
        self._stamp_late_ns = round(1e9 * localizer.latency_s)
        self._late_ns += self._stamp_late_ns
        pairs = (one.partition("=") for one in localizer.bodies)
        bodies = {robot or body: body for body, _, robot in pairs}
        self._offsets = {
            name: np.array([float(number) for number in numbers.split(",")])
            for name, _, numbers in (one.partition("=") for one in localizer.offsets)
        }
        pattern = localizer.topic or BODY_TOPIC
        names = [robot.name for robot in swarm.robots if robot.name in bodies or not bodies]
        self._robots = [swarm.index_of[name] for name in names]
        return [pattern.replace(BODY, bodies.get(name, name)).lstrip("/") for name in names]

    def _measure(self) -> Iterator[Message]:
        world, localizer = self._world, self._world.swarm.localizer
        if localizer is None:
            return
        for topic, k in zip(self.topics, self._robots, strict=True):
            offset = self._offsets.get(world.swarm.robots[k].name, np.zeros(3))
            sigma = localizer.position_sigma, localizer.position_sigma, localizer.heading_sigma
            pose = se2.compose(world.poses[k], offset) + self._noise(*sigma)
            stamp_ns = np.array([world.now_ns + self._stamp_late_ns])
            yield topic, encode_pose_stamped(localizer.source_frame or "map", stamp_ns, pose[None])[0]


class TrackedFixes(SimulatedSensor):
    """Fixes without covariance, of robots whose description has a sigma for these."""

    message_type, rate_hz = POSE_WITH_COVARIANCE, 10.0

    def _prepared(self) -> list[str]:
        swarm = self._world.swarm
        fixed = [] if swarm.localizer else [k for k, one in enumerate(swarm.robots) if one.fix.position_sigma]
        self._robots = fixed
        return [swarm.topic(swarm.robots[k].name, "fix") for k in fixed]

    def _measure(self) -> Iterator[Message]:
        world = self._world
        for topic, k in zip(self.topics, self._robots, strict=True):
            fix = world.swarm.robots[k].fix
            pose = world.poses[k] + self._noise(fix.position_sigma, fix.position_sigma, fix.heading_sigma)
            yield topic, encode_fix("map", world.now_ns, pose, np.zeros((3, 3)))


KINDS = (ReportedMotion, Gyroscope, Lidar, Radios, CeilingCameras, MotionCapture, TrackedFixes)


def sensors_of(world: RoomWorld) -> list[SimulatedSensor]:
    """The sensors of a swarm in its world; raises WorldError if one cannot be simulated."""
    seeds = np.random.default_rng([world.seed, 1]).spawn(len(KINDS))
    found = [kind(world, rng) for kind, rng in zip(KINDS, seeds, strict=True)]
    return [one for one in found if one.topics]
