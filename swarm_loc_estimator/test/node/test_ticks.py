"""The estimator keeps to its ticks also when many messages wait to be handled, as on a busy machine."""

from __future__ import annotations

from node_world import STEP_NS, T0_NS, Robots, Ros, stamp_ns
from rclpy.duration import Duration
from rosgraph_msgs.msg import Clock

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
