"""The driver node in this process, on a clock that the test sets: simulated time, pictures."""

import math
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from epuck_body import GEOMETRY, DrivenBody
from geometry_msgs.msg import Twist, Vector3
from nav_msgs.msg import Odometry
from node_world import SECOND, T0_NS, Ros, overrides, stamp_ns
from rclpy.qos import qos_profile_sensor_data
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image

from swarm_loc_drivers.common import robot_driver
from swarm_loc_drivers.epuck import wifi_session
from swarm_loc_drivers.epuck.epuck_driver_node import EpuckDriverNode
from swarm_loc_drivers.epuck.hardware import EPUCK2
from swarm_loc_drivers.sim.epuck.serial_firmware import SerialFirmware
from swarm_loc_drivers.sim.epuck.wifi_firmware import WifiFirmware
from swarm_loc_drivers.sim.link_host import FirmwareHost

STEP_NS = SECOND // 50
CALIBRATION = """
image_width: 160
image_height: 120
camera_name: epuck
camera_matrix: {rows: 3, cols: 3, data: [180.0, 0, 80, 0, 181.0, 60, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.2, 0, 0, 0]}
"""


class World:
    """A robot and its clock; the firmware answers in a thread, by the same clock.

    To it the time comes after the driver's node has it. What it streams at once when a step begins would
    else be taken for a second reading of the step before, and no other would follow while time stands still.

    Attributes:
        heard: What the firmware has received.
        rounds: How often it has gone on.
        age_ns: Of the readings that it sends.
    """

    def __init__(self, ros: Ros, stack: ExitStack) -> None:
        self.now_ns = T0_NS
        self._ros = ros
        self.body = DrivenBody(lambda: self.now_ns, steps=(32700, -32700))
        self.stack = stack
        self.heard = b""
        self.rounds = self.age_ns = 0
        self._clock = ros.tester.create_publisher(Clock, "/clock", 10)
        self._commands = ros.tester.create_publisher(Twist, "epuck1/cmd_vel", 10)
        self.odometry: list[Odometry] = ros.listen(Odometry, "epuck1/odom")

    def connect(self, node: EpuckDriverNode) -> None:
        """Let the node take part."""
        self._ros.add(node)
        self._ros.until(self._clock.get_subscription_count)
        self._ros.until(self._commands.get_subscription_count)
        self._node = node
        self.tell_time(self.now_ns)

    def tell_time(self, now_ns: int) -> None:
        """Let it be some time, first for the node."""
        self._clock.publish(Clock(clock=Time(nanoseconds=now_ns).to_msg()))
        self._ros.until(lambda: self._node.get_clock().now().nanoseconds == now_ns)
        self.now_ns = now_ns

    def command(self, speed: float, turn_rate: float = 0.0) -> None:
        """Publish a velocity."""
        self._commands.publish(Twist(linear=Vector3(x=speed), angular=Vector3(z=turn_rate)))

    def step(self) -> None:
        """Let time go on when the firmware waits for it, and wait for odometry as new as it can be."""
        self.rest()
        self.tell_time(self.now_ns + STEP_NS)
        self._ros.until(lambda: stamp_ns(self.odometry[-1]) >= self.now_ns - self.age_ns)

    def rest(self) -> None:
        """Wait until the firmware waits for time to go on."""
        rounds = self.rounds
        self._ros.until(lambda: self.rounds > rounds + 1)

    def until(self, condition: Callable[[], object]) -> None:
        """Let time go on, a moment for what is under way at each step, until something is so."""
        end_s = time.monotonic() + 60.0
        while not condition():
            assert time.monotonic() < end_s, "waited in vain"
            self.tell_time(self.now_ns + STEP_NS)
            moment_s = time.monotonic() + 0.1
            while not condition() and time.monotonic() < moment_s:
                self._ros.executor.spin_once(timeout_sec=0.02)


