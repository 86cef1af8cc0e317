"""PushBots over DDS: world, driver and tracker as processes, their bytes on TCP and on a serial port."""

import math
import signal
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Pose, PoseStamped, PoseWithCovarianceStamped, Twist, Vector3
from nav_msgs.msg import OccupancyGrid, Odometry
from node_world import Program, Ros, newest_status, stamp_ns, values_of
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from test_world_node import free_ports

from swarm_loc_drivers.pushbot.driver import NO_STOP
from swarm_loc_drivers.pushbot.pushbot_driver_node import PushbotDriverNode
from swarm_loc_drivers.sim.pushbot.floor_plan import floor_plan, wall_distance
from swarm_loc_drivers.sim.pushbot.optics import FOCAL_PX
from swarm_loc_drivers.sim.pushbot.world import PushbotWorld, PushbotWorldParameters
from swarm_loc_drivers.sim.simulation import SimulationOptions, graph_of, simulated_swarm
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.launch import NodeSpec
from swarm_loc_estimator.common.messages.cdr import EVENT_PACKETS
from swarm_loc_estimator.common.messages.poses import yaw_of
from swarm_loc_estimator.common.node import message_class
from swarm_loc_msgs.msg import LaserDistance, LightBearingArray, SwarmPose, SwarmPoses
from swarm_loc_vision.laser.calibration import LaserCalibration, load_laser, save_laser

SEED = 3
STARTS = {"pushbot1": (2.6, 1.5, math.pi), "pushbot2": (1.6, 1.2, 0.3)}
SIMULATED = """
fileversion: 1
types:
  pushbot: {odometry: {wheel_separation: 0.085}, camera: null, fix: {systematic_share: 1.0}}
robots:
  a: {type: pushbot, start: {x: 2.0, y: 3.0, theta: 3.14159265}}
"""
SIM_TIME = {"use_sim_time": "true"}


def world() -> PushbotWorld:
    """The world of the node, to know how its robots were put together."""
    return PushbotWorld(list(STARTS.values()), floor_plan("corridor"), PushbotWorldParameters(seed=SEED))


def true_calibration(robot: int) -> LaserCalibration:
    """What a perfect calibration of a robot finds."""
    row_at_infinity, focal_base = world().optics[robot].row
    return LaserCalibration(row_at_infinity, focal_base, 0.05, 0.04, 0.08, 3.0)


@pytest.fixture
def swarm_file(tmp_path: Path) -> Path:
    path = tmp_path / "swarm.yaml"
    rows = [
        f"  {name}: {{start: {{x: {x}, y: {y}, theta: {theta}}}}}" for name, (x, y, theta) in STARTS.items()
    ]
    path.write_text("\n".join(["fileversion: 1", "robots:", *rows, ""]), encoding="utf-8")
    return path


def way_from(x: float, y: float, truth: PoseStamped) -> float:
    """How far a robot is from a place [m]."""
    return math.hypot(truth.pose.position.x - x, truth.pose.position.y - y)


class Hall:
    """A world and the nodes of one of its robots, `pushbot1`."""

    def __init__(self, ros: Ros, running: ExitStack, folder: Path, swarm_file: Path, link: str) -> None:
        self.ros, self._running, self._folder = ros, running, folder
        ports = free_ports()
        place: dict[str, object] = {"first_port": ports} if link == "tcp" else {"link_folder": folder}
        world_parameters = {"swarm_file": swarm_file, "seed": SEED, "wheel_noise": 1e-6, **place}
        self.address = f"tcp://localhost:{ports}" if link == "tcp" else str(folder / "pushbot1")
        self.world = self.start("pushbot_world_node", world_parameters, "")
        self.world.wait_for("pushbot2 answers at")
        self.odometry: list[Odometry] = ros.listen(Odometry, "pushbot1/odom")
        self.truth: list[PoseStamped] = ros.listen(PoseStamped, "pushbot1/ground_truth")
        self.laser: list[LaserDistance] = ros.listen(LaserDistance, "pushbot1/laser")
        self.lights: list[LightBearingArray] = ros.listen(LightBearingArray, "pushbot1/lights")
        self.diagnostics: list[DiagnosticArray] = ros.listen(DiagnosticArray, "/diagnostics")
        self.packets: list[Any] = []
        ros.tester.create_subscription(
            message_class(EVENT_PACKETS[0]), "pushbot1/events", self.packets.append, qos_profile_sensor_data
        )
        self.velocity = (0.0, 0.0)
        self._publisher = ros.tester.create_publisher(Twist, "pushbot1/cmd_vel", 1)
        self.commands = ros.tester.create_timer(0.05, self._command)

    def start(
        self,
        name: str,
        parameters: dict[str, Any],
        namespace: str = "/pushbot1",
        package: str = "swarm_loc_drivers",
    ) -> Program:
        """Start a node in the robot's namespace."""
        arguments = ["-r", f"__ns:={namespace}"] if namespace else []
        log = self._folder / f"{name}{namespace.strip('/')}.log"
        return self._running.enter_context(Program(name, log, parameters, arguments, package))

    def start_driver(self, **parameters: Any) -> Program:
        """Start the driver of `pushbot1`."""
        return self.start("pushbot_driver_node", {"address": self.address, **SIM_TIME, **parameters})

    def start_tracker(self, **parameters: Any) -> Program:
        """Start its tracker."""
        chosen = {"light_frequencies": "[1000]", **SIM_TIME, **parameters}
        return self.start("event_tracker_node", chosen, package="swarm_loc_vision")

    def _command(self) -> None:
        speed, turn_rate = self.velocity
        self._publisher.publish(Twist(linear=Vector3(x=speed), angular=Vector3(z=turn_rate)))

    def status(self, name: str) -> DiagnosticStatus:
        """The newest diagnostics of a node."""
        return newest_status(self.diagnostics, f"pushbot1/{name}")

    def moved(self) -> float:
        """How far the robot truly is from where it began [m]."""
        x, y, _ = STARTS["pushbot1"]
        return way_from(x, y, self.truth[-1])

    def stands(self) -> bool:
        """Whether it has stood during the last ten poses."""
        places = [(one.pose.position.x, one.pose.position.y) for one in self.truth[-10:]]
        return len(places) == 10 and np.ptp(places, axis=0).max() < 1e-4


