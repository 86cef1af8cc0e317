"""The driver node over DDS, with emulated robots in processes of their own."""

import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from emulator_process import EmulatorProcess
from epuck_body import GEOMETRY
from epuck_rig import SQUARE
from geometry_msgs.msg import Twist, Vector3
from nav_msgs.msg import Odometry
from node_world import Program, Ros, newest_status, stamp_ns, values_of
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import Range
from tcp_link import TcpLink
from tf2_msgs.msg import TFMessage

from swarm_loc_drivers.epuck.hardware import PROXIMITY_BEARINGS
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.messages.poses import planar_pose


class Controller:
    """What a person has on the desk: commands go out at every step, odometry comes in."""

    def __init__(self, ros: Ros) -> None:
        self.ros = ros
        self.velocity = (0.0, 0.0)
        self.odometry: list[Odometry] = ros.listen(Odometry, "epuck1/odom")
        self.diagnostics: list[DiagnosticArray] = ros.listen(DiagnosticArray, "/diagnostics")
        self._publisher = ros.tester.create_publisher(Twist, "epuck1/cmd_vel", 1)
        self._timer = ros.tester.create_timer(0.03, self._say)

    def _say(self) -> None:
        speed, turn_rate = self.velocity
        self._publisher.publish(Twist(linear=Vector3(x=speed), angular=Vector3(z=turn_rate)))

    def fall_silent(self) -> None:
        """No more commands."""
        self._timer.cancel()

    def drive(self, legs: list[tuple[float, float, float]]) -> None:
        """Drive legs by odometry, then stand."""
        self.ros.until(lambda: self.odometry)
        for speed, turn_rate, amount in legs:
            self.velocity = (speed, turn_rate)
            self._until_gone(planar_pose(self.odometry[-1].pose.pose), amount, turning=bool(turn_rate))
        self.velocity = (0.0, 0.0)
        self.ros.until(lambda: not any(is_moving(message) for message in self.odometry[-3:]))

    def _until_gone(self, start: tuple[float, float, float], amount: float, *, turning: bool) -> None:
        def gone() -> float:
            step = se2.between(start, planar_pose(self.odometry[-1].pose.pose))
            return abs(float(step[2])) if turning else math.hypot(step[0], step[1])

        self.ros.until(lambda: gone() >= amount)

    def until_status(self, level: bytes) -> DiagnosticStatus:
        """Wait for a level; the diagnostics."""

        def newest() -> DiagnosticStatus:
            return newest_status(self.diagnostics, "epuck1/epuck_driver")

        self.ros.until(lambda: newest().name and newest().level == level)
        return newest()


def is_moving(message: Odometry) -> bool:
    twist = message.twist.twist
    return bool(twist.linear.x or twist.angular.z)


Start = Callable[..., Any]


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Start]:
    """Starts robots: on a serial port that always has one name, or behind TCP."""
    with ExitStack() as stack:

        def start(over: str, port: str = "0") -> EmulatorProcess:
            arguments = [str(tmp_path / "epuck"), "epuck1"] if over == "serial" else [port]
            started = EmulatorProcess("epuck_process.py", over, *arguments)
            stack.callback(started.kill)
            return started

        yield start


@pytest.fixture
def driver(tmp_path: Path) -> Iterator[Start]:
    """Starts drivers."""
    with ExitStack() as stack:

        def start(over: str, place: str, **parameters: object) -> Program:
            chosen = (
                {"address": place, "model": "epuck1"}
                if over == "serial"
                else {"address": f"tcp://127.0.0.1:{place}"}
            )
            program = Program(
                "epuck_driver_node",
                tmp_path / "log",
                {**chosen, **parameters},
                ("-r", "__ns:=/epuck1"),
                package="swarm_loc_drivers",
            )
            return stack.enter_context(program)

        yield start


OVER = pytest.mark.parametrize("over", ["serial", "wifi"])


@OVER
def test_a_square(ros: Ros, robot: Start, driver: Start, over: str) -> None:
    transforms: list[TFMessage] = ros.listen(TFMessage, "/tf")
    ranges: list[Range] = []
    for sensor in range(8):
        ros.tester.create_subscription(
            Range, f"epuck1/proximity/ps{sensor}", ranges.append, qos_profile_sensor_data
        )
    controller = Controller(ros)
    emulated = robot(over)
    driver(over, emulated.place)
    controller.drive(SQUARE)

    first, last = controller.odometry[0], controller.odometry[-1]
    assert not any(planar_pose(first.pose.pose))
    assert (last.header.frame_id, last.child_frame_id) == ("epuck1/odom", "epuck1/base_link")
    error = se2.between(emulated.truth()["pose"], planar_pose(last.pose.pose))
    step = GEOMETRY.metres_per_step
    assert math.hypot(error[0], error[1]) <= 20 * step
    assert abs(error[2]) <= 2.1 * step / GEOMETRY.wheel_separation

    covariance = np.array(last.pose.covariance).reshape(6, 6)
    assert np.linalg.eigvalsh(covariance)[0] > 0.0
    assert covariance[5, 5] > 10 * np.array(first.pose.covariance)[35]
    stamps = [stamp_ns(message) for message in controller.odometry]
    assert (np.diff(stamps) > 0).all()
    assert abs(ros.tester.get_clock().now().nanoseconds - stamps[-1]) < 60 * 10**9

    ros.until(
        lambda: (
            transforms and transforms[-1].transforms[0].header.stamp == controller.odometry[-1].header.stamp
        )
    )
    (transform,) = transforms[-1].transforms
    assert transform.child_frame_id == "epuck1/base_link"
    assert transform.transform.translation.x == controller.odometry[-1].pose.pose.position.x

    frames = {f"epuck1/ps{sensor}" for sensor in range(8)}
    ros.until(lambda: {message.header.frame_id for message in ranges} == frames)
    newest = {message.header.frame_id: message.range for message in ranges}
    assert newest["epuck1/ps3"] == math.inf
    assert 0.005 < newest["epuck1/ps7"] < newest["epuck1/ps0"] < 0.06

    values = values_of(controller.until_status(DiagnosticStatus.OK))
    assert values["connections"] == "1"
    assert float(values["readings rate [1/s]"]) > 1.0
    assert "implausible_counters" not in values


