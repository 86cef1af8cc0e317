"""The Droplet's driver node over DDS, with emulated robots in a process of their own."""

import json
import math
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from droplet_rig import IDS, TRIANGLE, read_by, world_of
from emulator_process import EmulatorProcess
from geometry_msgs.msg import Twist, Vector3
from nav_msgs.msg import Odometry
from node_world import Program, Ros, overrides, stamp_ns, values_of
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from swarm_loc_drivers.droplet.droplet_nodes import DropletDriverNode
from swarm_loc_estimator.common import se2
from swarm_loc_msgs.msg import BrightnessMatrix


@pytest.fixture
def robots(tmp_path: Path) -> Iterator[EmulatorProcess]:
    """Emulated robots, whose truth are their poses."""
    robots = EmulatorProcess("droplet_process.py", str(tmp_path / "droplet"))
    assert robots.place == str(tmp_path / "droplet")
    yield robots
    robots.kill()


def frames_of(heard: list[TFMessage]) -> set[str]:
    """The frames that have a parent."""
    return {transform.child_frame_id for message in heard for transform in message.transforms}


def test_a_droplet_walks_measures_and_stands_at_the_end(
    ros: Ros, robots: EmulatorProcess, tmp_path: Path
) -> None:
    odometry: list[Odometry] = ros.listen(Odometry, "droplet1/odom")
    relayed: list[Odometry] = ros.listen(Odometry, "droplet3/odom")
    matrices: list[BrightnessMatrix] = ros.listen(BrightnessMatrix, "droplet1/brightness")
    transforms: list[TFMessage] = ros.listen(TFMessage, "/tf")
    diagnostics: list[DiagnosticArray] = ros.listen(DiagnosticArray, "/diagnostics")
    parameters = {
        "address": tmp_path / "droplet",
        "partners": json.dumps([f"{robot:04X}" for robot in IDS[1:]]),
        "relayed": json.dumps([f"droplet3={IDS[2]:04X}"]),
        "exchange_rate": 0.0,
        "reply_timeout_s": 10.0,  # the emulated robots wait for a processor, too
    }
    arguments = ("-r", "__ns:=/droplet1")
    log = tmp_path / "log"
    with Program("droplet_driver_node", log, parameters, arguments, package="swarm_loc_drivers") as program:
        ros.until(lambda: odometry and relayed)
        publisher = ros.tester.create_publisher(Twist, "droplet1/cmd_vel", 1)

        def is_warned_of() -> bool:
            """Whether the log tells of a velocity that is none."""
            publisher.publish(Twist(linear=Vector3(x=math.nan)))
            return "bad_cmd_vel: velocities that were not finite" in program.output

        ros.until(is_warned_of)
        measure = ros.tester.create_client(Trigger, "droplet1/droplet_driver/measure")
        assert measure.wait_for_service(60.0)
        measure.call_async(Trigger.Request())
        ros.until(lambda: len(matrices) == 4)
        timer = ros.tester.create_timer(0.05, lambda: publisher.publish(Twist(linear=Vector3(x=-0.01))))
        ros.until(lambda: odometry[-1].pose.pose.position.x < -0.004)
        relay = ros.tester.create_publisher(Twist, "droplet3/cmd_vel", 1)
        relayed_timer = ros.tester.create_timer(0.05, lambda: relay.publish(Twist(linear=Vector3(x=-0.01))))
        ros.until(lambda: relayed[-1].pose.pose.position.x < -0.004)
        ros.until(lambda: frames_of(transforms) == {"droplet1/base_link", "droplet3/base_link"})
        ros.until(lambda: diagnostics and values_of(diagnostics[-1].status[0]).get("exchanges") == "2")
        timer.cancel()
        relayed_timer.cancel()
        assert program.end(signal.SIGINT) == 0, program.output
    first = np.array(robots.truth())
    assert (np.array(robots.truth()) == first).all()
    for heard, robot in ((odometry, 0), (relayed, 2)):
        moved = se2.between(TRIANGLE[robot], first[robot])
        # what it went until it stood is published until then
        ros.until(lambda: heard[-1].pose.pose.position.x == pytest.approx(moved[0], abs=4e-3))  # noqa: B023
    assert relayed[-1].pose.covariance[0] > 0.05 * 0.006**2  # it may not have heard
    assert (first[1] == TRIANGLE[1]).all()

    for near, far in zip(matrices[::2], matrices[1::2], strict=True):
        assert stamp_ns(near) == stamp_ns(far)
        assert near.header.frame_id == "droplet1/base_link"
        assert (near.power, far.power) == (BrightnessMatrix.POWER_NEAR, BrightnessMatrix.POWER_FAR)
        for one in (near, far):
            assert (one.receiver, one.n, one.saturation) == (IDS[0], 6, 240)
            exact = read_by(world_of(), 0, IDS.index(one.transmitter))[one.power]
            assert np.abs(np.reshape(one.readings, (6, 6)) - np.clip(exact, 0.0, 255.0)).max() < 0.51
    assert {one.transmitter for one in matrices} == set(IDS[1:])
    status = diagnostics[-1].status[0]
    assert (status.name, status.message) == ("droplet1/droplet_driver", "connected")
    assert values_of(status)["exchanges"] == "2"


def test_nobody_is_asked_while_the_link_is_down(ros: Ros, tmp_path: Path) -> None:
    address = str(tmp_path / "nothing")
    parameters = overrides(address=address, partners=["6B6F"], relayed=["droplet3=DF64"])
    ros.add(DropletDriverNode(namespace="/table/droplet1", parameter_overrides=parameters))
    response = ros.call(Trigger, "table/droplet1/droplet_driver/measure", Trigger.Request())
    assert not response.success
    assert address in response.message
    assert ros.tester.count_subscribers("table/droplet3/cmd_vel") == 1
