"""Robots are steered from when all of them have sent odometry."""

from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from node_world import Ros
from rclpy.node import Node
from rclpy.time import Time

from swarm_loc_drivers.common.robot_driver import Velocity
from swarm_loc_drivers.sim.scenarios.steering_nodes import TruthSteering
from swarm_loc_estimator.common.arrays import FloatArray

NAMES = ("epuck1", "epuck2")


def test_nobody_drives_before_the_last_robot_has_told_odometry(ros: Ros) -> None:
    steered: list[tuple[int, int]] = []

    def steer(robot: int, stamp_ns: int, _pose: FloatArray) -> Velocity:
        steered.append((robot, stamp_ns))
        return 0.06, 0.0, 0.3

    commands = [ros.listen(Twist, f"{name}/cmd_vel") for name in NAMES]  # listen as drivers do
    steering = TruthSteering(ros.add(Node("steering")), NAMES, steer)
    truth = ros.tester.create_publisher(PoseStamped, "epuck1/ground_truth", 10)
    odometry = [ros.tester.create_publisher(Odometry, f"{name}/odom", 10) for name in NAMES]
    ros.until(lambda: all(one.get_subscription_count() for one in (truth, *odometry)))
    ros.until(lambda: all(one.get_subscription_count() for one in steering._commands))

    def tell_truth(stamp_ns: int) -> None:
        pose = PoseStamped()
        pose.header.stamp = Time(nanoseconds=stamp_ns).to_msg()
        pose.pose.orientation.w = 1.0
        truth.publish(pose)

    tell_truth(1)
    odometry[0].publish(Odometry())
    ros.until(lambda: steering._silent == {"epuck2"})
    tell_truth(2)
    odometry[1].publish(Odometry())
    ros.until(lambda: not steering._silent)
    tell_truth(3)
    ros.until(lambda: commands[0])

    assert steered == [(0, 3)]
    assert (commands[0][0].linear.x, commands[0][0].angular.z) == (0.06, 0.3)
    assert not commands[1]
