"""Diagnostics of the estimator: robots, inputs, drops and load. No ROS here."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.health import Level, Report, drop_values, level_of, listed
from swarm_loc_estimator.filter.measurements import Measurements, Verdict
from swarm_loc_estimator.filter.models import SCAN
from swarm_loc_estimator.identification.memory import Identities
from swarm_loc_estimator.nodes.parameters import EstimatorParameters
from swarm_loc_estimator.sensors.inputs import Ingest, InputTopic
from swarm_loc_estimator.sensors.map_topic import MapSensor
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.timeline.estimate import Contradiction, LossReport
from swarm_loc_estimator.timeline.estimator import Estimate, Status

_FULL_LOAD = 0.95
_CAUSES = {
    "future_stamp": "are stamped ahead of this computer's clock",
    "odometry_too_old": "have stamps older than horizon_s: of another clock, or too late",
    "bad_covariance": "have a covariance that is zero or not positive definite",
    "fix_without_covariance": "have no covariance, and fix.position_sigma of its description is 0",
    "no_camera": "are detections, and its description has no camera",
    "no_odometry": "are odometry, and its description says that it stands",
    "non_finite": "are not finite",
    "odometry_non_finite": "are odometry that is not finite",
    "absurd": "are absurdly large",
    "face_down": "are of lying markers that show the floor: is the pose of the camera right?",
    "not_flat": "are of markers that do not lie level at z of their face: are size and camera pose right?",
    "odometry_absurd": "are odometry that is absurdly large",
    "scan_bad_geometry": "are scans without finite angles, or of more than a revolution",
    "scan_bad_times": "are scans whose time_increment is not finite, or makes a sweep of more than 2 s",
    "scan_without_beams": "are scans without any valid range",
}
"""Why messages of a robot are dropped."""
_UNUSED_SCANS = {
    Verdict.OFF_MAP: "contradict the map at its pose: check lidar.yaw, lidar.roll, the map and the start",
    Verdict.BLOCKED: "show too few walls of the map",
    Verdict.NOT_LOCALIZED: "do not locate it before it has driven on",
    Verdict.SEVERAL_PLACES: "fit several places in the map: drive it to where the map looks otherwise",
    Verdict.NO_PLACE: "fit no place in the map: check lidar.yaw, lidar.roll and the map",
    Verdict.GATED: "were gated",
}
"""Why no scan of a robot is used."""
_PATIENCE_S, _PATIENCE_PERIODS = 10.0, 5.0  # Timeout of an expected input [s], and in its mean periods


@dataclass
class TickCost:
    """Cost of the ticks since the last report."""

    count: int = 0  # Number of ticks
    sum_s: float = 0.0  # Total duration of the ticks [s]
    max_s: float = 0.0  # Duration of the longest tick [s]
    sightings: int = 0  # Number of measurements received
    shed: int = 0  # Number of measurements dropped under overload

    def note(self, seconds: float) -> None:
        """Count one tick."""
        self.count += 1
        self.sum_s += seconds
        self.max_s = max(self.max_s, seconds)

    def note_sightings(self, count: int, shed: int) -> None:
        """Count measurements, and those that were dropped under overload."""
        self.sightings += count
        self.shed += shed


Recent = tuple[Measurements, NDArray[np.uint8], FloatArray]


def add_contradictions(reports: Sequence[Report], contradictions: Sequence[Contradiction]) -> None:
    """Add contradictions to the reports of the robots that they are about, the others to the last report."""
    report_of = {report.name: report for report in reports}
    for one in contradictions:
        report = report_of.get(one.about.rpartition(" of ")[2], reports[-1])
        report.message = f"{report.message}; {one.text}" if report.warning else one.text
        report.level = Level.WARN


def add_identities(reports: Sequence[Report], identities: Identities | None) -> None:
    """Add to the robots' reports (the first ones) their detections in the newest aerial image."""
    if identities is None:
        return
    columns = zip(identities.place.tolist(), identities.probability.tolist(), strict=True)
    for report, (place, probability) in zip(reports, columns, strict=False):
        report.values["aerial detection"] = str(place) if place >= 0 else "not known"
        report.values["aerial probability [1]"] = _figure(probability)