@pytest.fixture(params=["tcp", "serial"])
def hall(ros: Ros, tmp_path: Path, swarm_file: Path, request: pytest.FixtureRequest) -> Iterator[Hall]:
    with ExitStack() as running:
        yield Hall(ros, running, tmp_path, swarm_file, request.param)


def test_a_robot_drives_and_measures_and_stops_when_nobody_tells_it_to_drive(
    hall: Hall, tmp_path: Path
) -> None:
    save_laser(tmp_path / "laser.yaml", true_calibration(0))
    driver = hall.start_driver()
    hall.start_tracker(calibration=tmp_path / "laser.yaml")
    hall.ros.until(lambda: hall.odometry and hall.packets and hall.truth)
    hall.velocity = (0.1, 0.0)
    hall.ros.until(lambda: hall.moved() > 0.3)
    hall.commands.cancel()
    hall.ros.until(hall.stands)
    standing_ns = stamp_ns(hall.truth[-1])

    def at_rest(messages: list[Any]) -> list[Any]:
        """Those of the robot as it stands now; what comes late is of before."""
        return [one for one in messages if stamp_ns(one) >= standing_ns]

    hall.ros.until(lambda: at_rest(hall.odometry) and len(at_rest(hall.laser)) >= 35)
    place = hall.odometry[-1].pose.pose.position
    assert place.x == pytest.approx(hall.moved(), abs=0.01)
    wall = STARTS["pushbot1"][0] - hall.moved()
    known = [one for one in at_rest(hall.laser)[:35] if not math.isnan(one.distance)]
    assert len(known) > 20
    wrong = np.array([one.distance for one in known]) - wall
    assert np.abs(wrong.mean()) < 4.0 * known[-1].sigma
    assert hall.packets[-1].encoding == "mono"
    assert driver.end(signal.SIGINT) == 0


def test_leds_of_others_are_seen_where_they_are(ros: Ros, tmp_path: Path, swarm_file: Path) -> None:
    with ExitStack() as running:
        hall = Hall(ros, running, tmp_path, swarm_file, "tcp")
        port = int(hall.address.rpartition(":")[2])
        hall.start_driver()
        hall.start_tracker()
        other = {"address": f"tcp://localhost:{port + 1}", **SIM_TIME}
        hall.start("pushbot_driver_node", other, "/pushbot2")
        seen = [hall.lights]
        ros.until(lambda: sum(len(one.lights) for one in seen[0]) > 30)
        lights = [light for one in hall.lights for light in one.lights][-20:]
    (x, y, theta), (ox, oy, _) = STARTS.values()
    way = math.remainder(math.atan2(oy - y, ox - x) - theta, 2.0 * math.pi)
    # one of two LEDs 4 cm before and behind the middle of the other robot, 1 m away; from 4 cm before our own
    assert np.mean([one.bearing for one in lights]) == pytest.approx(way, abs=0.05)
    assert all(one.elevation > 0.0 and one.frequency == 1000.0 for one in lights)
    assert all(0.0 < math.sqrt(one.covariance[0]) < 1.0 / FOCAL_PX for one in lights)


