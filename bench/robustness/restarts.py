"""PushBots whose drivers restart while they turn, drive or stand: are they found, and is the map kept?

Each run has a robot that is not heard for two to six seconds, in which it goes on with what it did, and whose
odometry then begins at zero. In every third run it happens again ten seconds later, in every fourth to both.
In `office.held` something holds bodies in every tenth drive while their wheels turn on, as an edge does.
Figures are `restart.HALL.NAME`: RMS position errors of all stops with and without restarts, their ratio, the
largest error of a published pose, poses off by more than 5 sigma and 2 cm (misleading) with and without, the
share of runs in which the robot was located again, and after how long (median of these). Those of whole
graphs, in real time, are `restart.live.HALL.NAME`, see `live_restarts.py`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.pushbot.exploration import PERIOD_S, Arrival, Exploration, PushBotNoise
from bench.shared.common import ProgressLine
from swarm_loc_drivers.pushbot.stop_and_go import StopAndGo, StopAndGoSettings
from swarm_loc_drivers.sim.pushbot.floor_plan import floor_plan
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.messages.poses import decode_odometry, encode_odometry
from swarm_loc_estimator.common.se2 import between
from swarm_loc_estimator.common.trajectory import DEFAULT_GAP_NS, Trajectory, interpolate
from swarm_loc_estimator.mapping.mapper import CooperativeMapper, Located
from swarm_loc_estimator.mapping.mapper_feed import MapperFeed, MapperInput, fix_covariance, inputs_of
from swarm_loc_estimator.mapping.scans import Readings
from swarm_loc_estimator.offline.map_replay import map_figures, truth_of
from swarm_loc_estimator.offline.metrics import is_misleading
from swarm_loc_estimator.swarm.swarm_file import load_swarm

BAG = Path("bags/pushbots_two")
PLANS = ("bag", "corridor", "office", "office.held")
_LEDS = {"pushbot1": 1000.0, "pushbot2": 1050.0}
_DURATION_S, _AGAIN_S = 600.0, 10.0
_ROBOTS = 2
_HELD = 0.1  # Share of drives in `office.held`


class Restart(NamedTuple):
    """A restart of a driver."""

    robot: int  # Its number
    begin_s: float  # When it was heard last [s]
    pause_s: float  # How long it is not heard [s]
    stands: bool  # Whether the robot stands meanwhile


class RestartRun(NamedTuple):
    """What came of a run."""

    position_m: float  # RMS position error of the stops
    stops: int  # Number of stops
    misleading: int  # Number of published poses off by more than 5 sigma and 2 cm
    worst_m: float  # Largest error of a published pose
    found_s: float  # Time from the last restart until the robot was located; NaN: never
    counters: dict[str, int]  # Of the mapper


def restarts(seed: int) -> list[Restart]:
    """The restarts of a run."""
    rng = np.random.default_rng([seed, 77])
    first = Restart(seed % 2, rng.uniform(5.0, 240.0), rng.uniform(2.0, 6.0), seed % 5 == 4)
    more = [first._replace(begin_s=first.begin_s + first.pause_s + _AGAIN_S)] if seed % 3 == 2 else []
    return [first, *more, *([first._replace(robot=1 - first.robot)] if seed % 4 == 3 else [])]


class _Published:
    """Poses that a mapper publishes."""

    def __init__(self, mapper: CooperativeMapper) -> None:
        self._mapper = mapper
        self.poses: list[tuple[int, Located, FloatArray]] = []
        self._last: dict[int, Located | None] = {}

    def look(self, robot: int) -> None:
        """Note the pose of a robot if it is new."""
        located = self._mapper.tracks[robot].located
        if located is not None and self._last.get(robot) is not located:
            self._last[robot] = located
            self.poses.append((robot, located, fix_covariance(self._mapper.covariance(robot))))

    def result(self, truth: Mapping[int, Trajectory], given: Sequence[Restart], begin_ns: int) -> RestartRun:
        """Compare with the truth by robot."""
        rows, covariances = [], []
        for robot, located, covariance in self.poses:
            pose, known = interpolate(truth[robot], np.array([located.stamp_ns]), DEFAULT_GAP_NS)
            if known[0]:
                rows.append(located.pose - pose[0])
                covariances.append(covariance)
        errors = np.array(rows).reshape(-1, 3)
        figures = map_figures(self._mapper, truth, np.zeros((0, 4)))
        found = math.nan
        if given:
            end_s = given[-1].begin_s + given[-1].pause_s
            later = [
                (one.stamp_ns - begin_ns) * 1e-9 - end_s
                for robot, one, _ in self.poses
                if robot == given[-1].robot and (one.stamp_ns - begin_ns) * 1e-9 > end_s
            ]
            found = later[0] if later else math.nan
        return RestartRun(
            figures.position_m,
            figures.stops,
            int(is_misleading(errors, np.array(covariances).reshape(-1, 3, 3)).sum()),
            float(np.hypot(errors[:, 0], errors[:, 1]).max(initial=0.0)),
            found,
            dict(self._mapper.counters),
        )


class _Killed(Exception):  # noqa: N818 (it is no error)
    """The driver of a robot has been killed during a move with these readings."""

    def __init__(self, readings: Readings) -> None:
        super().__init__()
        self.readings = readings


@dataclass
class RestartedExploration(Exploration):
    """An exploration in which drivers restart."""

    planned: list[Restart] = field(default_factory=list)  # Restarts to come, in order of time by robot
    # Motion of robots that have restarted, while they have no goal
    lost: dict[int, StopAndGo] = field(default_factory=dict)

    def _feed(self, robot: int, readings: Readings) -> None:
        now = next((one for one in self.planned if one.robot == robot), None)
        if now is None or readings.stamp_ns[-1] * 1e-9 < now.begin_s:
            super()._feed(robot, readings)
            return
        count = int(np.searchsorted(readings.stamp_ns * 1e-9, now.begin_s))
        if count:
            stamp_ns, odometry, inverse = (
                readings.stamp_ns[:count],
                readings.odometry[:count],
                readings.inverse[:count],
            )
            super()._feed(robot, Readings(stamp_ns, odometry, inverse, readings.sigma))
        raise _Killed(readings)

    def _act(self, robot: int) -> None:
        try:
            if robot in self.lost and self.mapper.goal(robot) is None:
                self._go_on(robot, self.lost[robot])
            else:
                super()._act(robot)
        except _Killed as killed:
            self._restart(robot, killed.readings)

    def _go_on(self, robot: int, motion: StopAndGo) -> None:
        """Move for a second as `exploration_node` moves a robot without a goal."""
        body, rows = self.robots[robot], []
        others = [one for key, one in self.robots.items() if key != robot]
        odometry = self._odometry[robot]
        for _ in range(round(1.0 / PERIOD_S)):
            forward, _, rate = motion.command(round(1e9 * body.time_s), odometry)
            rows.append(body.step(forward, rate, others))
            odometry = rows[-1].odometry[0]
            motion.take_distance(1.0 / inverse if (inverse := float(rows[-1].inverse[0])) else math.nan)
        stamp_ns, odometries, inverses, sigmas = zip(*rows, strict=True)
        together = np.concatenate(stamp_ns), np.concatenate(odometries), np.concatenate(inverses)
        self._feed(robot, Readings(*together, sigmas[0]))
        self._arrive(robot)

    def _restart(self, robot: int, readings: Readings) -> None:
        """Move on unheard, and scan as at the start."""
        body = self.robots[robot]
        others = [one for key, one in self.robots.items() if key != robot]
        now = next(one for one in self.planned if one.robot == robot)
        self.planned.remove(now)
        # what it did goes on, longer than the rest of the move, which was not heard either
        x, y, turn = between(readings.odometry[0], readings.odometry[-1]).tolist()
        more_s = self.rng.uniform(1.0, now.pause_s)
        if now.stands:
            body.rest(now.pause_s, others)
        elif math.hypot(x, y) > 1e-3:
            body.drive(0.2 * more_s, others)
        else:
            body.turn(math.copysign(more_s, float(turn)), others)
        # the new driver
        body.restart_odometry()
        self._odometry[robot] = np.zeros(3)
        self.lost[robot] = motion = StopAndGo(StopAndGoSettings())
        motion.command(
            round(1e9 * (body.time_s - _AGAIN_S)), np.zeros(3)
        )  # so that the next is one after a pause
        self._arrive(robot)


def explore(plan: str, seed: int, given: Sequence[Restart]) -> RestartRun:
    """A simulated run of two robots."""
    mapper = CooperativeMapper()
    rng = np.random.default_rng([seed, 5])
    hall, _, is_held = plan.partition(".")
    exploration = RestartedExploration(floor_plan(hall), mapper, rng, planned=list(given))
    for number in range(_ROBOTS):
        exploration.join(PushBotNoise(slip=(0.01, 0.03)[number], held=_HELD if is_held else 0.0))
    published = _Published(mapper)

    def note(_arrival: Arrival) -> None:
        for robot in range(_ROBOTS):
            published.look(robot)

    exploration.run(_DURATION_S, note)
    mapper.finish()
    truth = {}
    for robot, body in exploration.robots.items():
        stamps = np.round(np.arange(len(body.trace)) * PERIOD_S * 1e9).astype(np.int64)
        truth[robot] = Trajectory(stamps, body.trace)
    return published.result(truth, given, 0)


def replay(given: Sequence[Restart]) -> RestartRun:
    """The recorded run, whose robots drive as recorded."""
    swarm, mapper = load_swarm(BAG / "swarm.yaml"), CooperativeMapper()
    feed, published = MapperFeed(swarm.robots, mapper, _LEDS), _Published(mapper)
    source = {
        f"{robot.name}/{kind.topic}": (k, kind)
        for k, robot in enumerate(swarm.robots)
        for kind in inputs_of(robot, lights=True)
    }
    zero: dict[int, FloatArray] = {}
    begin_ns = 0
    with BagReader(BAG) as reader:
        for topic, _, at_ns, data in reader.messages(source):
            robot, kind = source[topic]
            begin_ns = begin_ns or at_ns
            now_s = (at_ns - begin_ns) * 1e-9
            mine = [one for one in given if one.robot == robot and one.begin_s <= now_s]
            if mine and now_s < mine[-1].begin_s + mine[-1].pause_s:
                zero.pop(robot, None)
                continue
            if kind is MapperInput.ODOMETRY and mine:
                data = _moved(data, robot, zero)  # noqa: PLW2901
            feed.add(robot, kind, data)
            number = feed.number(robot)
            if number is not None:
                published.look(number)
    mapper.finish()
    names = {feed.number(k): robot.name for k, robot in enumerate(swarm.robots)}
    tracks = truth_of(BAG, swarm)
    truth = {number: tracks[name] for number, name in names.items() if number is not None}
    return published.result(truth, given, begin_ns)


def _moved(data: bytes, robot: int, zero: dict[int, FloatArray]) -> bytes:
    """Odometry that begins at zero with the first message after a restart."""
    message = decode_odometry(data)
    pose = np.array(message.pose)
    relative = between(zero.setdefault(robot, pose), pose)
    stamp_ns = np.array([message.stamp_ns])
    return encode_odometry("odom", "base_link", stamp_ns, relative[None], np.zeros((1, 3)))[0]


def _run(job: tuple[str, int, bool]) -> RestartRun:
    plan, seed, restarted = job
    given = restarts(seed) if restarted else []
    return replay(given) if plan == "bag" else explore(plan, seed, given)


def measure(seeds: int, say: ProgressLine) -> dict[str, float]:
    """Figures of runs with and without restarts, offline."""
    jobs = [(plan, seed, way) for plan in PLANS for way in (False, True) for seed in range(1, seeds + 1)]
    jobs = [job for job in jobs if job[0] != "bag" or job[2] or job[1] == 1]
    results: dict[tuple[str, int, bool], RestartRun] = {}
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        for job, one in zip(jobs, pool.map(_run, jobs), strict=True):
            results[job] = one
            say(f"{len(results)} of {len(jobs)} runs")
    figures: dict[str, float] = {}
    for plan in PLANS:
        runs = [one for job, one in results.items() if job[0] == plan and job[2]]
        plain = [one for job, one in results.items() if job[0] == plan and not job[2]]
        found = [one.found_s for one in runs if math.isfinite(one.found_s)]
        numbers = {
            "position_cm": 100.0 * _rms(runs),
            "without_cm": 100.0 * _rms(plain),
            "rms_ratio": _rms(runs) / _rms(plain),
            "worst_cm": 100.0 * max(one.worst_m for one in runs),
            "misleading": float(sum(one.misleading for one in runs)),
            "misleading_without": float(sum(one.misleading for one in plain)),
            "located_again": len(found) / len(runs),
            "wait_s": float(np.median(found)) if found else math.inf,
            "taken_back": float(sum(one.counters["places_taken_back"] for one in runs)),
        }
        figures |= {f"restart.{plan}.{name}": value for name, value in numbers.items()}
    return figures


def _rms(runs: Sequence[RestartRun]) -> float:
    """RMS position error of all stops of runs [m]."""
    stops = [one.stops for one in runs]
    return math.sqrt(np.average([one.position_m**2 for one in runs], weights=stops))
