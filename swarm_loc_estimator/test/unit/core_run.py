"""Runs of the core in tests: messages handed in as they arrive, ticks, and what became of it all."""

from __future__ import annotations

from collections.abc import Container, Iterable

from core_messages import SECOND, Event, give
from core_world import World

from swarm_loc_estimator.filter.measurements import Verdict
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator
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


def ticks(begin_ns: int, end_ns: int, period_s: float = 0.1) -> list[int]:
    """Instants of ticks, the last one at `end_ns`."""
    return [*range(begin_ns, end_ns, round(period_s * SECOND)), end_ns]


def settled(estimator: Estimator) -> dict[str, int]:
    """How many measurements ended with which verdict."""
    counts = estimator._timeline.verdict_counts()
    return {verdict.name: int(counts[verdict]) for verdict in Verdict}
