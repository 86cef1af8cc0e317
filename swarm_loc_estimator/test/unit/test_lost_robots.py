"""A robot that is lost is named with the reason in /diagnostics and in replay's report, one test a reason."""

import html
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from core_messages import SECOND, T0, Event, batch_of
from lost_world import CAUSES, FIX_COVARIANCE, FIXED, HOME, TICK_NS, fix_of, lose

from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.health import Level
from swarm_loc_estimator.common.messages.cdr import ODOMETRY, POSE_WITH_COVARIANCE
from swarm_loc_estimator.common.messages.poses import UNKNOWN_COVARIANCE, encode_fix, encode_odometry
from swarm_loc_estimator.filter.measurements import LossReason
from swarm_loc_estimator.offline.replay import PeriodicSchedule, Runner, replay
from swarm_loc_estimator.offline.report.report import html_report, text_report
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.timeline.estimate import LOSS_CAUSES, LossReport
from swarm_loc_estimator.timeline.estimator import Estimator, Status
from swarm_loc_estimator.timeline.settings import Settings

LATE = {1.2: 1.2, 1.5: 2.2, 1.8: 1.8, 2.1: 2.1}
"""When fixes that are wrong were measured and when they come [s]."""


def test_every_reason_has_words_and_a_story() -> None:
    assert {*LOSS_CAUSES} == {*LossReason}
    assert {*CAUSES} == {*LossReason} - {LossReason.FRAME}


@pytest.mark.parametrize("why", CAUSES, ids=lambda why: why.name.lower())
def test_a_lost_robot_is_named_with_the_reason(why: LossReason, tmp_path: Path) -> None:
    lost = lose(why, tmp_path)
    estimator, cause = lost.estimator, CAUSES[why]
    loss = estimator.loss_of(0)
    assert loss is not None
    assert (loss.robot, loss.why, loss.cause) == (0, why, cause)
    assert 0 <= lost.now_ns - loss.stamp_ns < 1_000_000_000
    assert loss.text(loss.stamp_ns + 3_000_000_000) == f"lost 3.0 s ago: {cause}"
    assert estimator.counters[f"lost: {why.name.lower().replace('_', ' ')}"] == 1
    # /diagnostics
    report = lost.report()
    assert (report.level, report.values["status"]) == (Level.WARN, "waiting")
    assert report.message.startswith(loss.text(lost.now_ns))
    # replay
    result = lost.result
    assert result.status[-1, 0] == Status.WAITING
    at_s = max(0, loss.stamp_ns - int(result.stamp_ns[0])) * 1e-9
    remark = f"{result.swarm.robots[0].name} was lost once: {cause} (at {at_s:.1f} s)."
    assert result.loss_remarks == [remark]
    result = replace(result, remarks=(remark,))
    assert remark in text_report(result)
    assert f"<li>{html.escape(remark)}</li>" in html_report(result, {})


def test_replay_lists_all_losses_of_a_robot_that_is_located_again(tmp_path: Path) -> None:
    """Its fixes jump there and back; who has jumped once is believed less."""
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("a/odom", ODOMETRY)
        bag.add_topic("a/fix", POSE_WITH_COVARIANCE)
        for k in range(60):
            stamp_ns = k * 500_000_000
            odometry = np.array([stamp_ns]), np.zeros((1, 3)), np.zeros((1, 3)), *[UNKNOWN_COVARIANCE] * 2
            bag.write("a/odom", stamp_ns, encode_odometry("a/odom", "a/base_link", *odometry)[0])
            pose = np.add(HOME, (1.0 if 10 <= k < 30 else 0.0, 0.0, 0.0))
            bag.write("a/fix", stamp_ns, encode_fix("map", stamp_ns, pose, FIX_COVARIANCE))
    result = replay(tmp_path / "bag", FIXED)
    assert result.status[-1, 0] == Status.TRACKED
    begin_ns = int(result.stamp_ns[0])
    times = ", ".join(f"{(stamp_ns - begin_ns) * 1e-9:.1f} s" for stamp_ns in (6_000_000_000, 15_500_000_000))
    remark = f"a was lost 2 times: several absolute fixes in a row were gated (at {times})."
    assert result.remarks == (remark,)
    assert result.counters["lost: off fixes"] == 2