def test_a_driver_that_is_killed_leaves_a_robot_that_stops_by_itself(hall: Hall) -> None:
    driver = hall.start_driver()
    hall.ros.until(lambda: hall.odometry and hall.truth)
    hall.velocity = (0.1, 0.0)
    hall.ros.until(lambda: hall.moved() > 0.05)
    driver.end(signal.SIGKILL)
    hall.ros.until(hall.stands)
    assert hall.moved() < 2.0


def test_a_robot_that_does_not_stop_is_named_in_the_diagnostics(ros: Ros) -> None:
    diagnostics: list[DiagnosticArray] = ros.listen(DiagnosticArray, "/diagnostics")
    address = [Parameter("address", value="/dev/none")]
    node = ros.add(PushbotDriverNode(namespace="pushbot1", parameter_overrides=address))
    node._driver.trouble, node._driver.warning = "", NO_STOP
    ros.until(lambda: diagnostics)
    (status,) = diagnostics[-1].status
    assert (status.name, status.level) == ("pushbot1/pushbot_driver", DiagnosticStatus.WARN)
    assert status.message == NO_STOP


def test_a_world_that_goes_and_comes_back_is_connected_anew(
    ros: Ros, tmp_path: Path, swarm_file: Path
) -> None:
    with ExitStack() as running:
        hall = Hall(ros, running, tmp_path, swarm_file, "serial")
        hall.start_driver(use_sim_time="false")
        ros.until(lambda: hall.status("pushbot_driver").message == "connected")
        hall.world.end(signal.SIGINT)
        ros.until(lambda: hall.status("pushbot_driver").level == DiagnosticStatus.ERROR)
        parameters = {"swarm_file": swarm_file, "seed": SEED, "link_folder": tmp_path}
        hall.start("pushbot_world_node", parameters, "")
        ros.until(lambda: hall.status("pushbot_driver").message == "connected")
        before = stamp_ns(hall.odometry[-1])
        ros.until(lambda: stamp_ns(hall.odometry[-1]) > before)


def test_a_laser_that_is_never_seen_is_named(ros: Ros, tmp_path: Path, swarm_file: Path) -> None:
    with ExitStack() as running:
        hall = Hall(ros, running, tmp_path, swarm_file, "tcp")
        hall.start_driver(laser_frequency=0.0)
        hall.start_tracker()
        ros.until(lambda: "450 Hz has not been seen" in hall.status("event_tracker").message)
        assert all(math.isnan(one.distance) and one.covariance[0] == -1.0 for one in hall.laser)


def simulated_graph(folder: Path) -> Sequence[NodeSpec]:
    """The nodes of `simulate` for one robot."""
    (folder / "swarm.yaml").write_text(SIMULATED, encoding="utf-8")
    options = SimulationOptions(str(folder / "swarm.yaml"), seed=5, rate=2.0)
    return graph_of(options, simulated_swarm(options), str(folder))


def start_of(running: ExitStack, folder: Path, spec: NodeSpec) -> Program:
    log = folder / f"{spec.name}.log"
    return running.enter_context(Program(spec.executable, log, {}, spec.ros_arguments()[1:], spec.package))


def distance_ahead(walls: FloatArray, at: Pose) -> float:
    """True distance from a robot to the wall ahead [m]."""
    heading = yaw_of(at.orientation.x, at.orientation.y, at.orientation.z, at.orientation.w)
    return wall_distance(walls, at.position.x, at.position.y, heading)


@pytest.mark.timeout(300)  # a minute of the simulation, however slow the machine
def test_a_simulated_swarm_maps_its_hall_and_is_tracked(ros: Ros, tmp_path: Path) -> None:
    """The whole graph of `simulate`: serial ports, lasers, trackers, mapper, estimator, and who drives."""
    distances: list[LaserDistance] = ros.listen(LaserDistance, "a/laser")
    truths: list[PoseStamped] = ros.listen(PoseStamped, "a/ground_truth")
    goals: list[PoseStamped] = ros.listen(PoseStamped, "a/goal")
    poses: list[SwarmPoses] = ros.listen(SwarmPoses, "swarm/poses")
    with ExitStack() as running:
        for spec in simulated_graph(tmp_path):
            start_of(running, tmp_path, spec)
        ros.until(lambda: sum(one.distance > 0.0 for one in distances) > 20)
        # The second look around ends at 62 s of simulated time, which passes as fast as the machine allows.
        ros.until(lambda: len(goals) > 1 or (truths and stamp_ns(truths[-1]) > 90e9), patience_s=240.0)
        assert len(goals) > 1
        ros.until(lambda: truths and way_from(2.0, 3.0, truths[-1]) > 0.2)
        ros.until(lambda: poses and poses[-1].robots[0].status == SwarmPose.STATUS_TRACKED)
        pose, pose_ns = poses[-1].robots[0], stamp_ns(poses[-1])
        ros.until(lambda: stamp_ns(truths[-1]) >= pose_ns)
    seen = [one for one in distances if one.distance > 0.0][:20]  # it may be turning already
    there = [min(truths, key=lambda at: abs(stamp_ns(at) - stamp_ns(one))).pose for one in seen]
    walls = floor_plan("corridor").walls
    off = [one.distance - distance_ahead(walls, at) for one, at in zip(seen, there, strict=True)]
    assert abs(np.median(off)) < 3.0 * np.mean([one.sigma for one in seen])
    truth = min(truths, key=lambda one: abs(stamp_ns(one) - pose_ns)).pose.position  # it may be driving
    assert math.hypot(pose.x - truth.x, pose.y - truth.y) < 0.1


