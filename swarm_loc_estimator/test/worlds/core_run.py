"""Runs of the core in tests: messages handed in as they arrive, ticks, and what became of it all."""

from collections.abc import Container, Iterable, Sequence

import numpy as np
import pytest
from core_geometry import wrapped
from core_messages import SECOND, Event, give, joined
from core_world import World
from scipy.linalg import block_diag

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.filter.measurements import Verdict
from swarm_loc_estimator.filter.state import SwarmState
from swarm_loc_estimator.offline.calibration.recording import Recording
from swarm_loc_estimator.sensors.camera import NO_DETECTIONS, DetectionRows
from swarm_loc_estimator.sensors.inputs import Ingest
from swarm_loc_estimator.sensors.odometry import OdometryRows
from swarm_loc_estimator.swarm.calibration_states import ParameterTable
from swarm_loc_estimator.swarm.swarm import Anchor, Swarm
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator
from swarm_loc_estimator.timeline.settings import Policy, Settings
from swarm_loc_estimator.timeline.timeline import HasBudget


def play(
    estimator: Estimator,
    events: Iterable[tuple[int, Event]],
    ticks_ns: Iterable[int],
    resting_ns: Container[int] = (),
    has_budget: HasBudget = lambda: True,
) -> list[Estimate]:
    """Hand in events (arrival, event) as they arrive, and tick, not fusing at some; return all estimates."""
    waiting = sorted(events, key=lambda pair: pair[0])
    estimates, k = [], 0
    for now_ns in ticks_ns:
        begin = k
        while k < len(waiting) and waiting[k][0] <= now_ns:
            k += 1
        if k > begin:
            give(estimator, waiting[begin:k])
        estimates.append(estimator.tick(now_ns, fuse=now_ns not in resting_ns, has_budget=has_budget))
    return estimates


def on_time(world: World) -> list[tuple[int, Event]]:
    """The world's events, each arriving at its stamp."""
    return [(event.stamp_ns, event) for event in world.events]


IN_ORDER = Settings(fusion_period_s=0.0)
TOGETHER = Settings(fusion_period_s=0.2, policy=Policy(large_from=1, batch_from=2))
SPARSE = Settings(fusion_period_s=0.2, sparse_from=2)
ALL = pytest.mark.parametrize("settings", [IN_ORDER, TOGETHER, SPARSE], ids=["order", "batch", "sparse"])


def play_messages(
    estimator: Estimator,
    ingest: Ingest,
    messages: Iterable[SerializedMessage],
    events: Sequence[tuple[int, Event]],
    ticks_ns: Iterable[int],
) -> list[Estimate]:
    """Hand in messages and events (arrival, event) as they arrive, and tick; return all estimates."""
    waiting = sorted(messages, key=lambda message: message.log_ns)
    estimates, begin_ns = [], -1
    for now_ns in ticks_ns:
        new = [message for message in waiting if begin_ns < message.log_ns <= now_ns]
        for part in ingest.read(MessageBatch.of(new)) if new else []:
            estimator.receive(part)
        estimates += play(estimator, [(t, e) for t, e in events if begin_ns < t <= now_ns], [now_ns])
        begin_ns = now_ns
    return estimates


def ticks(begin_ns: int, end_ns: int, period_s: float = 0.1) -> list[int]:
    """Instants of ticks, the last one at `end_ns`."""
    return [*range(begin_ns, end_ns, round(period_s * SECOND)), end_ns]


def errors(world: World, estimates: Iterable[Estimate]) -> FloatArray:
    """Errors (T, N, 3); NaN of robots that are not located."""
    return wrapped(np.array([e.poses - world.at(e.stamp_ns) for e in estimates]))


def distances(world: World, estimates: Iterable[Estimate]) -> FloatArray:
    """(T, N) between estimates and truth [m]; NaN of robots that are not located."""
    return np.array([np.hypot(*(e.poses - world.at(e.stamp_ns))[:, :2].T) for e in estimates])


def settled(estimator: Estimator) -> dict[str, int]:
    """How many measurements ended with which verdict."""
    counts = estimator._timeline.verdict_counts()
    return {verdict.name: int(counts[verdict]) for verdict in Verdict}


def recording_of(world: World) -> Recording:
    moved = [event for event in world.events if event.pose is not None]
    seen = [event for event in world.events if event.detections.size]
    stamps = np.array([event.stamp_ns for event in moved])
    poses = np.array([event.pose for event in moved], dtype=float)
    odometry = OdometryRows.without_twist(np.array([event.robot for event in moved]), stamps, poses, stamps)
    count = [event.detections.size for event in seen]
    at_ns = np.repeat([event.stamp_ns for event in seen], count)
    robots = np.repeat([event.robot for event in seen], count)
    detections = NO_DETECTIONS
    if seen:
        detections = DetectionRows(robots, at_ns, joined([e.detections for e in seen]), at_ns)
    truth = {
        robot.name: Trajectory(world.stamp_ns, world.truth[:, index])
        for index, robot in enumerate(world.swarm.robots)
    }
    return Recording("world", odometry, detections, truth)


def covariance_of_places(swarm: Swarm) -> FloatArray:
    """Covariance (2 k, 2 k) of x and y of all places (k,), as the filter begins with it."""
    state = SwarmState(ParameterTable.of(swarm.robots, swarm.surveyed, swarm.map_error))
    moved = []
    for one in swarm.surveyed:
        is_shift = isinstance(one, Anchor)
        moved.append([[1.0, 0.0, 0.0 if is_shift else -one.y], [0.0, 1.0, 0.0 if is_shift else one.x]])
    columns = np.concatenate([state.landmark_column(k) + np.arange(3) for k in range(len(moved))])
    by = block_diag(*moved)
    covariance: FloatArray = by @ state.filter.block(columns) @ by.T
    return covariance
