"""Poses of PyDotBot become fixes, and velocities its commands: as its controller answers."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist, Vector3
from node_world import Ros, overrides

from swarm_loc_drivers.dotbot.dotbot_node import DotbotNode, pose_of
from swarm_loc_estimator.cli import new
from swarm_loc_estimator.common.messages.poses import planar_pose
from swarm_loc_estimator.common.parameters import ParameterError

DOTBOTS = [
    {
        "address": "B",
        "last_seen": 5.0,
        "pose": {"x": 100, "y": 200, "heading_deg": 90, "heading_source": "ekf"},
    },
    {"address": "A", "last_seen": 5.0, "lh2_position": {"x": 1000.0, "y": 500.0}},
]


class Controller(BaseHTTPRequestHandler):
    """Answers as the controller does, and keeps what is put."""

    put: list[tuple[str, object]] = []  # noqa: RUF012
    robots: object = DOTBOTS

    def _answer(self, body: object) -> None:
        self.send_response(200)
        self.end_headers()
        self.wfile.write(json.dumps(body).encode())

    def do_GET(self) -> None:
        """Tell the robots."""
        assert self.path == "/controller/dotbots"
        self._answer(self.robots)

    def do_PUT(self) -> None:
        """Take a command."""
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.put.append((self.path, body))
        self._answer(None)

    def log_message(self, *_: object) -> None:
        """Print nothing."""


@pytest.fixture
def url() -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), Controller) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.mark.parametrize(
    ("heading", "yaw"), [(0.0, -0.5 * math.pi), (90.0, -math.pi), (-90.0, 0.0), (180.0, 0.5 * math.pi)]
)
def test_headings_are_clockwise_from_y_which_points_down(heading: float, yaw: float) -> None:
    about = {"x": 1000, "y": 250, "heading_deg": heading, "heading_source": "travel"}
    found = pose_of({"pose": about})
    assert found is not None
    pose, known = found
    assert known
    assert pose[:2].tolist() == [1.0, -0.25]
    assert math.cos(pose[2] - yaw) == pytest.approx(1.0)
    assert pose_of({"last_seen": 1.0}) is None


@pytest.fixture
def swarm_file(tmp_path: Path) -> str:
    path = str(tmp_path / "swarm.yaml")
    assert new.main([path, "--yes", "--type", "dotbot", "--robots", "2"]) == 0
    return path


def test_poses_are_fixes_and_velocities_are_speeds_of_wheels(ros: Ros, swarm_file: str, url: str) -> None:
    fixes = [ros.listen(PoseWithCovarianceStamped, f"dotbot{k}/fix") for k in (1, 2)]
    node = DotbotNode(parameter_overrides=overrides(swarm_file=swarm_file, url=url))
    ros.add(node)
    ros.until(lambda: all(fixes))
    assert planar_pose(fixes[0][0].pose.pose)[:2] == (1.0, -0.5)
    assert fixes[0][0].pose.covariance[35] > math.pi**2
    x, y, yaw = planar_pose(fixes[1][0].pose.pose)
    assert (x, y, math.cos(yaw)) == pytest.approx((0.1, -0.2, -1.0))
    assert fixes[1][0].pose.covariance[0] == pytest.approx(1e-4)
    commands = ros.tester.create_publisher(Twist, "dotbot2/cmd_vel", 10)
    ros.publish_until(commands, Twist(linear=Vector3(x=0.1), angular=Vector3(z=1.0)), lambda: Controller.put)
    assert Controller.put[0] == (
        "/controller/dotbots/B/0/wheel_velocity",
        {"left_mm_s": 60, "right_mm_s": 140},
    )
    assert not [one for one in fixes[0][1:] if one.header.stamp != fixes[0][0].header.stamp]  # nothing new


@pytest.fixture
def node(
    ros: Ros,  # noqa: ARG001  # must run before
    swarm_file: str,
    url: str,
    monkeypatch: pytest.MonkeyPatch,
) -> DotbotNode:
    """The node of two robots, which has not asked yet."""
    monkeypatch.setattr(Controller, "robots", [])
    return DotbotNode(parameter_overrides=overrides(swarm_file=swarm_file, url=url))


@pytest.mark.parametrize(
    ("about", "reason"),
    [
        ({"pose": {"x": math.nan, "y": 1.0}}, {"bad_answer": 1}),
        ({"pose": {"x": "1", "y": 1.0}}, {"bad_answer": 1}),
        ({"pose": {"y": 1.0}}, {"bad_answer": 1}),
        ({"pose": [1.0, 2.0]}, {"bad_answer": 1}),
        ({"pose": {"x": 1.0, "y": 1.0, "heading_deg": None, "heading_source": "ekf"}}, {"bad_answer": 1}),
        ({"pose": {"x": 1.0, "y": 1.0, "heading_deg": math.inf, "heading_source": "ekf"}}, {"bad_answer": 1}),
        ({}, {}),
    ],
)
def test_a_bad_answer_is_dropped_and_counted_and_the_other_robot_is_heard(
    ros: Ros,
    node: DotbotNode,
    monkeypatch: pytest.MonkeyPatch,
    about: dict[str, object],
    reason: dict[str, int],
) -> None:
    good = {"address": "B", "last_seen": 5.0, "pose": {"x": 100, "y": 200}}
    monkeypatch.setattr(Controller, "robots", [{"address": "A", "last_seen": 5.0, **about}, good, "nonsense"])
    fixes = [ros.listen(PoseWithCovarianceStamped, f"dotbot{k}/fix") for k in (1, 2)]
    ros.add(node)
    ros.until(lambda: fixes[1])
    assert not fixes[0]
    assert set(node.health.drops) == set(reason)


@pytest.mark.parametrize("answer", [{"detail": "not found"}, None, "robots", [1, None]])
def test_an_answer_that_is_no_list_of_robots_is_survived(
    ros: Ros, node: DotbotNode, monkeypatch: pytest.MonkeyPatch, answer: object
) -> None:
    monkeypatch.setattr(Controller, "robots", answer)
    states = ros.listen(DiagnosticArray, "/diagnostics")
    fixes = ros.listen(PoseWithCovarianceStamped, "dotbot1/fix")
    ros.add(node)
    ros.until(lambda: any("no poses of dotbot1" in one.message for state in states for one in state.status))
    monkeypatch.setattr(Controller, "robots", DOTBOTS)
    ros.until(lambda: fixes)


def test_a_robot_keeps_its_address_when_another_one_is_gone(
    ros: Ros, node: DotbotNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Controller, "robots", DOTBOTS)
    fixes = [ros.listen(PoseWithCovarianceStamped, f"dotbot{k}/fix") for k in (1, 2)]
    ros.add(node)
    ros.until(lambda: all(fixes))
    before = len(fixes[0])
    monkeypatch.setattr(Controller, "robots", [{**DOTBOTS[0], "last_seen": 6.0}])
    ros.until(lambda: len(fixes[1]) > 1)
    assert len(fixes[0]) == before


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        ({"url": "file:///etc/passwd"}, "must begin with http:// or https://"),
        ({"bodies": ["A=dotbot1", "B=robot7"]}, "parameter bodies names robot7, but the robots are dotbot1"),
    ],
)
@pytest.mark.usefixtures("ros")
def test_a_wrong_parameter_is_one_sentence(
    swarm_file: str, parameters: dict[str, object], sentence: str
) -> None:
    with pytest.raises(ParameterError, match=sentence):
        DotbotNode(parameter_overrides=overrides(swarm_file=swarm_file, **parameters))
