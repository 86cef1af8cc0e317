"""Measurements are thinned out evenly, odometry never, and the same way every time."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.filter.measurements import concatenate
from swarm_loc_estimator.nodes.load import Thinning
from swarm_loc_estimator.sensors.aerial import AerialRows
from swarm_loc_estimator.sensors.camera import DetectionRows
from swarm_loc_estimator.sensors.fix import FixRows
from swarm_loc_estimator.sensors.infrared import BrightnessRows
from swarm_loc_estimator.sensors.inputs import Batch
from swarm_loc_estimator.sensors.odometry import OdometryRows
from swarm_loc_estimator.timeline.timeline import end_of_period

ROBOTS = 20
SEEN = 4


def sightings(robot: IntArray, stamp_ns: IntArray, marker: IntArray) -> DetectionRows:
    detection = np.zeros(robot.size, dtype=[("id", np.uint32)])
    detection["id"] = marker
    return DetectionRows(robot, stamp_ns, detection, stamp_ns)


def images(stamp_ns: int, robots: Any, seen: int = SEEN) -> Batch:
    """An image of each robot that shows the same markers in the same order every time."""
    robot = np.repeat(np.array(robots, dtype=np.int64), seen)
    stamps_ns = np.full(robot.size, stamp_ns)
    marker = np.tile(np.arange(seen), len(robots))
    drive = OdometryRows.without_twist(
        np.arange(3), np.full(3, stamp_ns), np.zeros((3, 3)), np.full(3, stamp_ns)
    )
    seen_now = sightings(robot, stamps_ns, marker)
    return Batch.of(stamp_ns, stamp_ns, odometry=drive, detections=seen_now)


@pytest.mark.parametrize("share", [0.75, 0.5, 0.25, 0.1, 1.0 / 3.0])
def test_all_robots_and_pairs_keep_the_same_share(share: float) -> None:
    thinning, kept = Thinning(ROBOTS), np.zeros((ROBOTS, SEEN))
    ticks = 400
    for tick in range(ticks):  # cameras take turns, so that each tick has the images of some
        messages = images(tick, np.arange(tick % 3, ROBOTS, 3))
        left = thinning.thin(messages, share).messages
        assert left["odometry"] is messages["odometry"]
        np.add.at(kept, (left["detections"].robot, left["detections"].detection["id"]), 1)
    sent = np.array([len(range(robot % 3, ticks, 3)) for robot in range(ROBOTS)])
    assert kept.sum(axis=1) == pytest.approx(share * SEEN * sent, abs=3.0)
    assert kept == pytest.approx(np.tile(share * sent[:, None], SEEN), abs=4.0)


def test_no_robot_goes_without_for_long() -> None:
    thinning, last = Thinning(ROBOTS), np.zeros(ROBOTS)
    for tick in range(300):
        left = thinning.thin(images(tick, range(ROBOTS)), 0.1).messages
        last[left["detections"].robot] = tick
        assert np.all(tick - last <= 8), "nothing for two images and a half is fair, for eight it is not"


def test_one_that_floods_is_the_first_to_lose() -> None:
    thinning, kept = Thinning(ROBOTS), np.zeros(ROBOTS)
    for tick in range(200):
        quiet, flood = images(tick, range(1, ROBOTS), 1), images(tick, [0], 200)
        both = Batch.of(tick, tick, detections=concatenate([quiet["detections"], flood["detections"]]))
        left = thinning.thin(both, 0.1).messages
        kept += np.bincount(left["detections"].robot, minlength=ROBOTS)
    assert set(kept[1:]) == {200.0}, "they sent less than everyone's part"
    assert kept[0] == pytest.approx(200 * (0.1 * 219 - 19), abs=3.0)


@given(st.lists(st.tuples(st.integers(0, 5), st.floats(0.01, 1.0)), max_size=30))
def test_the_same_backlog_leaves_the_same_behind(backlogs: list[tuple[int, float]]) -> None:
    one, other = Thinning(6), Thinning(6)
    for k, (robots, share) in enumerate(backlogs):
        first, second = (each.thin(images(k, range(robots)), share) for each in (one, other))
        assert first.shed == second.shed
        assert first.messages["detections"].robot.tolist() == second.messages["detections"].robot.tolist()
        assert sum(first.measurements.values()) == first.measurements["detections"] == robots * SEEN
        assert robots * SEEN - first.shed == first.messages["detections"].robot.size
        assert first.messages.dropped.get("shed_detections", 0) == first.shed


@pytest.mark.parametrize("share", [0.75, 0.5, 0.25, 0.1])
def test_of_a_large_swarm_whole_periods_are_left_out_in_whatever_order_they_come(share: float) -> None:
    period_ns, periods = 4, 1000
    thinning, kept = Thinning(ROBOTS, period_ns), np.zeros((periods, ROBOTS, SEEN))
    rng = np.random.default_rng(1)
    stamps_ns = 1 + rng.permutation(period_ns * periods)
    for stamp_ns in stamps_ns.tolist():  # late ones share the fate of their period
        left = thinning.thin(images(stamp_ns, range(ROBOTS)), share).messages
        seen = (
            end_of_period(stamp_ns, period_ns) // period_ns - 1,
            left["detections"].robot,
            left["detections"].detection["id"],
        )
        np.add.at(kept, seen, 1)
    assert set(kept.ravel().tolist()) == {0.0, float(period_ns)}
    used = np.all(kept == period_ns, axis=(1, 2))
    assert used.sum() == pytest.approx(share * periods, abs=3.0)
    gaps = np.diff(np.flatnonzero(used))
    assert gaps.max() <= 3.0 / share
    assert thinning.thin(images(0, range(ROBOTS)), 1.0).shed == 0


def test_all_matrices_of_an_exchange_share_its_fate() -> None:
    thinning = Thinning(2)

    def exchange(tick: int) -> BrightnessRows:
        stamps_ns = np.array([tick, tick + 1, tick, tick + 1])
        robot = np.array([0, 0, 1, 1])
        zero = np.zeros(4, dtype=np.int64)
        readings = np.empty(4, dtype=object)
        return BrightnessRows(robot, stamps_ns, robot, 1 - robot, zero, zero, zero, readings, stamps_ns)

    fate: dict[tuple[int, int], list[bool]] = {}
    shed = 0
    for tick in range(200):
        rows = exchange(tick)
        thinned = thinning.thin(Batch.of(tick, tick, brightness=rows), 0.5)
        shed += thinned.messages.dropped.get("shed_brightness", 0)
        left = thinned.messages["brightness"]
        pairs = zip(left.robot, left.stamp_ns, strict=True)
        kept = {(int(robot), int(stamp)) for robot, stamp in pairs}
        for key in zip(rows.robot.tolist(), rows.stamp_ns.tolist(), strict=True):
            fate.setdefault(key, []).append(key in kept)
    assert all(len(set(one)) == 1 for one in fate.values())
    assert np.mean([one[0] for one in fate.values()]) == pytest.approx(0.5, abs=0.05)
    assert shed == sum(not used for one in fate.values() for used in one)


def test_an_image_from_above_stays_whole_and_fixes_are_thinned() -> None:
    thinning, images_kept, fixes_kept = Thinning(2), 0, 0
    for tick in range(100):
        above = np.full(7, -1)
        stamps_ns = np.full(7, tick)
        aerial = AerialRows(above, stamps_ns, np.arange(7), np.zeros((7, 3)), np.zeros((7, 3, 3)), stamps_ns)
        robot, stamp = np.array([1]), np.array([tick])
        fixes = FixRows(robot, stamp, np.zeros((1, 3)), np.zeros((1, 3, 3)), stamp)
        left = thinning.thin(Batch.of(tick, tick, fixes=fixes, aerial=aerial), 0.5).messages
        assert left["aerial"].robot.size in (0, 7)
        images_kept += left["aerial"].robot.size // 7
        fixes_kept += left["fixes"].robot.size
    assert images_kept == pytest.approx(50, abs=2)
    assert fixes_kept == pytest.approx(50, abs=2)
