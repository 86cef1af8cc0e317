"""PushBots in floor plans: motion and readings, a short exploration, and its bag."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from repository_bags import assert_same_messages, options_of, words_of

from bench.pushbot.bag import PushbotBagSettings, main, write_pushbot_bag
from bench.pushbot.exploration import Exploration, KinematicPushBot, PushBotNoise
from swarm_loc_drivers.sim.pushbot.floor_plan import FloorPlan, floor_plan, outline
from swarm_loc_drivers.sim.pushbot.optics import laser_hz
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.bags.writer import typestore
from swarm_loc_estimator.common.messages.event_encoding import decode_events
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.mapping.mapper import CooperativeMapper
from swarm_loc_estimator.mapping.scans import LightSightings
from swarm_loc_vision.events.tracker import LightSource, LightTracker, TrackerSettings
from swarm_loc_vision.laser.calibration import load_laser

ROOM = FloorPlan("room", outline([(0, 0, 4, 3)], [(2, 1, 2.5, 2)]), np.array([[1.0, 1.5], [3.5, 1.5]]))
EXACT = PushBotNoise(turn=0.0, distance=0.0, heading=0.0, pixel=1e-9, dropout=0.0, outlier=0.0, bearing=1e-9)


def robot(noise: PushBotNoise, heading: float = 0.0, seed: int = 1) -> KinematicPushBot:
    return KinematicPushBot(ROOM, np.array([1.0, 1.5, heading]), noise, np.random.default_rng(seed))


def test_turns_are_short_by_the_slip_and_distances_exact_without_noise() -> None:
    body = robot(EXACT)
    readings = body.turn(math.pi, [])
    assert body.pose[2] == pytest.approx(math.pi)
    assert 1.0 / readings.inverse[-1] == pytest.approx(1.0)
    slips = robot(PushBotNoise(slip=0.05, turn=0.0))
    slips.turn(2.0, [])
    assert slips.pose[2] == pytest.approx(1.9)
    assert readings.stamp_ns[0] == 20_000_000
    assert body.time_s == pytest.approx(len(readings.stamp_ns) * 0.02)


def test_noise_is_as_strong_as_it_says() -> None:
    turns = [robot(PushBotNoise(), seed=seed) for seed in range(300)]
    for one in turns:
        one.turn(2.0 * math.pi, [])
    spread = np.degrees(np.std([one.pose[2] for one in turns]))
    assert spread == pytest.approx(0.64, rel=4.0 / math.sqrt(2 * 300))
    readings = robot(PushBotNoise(dropout=0.1)).turn(1e-6, [])
    assert len(readings.stamp_ns) == 1
    still = robot(PushBotNoise(dropout=0.1, outlier=0.0)).rest(60.0, [])
    seen = still.inverse[still.inverse > 0.0]
    assert 1.0 - len(seen) / len(still.inverse) == pytest.approx(0.1, abs=4.0 * math.sqrt(0.09 / 3000))
    assert seen.std() == pytest.approx(still.sigma, rel=4.0 / math.sqrt(2.0 * len(seen)))


def test_walls_and_robots_stop_a_drive_and_odometry_knows() -> None:
    body = robot(EXACT)
    readings = body.drive(2.0, [])
    assert body.bumps == 1
    assert body.pose[0] == pytest.approx(2.0 - 0.06, abs=0.005)
    assert readings.odometry[-1, 0] == pytest.approx(body.pose[0] - 1.0, abs=1e-9)


def test_lights_are_seen_in_front_and_not_behind_walls() -> None:
    other = KinematicPushBot(ROOM, np.array([1.0, 2.5, 0.0]), EXACT, np.random.default_rng(2))
    body = robot(EXACT, math.pi / 2 - 0.2)
    seen = body.lights(body.rest(0.1, [other]).stamp_ns, {7: other})
    assert (seen.target == 7).all()
    assert len(seen.stamp_ns) == 5
    assert np.allclose(seen.bearing, 0.2, atol=0.05)  # one of two lights off its middle
    away = robot(EXACT, -math.pi / 2)
    assert not len(away.lights(away.rest(0.1, [other]).stamp_ns, {7: other}).stamp_ns)


def test_lights_are_seen_where_robots_were_at_the_time() -> None:
    """One robot is simulated ahead of the other, which then drives away from where it was."""
    exploration = Exploration(floor_plan("open12"), CooperativeMapper(), np.random.default_rng(2))
    seen: list[tuple[int, LightSightings]] = []
    exploration.on_lights = lambda robot, sightings: seen.append((robot, sightings))
    for _ in range(2):
        exploration.join(PushBotNoise(bearing=1e-6))
    exploration.run(150.0)
    traces = {key: one.trace for key, one in exploration.robots.items()}
    assert {robot for robot, _ in seen} == {0, 1}
    for robot, sightings in seen:
        steps = np.round(sightings.stamp_ns / 20e6).astype(int)
        own, other = traces[robot][steps], traces[1 - robot][steps]
        way = (other - own)[:, :2]
        off = wrap_angle(np.arctan2(way[:, 1], way[:, 0]) - own[:, 2] - sightings.bearing)
        assert (np.hypot(*way.T) * np.abs(np.sin(off)) < 0.046).all()  # a light off the middle


@pytest.mark.parametrize(("plan", "seed"), [("corridor", 1), ("tee", 2)])
def test_two_robots_explore_a_hall(plan: str, seed: int) -> None:
    mapper = CooperativeMapper()
    exploration = Exploration(floor_plan(plan), mapper, np.random.default_rng(seed))
    for slip in (0.0, 0.03):
        exploration.join(PushBotNoise(slip=slip))
    exploration.run(100.0)
    errors: FloatArray = np.array([one.online - one.truth for one in exploration.arrivals])
    assert {one.robot for one in exploration.arrivals} == {0, 1}
    assert len(errors) > 10
    assert np.hypot(errors[:, 0], errors[:, 1]).max() < 0.3
    assert abs(mapper.graph.slip - [0.0, 0.03]).max() < 0.005


def test_five_robots_whose_starts_are_hardly_known_all_find_their_places() -> None:
    """The fifth is described to start 20 cm and 5 deg off; the nearest robot sees little of what it does."""
    mapper = CooperativeMapper()
    exploration = Exploration(floor_plan("corridor"), mapper, np.random.default_rng([4, 20, 5]))
    for number in range(5):
        exploration.join(PushBotNoise(slip=0.02 * (0.5 + 0.125 * number)))
    exploration.rng.standard_normal()  # of the noise of these starts, one draw in eight is above the bound
    exploration.run(35.0)
    errors: FloatArray = np.array([one.online - one.truth for one in exploration.arrivals])
    assert {one.robot for one in exploration.arrivals} == set(range(5))
    assert np.hypot(errors[:, 0], errors[:, 1]).max() < 0.05
    assert np.degrees(np.abs(wrap_angle(errors[:, 2]))).max() < 2.5


def test_the_events_of_a_bag_show_the_distances_of_the_bag(tmp_path: Path) -> None:
    """The tracker, with the calibration next to the bag, reads from the events what `laser` says."""
    bag = tmp_path / "bag"
    write_pushbot_bag(PushbotBagSettings(3, 10.0, 2, "corridor", 0.02, events_s=2.0), bag, "Of a test.")
    calibration = load_laser(bag / "pushbot1.yaml")
    tracker = LightTracker([LightSource(laser_hz(0), is_above=False)], (128, 128), TrackerSettings())
    told: dict[int, float] = {}
    read: list[tuple[int, float, float]] = []
    with BagReader(bag) as reader:
        for topic, kind, _, data in reader.messages({"pushbot1/events", "pushbot1/laser"}):
            message: Any = typestore().deserialize_cdr(data, kind)
            stamp_ns = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
            if topic.endswith("laser"):
                told[stamp_ns] = message.distance
                continue
            events = decode_events(
                message.events.tobytes(), message.encoding, (message.width, message.height)
            )
            for report in tracker.track(events._replace(time_ns=stamp_ns + events.time_ns)):
                for seen in report.sightings:
                    found = calibration.distance(seen.v, float(seen.covariance[1, 1]), seen.locking)
                    read.append((seen.stamp_ns, *found))
    assert len(read) > 20
    stamps = np.array(sorted(told))
    distances = np.array([told[one] for one in stamps.tolist()])
    nearest = np.abs(stamps[:, None] - np.array([one[0] for one in read])[None, :]).argmin(axis=0)
    off = np.array([one[1] for one in read]) - distances[nearest]
    sigma = np.array([one[2] for one in read])
    assert abs(np.nanmedian(off / sigma)) < 1.0
    assert np.nanmedian(np.abs(off)) < 0.05


def test_a_plan_without_starts_for_the_robots_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "plan.yaml").write_text("free: [[0, 0, 2, 2]]\n")
    assert main([str(tmp_path / "bag"), "--robots", "1", "--plan", str(tmp_path / "plan.yaml")]) == 1
    assert "has starts for 0 robots" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["pushbot_one", "pushbots_two"])
def test_a_bag_of_the_repository_comes_out_again(name: str, tmp_path: Path) -> None:
    assert options_of(name).pop("swarm") == "pushbots"
    assert main([str(tmp_path / name), *words_of(name)]) == 0
    assert_same_messages(tmp_path / name, name)