def test_a_loss_that_late_data_move_back_is_listed_once() -> None:
    """The third of the fixes that are gated is another one when a late one comes."""
    estimator = Estimator(FIXED)
    runner, end_ns = Runner(estimator, PeriodicSchedule(TICK_NS)), T0 + 3 * SECOND
    wrong = {round(T0 + at_s * SECOND): round(T0 + later_s * SECOND) for at_s, later_s in LATE.items()}
    arrivals = {arrival_ns: stamp_ns for stamp_ns, arrival_ns in wrong.items()}
    for now_ns in range(T0, end_ns, TICK_NS):
        runner.take(batch_of([(now_ns, Event(0, now_ns, (0.0, 0.0, 0.0)))]))
        if now_ns < T0 + SECOND:
            runner.take(fix_of(now_ns, np.array(HOME), now_ns))
        elif now_ns in arrivals:
            runner.take(fix_of(arrivals[now_ns], np.add(HOME, (1.0, 0.0, 0.0)), now_ns))
    runner.finish(end_ns)
    assert [one.stamp_ns for one in estimator.losses] == [T0 + 1_800_000_000]
    assert runner.result("late", (T0, end_ns), {}, {}).losses == (*estimator.losses,)


def test_many_losses_are_listed_in_few_words() -> None:
    losses = tuple(LossReport(k % 30, LossReason.GATED, k * SECOND, "gated") for k in range(600))
    swarm = Swarm(tuple(Robot(f"r{k}") for k in range(30)))
    none, waiting = np.zeros((1, 30, 3)), np.zeros((1, 30), dtype=np.uint8)
    result = ReplayResult(
        "many", swarm, np.array([0]), none, none[..., None], waiting, losses=losses, heading_known=waiting > 0
    )
    assert len(result.loss_remarks) == 21
    assert result.loss_remarks[-1] == "10 more robots were lost."
    assert max(map(len, result.loss_remarks)) < 150


def test_the_end_of_a_local_frame_is_no_fault_in_the_report() -> None:
    ended = (LossReport(0, LossReason.FRAME, 0, LOSS_CAUSES[LossReason.FRAME]),)
    none, waiting = np.zeros((1, 1, 3)), np.zeros((1, 1), dtype=np.uint8)
    result = ReplayResult(
        "x", FIXED, np.array([0]), none, none[..., None], waiting, losses=ended, heading_known=waiting > 0
    )
    assert result.loss_remarks == []


def test_a_robot_that_is_not_located_is_not_lost_by_a_command() -> None:
    estimator = Estimator(Swarm((Robot("a", camera=None),)))
    estimator.forget(0, T0)
    estimator.tick(T0)
    assert estimator.losses == []


@pytest.mark.parametrize("period_s", [0.0, 0.2])
def test_the_fix_that_shows_that_a_robot_is_too_uncertain_is_kept(period_s: float) -> None:
    settings = Settings(lost_sigma=0.1, horizon_s=5.0, fusion_period_s=period_s, sparse_from=2)
    estimator = Estimator(Swarm(tuple(Robot(name, start=(0.0, 0.0, 0.0)) for name in "ab")), settings)
    for now_s in np.arange(1.0, 31.0):
        t = now_s - 1.0 + 0.1 * np.arange(10)
        driven = {"robot": "a", "stamp_s": t, "pose": np.multiply.outer(t, (0.5, 0.0, 0.0))}
        fix = {"robot": "a", "stamp_s": t[1:2], "pose": driven["pose"][1:2], "covariance": [np.eye(3) * 1e-4]}
        readings = {"odometry": driven} | ({"fixes": fix} if now_s == 29.0 else {})
        estimator.step(now_s, now_ns=None, **readings)
    assert estimator.counters == {"measurements used": 0, "constraints kept": 1, "lost: uncertain": 1}


def test_a_robot_that_was_never_located_only_waits() -> None:
    estimator = Estimator(Swarm((Robot("a", camera=None),)))
    estimator.receive(batch_of([(T0, Event(0, T0, (0.0, 0.0, 0.0)))]))
    estimator.tick(T0)
    assert estimator.loss_of(0) is None
    assert estimator.losses == []
    assert not any(name.startswith("lost") for name in estimator.counters)