class Graph(Protocol):
    """Publishers in the ROS graph, see `ConfiguredNode`."""

    def duplicate_publishers(self, topic: str) -> list[str]:
        """Names of the nodes that publish a topic, if there are several."""

    def why_missing(self, topic: str, message_type: str) -> str:
        """Why a topic has no messages, such as " (no publisher)"."""


class Diagnostics:
    """Creates the diagnostic reports of an interval; inputs and `sole` topics should have one publisher."""

    def __init__(
        self, swarm: Swarm, ingest: Ingest, parameters: EstimatorParameters, graph: Graph, sole: Sequence[str]
    ) -> None:
        # One sentence for each topic that has more publishers, at the newest reports
        self.duplicate_publishers: list[str] = []
        self._swarm = swarm
        self._ingest = ingest
        self._parameters = parameters
        self._graph = graph
        self._sole = sole
        self._sources = swarm.sources
        self._inputs_of: list[list[tuple[int, InputTopic]]] = [[] for _ in self._sources]
        self._of_swarm: list[tuple[int, InputTopic]] = []
        for handle, topic in enumerate(ingest.topics):
            inputs = self._inputs_of[topic.robot] if topic.kind.of_each else self._of_swarm
            inputs.append((handle, topic))
        self._received = [0] * len(ingest.topics)
        self._dropped: list[Mapping[str, int]] = [{} for _ in self._sources]
        self._reported_ns: int | None = None

    def missing(self) -> list[InputTopic]:
        """Expected topics without any message so far."""
        pairs = zip(self._ingest.topics, self._ingest.statistics, strict=True)
        return [topic for topic, statistics in pairs if topic.expected and not statistics.received]

    def missing_text(self) -> str:
        """One sentence about the missing topics, grouped by cause; "" without any."""
        by_cause: dict[str, list[str]] = {}
        for topic in self.missing():
            why = self._graph.why_missing(topic.name, topic.kind.message_type)
            by_cause.setdefault(why, []).append(topic.name)
        causes = by_cause.items()
        return "; ".join(f"no messages received on {listed(names)}{cause}" for cause, names in causes)

    def reports(
        self,
        now_ns: int,
        estimate: Estimate,
        recent: Recent,
        drops: Mapping[str, int],
        drops_of: Sequence[Mapping[str, int]] = (),
        losses: Sequence[LossReport | None] = (),
    ) -> list[Report]:
        """Reports of robots, of fixed cameras, of the swarm's inputs and drops; begins a new interval.

        `recent` are the estimator's measurements with verdicts and normalized innovations squared, `drops`
        what was not used by reason, `drops_of` that of each robot and fixed camera, and `losses` why robots
        are not located; None for others.
        """
        elapsed_s = (now_ns - self._reported_ns) * 1e-9 if self._reported_ns is not None else 0.0
        self._reported_ns = now_ns
        # how many measurements of each source were used, and their mean NIS (NaN for none)
        measurements, verdicts, nis = recent
        mine = (verdicts == Verdict.USED) & (measurements.received_from >= 0) & np.isfinite(nis)
        observers, count = measurements.received_from[mine], len(self._sources)
        used = np.bincount(observers, minlength=count)
        total = np.bincount(observers, nis[mine], minlength=count)
        mean_nis = np.divide(total, used, out=np.full(count, np.nan), where=used > 0)
        # robots and fixed cameras
        of_one = [topic.name for _, topic in self._of_swarm if not topic.kind.stands_for]
        common = self._duplicates_on([*self._sole, *of_one])
        self.duplicate_publishers = common.copy()
        reports, clocks_apart = [], self._ingest.clocks_apart()
        for index, source in enumerate(self._sources):
            robot = source if isinstance(source, Robot) else None
            inputs, loss = self._inputs_of[index], losses[index] if index < len(losses) else None
            troubles = self._duplicates_on([topic.name for _, topic in inputs])
            self.duplicate_publishers += troubles
            troubles += [loss.text(now_ns)] if loss is not None else []
            if drops_of:
                before, self._dropped[index] = self._dropped[index], dict(drops_of[index])
                for reason, cause in _CAUSES.items():
                    grown = drops_of[index].get(reason, 0) - before.get(reason, 0)
                    troubles += [f"dropped {grown} of its data: they {cause}"] if grown else []
            own = verdicts[(measurements.model == SCAN) & (measurements.target == index)]
            most = Verdict(int(np.bincount(own).argmax())) if own.size else Verdict.OPEN
            if most and not (own == Verdict.USED).any():
                why = _UNUSED_SCANS[most]
                troubles.append(f"none of its last {own.size} scans is used: they {why}")
            troubles += [clocks_apart[index].problem] if index in clocks_apart else []
            values: dict[str, object] = {}
            for handle, topic in inputs:
                troubles += self._input_troubles(handle, topic, robot, now_ns)
                if topic.expected or self._ingest.statistics[handle].received:
                    values.update(self._values(handle, topic, now_ns, elapsed_s))
            words = "seeing" if robot is None else _state(index, estimate, troubles, values)
            values |= drop_values(drops_of[index]) if drops_of else {}
            values |= {"measurements used": str(used[index]), "NIS mean": _figure(mean_nis[index])}
            reports.append(Report(source.name, "; ".join(troubles) or words, level_of(troubles), values))
        # the swarm
        troubles, values = [*common, *filter(None, [self.missing_text()])], drop_values(drops)
        for handle, topic in self._of_swarm:
            troubles += self._input_troubles(handle, topic, None, now_ns)
            if self._ingest.statistics[handle].received:
                values.update(self._values(handle, topic, now_ns, elapsed_s))
        summary = {int(status): int(np.sum(estimate.status == status)) for status in Status}
        words = ", ".join(f"{summary[status]} {status.name.lower()}" for status in Status if summary[status])
        turned = int(np.sum((estimate.status != Status.WAITING) & ~estimate.heading_known))
        words += f", {turned} of unknown heading" if turned else ""
        reports.append(Report("estimator", "; ".join(troubles) or words, level_of(troubles), values))
        return reports

    def _duplicates_on(self, topics: Sequence[str]) -> list[str]:
        """One sentence for each of the topics that several nodes publish."""
        found = {topic: self._graph.duplicate_publishers(topic) for topic in topics}
        some = {topic: names for topic, names in found.items() if names}
        return [f"{topic} has {len(names)} publishers: {listed(names)}" for topic, names in some.items()]

    def _input_troubles(self, handle: int, topic: InputTopic, robot: Robot | None, now_ns: int) -> list[str]:
        statistics = self._ingest.statistics[handle]
        if not statistics.received:
            why = self._graph.why_missing(topic.name, topic.kind.message_type)
            return [f"no messages received on {topic.name}{why}"] if topic.expected else []
        if statistics.last_arrival_ns is None:
            return [f"no message on {topic.name} is a {topic.kind.message_type}"]
        troubles, found = [], self._ingest.frame_id(handle)
        silent_s = (now_ns - statistics.last_arrival_ns) * 1e-9
        # detectors and infrared boards have periods of their own
        patience_s = max(_PATIENCE_S, _PATIENCE_PERIODS * 1e-9 * (statistics.mean_period_ns or 0.0))
        if topic.kind.name == "odometry" and robot is not None:
            patience_s = robot.odometry.timeout_s
        elif (topic.kind.of_each and not topic.expected) or topic.kind.rows == MapSensor.name:
            patience_s = math.inf
        if silent_s > patience_s:
            troubles.append(f"{topic.name} is silent for {silent_s:.1f} s")
        map_frame = self._ingest.map_frame
        if topic.kind.in_map and found != map_frame:
            troubles.append(f"{topic.name} is in frame '{found}' but must be in '{map_frame}'")
        one = self._parameters
        odom_frame = one.odom_frame if robot is None else one.odom_frame_of(robot.name)
        if topic.kind.rows == "odometry" and found != odom_frame:
            published = f"transforms are published for '{odom_frame}'"
            troubles.append(f"{topic.name} is in frame '{found}' but {published}")
        return troubles

    def _values(self, handle: int, topic: InputTopic, now_ns: int, elapsed_s: float) -> dict[str, object]:
        """Figures of an input over the interval; begins its next one."""
        statistics = self._ingest.statistics[handle]
        name = topic.name if topic.kind.of_pairs or topic.device else topic.kind.topic
        arrived = statistics.received - self._received[handle]
        self._received[handle] = statistics.received
        arrival_ns, count, most_ns = statistics.last_arrival_ns, statistics.late_count, statistics.late_max_ns
        values: dict[str, object] = {
            f"{name} received": str(statistics.received),
            f"{name} malformed": str(statistics.malformed),
            f"{name} rate [1/s]": _figure(arrived / elapsed_s if elapsed_s > 0.0 else None),
            f"{name} age [s]": _figure(None if arrival_ns is None else (now_ns - arrival_ns) * 1e-9),
            f"{name} lateness mean [s]": _figure(statistics.late_sum_ns * 1e-9 / count if count else None),
            f"{name} lateness max [s]": _figure(None if most_ns is None else most_ns * 1e-9),
        }
        statistics.restart()
        return values


