"""What /diagnostics and the log say: from figures alone, and each problem once in a while."""

from typing import Any

import numpy as np
import pytest
from core_messages import SECOND, odometry_bytes

from swarm_loc_estimator.common.health import PATIENCE_S, THROTTLE_S, Health, drop_values, listed
from swarm_loc_estimator.common.messages.cdr import RANGE, encode
from swarm_loc_estimator.common.messages.detections import DETECTION_DTYPE, encode_detections
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.filter.measurements import LossReason, Measurements, Verdict
from swarm_loc_estimator.filter.models import SCAN
from swarm_loc_estimator.nodes.estimator_diagnostics import Diagnostics, Recent, TickCost, load_report
from swarm_loc_estimator.nodes.parameters import EstimatorParameters
from swarm_loc_estimator.sensors.inputs import Ingest
from swarm_loc_estimator.swarm.error_models import OdometryModel
from swarm_loc_estimator.swarm.swarm import Robot, Swarm, UwbDevice
from swarm_loc_estimator.timeline.estimate import LossReport
from swarm_loc_estimator.timeline.estimator import Estimate, Status

SWARM = Swarm((Robot("a", odometry=OdometryModel(timeout_s=1.0)), Robot("b", camera=None)))


class Graph:
    """Knows the publishers that a test says."""

    def __init__(self) -> None:
        self.publishers: dict[str, list[str]] = {}

    def duplicate_publishers(self, topic: str) -> list[str]:
        """Those of the topic."""
        return self.publishers.get(topic, [])

    def why_missing(self, topic: str, message_type: str) -> str:
        """The robot's name is why."""
        assert "/msg/" in message_type
        return f" (why {topic[0]})"


class World:
    """Diagnostics of a swarm, fed by hand."""

    def __init__(self, swarm: Swarm = SWARM, *, tf_per_robot: bool = False) -> None:
        parameters = EstimatorParameters(tf_per_robot=tf_per_robot)
        self.ingest = Ingest(swarm)
        self.graph = Graph()
        self.diagnostics = Diagnostics(swarm, self.ingest, parameters, self.graph, ["swarm/poses"])
        self.reports = self.diagnostics.reports
        self._all_tracked = [Status.TRACKED] * len(swarm.robots)

    def tracked(self, now_ns: int = 0, rows: Recent | None = None) -> list[Any]:
        """Reports where all robots are tracked."""
        return [*self.reports(now_ns, estimate(now_ns, *self._all_tracked), rows or recent(), {})]

    def read(self, topic: str, data: bytes, now_ns: int) -> None:
        """A message on a topic."""
        message = SerializedMessage(self.ingest.handle_of[topic], data, now_ns)
        list(self.ingest.read(MessageBatch.of([message])))

    def detections(self, now_ns: int) -> None:
        """A picture of robot a without any marker."""
        data = encode_detections("a/camera_optical_frame", now_ns, np.zeros(0, DETECTION_DTYPE))
        self.read("a/detections", data, now_ns)

    def odometry(self, robot: str, stamp_ns: int, now_ns: int, frame: str | None = None) -> None:
        """One message."""
        self.read(f"{robot}/odom", odometry_bytes(robot, stamp_ns, frame=frame), now_ns)


def estimate(now_ns: int, *status: Status) -> Estimate:
    n, code = len(status), np.array(status, np.uint8)
    poses, covariances = np.zeros((n, 3)), np.tile(4.0 * np.eye(3), (n, 1, 1))
    return Estimate(now_ns, poses, covariances, poses, code, np.zeros(n), np.ones(n, bool))


def recent(*rows: tuple[int, Verdict, float]) -> Recent:
    """Measurements: who sent it, what was thought of it, its NIS."""
    measurements = Measurements.empty(len(rows))
    measurements.received_from[:] = [row[0] for row in rows]
    verdicts, nis = [row[1] for row in rows], [row[2] for row in rows]
    return measurements, np.array(verdicts, np.uint8), np.array(nis, dtype=float)


def test_missing_topics_are_grouped_by_cause() -> None:
    world = World()
    assert [topic.name for topic in world.diagnostics.missing()] == ["a/odom", "a/detections", "b/odom"]
    assert world.diagnostics.missing_text() == (
        "no messages received on a/odom, a/detections (why a); no messages received on b/odom (why b)"
    )
    world.odometry("b", 0, 0)
    assert "b/odom" not in world.diagnostics.missing_text()