@pytest.fixture
def world(ros: Ros, monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    # real time does not count here
    monkeypatch.setattr(robot_driver, "STANDING_CLOCK_S", math.inf)
    monkeypatch.setattr(wifi_session, "_REPEAT_S", math.inf)
    monkeypatch.setattr(robot_driver, "MAX_STOP_S", 0.1)  # who could answer is gone when the node ends
    with ExitStack() as stack:
        yield World(ros, stack)


def node_on(address: object, **values: object) -> EpuckDriverNode:
    """A node on simulated time."""
    settings = {"address": str(address), "use_sim_time": True, "reading_rate": 50.0, "cmd_vel_timeout_s": 0.1}
    node = EpuckDriverNode(namespace="/epuck1", parameter_overrides=overrides(**settings, **values))
    node.start()
    return node


def serve(world: World, over: str) -> object:
    """The robot's address."""

    def noting(firmware: Any) -> Any:
        receive, stream = firmware.receive, firmware.stream

        def heard(data: bytes) -> Any:
            answer = receive(data)
            world.heard += data
            return answer

        def streamed() -> Any:
            answer = stream()
            world.rounds += 1
            return answer

        firmware.receive, firmware.stream = heard, streamed
        return firmware

    host, ended = world.stack.enter_context(FirmwareHost()), threading.Event()

    def answer() -> None:
        while not ended.is_set():
            host.poll(0.002)

    if over == "wifi":
        world.age_ns = STEP_NS  # it streams what it has read a cycle before
        address: object = f"tcp://127.0.0.1:{host.serve_tcp(noting(WifiFirmware(world.body)))}"
    else:
        address = host.serve_pty(noting(SerialFirmware(world.body, EPUCK2)))
    thread = threading.Thread(target=answer)
    thread.start()
    world.stack.callback(thread.join)
    world.stack.callback(ended.set)
    return address


@pytest.mark.parametrize("over", ["serial", "wifi"])
def test_stamps_motion_and_timeout_follow_simulated_time(world: World, ros: Ros, over: str) -> None:
    """The wheels turn for 0.12 s: until the first step at which the command is older than its 0.1 s.

    Over the serial port that step's question stops them at once, as the command itself starts them. By WiFi a
    cycle takes a step and reads one command, which the next one obeys. The start comes when a cycle has read
    its command, the stop in answer to what a cycle streams, so that the same one may still read it: 0.02 s
    less. Whole steps of the motors are counted.
    """
    address = serve(world, over)
    world.connect(node_on(address))
    world.until(lambda: world.odometry)
    world.rest()
    world.command(0.1)
    speeds = EPUCK2.wheel_commands(GEOMETRY, 0.1, 0.0)
    ros.until(lambda: struct.pack("<2h", *speeds) in world.heard)
    for _ in range(10):
        world.step()

    stamps = np.array([stamp_ns(message) for message in world.odometry])
    # a stream is stamped when read; an answer in the middle since its question, and time may step between
    grain_ns = STEP_NS if over == "wifi" else STEP_NS // 2
    assert ((stamps - T0_NS) % grain_ns == 0).all()
    assert (np.diff(stamps) > 0).all()
    driven = world.odometry[-1].pose.pose.position.x
    assert driven == pytest.approx(world.body.pose[0], abs=2 * GEOMETRY.metres_per_step)
    assert not any(world.body.rates)
    rate = EPUCK2.rate(speeds[0])
    assert math.floor(0.1 * rate) <= round(driven / GEOMETRY.metres_per_step) <= 0.14 * rate


def test_time_that_jumps_back_stops_the_robot_and_goes_on(world: World, ros: Ros) -> None:
    address = serve(world, "serial")
    world.connect(node_on(address))
    world.until(lambda: world.odometry)
    world.command(0.1)
    ros.until(lambda: any(world.body.rates))
    world.step()
    before = world.odometry[-1]
    world.tell_time(T0_NS - 100 * SECOND)
    ros.until(lambda: not any(world.body.rates))
    ros.until(lambda: stamp_ns(world.odometry[-1]) <= world.now_ns)
    world.step()
    assert world.odometry[-1].pose.pose.position.x == pytest.approx(before.pose.pose.position.x, abs=1e-3)


def test_pictures_come_with_their_calibration(world: World, ros: Ros, tmp_path: Path) -> None:
    images: list[Image] = []
    infos: list[CameraInfo] = []
    ros.tester.create_subscription(Image, "epuck1/image_raw", images.append, qos_profile_sensor_data)
    ros.tester.create_subscription(CameraInfo, "epuck1/camera_info", infos.append, qos_profile_sensor_data)
    path = tmp_path / "camera.yaml"
    path.write_text(CALIBRATION, encoding="utf-8")
    rows, columns = np.mgrid[:960, :1280]
    frame = np.stack([rows // 8, columns // 8, 0 * rows], axis=-1).astype(np.uint8)
    address = serve(world, "wifi")
    world.connect(node_on(address, camera=True, camera_info_file=str(path)))
    world.body.frame = (frame, None)
    world.until(lambda: images and infos)

    image, info = images[0], infos[0]
    assert (image.width, image.height, image.step, image.encoding) == (160, 120, 480, "rgb8")
    pixels = np.frombuffer(image.data, np.uint8).reshape(120, 160, 3)
    expected = frame.reshape(120, 8, 160, 8, 3).mean(axis=(1, 3))
    assert np.abs(pixels - expected).max() <= 8
    assert image.header.frame_id == "epuck1/camera_optical_frame"
    assert T0_NS <= stamp_ns(image) <= world.now_ns
    assert info.header == image.header
    assert (info.k[0], info.k[4], info.k[2], info.d[1]) == (180.0, 181.0, 80.0, -0.2)
    assert info.p.tolist() == [180.0, 0, 80, 0, 0, 181.0, 60, 0, 0, 0, 1, 0]