def load_report(cost: TickCost, elapsed_s: float, period_s: float, fusion_period_s: float) -> Report:
    """Report of the ticks in `elapsed_s` by the wall clock, with advice if they take too long."""
    load = cost.sum_s / elapsed_s if elapsed_s > 0.0 else 0.0
    values: dict[str, object] = {
        "ticks": str(cost.count),
        "tick mean [ms]": _figure(1e3 * cost.sum_s / cost.count if cost.count else None),
        "tick max [ms]": _figure(1e3 * cost.max_s),
        "load [1]": _figure(load),
    }
    if load < _FULL_LOAD:
        return Report("load", f"ticks take {100.0 * load:.0f} % of the time", values=values)
    advice = f"raise fusion_period_s (now {fusion_period_s:g} s) or tick_period_s (now {period_s:g} s)"
    said = f"a tick takes {1e3 * cost.sum_s / cost.count:.0f} ms, more than its share: {advice}"
    return Report("load", said, level=Level.WARN, values=values)


def shedding_report(cost: TickCost) -> Report:
    """Report of the share of measurements dropped under overload."""
    share = cost.shed / cost.sightings if cost.sightings else 0.0
    dropped = f"dropped {cost.shed} of {cost.sightings} measurements ({100.0 * share:.0f} %)"
    said = f"overload: {dropped}, uniformly over robots"
    said = said if cost.shed else "nothing is left out for lack of time"
    return Report("shedding", said, level_of(cost.shed), {"sightings left out [1]": _figure(share)})


