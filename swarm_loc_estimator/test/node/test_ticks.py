"""The estimator keeps to its ticks also when many messages wait to be handled, as on a busy machine."""

from diagnostic_msgs.msg import DiagnosticArray
from node_world import SECOND, STEP_NS, T0_NS, TRUE_POSES, Robots, Ros, odometry_bytes, stamp_ns
from rclpy.duration import Duration
from rosgraph_msgs.msg import Clock

from swarm_loc_estimator.common.node import _EACH_CHANGE
from swarm_loc_estimator.nodes.estimator_node import EstimatorNode

BACKLOG = 20
PATIENCE = Duration(seconds=60)


def test_time_told_again_and_again_before_the_tick_neither_repeats_nor_delays_it(
    ros: Ros, robots: Robots
) -> None:
    due_ns = robots.run(T0_NS, 4) + STEP_NS
    told_ns = [due_ns - 2]
    others_work = ros.tester.create_publisher(Clock, "others_work", BACKLOG)

    def work(_: Clock) -> None:
        """While one of the waiting messages is handled, a new time comes in behind them."""
        told_ns.append(told_ns[-1] + 1)
        robots.tell_time(told_ns[-1])
        robots.wait_until_told()

    ros.tester.create_subscription(Clock, "others_work", work, BACKLOG)
    times = ros.listen(Clock, "/clock")
    ros.until(others_work.get_subscription_count)
    others_work.publish(Clock())
    ros.until(lambda: times)
    for _ in range(BACKLOG):
        others_work.publish(Clock())
        assert others_work.wait_for_all_acked(PATIENCE)
        robots.tell_time(due_ns - 1)
        robots.wait_until_told()
    ros.until(lambda: stamp_ns(robots.poses[-1]) >= due_ns)
    for step in range(1, 4):
        robots.step(told_ns[-1] + step * STEP_NS)

    stamps = [stamp_ns(pose) for pose in robots.poses]
    assert sum(due_ns <= stamp < due_ns + STEP_NS for stamp in stamps) == 1


def test_what_comes_with_a_time_that_waits_to_be_handled_is_not_of_the_future(
    ros: Ros, robots: Robots, node: EstimatorNode
) -> None:
    heard = ros.listen(DiagnosticArray, "/diagnostics")
    due_ns = robots.run(T0_NS, 4) + STEP_NS
    later_ns = due_ns + SECOND

    def has_budget(_jump: object) -> None:
        """Between the time that makes a tick due and the tick, time and robots go on."""
        if node.get_clock().now().nanoseconds == due_ns:
            robots.tell_time(later_ns)
            for name, pose in TRUE_POSES.items():
                robots.odometry(name, odometry_bytes(name, later_ns, pose))
            robots.wait_until_told()
            robots.wait_until_received()

    jumps = node.get_clock().create_jump_callback(_EACH_CHANGE, post_callback=has_budget)
    robots.tell_time(due_ns)
    ros.until(lambda: stamp_ns(robots.poses[-1]) == later_ns)
    jumps.unregister()
    robots.step(later_ns + STEP_NS)
    ros.until(lambda: heard and stamp_ns(heard[-1]) == later_ns + STEP_NS)

    stamps = [stamp_ns(pose) for pose in robots.poses]
    assert len(set(stamps)) == len(stamps)
    values = {pair.key: pair.value for status in heard[-1].status for pair in status.values}
    assert "dropped: future_stamp" not in values
    assert values["odom received"] == "6"
