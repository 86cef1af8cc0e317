"""The whole chain over DDS: steering, drivers, emulated firmware, one world, its clock and its cameras."""

import signal
import socket
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from node_world import Program, Ros, stamp_ns
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image

from bench.scenarios.eight_run import EightSettings, describe
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.scenarios.eight import HALF_WIDTH, Lemniscate
from swarm_loc_estimator.swarm.swarm_file import save_swarm

SECOND = 1_000_000_000
SIZE = {"width": 320, "height": 240}
SPEED = 0.06
RATE = 0.5
"""Simulated seconds per second: on a busy machine, too, commands come before the robots have gone far."""
AT_PLACE, COMMANDS = 0.05, 10
"""A robot that is commanded to be this little faster or slower is where it should be, to 6 mm."""


@pytest.fixture
def swarm_file(tmp_path: Path) -> Path:
    path = tmp_path / "swarm.yaml"
    eight = Lemniscate(HALF_WIDTH)
    start, _ = eight.at(np.array([0.0, 0.5 * eight.length]))
    save_swarm(describe(EightSettings(robots=2), start), path)
    return path


def free_ports() -> int:
    """The first of two TCP ports that nobody uses."""
    while True:
        with socket.create_server(("127.0.0.1", 0)) as one:
            port = int(one.getsockname()[1])
            try:
                with socket.create_server(("127.0.0.1", port + 1)):
                    return port
            except OSError:
                continue


@pytest.mark.parametrize("link", ["wifi", "serial"])
def test_robots_drive_the_eight_by_their_bytes_and_their_cameras_look(
    ros: Ros, swarm_file: Path, tmp_path: Path, link: str
) -> None:
    first_port = free_ports()
    place: dict[str, object] = {"first_port": first_port} if link == "wifi" else {"link_folder": tmp_path}
    clock: list[Clock] = ros.listen(Clock, "/clock")
    truth: list[PoseStamped] = ros.listen(PoseStamped, "epuck2/ground_truth")
    odometry: list[Odometry] = ros.listen(Odometry, "epuck2/odom")
    commands: list[Twist] = ros.listen(Twist, "epuck2/cmd_vel")
    images: list[Image] = ros.listen(Image, "epuck2/image_raw")
    infos: list[CameraInfo] = ros.listen(CameraInfo, "epuck2/camera_info")
    sim_time = {"use_sim_time": "true"}
    swarm = {"swarm_file": swarm_file}
    with ExitStack() as running:

        def start(name: str, log: str, parameters: dict[str, object], namespace: str = "") -> Program:
            arguments = ["-r", f"__ns:=/{namespace}"] if namespace else []
            program = Program(name, tmp_path / log, parameters, arguments, package="swarm_loc_drivers")
            return running.enter_context(program)

        world = start("epuck_world_node", "world.log", {**swarm, **place, **SIZE, "rate": RATE})
        ros.until(lambda: clock)
        for robot in range(2):
            address = (
                f"tcp://localhost:{first_port + robot}" if link == "wifi" else tmp_path / f"epuck{robot + 1}"
            )
            start(
                "epuck_driver_node",
                f"{robot}.log",
                {"address": address, **sim_time},
                namespace=f"epuck{robot + 1}",
            )
        start("eight_steering_node", "steering.log", {**swarm, "speed": SPEED, **sim_time})
        ros.until(lambda: any(one.twist.twist.linear.x > 0.9 * SPEED for one in odometry))

        def is_at_its_place() -> bool:
            """Whether it is neither in a hurry, as after commands that came late, nor about to be."""
            speeds = [one.linear.x for one in commands[-COMMANDS:]]
            return len(speeds) == COMMANDS and speeds == pytest.approx([SPEED] * COMMANDS, rel=AT_PLACE)

        ros.until(is_at_its_place)
        begin = len(truth)
        begin_ns = stamp_ns(truth[-1])
        ros.until(lambda: stamp_ns(truth[-1]) > begin_ns + 3 * SECOND and is_at_its_place())
        ros.until(lambda: len(images) > 20)
        assert world.end(signal.SIGINT) == 0, world.output
    times = [Time.from_msg(one.clock).nanoseconds for one in clock]
    assert (np.diff(times) > 0).all()
    driven = np.array([[one.pose.position.x, one.pose.position.y] for one in truth[begin:]])
    elapsed_s = (stamp_ns(truth[-1]) - stamp_ns(truth[begin])) * 1e-9
    path = np.linalg.norm(np.diff(driven, axis=0), axis=1).sum()
    assert path / elapsed_s == pytest.approx(SPEED, rel=0.1)
    r2 = (driven**2).sum(axis=1)
    on_eight = r2**2 - HALF_WIDTH**2 * (driven[:, 0] ** 2 - driven[:, 1] ** 2)
    assert np.abs(on_eight).max() < 0.02
    assert {(one.encoding, one.width, one.height) for one in images} == {("mono8", 320, 240)}
    stamps = [stamp_ns(one) for one in images]
    steps = np.diff(stamps) / round(SECOND / 7.5)
    assert (steps >= 1).all()
    assert (steps == np.rint(steps)).all()  # one may get lost on the way
    assert np.std(np.frombuffer(images[-1].data, np.uint8)) > 10.0
    assert images[-1].header.frame_id == "epuck2/camera_optical_frame"
    model = CameraModel(**SIZE)
    np.testing.assert_allclose(infos[-1].k, model.camera.matrix.reshape(9))
    assert len({stamp_ns(one) for one in infos} & set(stamps)) > 0.9 * len(stamps)