def merged(reports: Sequence[Report], name: str) -> Report:
    """Several reports merged into one; warnings come first."""
    warnings = [report.message for report in reports if report.warning]
    values = {key: value for report in reports for key, value in report.values.items()}
    message = "; ".join(warnings or [report.message for report in reports])
    return Report(name, message, level_of(warnings), values)


def _state(index: int, estimate: Estimate, troubles: list[str], values: dict[str, object]) -> str:
    """The state of a robot in words, which is added to troubles and values."""
    status, sigma = Status(int(estimate.status[index])), np.sqrt(np.diagonal(estimate.covariances[index]))
    if status is Status.WAITING and not troubles:
        troubles.append("waiting for a sighting or a fix that locates it")
    if status is Status.STALE and not troubles:
        troubles.append("its odometry is silent")
    if status is Status.UNCERTAIN:
        size = f"{_figure(max(sigma[:2]))} m, with a heading of {_figure(sigma[2])} rad"
        troubles.append(f"its position is uncertain: its standard deviation is {size}")
    heading_known = bool(estimate.heading_known[index])
    values["status"], values["heading known"] = status.name.lower(), str(heading_known).lower()
    values["fix age [s]"] = _figure(estimate.fix_age_s[index])
    values["sigma x [m]"], values["sigma y [m]"] = _figure(sigma[0]), _figure(sigma[1])
    values["sigma theta [rad]"] = _figure(sigma[2])
    unknown = status is not Status.WAITING and not heading_known
    return f"{status.name.lower()}{', heading unknown' if unknown else ''}"


def _figure(value: float | None) -> str:
    """A number as text; "-" for NaN."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.4g}"
