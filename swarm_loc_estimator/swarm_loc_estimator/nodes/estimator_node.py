"""The central estimator of a swarm as a ROS 2 node.

    ./run swarm_loc_estimator estimator_node --ros-args -p swarm_file:=swarm.yaml

It subscribes to `<robot>/odom`, `<robot>/detections`, `<robot>/brightness` and `<robot>/fix` of the robots in
the swarm description. It publishes `swarm/poses`, `<robot>/pose`, `/tf` (map to `<robot>/odom`, which no one
else may publish), `/diagnostics`.
Services: `~/reset`, `~/set_robot_pose`. Parameters: see `estimator_parameters.py` and the package's README.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger

from swarm_loc_estimator.core.compiled import is_warm
from swarm_loc_estimator.core.estimator import SwarmEstimate, SwarmEstimator
from swarm_loc_estimator.core.settings import EstimatorSettings
from swarm_loc_estimator.core.swarm import Swarm
from swarm_loc_estimator.io.ingest import Ingest
from swarm_loc_estimator.io.inputs import InputKind
from swarm_loc_estimator.io.message_batch import MessageBatch
from swarm_loc_estimator.io.swarm_file import load_swarm
from swarm_loc_estimator.nodes.declare import declare_parameters
from swarm_loc_estimator.nodes.estimator_health import Health, Report, TickCost, load_report, merged
from swarm_loc_estimator.nodes.estimator_outputs import EstimateOutputs
from swarm_loc_estimator.nodes.estimator_parameters import EstimatorParameters
from swarm_loc_estimator.nodes.fusion_pace import FusionPace
from swarm_loc_estimator.nodes.running import run_node, spin
from swarm_loc_estimator.nodes.seating import REFUSALS, SeatRequestError, planar_seat
from swarm_loc_estimator.nodes.warm_up import warm_up
from swarm_loc_msgs.msg import BrightnessMatrix, MarkerDetectionArray
from swarm_loc_msgs.srv import SetRobotPose

INPUT_QOS = QoSProfile(depth=1000)
"""Deep enough for a busy moment as long as the horizon; what is older would not be used anyway.