def test_topics_with_too_many_publishers_are_named_where_they_belong() -> None:
    world = World()
    world.odometry("b", 0, 0)
    world.graph.publishers = {"swarm/poses": ["/one", "/two"], "b/odom": ["/player", "/player"]}
    a, b, whole = world.tracked()
    assert "publishers" not in a.message
    assert (b.warning, b.message) == (True, "b/odom has 2 publishers: /player, /player")
    assert whole.message.startswith("swarm/poses has 2 publishers: /one, /two; no messages received")
    assert world.diagnostics.duplicate_publishers == [whole.message.partition(";")[0], b.message]
    world.graph.publishers = {}
    _, b, _ = world.tracked()
    assert (b.warning, world.diagnostics.duplicate_publishers) == (False, [])


def test_rates_and_lateness_are_those_of_the_interval() -> None:
    world = World()
    world.odometry("b", 1 * SECOND, 2 * SECOND)
    world.tracked(10 * SECOND)
    for k in range(4):
        world.odometry("b", 10 * SECOND, 10 * SECOND + k * SECOND // 2)
    _, b, _ = world.tracked(12 * SECOND)
    assert b.values["odom received"] == "5"
    assert b.values["odom rate [1/s]"] == "2"
    assert b.values["odom age [s]"] == "0.5"
    assert b.values["odom lateness mean [s]"] == "0.75"
    assert b.values["odom lateness max [s]"] == "1.5"
    assert b.values["sigma x [m]"] == "2"
    assert (b.warning, b.message) == (False, "tracked")


def test_each_pair_of_radios_has_figures_of_its_own() -> None:
    radios = (UwbDevice(1), UwbDevice(2), UwbDevice(3))
    robots = (Robot(f"r{one.address}", camera=None, uwb=one) for one in radios)
    world = World(Swarm(tuple(robots), range_topic="uwb/{from}/{to}"))
    for topic, count in (("uwb/1/2", 3), ("uwb/1/3", 1)):
        for k in range(count):
            data = encode({"header": {"stamp": k * SECOND}, "range": 1.0}, RANGE)
            world.read(topic, data, k * SECOND)
    first = world.tracked(SECOND)[0]
    found = {name: value for name, value in first.values.items() if str(name).endswith(" received")}
    assert found["uwb/1/2 received"] == "3"
    assert found["uwb/1/3 received"] == "1"


def test_a_robot_is_told_apart_as_waiting_lost_silent_or_in_a_foreign_frame() -> None:
    world = World()
    world.odometry("b", 0, 0)
    _, b, whole = world.reports(0, estimate(0, Status.TRACKED, Status.WAITING), recent(), {"gated": 3})
    assert (b.warning, b.message) == (True, "waiting for a sighting or a fix that locates it")
    assert whole.values == {"dropped: gated": 3}
    world.tracked()
    losses = [None, LossReport(1, LossReason.OFF_MAP, -3 * SECOND, "its scans contradict the map")]
    waiting = estimate(0, Status.TRACKED, Status.WAITING)
    _, b, _ = world.reports(0, waiting, recent(), {}, losses=losses)
    assert (b.warning, b.message) == (True, "lost 3.0 s ago: its scans contradict the map")
    now_ns = 5 * SECOND
    _, b, _ = world.reports(now_ns, estimate(now_ns, Status.TRACKED, Status.STALE), recent(), {})
    assert b.message == "b/odom is silent for 5.0 s"
    world.odometry("b", now_ns, now_ns, frame="odom")
    _, b, _ = world.tracked(now_ns)
    assert b.message == "b/odom is in frame 'odom' but transforms are published for 'b/odom'"


@pytest.mark.parametrize(
    ("reason", "cause"),
    [
        ("future_stamp", "they are stamped ahead of this computer's clock"),
        ("odometry_too_old", "they have stamps older than horizon_s: of another clock, or too late"),
        ("bad_covariance", "they have a covariance that is zero or not positive definite"),
        ("fix_without_covariance", "they have no covariance, and fix.position_sigma of its description is 0"),
        ("no_camera", "they are detections, and its description has no camera"),
        ("no_odometry", "they are odometry, and its description says that it stands"),
        ("odometry_non_finite", "they are odometry that is not finite"),
    ],
)
def test_a_waiting_robot_whose_data_are_dropped_is_told_why(reason: str, cause: str) -> None:
    world = World()
    world.odometry("b", 0, 0)
    waiting = estimate(0, Status.TRACKED, Status.WAITING)
    _, b, _ = world.reports(0, waiting, recent(), {reason: 20}, [{}, {reason: 20}])
    assert (b.warning, b.message) == (True, f"dropped 20 of its data: {cause}")
    assert b.values[f"dropped: {reason}"] == 20
    _, b, _ = world.reports(0, waiting, recent(), {reason: 20}, [{}, {reason: 20}])
    assert b.message == "waiting for a sighting or a fix that locates it"


def test_delays_of_another_clock_do_not_overflow() -> None:
    world, now_ns = World(), 1_700_000_000 * SECOND
    for _ in range(20):
        world.odometry("b", 0, now_ns)
    _, b, _ = world.tracked(now_ns)
    assert float(str(b.values["odom lateness mean [s]"])) == pytest.approx(1.7e9)


def test_a_robot_with_a_clock_of_its_own_is_named() -> None:
    world, now_ns = World(Swarm(tuple(Robot(name, camera=None) for name in "abc"))), 10 * SECOND
    for late_s, problem in ((0.3, "has a clock 0.3 s behind those of the other robots"), (0.1, "tracked")):
        for name, one_s in (("a", 0.0), ("b", late_s), ("c", 0.0)):
            world.odometry(name, now_ns - round(one_s * SECOND), now_ns)
        assert world.tracked(now_ns)[1].message == problem


def test_with_transforms_per_robot_frames_have_no_prefix() -> None:
    world, now_ns = World(tf_per_robot=True), 10 * SECOND
    for frame, message in (("odom", "tracked"), ("b/odom", "b/odom is in frame 'b/odom' but transforms are")):
        world.odometry("b", now_ns, now_ns, frame=frame)
        assert world.tracked(now_ns)[1].message.startswith(message)


def test_a_robot_that_is_too_uncertain_is_named() -> None:
    world = World()
    world.odometry("b", 0, 0)
    a, b, _ = world.reports(0, estimate(0, Status.TRACKED, Status.UNCERTAIN), recent(), {})
    assert "deviation" not in a.message
    assert b.warning
    assert b.message == "its position is uncertain: its standard deviation is 2 m, with a heading of 2 rad"
    assert b.values["status"] == "uncertain"


@pytest.mark.parametrize(("known", "message"), [(True, "tracked"), (False, "tracked, heading unknown")])
def test_an_unknown_heading_is_told_and_is_no_fault(known: bool, message: str) -> None:
    world = World()
    world.odometry("b", 0, 0)
    now = estimate(0, Status.TRACKED, Status.TRACKED)
    now.heading_known[1] = known
    _, b, _ = world.reports(0, now, recent(), {})
    assert (b.message, b.warning) == (message, False)
    assert (b.values["status"], b.values["heading known"]) == ("tracked", str(known).lower())


@pytest.mark.parametrize(("period_s", "patience_s"), [(0.05, 10.0), (1.0, 10.0), (60.0, 300.0)])
def test_a_detector_that_falls_silent_is_named_as_soon_as_its_period_allows(
    period_s: float, patience_s: float
) -> None:
    world, last_ns = World(), round(3 * period_s * SECOND)
    for k in range(4):
        world.detections(round(k * period_s * SECOND))
    for late_s, message in ((-0.1, "tracked"), (0.1, f"a/detections is silent for {patience_s + 0.1:.1f} s")):
        now_ns = last_ns + round((patience_s + late_s) * SECOND)
        world.odometry("a", now_ns, now_ns)
        assert world.tracked(now_ns)[0].message == message


def test_nis_is_the_mean_of_what_was_used() -> None:
    rows = recent(
        (0, Verdict.USED, 2.0), (0, Verdict.USED, 4.0), (0, Verdict.GATED, 900.0), (-1, Verdict.USED, 7.0)
    )
    a, b, _ = World().tracked(rows=rows)
    assert (a.values["measurements used"], a.values["NIS mean"]) == ("2", "3")
    assert (b.values["measurements used"], b.values["NIS mean"]) == ("0", "-")


@pytest.mark.parametrize(("tick_s", "warning"), [(0.002, False), (0.06, True)])
def test_ticks_that_take_all_the_time_name_what_helps(tick_s: float, warning: bool) -> None:
    cost = TickCost()
    for _ in range(16):
        cost.note(tick_s)
    report = load_report(cost, elapsed_s=1.0, period_s=0.05, fusion_period_s=0.0)
    assert report.warning == warning
    assert ("fusion_period_s" in report.message) == warning
    assert report.values["tick mean [ms]"] == f"{1e3 * tick_s:.4g}"


@pytest.mark.parametrize(
    ("verdict", "said"), [(Verdict.OFF_MAP, "contradict the map"), (Verdict.BLOCKED, "show too few walls")]
)
def test_a_robot_whose_scans_are_all_unused_is_not_ok(verdict: Verdict, said: str) -> None:
    world, scans = World(), Measurements.empty(3)
    scans.model[:], scans.target[:] = SCAN, 0
    found = {}
    for used in (verdict, Verdict.USED):
        verdicts = np.array([verdict, used, verdict], dtype=np.uint8)
        found[used] = world.tracked(9, (scans, verdicts, np.full(3, np.nan)))
    assert f"none of its last 3 scans is used: they {said}" in found[verdict][0].message
    assert found[verdict][0].warning
    assert "scans" not in found[verdict][1].message + found[Verdict.USED][0].message


class Log:
    """Warnings of a `Health` on a clock that a test sets."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.lines: list[str] = []
        self.health = Health(self.lines.append, lambda: self.now_s)

    def new(self) -> list[str]:
        """Warnings since the last call."""
        lines, self.lines[:] = self.lines.copy(), []
        return lines


def test_eight_new_problems_are_logged_one_by_one_and_more_in_a_sentence() -> None:
    """Each once, until it has gone."""
    log, texts = Log(), [f"robot{k} is kidnapped" for k in range(19)]
    all_of: dict[Any, str] = {(k, "pose"): text for k, text in enumerate(texts)}
    part = [dict(list(all_of.items())[:count]) for count in range(20)]
    other = {key: text for key, text in part[18].items() if key != (0, "pose")} | {(0, "noise"): "noisy"}
    for problems, expected in (
        (part[8], texts[:8]),
        (part[9], texts[8:9]),
        (part[18], [*texts[9:17], "1 more warnings of this kind, see /diagnostics"]),
        (other, ["noisy"]),
        (all_of, [texts[0], texts[18]]),
    ):
        log.health.warn_of("contradictions", problems)
        assert log.new() == expected
        log.now_s += THROTTLE_S


def test_a_problem_that_comes_and_goes_is_logged_once_per_throttle() -> None:
    log = Log()
    for now_s in range(int(2 * THROTTLE_S) + 1):
        log.now_s = now_s
        log.health.warn_of("link", {"": "no answer"} if now_s % 2 == 0 else {})
    assert log.new() == 3 * ["no answer"]


def test_a_problem_must_last_before_it_is_logged() -> None:
    log = Log()
    for log.now_s, problems, expected in (
        (0.0, {1: "late"}, []),
        (4.9, {1: "late"}, []),
        (5.0, {1: "late"}, ["late"]),
        (99.0, {1: "late"}, []),
        (100.0, {2: "later"}, []),
        (104.0, {}, []),
        (105.0, {2: "later"}, []),
    ):
        log.health.warn_of("missing", problems, PATIENCE_S)
        assert log.new() == expected


def test_drops_are_counted_and_logged_with_their_details() -> None:
    log = Log()
    log.health.drop("size", "the image has 3 x 2 pixels")
    log.health.drop("size", "the image has 4 x 2 pixels")
    log.health.drop("corrupt")
    log.health.warn_of_drops()
    assert log.new() == ["dropped so far: 2 size (the image has 4 x 2 pixels), 1 corrupt"]
    log.health.warn_of_drops()
    log.health.drop("size", "the image has 5 x 2 pixels")
    log.health.warn_of_drops()
    assert log.new() == []
    log.now_s = THROTTLE_S
    log.health.warn_of_drops()
    assert log.new() == ["dropped so far: 3 size (the image has 5 x 2 pixels)"]
    assert drop_values({**log.health.drops, "never": 0}) == {"dropped: corrupt": 1, "dropped: size": 3}


def test_a_topic_is_silent_before_its_first_message_and_after_a_while_without_any() -> None:
    log = Log()
    assert log.health.silence("odom") == "no messages received on odom"
    log.health.received("odom")
    assert not log.health.silence("odom")
    log.now_s = 7.0
    assert log.health.silence("odom") == "no messages received on odom for 7 s"


def test_long_lists_are_cut() -> None:
    assert listed([*"abcdefgh"]) == "a, b, c, d, e, f, g, h"
    assert listed([*"abcdefghij"]) == "a, b, c, d, e, f, g, h and 2 more"
