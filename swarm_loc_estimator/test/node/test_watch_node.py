"""The page's node and the markers' node beside a real estimator, over DDS."""

import json
import queue
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import pytest
from aiohttp.client_exceptions import ClientError
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import OccupancyGrid, Odometry
from node_world import STEP_NS, T0_NS, TRUE_POSES, Robots, Ros, overrides
from page_frames import unpack
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from visualization_msgs.msg import MarkerArray

from swarm_loc_estimator.watch.markers_node import MarkersNode
from swarm_loc_estimator.watch.watch_node import AerialNames, WatchNode
from swarm_loc_msgs.msg import (
    AnonymousDetection,
    AnonymousDetectionArray,
    RobotIdentities,
    RobotIdentity,
    SwarmPose,
    SwarmPoses,
)

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)


class Viewer:
    """Takes what a page would, in a thread of its own."""

    def __init__(self, url: str) -> None:
        self.frames: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {}
        self.notes: list[dict[str, Any]] = []
        self._orders: queue.Queue[str] = queue.Queue()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(url,))
        self._thread.start()

    def order(self, **command: object) -> None:
        """Send a command with the next frame that comes."""
        self._orders.put(json.dumps(command))

    def close(self) -> None:
        """Leave."""
        self._ended.set()
        self._thread.join()

    def _run(self, url: str) -> None:
        import asyncio

        asyncio.run(self._look(url))

    async def _look(self, url: str) -> None:
        async with aiohttp.ClientSession() as session, session.ws_connect(f"{url}socket") as socket:
            while not self._ended.is_set():
                try:
                    message = await socket.receive(timeout=0.1)
                except (TimeoutError, ClientError):
                    message = None
                while not self._orders.empty():
                    await socket.send_str(self._orders.get())
                if message is not None and message.type == aiohttp.WSMsgType.TEXT:
                    self.notes.append(message.json())
                elif message is not None and message.type == aiohttp.WSMsgType.BINARY:
                    await socket.send_str("+")
                    header, columns = unpack(message.data)
                    self.frames[header["kind"]] = (header, columns)


@pytest.fixture
def page_node(ros: Ros, swarm_file: Path) -> WatchNode:
    parameters = overrides(swarm_file=str(swarm_file), port=0, use_sim_time=True, teleop=True)
    watch: WatchNode = ros.add(WatchNode(parameter_overrides=parameters))
    return watch


@pytest.fixture
def viewer(page_node: WatchNode) -> Iterator[Viewer]:
    with closing(Viewer(page_node.server.url)) as looking:
        yield looking


def test_a_page_receives_what_the_graph_publishes(
    ros: Ros, robots: Robots, page_node: WatchNode, viewer: Viewer
) -> None:
    truth = ros.tester.create_publisher(PoseStamped, "alpha/ground_truth", BEST_EFFORT)
    maps = ros.tester.create_publisher(OccupancyGrid, "map", LATCHED)
    grid = OccupancyGrid(data=[0, 100, -1, 50, 0, 0])
    grid.info.width, grid.info.height, grid.info.resolution = 3, 2, 0.5
    maps.publish(grid)
    ros.until(lambda: page_node.server.has_viewers)
    viewer.order(do="select", robot=0)
    steps = iter(range(10_000))

    def step() -> None:
        now_ns = T0_NS + next(steps) * STEP_NS
        place = PoseStamped()
        place.header.stamp = Time(nanoseconds=now_ns).to_msg()
        place.pose.position.x, place.pose.orientation.w = 7.0, 1.0
        truth.publish(place)
        robots.step(now_ns)

    def until(kinds: set[str]) -> None:
        while not kinds <= viewer.frames.keys() or not any(note["kind"] == "report" for note in viewer.notes):
            step()

    until({"poses", "sightings", "truth", "map"})
    about = viewer.notes[0]
    assert about["names"] == [*TRUE_POSES]
    ros.until(lambda: viewer.frames["poses"][1]["status"][0] != 0)
    columns = viewer.frames["poses"][1]
    assert columns["x"][0] == pytest.approx(robots.newest("alpha").x, abs=0.1)
    assert viewer.frames["truth"][1]["x"].tolist() == [7.0]
    assert viewer.frames["map"][1]["cells"].tolist() == [0, 100, -1, 50, 0, 0]
    seen = viewer.frames["sightings"][1]
    assert set(seen["observer"].tolist()) <= {0, 1}
    assert np.isin(seen["verdict"], [0, 1, 2, 3, 4]).all()
    report = next(note for note in viewer.notes if note["kind"] == "report")
    assert (report["robot"], "status" in report["values"]) == (0, True)