More cannot be counted: Fast DDS tells of no message that a newer one replaces in this queue.
"""

_MESSAGE_CLASSES = {
    InputKind.ODOMETRY: Odometry,
    InputKind.DETECTIONS: MarkerDetectionArray,
    InputKind.BRIGHTNESS: BrightnessMatrix,
    InputKind.FIXES: PoseWithCovarianceStamped,
}
NO_CLOCK = "use_sim_time is true but no /clock has come"
_DIAGNOSTICS_PERIOD_S = 1.0
_THROTTLE_S = 30.0
_ORDINARY_DROPS = frozenset(
    {
        "duplicate",
        "gated",
        "ir_saturated",
        "ir_too_weak",
        "ir_undetermined",
        "odometry_duplicate",
        "odometry_too_old",
        "reset",
        "too_old",
        "untied",
    }
)
"""Late, double or outlying data is a matter of course, and so is light of robots too far or too near."""
_MOST_WITHOUT_CLOCK = 20_000
_PATIENCE_S = 5.0
"""How long nothing may come before the log names what is missing."""

CreateEstimator = Callable[[Swarm, EstimatorSettings], SwarmEstimator]


class EstimatorNode(Node):
    """Receives, lets the core estimate once per tick, publishes.

    Args:
        create_estimator: Makes the estimator; tests hand in another one.
        node_arguments: Further arguments of `rclpy.node.Node`.

    Raises:
        ParameterError: A parameter cannot be used.
        SwarmFileError: The swarm description cannot be used.
    """

    def __init__(self, create_estimator: CreateEstimator = SwarmEstimator, **node_arguments: Any) -> None:
        super().__init__("estimator", **node_arguments)
        self._wishes = declare_parameters(self, EstimatorParameters)
        self._swarm = load_swarm(Path(self._wishes.swarm_file))
        if not is_warm():
            self.get_logger().info("compiling the estimator for this machine: about a minute")
        warm_up()
        self._estimator = create_estimator(self._swarm, self._wishes.settings)
        self._ingest = Ingest(self._swarm, self._wishes.map_frame)
        self._backlog: list[tuple[int, bytes, int]] = []
        self._estimate: SwarmEstimate | None = None
        self._jumps = 0
        self._pace = FusionPace(self._wishes.fusion_load, self._wishes.settings.horizon_s)
        self._cost = TickCost()
        self._health = Health(self._swarm, self._ingest, self._wishes.odom_frame, self._why_missing)
        self._outputs = EstimateOutputs(self, self._swarm, self._wishes)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))
        self._waiting_since_s = self._reported_s = time.monotonic()
        self._clock_runs = False
        self._has_said_missing = False
        self._known_drops: dict[str, int] = {}
        self._told_drops_s = -math.inf
        self._offer_services()
        self._subscribe()
        self._start_timers()

    def _offer_services(self) -> None:
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(SetRobotPose, "~/set_robot_pose", self._on_set_robot_pose)

    def _subscribe(self) -> None:
        """Listen to all robots. Raw bytes: building message objects would cost more than estimating."""
        for handle, topic in enumerate(self._ingest.topics):
            self.create_subscription(
                _MESSAGE_CLASSES[topic.kind], topic.name, self._receiver(handle), INPUT_QOS, raw=True
            )

    def _receiver(self, handle: int) -> Callable[[bytes], None]:
        """A callback that only keeps the message and the time; the next tick reads it."""
        backlog, clock = self._backlog, self.get_clock()

        def receive(data: bytes) -> None:
            backlog.append((handle, data, clock.now().nanoseconds))

        return receive

    def _start_timers(self) -> None:
        self._timer = self.create_timer(self._wishes.tick_period_s, self._on_tick)
        # by a clock that runs also while simulated time stands still
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_DIAGNOSTICS_PERIOD_S, self._on_diagnostics, clock=steady)
        self.get_logger().info(
            f"ready: {len(self._swarm.robots)} robots and {len(self._swarm.landmarks)} landmarks"
            f" of '{self._wishes.swarm_file}'"
        )

    def _on_tick(self) -> None:
        if self._timer.time_until_next_call() > self._timer.timer_period_ns:
            # Where several /clock messages were handled while a tick was due, the EventsExecutor calls once
            # for each of them, and every call moves the timer on, in the end seconds ahead of time.
            self._timer.reset()
            return
        begin_s = time.perf_counter()
        now_ns = self.get_clock().now().nanoseconds
        if not now_ns:
            self._limit_backlog()
            return
        backlog = [(handle, data, arrival_ns or now_ns) for handle, data, arrival_ns in self._backlog]
        self._backlog.clear()
        for messages in self._ingest.read(MessageBatch.of(backlog)):
            self._estimator.receive(messages)
        fuse = self._pace.is_due(begin_s, now_ns)  # large swarms: in between odometry leads on
        begin_cpu_s = time.thread_time()
        self._estimate = self._estimator.tick(now_ns, fuse=fuse)
        if fuse:
            self._pace.note(begin_s, now_ns, time.thread_time() - begin_cpu_s)
        self._say_time_jumps()
        self._outputs.publish(self._estimate)
        self._cost.note(time.perf_counter() - begin_s)

    def _limit_backlog(self) -> None:
        """Before the first /clock nothing can be placed in time; keep the newest."""
        surplus = len(self._backlog) - _MOST_WITHOUT_CLOCK
        if surplus > 0:
            del self._backlog[:surplus]
            self._estimator.drop("no_clock", surplus)

    def _say_time_jumps(self) -> None:
        """The estimator itself begins anew when time has jumped back; say so, once per jump."""
        if self._estimator.time_jumps != self._jumps:
            self._jumps = self._estimator.time_jumps
            self.get_logger().warning("time has jumped back: the estimator begins anew")

    def _on_diagnostics(self) -> None:
        now_s = time.monotonic()
        elapsed_s, self._reported_s = now_s - self._reported_s, now_s
        cost, self._cost = self._cost, TickCost()
        if not self.get_clock().now().nanoseconds:
            reports = [Report("estimator", NO_CLOCK, warning=True)]
        else:
            period_s, settings = self._wishes.tick_period_s, self._wishes.settings
            load = load_report(cost, elapsed_s, period_s, settings.fusion_period_s)
            if load.warning:
                self.get_logger().warning(load.message, throttle_duration_sec=_THROTTLE_S)
            reports = self._estimate_reports(load)
            self._warn_of_drops(now_s)
        self._say_what_is_missing(now_s)
        self._publish_diagnostics(reports)

    def _estimate_reports(self, load: Report) -> list[Report]:
        """One report per robot and one for the estimator."""
        if self._estimate is None:
            return [Report("estimator", load.message, load.warning, load.values)]
        now_ns = self.get_clock().now().nanoseconds
        recent, drops = self._estimator.recent(), self._estimator.drops
        *robots, whole = self._health.reports(now_ns, self._estimate, recent, drops)
        whole.values["time jumps"] = str(self._estimator.time_jumps)
        whole.values.update({name: str(count) for name, count in self._estimator.counters.items()})
        return [*robots, merged([whole, load], "estimator")]

    def _warn_of_drops(self, now_s: float) -> None:
        """Tell of data that is dropped for being wrong, not too often; what is not told now is told later."""
        drops = self._estimator.drops
        wrong = {reason: count for reason, count in drops.items() if reason not in _ORDINARY_DROPS}
        if wrong != self._known_drops and now_s >= self._told_drops_s + _THROTTLE_S:
            self._known_drops, self._told_drops_s = wrong, now_s
            words = ", ".join(f"{count} {reason}" for reason, count in wrong.items())
            self.get_logger().warning(f"dropped so far: {words}")

    def _say_what_is_missing(self, now_s: float) -> None:
        """Name what is waited for, after a while and once: first the clock, then the topics."""
        clock_runs = bool(self.get_clock().now().nanoseconds)
        if clock_runs != self._clock_runs:
            self._clock_runs, self._waiting_since_s, self._has_said_missing = clock_runs, now_s, False
        if self._has_said_missing or now_s < self._waiting_since_s + _PATIENCE_S:
            return
        self._has_said_missing = True
        missing = self._health.missing_text() if clock_runs else NO_CLOCK
        if missing:
            self.get_logger().warning(f"waiting: {missing}")

    def _why_missing(self, topic: str) -> str:
        """What the graph knows about a topic on which nothing comes."""
        publishers = self.get_publishers_info_by_topic(topic)
        if not publishers:
            return " (no publisher)"
        if all(info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for info in publishers):
            return " (published best effort, must be reliable)"
        return ""

    def _publish_diagnostics(self, reports: list[Report]) -> None:
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        message.status = [self._status_message(report) for report in reports]
        self._diagnostics.publish(message)

    def _status_message(self, report: Report) -> DiagnosticStatus:
        name = self.get_name() if report.name == "estimator" else f"{self.get_name()}: {report.name}"
        return DiagnosticStatus(
            level=DiagnosticStatus.WARN if report.warning else DiagnosticStatus.OK,
            name=name,
            message=report.message,
            values=[KeyValue(key=key, value=value) for key, value in report.values.items()],
        )

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._estimator.drop("reset", len(self._backlog))
        self._backlog.clear()
        self._estimator.reset()
        response.success, response.message = True, "All robots begin anew at their configured starts."
        self.get_logger().info("reset by service: the estimator begins anew")
        return response

    def _on_set_robot_pose(
        self, request: SetRobotPose.Request, response: SetRobotPose.Response
    ) -> SetRobotPose.Response:
        try:
            response.message = self._set_robot_pose(request)
            response.success = True
            self.get_logger().info(f"by service: {response.message}")
        except SeatRequestError as error:
            response.success, response.message = False, f"Nothing was changed: {error}"
        return response

    def _set_robot_pose(self, request: SetRobotPose.Request) -> str:
        """Do what was asked, and say it."""
        robot = self._swarm.index_of.get(request.robot)
        now_ns = self.get_clock().now().nanoseconds
        if robot is None:
            raise SeatRequestError(f"there is no robot '{request.robot}' in the swarm description.")
        if not now_ns:
            raise SeatRequestError(f"{NO_CLOCK}.")
        if request.forget:
            self._estimator.forget(robot, now_ns)
            return f"Robot '{request.robot}' waits for a fix."
        pose, covariance = planar_seat(request.pose, self._swarm.robots[robot].start_sigma)
        fault = self._estimator.seat(robot, now_ns, pose, covariance)
        if fault:
            raise SeatRequestError(REFUSALS[fault])
        x, y, theta = pose
        return f"Robot '{request.robot}' is at x {x:.3f} m, y {y:.3f} m, theta {theta:.3f} rad."


def main() -> int:
    """Run until SIGINT or SIGTERM; 1 when a parameter or the swarm description cannot be used."""
    return run_node("estimator_node", EstimatorNode, spin)


if __name__ == "__main__":
    sys.exit(main())
