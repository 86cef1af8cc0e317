"""The doctor names what is wrong in graphs that were good until one thing was changed, and is silent else."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from core_messages import odometry_bytes
from wrong_setups import (
    BAGS,
    BOTH,
    ROBOT,
    SEEN,
    WRONG,
    Change,
    edited,
    farther,
    good,
    landmark_elsewhere,
    shifted,
    with_gyroscope,
    with_swarm,
    with_topics,
)

from bench.shared.bags import copy_part
from swarm_loc_estimator.cli import doctor as command
from swarm_loc_estimator.cli import survey
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.cdr import ODOMETRY, POSE_WITH_COVARIANCE, TRANSFORMS
from swarm_loc_estimator.common.messages.poses import encode_fix
from swarm_loc_estimator.doctor.contents import IMAGE
from swarm_loc_estimator.doctor.doctor import evidence_of_bag, examine, lines_of
from swarm_loc_estimator.doctor.evidence import Evidence, Heard, Message
from swarm_loc_estimator.offline.recorded_bag import unwatched
from swarm_loc_estimator.swarm.error_models import ClockModel
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_named(name: str) -> None:
    change, about, words = WRONG[name]
    findings = examine(change(good()))
    named = [one for one in findings if one.about.startswith(about)]
    assert any(words in line for line in lines_of(named)), lines_of(findings)


@pytest.mark.parametrize(
    ("bag", "seconds"),
    [
        *[("eight_five_robots", seconds) for seconds in (10.0, 25.0, 54.0)],
        *[(name, 20.0) for name in ("pushbots_two", "pushbot_one", "aerial_five", "droplets_twenty")],
        *[("aerial_five", 5.0), ("aerial_five", 60.0), ("droplets_twenty", 60.0)],
    ],
)
def test_nothing_is_wrong_in_good_bags(bag: str, seconds: float) -> None:
    assert lines_of(examine(good(bag, seconds))) == []


def test_a_described_offset_makes_a_clock_good() -> None:
    heard = shifted(BOTH, -0.3)(good())
    robots = tuple(
        replace(one, clock=ClockModel(-0.3)) if one.name == ROBOT else one for one in heard.swarm.robots
    )
    corrected = Evidence(replace(heard.swarm, robots=robots), heard.topics)
    assert lines_of(examine(corrected)) == []
    for sensor in ("odometry", "detections"):
        assert np.array_equal(corrected.rows(sensor).stamp_ns, good().rows(sensor).stamp_ns)


def test_a_good_gyroscope_is_not_accused() -> None:
    findings = examine(with_gyroscope(1.0)(good()))
    assert not [one for one in findings if one.about.endswith("gyroscope")]


def test_a_camera_is_not_accused_by_one_half_of_a_recording() -> None:
    heard, changed = good(), farther(1.8)(good())
    half = len(heard.topics[SEEN].messages) // 2
    messages = [*changed.topics[SEEN].messages[:half], *heard.topics[SEEN].messages[half:]]
    mixed = with_topics(heard, epuck2__detections=replace(heard.topics[SEEN], messages=messages))
    assert not [one for one in examine(mixed) if "times as far" in one.problem]
    assert [one for one in examine(changed) if "times as far" in one.problem]


def test_a_landmark_is_not_accused_by_one_half_of_a_recording() -> None:
    heard = with_swarm(landmark_elsewhere)(good(seconds=50.0))
    middle_ns = heard.end_ns - 25_000_000_000
    number = heard.swarm.landmarks[0].id
    seen = [name for name in heard.topics if name.endswith("detections")]

    def see_late(message: Any, arrival_ns: int) -> None:
        if arrival_ns <= middle_ns:
            message.detections = message.detections[message.detections["id"] != number]

    about = f"landmark {number}"
    assert any(one.about == about for one in examine(heard))
    assert not any(one.about == about for one in examine(edited(seen, see_late)(heard)))


def test_the_command_prints_findings(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main([str(BAGS / "eight_five_robots"), "--seconds", "10"]) == 0
    said = capsys.readouterr().out
    assert said.endswith("Nothing is wrong.\n")
    assert "only the first 10 s of the bag were looked at" in said
    assert command.main([str(BAGS / "eight_pictures")]) == 1
    said = capsys.readouterr().out
    assert "- epuck1/detections, epuck2/detections: each has no messages. Start a detector such as" in said


@pytest.mark.parametrize(
    "change",
    [
        lambda e: Evidence(e.swarm, {}),
        lambda e: Evidence(e.swarm, {name: Heard(one.type) for name, one in e.topics.items()}),
        lambda e: with_topics(
            e, foo=Heard("foo_msgs/msg/Foo", [Message(1, b"x")]), tf=Heard(TRANSFORMS, [Message(1, b"x")])
        ),
        lambda e: with_topics(e, epuck1__image_raw=Heard(IMAGE, [Message(1, b"\0\1\0\0")])),
        lambda e: Evidence(e.swarm, {k: Heard(v.type, v.messages[:1]) for k, v in e.topics.items()}),
        lambda e: Evidence(
            e.swarm,
            {k: Heard(v.type, [Message(5, one.data) for one in v.messages]) for k, v in e.topics.items()},
        ),
    ],
)
def test_any_evidence_is_looked_at(change: Change) -> None:
    """Nothing, single, broken and simultaneous messages raise neither errors nor warnings."""
    lines_of(examine(change(good(seconds=5.0))))


def test_a_whole_swarm_may_be_in_a_namespace(tmp_path: Path) -> None:
    bag, swarm = BAGS / "eight_five_robots", load_swarm(BAGS / "eight_five_robots" / "swarm.yaml")
    copy_part(bag, tmp_path / "bag", 5.0, rename=lambda name, kind: (f"lab/{name}", kind))
    for namespace, is_wrong in (("", True), ("lab", False), ("/lab/", False)):
        evidence = evidence_of_bag(tmp_path / "bag", swarm, 5.0, unwatched, namespace=namespace)
        assert bool(examine(evidence)) == is_wrong


OUT = ["--out", "surveyed.yaml"]


@pytest.mark.parametrize(
    ("main", "options", "said"),
    [
        (command.main, ["swarm.yaml", "--remap", "a:=b"], "--remap is for bags"),
        (command.main, ["bag", "--use-sim-time"], "--use-sim-time is for a live graph"),
        (command.main, ["bag", "--namespace", "two words"], "--namespace 'two words' must be names"),
        (command.main, ["nowhere"], "There is no bag 'nowhere'."),
        (survey.main, ["bag", "--seconds", "9", *OUT], "--seconds and --namespace are for a live graph"),
        (survey.main, ["bag", "--use-sim-time", *OUT], "--use-sim-time is for a live graph"),
        (survey.main, ["swarm.yaml", "--remap", "a:=b", *OUT], "--remap is for bags"),
        (survey.main, ["swarm.yaml", "--namespace", "a b", *OUT], "--namespace 'a b' must be names"),
    ],
)
def test_options_that_do_not_fit_the_source_end_with_one_sentence(
    main: Callable[[list[str]], int], capsys: pytest.CaptureFixture[str], options: list[str], said: str
) -> None:
    assert main(options) == 1
    assert said in capsys.readouterr().err


def test_exchanged_bodies_are_named_whatever_topics_are_missing(tmp_path: Path) -> None:
    """Two robots drive side by side; their fixes are exchanged after ten seconds; no detections."""
    robots = [Robot(name, start=(0.0, y, 0.0)) for name, y in (("a", 0.0), ("b", 1.0))]
    with BagWriter(tmp_path / "bag") as bag:
        for robot in robots:
            bag.add_topic(f"{robot.name}/odom", ODOMETRY)
            bag.add_topic(f"{robot.name}/fix", POSE_WITH_COVARIANCE)
        for k in range(200):
            stamp_ns = k * 100_000_000
            for index, robot in enumerate(robots):
                odometry = odometry_bytes(robot.name, stamp_ns, (0.01 * k, 0.0, 0.0))
                bag.write(f"{robot.name}/odom", stamp_ns, odometry)
                seen = np.array([0.01 * k, float(index != (k >= 100)), 0.0])
                fix = encode_fix("map", stamp_ns, seen, np.diag(np.square([0.01, 0.01, 0.02])))
                bag.write(f"{robot.name}/fix", stamp_ns, fix)
    said = lines_of(examine(evidence_of_bag(tmp_path / "bag", Swarm(tuple(robots)), 60.0, unwatched)))
    assert any("a/detections" in line for line in said)
    assert any("fixes of a, fixes of b" in line for line in said)