@pytest.mark.usefixtures("page_node")
def test_what_a_page_cannot_show_is_counted_in_diagnostics(ros: Ros) -> None:
    maps = ros.tester.create_publisher(OccupancyGrid, "map", LATCHED)
    truth = ros.tester.create_publisher(PoseStamped, "alpha/ground_truth", BEST_EFFORT)
    received = ros.listen(DiagnosticArray, "/diagnostics")
    poses = ros.tester.create_publisher(SwarmPoses, "swarm/poses", QoSProfile(depth=10))
    maps.publish(OccupancyGrid(data=[0, 0, 0]))  # its width and height are 0
    nowhere = PoseStamped()
    nowhere.pose.position.x = float("nan")

    def values() -> dict[str, str]:
        poses.publish(SwarmPoses(poses=[SwarmPose(name="stranger")]))
        truth.publish(nowhere)
        newest = [one for message in received for one in message.status if one.name == "watch"][-1:]
        return {pair.key: pair.value for one in newest for pair in one.values}

    ros.until(lambda: {"dropped: map malformed", "dropped: swarm/poses other_swarm"} <= values().keys())
    levels = [
        (one.level, one.message) for message in received for one in message.status if one.name == "watch"
    ]
    assert any(level == DiagnosticStatus.WARN and "map malformed" in said for level, said in levels)
    assert values()["dropped: map malformed"] == "1"
    assert values()["pages"] == "0"


def test_orders_of_a_page_reach_the_estimator_and_the_robots(
    ros: Ros, robots: Robots, page_node: WatchNode, viewer: Viewer
) -> None:
    driven = ros.listen(Twist, "beta/cmd_vel")
    robots.run(T0_NS, 4)
    ros.until(lambda: page_node.server.has_viewers)

    def said(text: str) -> bool:
        return any(note["kind"] == "said" and text in note["text"] for note in viewer.notes)

    viewer.order(do="set_pose", robot=1, pose=[3.0, 0.5, 1.0])
    ros.until(lambda: said("Robot 'beta' is at x 3.000 m, y 0.500 m, theta 1.000 rad."))
    for wrong in (None, float("inf"), 10**400):
        viewer.notes.clear()
        viewer.order(do="set_pose", robot=1, pose=[3.0, wrong, 1.0])
        ros.until(lambda: said("A pose is three finite numbers."))
    viewer.order(do="reset")
    ros.until(lambda: said("All robots restart"))
    viewer.order(do="drive", robot=1, ahead=1, left=0)
    ros.until(lambda: bool(driven) and driven[-1].linear.x == 0.0)
    assert [one.linear.x for one in driven if one.linear.x] in ([0.05], []), (
        "the first may come before we listen"
    )


def test_identities_join_the_detections_of_their_image() -> None:
    names = AerialNames({"alpha": 0, "beta": 1})
    seen = AnonymousDetectionArray(detections=[AnonymousDetection(x=float(k)) for k in range(3)])
    _, columns = unpack(names.detections(seen).data)
    assert columns["robot"].tolist() == [-1, -1, -1]
    identities = [
        RobotIdentity(name=name, detection=detection, probability=0.75)
        for name, detection in (("beta", 2), ("alpha", 3), ("alpha", -1), ("stranger", 0))
    ]
    frame = names.identities(RobotIdentities(identities=identities))
    assert frame is not None
    _, columns = unpack(frame.data)
    assert (columns["x"].tolist(), columns["robot"].tolist()) == ([0.0, 1.0, 2.0], [-1, -1, 1])
    assert columns["probability"].tolist() == [0.0, 0.0, 0.75]
    unknown = RobotIdentities()
    unknown.header.stamp.sec = 1
    assert names.identities(unknown) is None


def test_pages_drive_nobody_unless_that_is_allowed(ros: Ros, swarm_file: Path) -> None:
    parameters = overrides(swarm_file=str(swarm_file), port=0, use_sim_time=True)
    node: WatchNode = ros.add(WatchNode(parameter_overrides=parameters))
    with closing(Viewer(node.server.url)) as viewer:
        viewer.order(do="drive", robot=1, ahead=1, left=0)
        refusal = "Driving is not allowed: parameter teleop is false."
        ros.until(lambda: any(note.get("text") == refusal for note in viewer.notes))
    assert ros.tester.count_publishers("beta/cmd_vel") == 0
    assert not viewer.notes[0]["teleop"]


def test_markers_cost_nothing_until_somebody_looks(ros: Ros, robots: Robots, swarm_file: Path) -> None:
    node = ros.add(MarkersNode(parameter_overrides=overrides(swarm_file=str(swarm_file), use_sim_time=True)))
    robots.run(T0_NS, 4)
    listens = [one.topic_name for one in node.subscriptions]
    assert not [name for name in listens if name.startswith(("/swarm", "/alpha", "/beta"))]
    markers, odometry = (
        ros.listen(MarkerArray, "swarm/markers"),
        ros.listen(Odometry, "alpha/odometry/filtered"),
    )
    ros.until(lambda: "/swarm/poses" in [one.topic_name for one in node.subscriptions])
    steps = iter(range(10_000))
    while not markers or not odometry:
        robots.step(T0_NS + (10 + next(steps)) * STEP_NS)
    assert {marker.ns for marker in markers[-1].markers} >= {"robots", "headings"}
    assert (odometry[-1].header.frame_id, odometry[-1].child_frame_id) == ("map", "alpha/base_link")
