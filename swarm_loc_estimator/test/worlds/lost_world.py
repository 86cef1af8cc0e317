"""Small swarms in which a robot is lost, one for each reason, run as `replay` runs them."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np
from aerial_world import View, seen_from_above
from core_messages import SECOND, T0, Event, batch_of, odometry_bytes
from core_world import Plan, World, simulate
from mapping_world import LIDAR, SWEEP_NS, LidarRobot, room_map, scan_bytes

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.health import Report
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.filter.measurements import LossReason
from swarm_loc_estimator.mapping.map_file import save_map
from swarm_loc_estimator.nodes.estimator_diagnostics import Diagnostics
from swarm_loc_estimator.nodes.parameters import EstimatorParameters
from swarm_loc_estimator.offline.replay import PeriodicSchedule, Runner
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.sensors.fix import FixRows
from swarm_loc_estimator.sensors.inputs import Batch, Ingest
from swarm_loc_estimator.swarm.swarm import Robot, StartSigma, Swarm
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_estimator.timeline.settings import Settings

CAUSES = {
    LossReason.UNCERTAIN: "its position's standard deviation exceeded 0.05 m (lost_sigma), or stemmed"
    " from a heading beyond 0.3 rad (lost_heading_sigma)",
    LossReason.REFUTED: "a measurement contradicted its pose before 2 had confirmed it",
    LossReason.GATED: "7 measurements in a row were gated",
    LossReason.OFF_FIXES: "several absolute fixes in a row were gated",
    LossReason.KIDNAPPED: "its measurements can only mean that it is elsewhere",
    LossReason.OFF_MAP: "its scans contradict the map",
    LossReason.NOT_IN_IMAGE: "aerial images do not show it where it should be",
    LossReason.COMMAND: "a command removed it",
}
"""What users read of each reason."""
TICK_NS = 100_000_000
FIX_COVARIANCE = np.diag([1e-4, 1e-4, 1e-3])
HOME = (0.2, -0.1, 0.5)
FIXED = Swarm((Robot("a", start=HOME, start_sigma=StartSigma(0.02, 0.02, 0.05), camera=None),))
_NEVER = Settings(max_fault_score=1e9)
_PLAN = Plan(robots=2, duration_s=10.0)
_CARRIED = replace(_PLAN, carried=(0,))


@dataclass(frozen=True)
class Story:
    """How robot 0 of a swarm is lost; its end may be a command."""

    swarm: Swarm
    inputs: Iterable[Batch]  # By arrival; read until it is lost
    settings: Settings | None = None


@dataclass(frozen=True)
class LostRobot:
    """What became of a story."""

    estimator: Estimator
    now_ns: int  # Newest tick
    result: ReplayResult

    def report(self) -> Report:
        """The status of the robot in /diagnostics."""
        estimator, now_ns = self.estimator, self.now_ns
        swarm = estimator.swarm
        diagnostics = Diagnostics(swarm, Ingest(swarm), EstimatorParameters(), Alone(), [])
        losses = [estimator.loss_of(robot) for robot in range(len(swarm.robots))]
        estimate = estimator.tick(now_ns)
        found = diagnostics.reports(now_ns, estimate, estimator.recent(), estimator.drops, losses=losses)
        return found[0]


@dataclass(frozen=True)
class Alone:
    """A graph in which nobody publishes."""

    why: str = ""

    def duplicate_publishers(self, _topic: str) -> list[str]:
        """None."""
        return []

    def why_missing(self, _topic: str, _message_type: str) -> str:
        """That nobody does."""
        return self.why


def lose(why: LossReason, folder: Path) -> LostRobot:
    """Run the story of a reason until robot 0 is lost; a map lies in the folder."""
    story = _STORIES[why](folder)
    estimator = Estimator(story.swarm, story.settings)
    runner, begin_ns, now_ns = Runner(estimator, PeriodicSchedule(TICK_NS)), -1, 0
    for batch in story.inputs:
        begin_ns, now_ns = begin_ns if begin_ns >= 0 else batch.begin_ns, batch.end_ns
        runner.take(batch)
        if estimator.loss_of(0) is not None:
            break
    if why is LossReason.COMMAND:
        estimator.forget(0, now_ns)
    runner.finish(now_ns)
    result = runner.result("a run", (begin_ns, now_ns), {}, {})
    return LostRobot(estimator, int(result.stamp_ns[-1]), result)


def _played(world: World) -> Iterator[Batch]:
    """The events of a world, those of each tick together."""
    for _, events in groupby(world.events, key=lambda one: one.stamp_ns // TICK_NS):
        yield batch_of([(one.stamp_ns, one) for one in events])


def _fixes(
    offset_m: Callable[[float], float], speed: float = 0.0, fixes_from_s: float = 0.0
) -> Iterator[Batch]:
    """Odometry, and fixes that are off by a distance at each time [s]."""
    for k in range(300):
        stamp_ns, second = T0 + k * TICK_NS, k * TICK_NS / SECOND
        yield batch_of([(stamp_ns, Event(0, stamp_ns, (speed * second, 0.0, 0.0)))])
        if k % 3 or second < fixes_from_s:
            continue
        along = speed * second
        x, y = along * np.cos(HOME[2]) + offset_m(second), along * np.sin(HOME[2])
        yield fix_of(stamp_ns, np.add(HOME, (x, y, 0.0)), stamp_ns)


def fix_of(stamp_ns: int, pose: FloatArray, arrival_ns: int) -> Batch:
    stamp, arrival = np.array([stamp_ns]), np.array([arrival_ns])
    fix = FixRows(np.array([0]), stamp, pose[None], FIX_COVARIANCE[None], arrival)
    return Batch.of(arrival_ns, arrival_ns, fixes=fix)


def _uncertain(_folder: Path) -> Story:
    """It drives for five seconds before its first fix."""
    driven = _fixes(lambda _: 0.0, speed=0.3, fixes_from_s=5.0)
    return Story(FIXED, driven, Settings(lost_sigma=0.05))


def _refuted(_folder: Path) -> Story:
    return Story(FIXED, _fixes(lambda _: 1.0))


def _gated(_folder: Path) -> Story:
    """It was carried, and faults are never attributed."""
    world = simulate(_CARRIED, 1)
    return Story(world.swarm, _played(world), replace(_NEVER, lost_after=7))


def _off_fixes(_folder: Path) -> Story:
    """Its fixes jump by a metre."""
    return Story(FIXED, _fixes(lambda second: 1.0 if second > 5.0 else 0.0))


def _kidnapped(_folder: Path) -> Story:
    world = simulate(_CARRIED, 1)
    return Story(world.swarm, _played(world))


def _off_map(folder: Path) -> Story:
    """Its start is wrong by a metre."""
    path, robot = save_map(room_map(0.05), folder / "room")[0], LidarRobot()
    x, y, theta = robot.start.tolist()
    one = Robot("a", start=(x + 1.0, y, theta), start_sigma=StartSigma(0.05, 0.05, 0.05), lidar=LIDAR)
    swarm = Swarm((one,), map=path)

    def scans() -> Iterator[Batch]:
        ingest = Ingest(swarm)
        for at_ns in range(SWEEP_NS, 3 * SECOND, SWEEP_NS):
            sent = [
                ("a/odom", odometry_bytes("a", stamp_ns, robot.odometry(np.array([stamp_ns]))))
                for stamp_ns in (at_ns - SWEEP_NS, at_ns)
            ]
            sent.append(("a/scan", scan_bytes(robot.scan(at_ns - SWEEP_NS))))
            messages = [SerializedMessage(ingest.handle_of[topic], data, at_ns) for topic, data in sent]
            yield from ingest.read(MessageBatch.of(messages))

    return Story(swarm, scans())


def _not_in_image(_folder: Path) -> Story:
    """Images show it until it is taken away."""
    seen = seen_from_above(replace(_PLAN, robots=6), View(), 1)
    events = [
        replace(one, aerial=one.aerial[seen.robot[one.stamp_ns] != 0])
        if one.aerial.size and one.stamp_ns > T0 + 5 * SECOND
        else one
        for one in seen.world.events
    ]
    return Story(seen.world.swarm, _played(replace(seen.world, events=tuple(events))))


def _command(_folder: Path) -> Story:
    """Located by fixes, until the end."""
    fixes = list(_fixes(lambda _: 0.0))
    return Story(FIXED, fixes[:30])


_STORIES: dict[LossReason, Callable[[Path], Story]] = {
    LossReason.UNCERTAIN: _uncertain,
    LossReason.REFUTED: _refuted,
    LossReason.GATED: _gated,
    LossReason.OFF_FIXES: _off_fixes,
    LossReason.KIDNAPPED: _kidnapped,
    LossReason.OFF_MAP: _off_map,
    LossReason.NOT_IN_IMAGE: _not_in_image,
    LossReason.COMMAND: _command,
}
