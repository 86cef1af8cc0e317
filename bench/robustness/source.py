"""A process that publishes odometry and images of robots in real time, from messages serialized before.

Robots drive circles on the grid of `bench-scaling`, so that what their cameras see repeats: only the stamps
of images are written again. The true pose is a function of the stamp, unless that was shifted.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from multiprocessing import get_context
from multiprocessing.connection import Connection

import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

from bench.scenarios.bags import as_detections
from bench.scenarios.lived_run import ODOMETRY_DTYPE, SimulatedRun
from bench.scenarios.sightings import schedule_exposures
from bench.shared.grid import (
    HOME_RADIUS,
    ODOMETRY,
    ODOMETRY_RATE_HZ,
    VIEW,
    Shape,
    describe,
    observe_neighbours,
)
from swarm_loc_drivers.sim.differential_drive import twist_of, wheel_paths
from swarm_loc_drivers.sim.run import Trajectories
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.detections import encode_detections
from swarm_loc_estimator.common.messages.poses import encode_odometry
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_msgs.msg import MarkerDetectionArray

LAP_NS = 10_000_000_000
_STEP_NS = round(1e9 / ODOMETRY_RATE_HZ)
_TICK_S = 0.005
_CLOCK_NS = 10_000_000
_DEPTH = 1000
_ROBOTS_PER_NODE = 5
_EPOCH_LAPS = 1000  # Clocks may jump back by an hour or two
_WAKE_S = 0.1
_VIEW = replace(VIEW, farthest=3.0)  # Half of the swarm in each image: messages are few, the work is much
_STAMP = slice(4, 12)  # Of a header, after the encapsulation
_PATIENCE_S = 600.0


@dataclass(frozen=True)
class SourceSettings:
    """Settings of a source."""

    robots: int
    image_rate_hz: float  # Of each robot
    seed: int = 1
    is_clock: bool = False  # Whether its time is that of /clock; else stamps are of the computer's clock


class Circles:
    """Robots on circles about their homes."""

    def __init__(self, settings: SourceSettings) -> None:
        rng = np.random.default_rng(settings.seed)
        homes = Shape.BORDER.homes(settings.robots)
        self._homes, self._phase = homes, rng.uniform(-np.pi, np.pi, settings.robots)
        start = self.at(np.zeros(1, dtype=np.int64))[0]
        self.swarm: Swarm = describe(rng, start, Shape.BORDER.landmarks(homes))

    def at(self, stamp_ns: IntArray) -> FloatArray:
        """True poses (T, N, 3) at stamps (T,) that are not shifted; they repeat with each lap."""
        turned = (stamp_ns % LAP_NS)[:, None] * (2.0 * np.pi / LAP_NS) + self._phase
        place = self._homes + HOME_RADIUS * np.stack([np.sin(turned), -np.cos(turned)], axis=-1)
        return np.concatenate([place, se2.wrap_angle(turned)[..., None]], axis=-1)


@dataclass(frozen=True)
class Sent:
    """What a source has published."""

    odometry: int  # Messages
    images: int  # Messages
    detections: int  # In these images
    late_s: float  # How late the latest message was


class _Images:
    """Serialized images of a lap in order of their arrival."""

    def __init__(self, settings: SourceSettings, circles: Circles) -> None:
        rng = np.random.default_rng([settings.seed, 1])
        stamps = np.arange(0, LAP_NS + 1, 10_000_000)
        truth = Trajectories(stamps, circles.at(stamps))
        exposures = schedule_exposures(rng, settings.robots, settings.image_rate_hz, 0, LAP_NS - 1)
        frames, sightings = observe_neighbours(rng, circles.swarm, truth, exposures, Shape.BORDER, _VIEW)
        run = SimulatedRun(circles.swarm, truth, np.zeros(0, ODOMETRY_DTYPE), frames, sightings)
        detections = as_detections(run)
        self.arrival_ns, self.stamp_ns = frames["arrival_ns"].tolist(), frames["stamp_ns"].tolist()
        self.robot, self.count = frames["robot"].tolist(), frames["count"].tolist()
        self.data = [
            encode_detections(
                f"{circles.swarm.robots[robot].name}/camera", 0, detections[first : first + count]
            )
            for robot, _, _, first, count in frames.tolist()
        ]


class _Source:
    """Publishes in time with a steady clock."""

    def __init__(self, settings: SourceSettings, node: Node) -> None:
        self._circles = Circles(settings)
        self._images = _Images(settings, self._circles)
        self._rng = np.random.default_rng([settings.seed, 2])
        self._names = [robot.name for robot in self._circles.swarm.robots]
        qos = QoSProfile(depth=_DEPTH)
        nodes = [node, *(_node(f"robots{k}") for k in range(settings.robots // _ROBOTS_PER_NODE))]
        self._odometry: list[Publisher] = []
        self._detections: list[Publisher] = []
        for k, name in enumerate(self._names):
            own = nodes[k // _ROBOTS_PER_NODE]
            self._odometry.append(own.create_publisher(Odometry, f"{name}/odom", qos))
            self._detections.append(own.create_publisher(MarkerDetectionArray, f"{name}/detections", qos))
        self._clock = node.create_publisher(Clock, "/clock", qos) if settings.is_clock else None
        self._pose = np.zeros((settings.robots, 3))
        self._epoch_ns = _EPOCH_LAPS * LAP_NS
        self._shift_ns = np.zeros(settings.robots, dtype=np.int64)  # Of each robot's stamps
        self._odometry_ns, self._clock_ns, self._next, self._laps = 0, 0, 0, 0
        self._images_sent = self._detections_sent = self._odometry_sent = 0
        self._late_s = 0.0

    @property
    def are_heard(self) -> bool:
        """Whether all topics have a subscriber."""
        clock = [] if self._clock is None else [self._clock]
        return all(one.get_subscription_count() for one in (*clock, *self._odometry, *self._detections))

    def run(self, orders: Connection) -> Sent:
        """Publish until the order "stop"; others shift the stamps of all robots, or of one, by nanoseconds.

        By the computer's clock the first lap begins at the next multiple of a lap.
        """
        begin_ns = time.monotonic_ns()
        if self._clock is None:
            self._epoch_ns = (time.time_ns() // LAP_NS + 1) * LAP_NS
            begin_ns += self._epoch_ns - time.time_ns()
        while True:
            now_ns = time.monotonic_ns() - begin_ns
            self._publish_clock(now_ns)
            self._publish_odometry(now_ns)
            self._publish_images(now_ns)
            if orders.poll(_TICK_S):
                order = orders.recv()
                if order == "stop":
                    return Sent(self._odometry_sent, self._images_sent, self._detections_sent, self._late_s)
                robot, by_ns = order
                if robot is None:
                    self._epoch_ns += by_ns
                else:
                    self._shift_ns[robot] += by_ns
                orders.send(self._epoch_ns + now_ns)

    def _publish_clock(self, now_ns: int) -> None:
        if self._clock is not None and now_ns >= self._clock_ns:
            self._clock_ns = now_ns + _CLOCK_NS
            self._clock.publish(Clock(clock=Time(nanoseconds=self._epoch_ns + now_ns).to_msg()))

    def _publish_odometry(self, now_ns: int) -> None:
        """Steps of all robots until now."""
        step_s = 1e-9 * _STEP_NS
        rate = 2e9 * np.pi / LAP_NS
        separation = ODOMETRY.wheel_separation
        while self._odometry_ns <= now_ns:
            stamp_ns = self._epoch_ns + self._odometry_ns
            paths = wheel_paths(np.array(HOME_RADIUS * rate), np.array(rate), separation, step_s)
            noise = self._rng.standard_normal((len(self._names), 2))
            driven = twist_of(paths + np.sqrt(ODOMETRY.wheel_noise * np.abs(paths)) * noise, separation)
            self._pose = se2.compose(self._pose, se2.exp(driven))
            for k, name in enumerate(self._names):
                stamps = np.array([stamp_ns + self._shift_ns[k]])
                twist = driven[k : k + 1] / step_s
                (data,) = encode_odometry(
                    f"{name}/odom", f"{name}/base_link", stamps, self._pose[k : k + 1], twist
                )
                self._odometry[k].publish(data)
            self._odometry_sent += len(self._names)
            self._late_s = max(self._late_s, 1e-9 * (now_ns - self._odometry_ns))
            self._odometry_ns += _STEP_NS

    def _publish_images(self, now_ns: int) -> None:
        """Images that have arrived until now."""
        images, k = self._images, self._next
        while self._laps * LAP_NS + images.arrival_ns[k] <= now_ns:
            robot, count = images.robot[k], images.count[k]
            stamp_ns = self._epoch_ns + self._laps * LAP_NS + images.stamp_ns[k] + int(self._shift_ns[robot])
            data = images.data[k]
            stamp = struct.pack("<iI", *divmod(stamp_ns, 1_000_000_000))
            self._detections[robot].publish(data[: _STAMP.start] + stamp + data[_STAMP.stop :])
            self._images_sent, self._detections_sent = self._images_sent + 1, self._detections_sent + count
            k += 1
            if k == len(images.data):
                k, self._laps = 0, self._laps + 1
        self._next = k


def _node(name: str) -> Node:
    """A node of a participant of its own, whose shared memory it fills alone."""
    context = rclpy.Context()
    rclpy.init(args=[], context=context)
    return rclpy.create_node(name, context=context)


def _serve(settings: SourceSettings, orders: Connection) -> None:
    source = _Source(settings, _node("source"))
    until_s = time.monotonic() + _PATIENCE_S
    while not source.are_heard and time.monotonic() < until_s:
        time.sleep(_WAKE_S)
    with suppress(EOFError):
        orders.send(source.are_heard)
        orders.send(source.run(orders))
        orders.recv()  # its messages may still be on their way


class Source:
    """The other end of a source's process."""

    def __init__(self, pid: int, orders: Connection) -> None:
        self.pid, self._orders = pid, orders

    def has_begun(self) -> bool:
        """Whether all topics have been subscribed to and robots drive."""
        return self._orders.poll() and bool(self._orders.recv())

    def shift(self, by_ns: int, robot: int | None = None) -> int:
        """Shift the time of all, or the stamps of one robot; the time afterwards, without the latter [ns]."""
        self._orders.send((robot, by_ns))
        return int(self._orders.recv())

    def stop(self) -> Sent:
        """End publishing."""
        self._orders.send("stop")
        sent: Sent = self._orders.recv()
        return sent


@contextmanager
def running(settings: SourceSettings) -> Iterator[Source]:
    """A source in the ROS domain of this process; it begins once it is heard."""
    context = get_context("spawn")
    orders, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(settings, theirs), daemon=True)
    process.start()
    theirs.close()
    try:
        yield Source(process.pid or 0, orders)
    finally:
        orders.close()
        process.join(10.0)
        process.kill()
