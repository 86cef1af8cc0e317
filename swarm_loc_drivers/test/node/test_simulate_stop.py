"""`simulate` from its start to a signal that stops it: no robot is left moving, and no link is missed."""

import signal
from pathlib import Path

import pytest
from geometry_msgs.msg import PoseStamped, Twist, Vector3
from node_world import Program, Ros

SWARM = """
fileversion: 1
types:
  pushbot: {odometry: {wheel_separation: 0.085}, camera: null, fix: {systematic_share: 1.0}}
robots:
  pushbot1: {type: pushbot, start: {x: 1.5, y: 1.5, theta: 0.0}}
"""


@pytest.mark.timeout(300)
def test_a_signal_stops_the_robots_before_their_world(ros: Ros, tmp_path: Path) -> None:
    swarm_file = tmp_path / "swarm.yaml"
    swarm_file.write_text(SWARM, encoding="utf-8")
    truth: list[PoseStamped] = ros.listen(PoseStamped, "pushbot1/ground_truth")
    velocity = ros.tester.create_publisher(Twist, "pushbot1/cmd_vel", 1)
    ros.tester.create_timer(0.1, lambda: velocity.publish(Twist(linear=Vector3(x=0.1))))
    arguments = {"package": "swarm_loc_drivers", "options": [str(swarm_file)]}
    with Program("simulate", tmp_path / "log", {}, **arguments) as simulation:  # type: ignore[arg-type]
        ros.until(lambda: truth and truth[-1].pose.position.x > 1.55, 150.0)
        assert simulation.end(signal.SIGTERM) == 0
        output = simulation.output
    for trouble in ("cannot be opened", "is broken", "may still be moving", "does not end", "no /clock"):
        assert trouble not in output