def test_the_sensors_sit_where_they_look(ros: Ros, robot: Start, driver: Start) -> None:
    static: list[TFMessage] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    driver("wifi", robot("wifi").place)
    ros.tester.create_subscription(TFMessage, "/tf_static", static.append, latched)
    ros.until(lambda: static)
    for transform, bearing in zip(static[0].transforms, PROXIMITY_BEARINGS, strict=True):
        rotation, place = transform.transform.rotation, transform.transform.translation
        assert 2.0 * math.atan2(rotation.z, rotation.w) == pytest.approx(bearing)
        assert math.atan2(place.y, place.x) == pytest.approx(bearing)
        assert transform.header.frame_id == "epuck1/base_link"


@OVER
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_robot_stands_when_the_node_has_ended(
    ros: Ros, robot: Start, driver: Start, over: str, number: signal.Signals
) -> None:
    controller, emulated = Controller(ros), robot(over)
    program = driver(over, emulated.place)
    controller.velocity = (0.06, 0.3)
    ros.until(lambda: any(is_moving(message) for message in controller.odometry[-1:]))
    ros.until(lambda: any(emulated.truth()["rates"]))  # it stands for a while where commands came late
    assert program.end(number) == 0
    assert emulated.truth()["rates"] == [0.0, 0.0]
    assert "Traceback" not in program.output


def test_the_robot_stands_also_where_its_link_is_down_at_the_signal(
    ros: Ros, robot: Start, driver: Start
) -> None:
    controller, emulated = Controller(ros), robot("wifi")
    with TcpLink(int(emulated.place)) as link:
        program = driver("wifi", str(link.port))
        controller.velocity = (0.06, 0.0)
        ros.until(lambda: any(emulated.truth()["rates"]))
        link.cut()
        program.process.send_signal(signal.SIGINT)
        down_s = time.monotonic()
        ros.until(lambda: time.monotonic() > down_s + 1.2)
        link.mend()
        assert program.end() == 0
        ros.until(lambda: not any(emulated.truth()["rates"]))


@OVER
def test_the_robot_stands_when_commands_stop(ros: Ros, robot: Start, driver: Start, over: str) -> None:
    controller, emulated = Controller(ros), robot(over)
    driver(over, emulated.place, cmd_vel_timeout_s=0.3)
    controller.velocity = (0.06, 0.3)
    ros.until(lambda: any(is_moving(message) for message in controller.odometry[-1:]))
    controller.fall_silent()
    ros.until(lambda: not any(emulated.truth()["rates"]))
    ros.until(lambda: not is_moving(controller.odometry[-1]))


def test_velocities_that_are_not_finite_are_warned_of(ros: Ros, robot: Start, driver: Start) -> None:
    controller = Controller(ros)
    program = driver("wifi", robot("wifi").place)
    controller.velocity = (math.nan, 0.0)
    ros.until(lambda: " bad_cmd_vel: velocities that were not finite or too large" in program.output)


@OVER
def test_a_robot_that_dies_is_told_and_found_again(ros: Ros, robot: Start, driver: Start, over: str) -> None:
    controller, emulated = Controller(ros), robot(over)
    driver(over, emulated.place)
    controller.drive(SQUARE[:1])
    controller.until_status(DiagnosticStatus.OK)
    emulated.kill()
    assert emulated.place in controller.until_status(DiagnosticStatus.ERROR).message
    count, end = len(controller.odometry), planar_pose(controller.odometry[-1].pose.pose)

    again = robot(over, emulated.place)
    controller.until_status(DiagnosticStatus.OK)
    ros.until(lambda: len(controller.odometry) > count)
    assert planar_pose(controller.odometry[count].pose.pose) == pytest.approx(end, abs=1e-9)
    controller.drive(SQUARE[:1])
    driven = se2.between(end, planar_pose(controller.odometry[-1].pose.pose))
    assert driven == pytest.approx(again.truth()["pose"], abs=5e-3)
