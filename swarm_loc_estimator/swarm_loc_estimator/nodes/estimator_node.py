"""The central estimator of a swarm as a ROS 2 node.

    ./run swarm_loc_estimator estimator_node --ros-args -p swarm_file:=swarm.yaml

Topics, services and parameters: see `doc/estimator_node.md`. No other node may publish its transforms.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from rclpy.subscription import Subscription
from rclpy.time import Time
from std_srvs.srv import Trigger

from swarm_loc_estimator.common.health import PATIENCE_S, Level, Report
from swarm_loc_estimator.common.jit import is_precompiled
from swarm_loc_estimator.common.messages.streams import MessageBatch
from swarm_loc_estimator.common.node import BACKWARDS, ManagedNode, Ticks, run_node
from swarm_loc_estimator.nodes import estimator_diagnostics as diagnostics
from swarm_loc_estimator.nodes import estimator_topics as topics
from swarm_loc_estimator.nodes.load import SHED_REASONS, FusionPace, Shedding, Thinning
from swarm_loc_estimator.nodes.parameters import EstimatorParameters
from swarm_loc_estimator.nodes.refinement import Refinement
from swarm_loc_estimator.precompile import precompile, size_of
from swarm_loc_estimator.sensors.inputs import Ingest, live_topics
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator
from swarm_loc_estimator.timeline.map_search import described_map
from swarm_loc_estimator.timeline.settings import Settings
from swarm_loc_msgs.srv import SetRobotPose

_ORDINARY_DROPS = SHED_REASONS | {
    *("aerial_ambiguous", "aerial_unassigned", "duplicate", "gated", "ir_saturated", "ir_too_weak"),
    *("ir_undetermined", "odometry_duplicate", "reset", "too_old", "not_localized"),
}
"""Ordinary drops, which are not logged; those under overload have a warning of their own."""

_READ_BYTES = 8_000_000  # Read and thinned out at once: what is read takes more memory than what is left
INACTIVE = "Nothing was changed: the estimator is not active."  # Answer of the services while it is not

CreateEstimator = Callable[[Swarm, Settings], Estimator]


class EstimatorNode(ManagedNode[EstimatorParameters]):
    """Takes messages, runs the estimator, which tests replace, once per tick, and publishes the estimate."""

    def __init__(self, create_estimator: CreateEstimator = Estimator, **node_arguments: Any) -> None:
        super().__init__("estimator", EstimatorParameters, **node_arguments)
        self._create_estimator = create_estimator
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(Trigger, "~/refine", self._on_refine)
        self.create_service(SetRobotPose, "~/set_robot_pose", self._on_set_robot_pose)
        self.autostart()

    def prepare(self) -> None:
        """Read the description and its map, and compile."""
        self._swarm = load_swarm(Path(self.params.swarm_file))
        has_infrared = any(robot.ir is not None for robot in self._swarm.robots)
        compiled = partial(precompile, size_of(self._swarm, self.params.settings), has_infrared)
        if not is_precompiled(compiled):
            self.get_logger().info("compiling the estimator for this machine: one to three minutes")
        compiled()
        described_map(self._swarm)  # each activation reads them again; here they are refused or compiled for

    def begin(self) -> None:
        """Estimate from scratch: what was known before a pause may be wrong by now."""
        self._estimator = self._create_estimator(self._swarm, self.params.settings)
        shared = self.params.shared_topics
        self._ingest = Ingest(self._swarm, self.params.map_frame, live_topics(self._swarm, shared=shared))
        self._estimate: Estimate | None = None
        self._jumps = 0
        self._origin = ""
        self._pace = FusionPace(self.params.fusion_load, self.params.settings.horizon_s)
        self._shedding = Shedding(self.params.fusion_load, self.params.settings.horizon_s)
        # whole fusion periods of a large swarm, whose measurements are fused together
        period_s = self._estimator.settings.fusion_period_s
        is_large = len(self._swarm.robots) >= self._estimator.settings.sparse_from
        self._thinning = Thinning(len(self._swarm.robots), round(period_s * 1e9) if is_large else 0)
        self._measurements: Counter[str] = Counter()  # Read so far, by sensor
        self._cost = diagnostics.TickCost()
        sole = ["swarm/poses", *(["/clock"] if self.get_clock().ros_time_is_active else [])]
        self._diagnostics = diagnostics.Diagnostics(self._swarm, self._ingest, self.params, self, sole)
        self._outputs = topics.EstimateOutputs(self, self._swarm, self.params)
        self._reported_s = time.monotonic()
        self._lost = 0
        self._refinement = Refinement()
        self.at_end(self._refinement.stop)
        self._static_transforms = topics.StaticTransforms(self, self._swarm, self._ingest, self.params)
        horizon_s = self.params.settings.horizon_s
        self._inputs = topics.EstimatorInputs(self, self._ingest.topics, self._estimator.drop, horizon_s)
        frame = self.params.map_frame
        self._commands = topics.PoseCommands(self, self._swarm, self._estimator, frame, by_topics=not shared)
        self.at_end(Ticks(self, self.params.tick_period_s, self._on_tick).stop)
        # messages received before a backward jump must not be stamped after it
        before_jumps = partial(self._receive, self._time_ns)
        self.at_end(self.get_clock().create_jump_callback(BACKWARDS, pre_callback=before_jumps).unregister)
        known = f"{len(self._swarm.robots)} robots and {len(self._swarm.landmarks)} landmarks"
        self.get_logger().info(f"ready: {known} of '{self.params.swarm_file}'")
        if hint := self._estimator.hint:
            self.get_logger().warning(hint)

    @property
    def status_name(self) -> str:
        """First part of the names of its statuses, which name robots, too."""
        return str(self.get_name())

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """Subscriptions that an executor handles; the raw ones, the inputs, are taken by ticks."""
        return (one for one in super().subscriptions if not one.raw)

    def _on_tick(self) -> None:
        begin_s = time.perf_counter()
        if not (self.is_active and self._time_ns()):
            return
        self._shedding.begin_tick(begin_s, self._pace.waited_s(self._time_ns()))
        self._receive(partial(topics.newest_time_ns, self))
        # restart with mounts of sensors that static transforms tell
        news = self._static_transforms.mounts()
        if news is not None and news[0] != self._estimator.swarm:
            self._estimator.describe(news[0])
            self.get_logger().info(" ".join(news[1]))
        self._inputs.looked_ns = now_ns = self._time_ns()
        self._estimate, fusing_s = self._estimate_at(now_ns, begin_s)
        if self._estimator.time_jumps != self._jumps:
            self._jumps = self._estimator.time_jumps
            self._refinement.forget()
            self.get_logger().warning("clock jumped back; estimator reset")
        self._follow_frame()
        self._outputs.publish(self._estimate)
        self._outputs.publish_identities(self._estimator.identities)
        self._outputs.publish_sightings(self._estimator, now_ns)
        busy_s = time.perf_counter() - begin_s
        self._cost.note(busy_s)
        self._shedding.note(busy_s, fusing_s)

    def _estimate_at(self, now_ns: int, begin_s: float) -> tuple[Estimate, float]:
        """Fuse within the time budget; returns the poses at an instant and the time that fusing took [s].

        Fusing a large swarm is spread over several ticks, in between which poses are predicted by odometry.
        """
        is_due = not self._estimator.is_fusing and self._pace.is_due(begin_s, now_ns)
        if is_due:
            self._pace.begin(begin_s, now_ns)
            self._shedding.begin_fusion()
        begin_cpu_s, begin_fusing_s = time.thread_time(), time.perf_counter()
        fuse, end_cpu_s = is_due or self._estimator.is_fusing, begin_cpu_s + self.params.tick_period_s
        estimate = self._estimator.tick(now_ns, fuse=fuse, has_budget=lambda: time.thread_time() < end_cpu_s)
        if not fuse:
            return estimate, 0.0
        self._pace.note(time.thread_time() - begin_cpu_s)
        return estimate, time.perf_counter() - begin_fusing_s

    def _time_ns(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _receive(self, time_ns: Callable[[], int]) -> None:
        """Pass the messages received to the estimator, thinned out under overload."""
        batches = MessageBatch.parts_of(self._inputs.take(time_ns), _READ_BYTES)
        for messages in chain.from_iterable(map(self._ingest.read, batches)):
            thinned = self._thinning.thin(messages, self._shedding.share)
            self._measurements.update(thinned.measurements)
            self._cost.note_sightings(sum(thinned.measurements.values()), thinned.shed)
            self._estimator.receive(thinned.messages)
            self._refinement.keep(thinned.messages)
        # how many measurements were in messages that were not read is not known: as many as usually
        for sensor, count in self._measurements.items():
            unread = self._inputs.unread.pop(sensor, 0)
            missed = round(unread * count / max(self._inputs.taken[sensor], 1))
            self._cost.note_sightings(missed, missed)
            self._estimator.drop(f"shed_{sensor}", missed)

    def _follow_frame(self) -> None:
        """Publish in the frame that the poses are in: `map_frame`, or that of the origin of a local frame."""
        if self._estimator.origin == self._origin:
            return
        before, self._origin = self._frame, self._estimator.origin
        self._outputs.use_frame(self._frame)
        if self._origin:
            text = f"no start, landmark or fix: poses are relative to {self._origin}, in '{self._frame}'"
            self.get_logger().warning(text)
        else:
            self.get_logger().info(f"poses are in '{self._frame}' now, no longer in '{before}'")

    @property
    def _frame(self) -> str:
        return f"{self._origin}/start" if self._origin else self.params.map_frame

    def report(self) -> None:
        """Publish one report per robot and one of the estimator."""
        begin_s = time.perf_counter()
        now_s = time.monotonic()
        elapsed_s, self._reported_s = now_s - self._reported_s, now_s
        cost, self._cost = self._cost, diagnostics.TickCost()
        if not self._time_ns():
            missing, reports = topics.NO_CLOCK, [Report("estimator", topics.NO_CLOCK, Level.WARN)]
        else:
            missing, reports = self._diagnostics.missing_text(), self._make_reports(cost, elapsed_s)
        self.health.warn_of("missing", {self._time_ns() > 0: missing} if missing else {}, PATIENCE_S)
        for report in reports:
            report.name = f"{self.status_name}: {report.name}".removesuffix(": estimator")
        # inputs are taken for poses, so counts belong to the stamp of the poses
        stamp = Time(nanoseconds=self._estimate.stamp_ns) if self._estimate is not None else None
        self.publish_reports(*reports, stamp=stamp)
        self._shedding.note(time.perf_counter() - begin_s)

    def _make_reports(self, cost: diagnostics.TickCost, elapsed_s: float) -> list[Report]:
        """One report per robot and one for the estimator; warnings are logged."""
        # Load, and what was left out or dropped.
        periods_s = self.params.tick_period_s, self._estimator.settings.fusion_period_s
        causes = [diagnostics.load_report(cost, elapsed_s, *periods_s), diagnostics.shedding_report(cost)]
        for report in causes:
            if report.warning:
                self.health.warn(report.name, report.message)
        drops = self._estimator.drops
        self.health.warn_of_drops({k: n for k, n in drops.items() if k not in _ORDINARY_DROPS})
        if self._estimate is None:
            return [diagnostics.merged(causes, "estimator")]
        # Robots, with faults and identities.
        now_ns = self._time_ns()
        own = [self._estimator.drops_of(source) for source in range(len(self._swarm.sources))]
        losses = [self._estimator.loss_of(robot) for robot in range(len(self._swarm.robots))]
        recent = self._estimator.recent()
        reports = self._diagnostics.reports(now_ns, self._estimate, recent, drops, own, losses)
        contradictions = self._estimator.contradictions(now_ns)
        diagnostics.add_contradictions(reports, contradictions)
        diagnostics.add_identities(reports, self._estimator.identities)
        # The estimator as a whole.
        *robots, whole = reports
        frames = {"frame": self._frame, "frame moves": self._estimator.frame_moves}
        whole.values |= {"time jumps": self._estimator.time_jumps, **frames, **self._estimator.counters}
        foreign = self._static_transforms.foreign
        lost, self._lost = drops.get("overload", 0) - self._lost, drops.get("overload", 0)
        if lost:
            text = f"overload: {lost} messages were lost in queues"
            causes.append(Report("overload", text, Level.WARN))
        causes += [Report("transforms", text, Level.WARN) for text in foreign]
        publishers = [*self._diagnostics.duplicate_publishers, *foreign]
        self.health.warn_of("publishers", {text: text for text in publishers})
        self.health.warn_of("contradictions", {(one.about, one.kind): one.text for one in contradictions})
        return [*robots, diagnostics.merged([whole, *causes], "estimator")]

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not self.is_active:
            response.message = INACTIVE
            return response
        self._estimator.drop("reset", len(self._inputs.take(self._time_ns)))
        self._estimator.reset()
        response.success, response.message = True, "All robots restart at their configured poses."
        self.get_logger().info("estimator reset by service")
        return response

    def _on_refine(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not self.is_active:
            response.message = INACTIVE
            return response
        answer = self._refinement.ask(self._estimator.swarm, Path(self.params.swarm_file))
        response.success, response.message = answer
        self.get_logger().info(response.message)
        return response

    def _on_set_robot_pose(
        self, request: SetRobotPose.Request, response: SetRobotPose.Response
    ) -> SetRobotPose.Response:
        if not self.is_active:
            response.message = INACTIVE
            return response
        return self._commands.on_request(request, response)


main = partial(run_node, "estimator_node", EstimatorNode, leaves_at_once=True)
"""It has nothing to finish, and destroying many publishers takes long."""