@pytest.mark.timeout(600)  # two minutes of the simulation, however slow the machine
def test_a_robot_whose_driver_is_killed_while_it_maps_is_lost_until_its_scans_tell_where_it_is(
    ros: Ros, tmp_path: Path
) -> None:
    truths: list[PoseStamped] = ros.listen(PoseStamped, "a/ground_truth")
    fixes: list[PoseWithCovarianceStamped] = ros.listen(PoseWithCovarianceStamped, "a/fix")
    goals: list[PoseStamped] = ros.listen(PoseStamped, "a/goal")
    maps: list[OccupancyGrid] = ros.listen(OccupancyGrid, "map")
    diagnostics: list[DiagnosticArray] = ros.listen(DiagnosticArray, "/diagnostics")

    def counted(name: str) -> int:
        """A counter of the mapper."""
        return int(values_of(newest_status(diagnostics, "mapper")).get(name, 0))

    def has_driven(since: int) -> bool:
        """Whether the robot has left the place where it was when there were so many true poses."""
        there = truths[since - 1].pose.position
        return way_from(there.x, there.y, truths[-1]) > 0.1

    with ExitStack() as running:
        programs = {
            spec.executable: (spec, start_of(running, tmp_path, spec)) for spec in simulated_graph(tmp_path)
        }
        ros.until(lambda: len(goals) > 1, patience_s=240.0)
        since = len(truths)
        ros.until(lambda: has_driven(since), patience_s=240.0)
        spec, driver = programs["pushbot_driver_node"]
        driver.end(signal.SIGKILL)
        known = len(fixes)
        start_of(running, tmp_path, spec)
        ros.until(lambda: counted("odometry_restarts"), patience_s=240.0)
        stops, cells = counted("stops"), maps[-1].data
        # one scan never tells where it is, and more of them may not in so small a map
        for scans in (1, 2, 3):
            ros.until(lambda: counted("scans_not_located") >= scans or len(fixes) > known, patience_s=240.0)  # noqa: B023
            if len(fixes) > known:
                break
            assert counted("stops") == stops
            assert maps[-1].data == cells
        assert counted("scans_not_located") > 0
        ros.until(lambda: stamp_ns(truths[-1]) >= stamp_ns(fixes[-1]))
    for fix in fixes[known:]:
        truth = min(truths, key=lambda one: abs(stamp_ns(one) - stamp_ns(fix)))
        place = fix.pose.pose.position
        assert way_from(place.x, place.y, truth) < 0.1


def test_a_laser_is_calibrated_by_a_drive_at_a_wall(ros: Ros, tmp_path: Path, swarm_file: Path) -> None:
    with ExitStack() as running:
        hall = Hall(ros, running, tmp_path, swarm_file, "tcp")
        hall.commands.cancel()
        hall.start_driver()
        hall.start_tracker()
        ros.until(lambda: hall.odometry and hall.laser)
        parameters = {
            "start_distance": 2.6, "speed": 0.25, "stop_distance": 0.16, "output": tmp_path / "found.yaml"
        }  # fmt: skip
        command = hall.start("calibrate_laser", parameters, package="swarm_loc_vision")
        while command.process.poll() is None:
            ros.executor.spin_once(timeout_sec=0.05)
        assert command.end() == 0, command.output
        assert "wrote" in command.output
        ros.until(hall.stands)
    found, truth = load_laser(tmp_path / "found.yaml"), true_calibration(0)
    depths = np.linspace(0.12, 2.5, 100)
    read = [found.focal_base / (truth.row(depth) - found.row_at_infinity) for depth in depths]
    assert 100.0 * np.sqrt(np.mean((read - depths) ** 2)) < 3.0
