"""Replay: the same poses twice, good ones, what a bag that was cut off holds, and schedules of runners."""

import itertools
import shutil
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from bench.shared.bags import copy_part
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.offline.replay import ListedSchedule, PeriodicSchedule, Runner, replay
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.sensors.inputs import Batch
from swarm_loc_estimator.sensors.odometry import OdometryRows
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.estimator import Estimator

DEMO = Path(__file__).parents[3] / "bags" / "eight_five_robots"


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bags") / "short"
    copy_part(DEMO, folder, 10.0)
    return folder


@pytest.fixture(scope="module")
def first(bag: Path) -> ReplayResult:
    return replay(bag, load_swarm(DEMO / "swarm.yaml"))


def test_a_bag_gives_the_same_poses_twice_byte_for_byte(bag: Path, first: ReplayResult) -> None:
    second = replay(bag, load_swarm(DEMO / "swarm.yaml"))

    assert first.stamp_ns.tobytes() == second.stamp_ns.tobytes()
    assert first.poses.tobytes() == second.poses.tobytes()
    assert first.covariances.tobytes() == second.covariances.tobytes()
    assert np.isfinite(first.poses[-1]).all()
    assert first.overall.position_rmse < 0.01


def test_a_bag_cut_in_the_middle_gives_the_poses_up_to_there(tmp_path: Path) -> None:
    swarm = load_swarm(DEMO / "swarm.yaml")
    whole = replay(DEMO, swarm)
    file = next(DEMO.glob("*.mcap"))
    cut = tmp_path / "cut.mcap"
    shutil.copy(file, cut)
    with cut.open("r+b") as stream:
        stream.truncate(file.stat().st_size // 2)
    part = replay(cut, swarm)

    assert part.remarks
    same = len(part.stamp_ns) - 3  # the last ones lack what the cut has taken
    assert 0.3 < same / len(whole.stamp_ns) < 0.6
    np.testing.assert_array_equal(part.stamp_ns[:same], whole.stamp_ns[:same])
    np.testing.assert_array_equal(part.poses[:same], whole.poses[:same])


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_a_clock_that_is_set_ends_no_replay(
    bag: Path, first: ReplayResult, tmp_path: Path, share: float
) -> None:
    """As that of a robot that gets the time when its recording has begun."""
    swarm, ahead_ns = load_swarm(DEMO / "swarm.yaml"), 50 * 365 * 86400 * 10**9
    with BagReader(bag) as reader:
        count = sum(1 for _ in reader.messages())
    number = itertools.count()

    def ahead(_: str, at_ns: int, data: bytes) -> tuple[int, bytes]:
        return at_ns + ahead_ns * (next(number) > share * count), data

    copy_part(bag, tmp_path / "bag", change=ahead)
    jumping = replay(tmp_path / "bag", swarm)
    assert "jumps ahead by more than an hour, 1 x" in jumping.remarks[-1]
    assert abs(len(first.stamp_ns) - len(jumping.stamp_ns)) <= 2
    before = int(np.sum(jumping.stamp_ns < ahead_ns))
    assert before == pytest.approx(share * len(first.stamp_ns), abs=2)
    np.testing.assert_array_equal(jumping.poses[:before], first.poses[:before])


def repeated(folder: Path, times: int) -> Path:
    """The demo's messages several times over, each time later."""
    with BagReader(DEMO) as reader, BagWriter(folder) as writer:
        first_ns, last_ns = reader.time_range_ns
        for topic in reader.topics:
            writer.add_topic(topic.name, topic.type)
        for k in range(times):
            for name, _, log_ns, data in reader.messages():
                writer.write(name, log_ns + k * (last_ns - first_ns), data)
    return folder


def test_memory_does_not_grow_with_the_bag(bag: Path, tmp_path: Path) -> None:
    swarm, peaks = load_swarm(DEMO / "swarm.yaml"), []
    bags = [repeated(tmp_path / f"{times}", times) for times in (1, 4)]
    for one in (bag, *bags):  # the first run also pays for what is loaded once
        tracemalloc.start()
        result = replay(one, swarm)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert len(result.stamp_ns) > 2000
    assert peaks[2] < 1.02 * peaks[1]


SECOND = 1_000_000_000
HOUR = 3600 * SECOND


def test_a_stretch_of_inputs_may_last_for_hours() -> None:
    schedule = PeriodicSchedule(SECOND)
    schedule.begin(SECOND // 2)
    assert schedule.due(5 * HOUR) == [k * SECOND for k in range(1, 5 * 3600 + 1)]
    assert schedule.due(5 * HOUR) == []
    assert schedule.rest(5 * HOUR + 1) == [5 * HOUR + SECOND]
    assert schedule.jumps == 0


def test_nothing_is_due_while_the_clock_was_set_ahead() -> None:
    schedule = PeriodicSchedule(SECOND)
    schedule.begin(0)
    assert schedule.due(2 * SECOND) == [SECOND, 2 * SECOND]
    schedule.begin(9 * HOUR)
    assert schedule.due(9 * HOUR + SECOND) == [9 * HOUR + SECOND]
    assert schedule.rest(20 * HOUR) == [20 * HOUR + SECOND]
    assert schedule.jumps == 2


def test_listed_instants_all_come_once() -> None:
    schedule = ListedSchedule(np.array([1, 5, 9]))
    assert [schedule.due(0), schedule.due(5), schedule.due(6), schedule.rest(7)] == [[], [1, 5], [], [9]]


def test_what_arrives_at_a_tick_counts_at_the_next_one() -> None:
    """As the live node reads what had come before its tick began."""
    swarm = Swarm((Robot("a", start=(0.0, 0.0, 0.0)),))
    runner = Runner(Estimator(swarm), PeriodicSchedule(SECOND))
    stamps_ns = np.array([SECOND // 2, SECOND])
    pose = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0]])
    odometry = OdometryRows.without_twist(np.zeros(2, dtype=np.int64), stamps_ns, pose, stamps_ns)
    runner.take(Batch.of(int(stamps_ns[0]), int(stamps_ns[1]), odometry=odometry))
    runner.finish(int(stamps_ns[1]))
    result = runner.result("two", (0, SECOND), {}, {})
    assert result.stamp_ns.tolist() == [SECOND, 2 * SECOND]
    assert result.poses[0, 0, 0] == 0.0
    assert result.poses[1, 0, 0] >= 0.01  # and on, at the speed that it has by then


def test_without_inputs_there_are_no_poses() -> None:
    runner = Runner(Estimator(Swarm((Robot("a"),))), PeriodicSchedule(SECOND))
    runner.finish(HOUR)
    assert runner.result("nothing", (0, HOUR), {}, {}).poses.shape == (0, 1, 3)
