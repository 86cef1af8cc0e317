"""Compare the poses of the live graph with those of a replay of the same bag."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.offline.live.run import LiveRun
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.timeline.settings import Settings

_EQUAL_M = 1e-6


@dataclass(frozen=True)
class Agreement:
    """Live poses beside those of a replay at the same stamps.

    A live estimator cannot know what is still on its way when it gives a pose: up to a step of the player's
    clock and the transport, which takes the longer the busier the machine is. Only at settled stamps is it
    known that both know the same, and the poses must be equal.

    Attributes:
        replayed: The replay.
        distance_m: (T, N) between the positions; NaN where neither is located, infinite where one is not.
        turn_rad: (T, N) between the headings, likewise, without sign.
        settled: (T,) whether the estimator has said that it knew just what had arrived by then in the bag.
    """

    replayed: ReplayResult
    distance_m: FloatArray
    turn_rad: FloatArray
    settled: NDArray[np.bool_]

    @property
    def equal_share(self) -> float:
        """Share of the poses that are the same to a micrometre."""
        return float(np.mean(self.distance_m[~np.isnan(self.distance_m)] < _EQUAL_M))

    @property
    def rms_m(self) -> float:
        """Root mean square distance of all robots that both had located [m]."""
        return float(np.sqrt(np.mean(self.distance_m[np.isfinite(self.distance_m)] ** 2)))

    @property
    def settled_max_m(self) -> float:
        """Largest distance at settled stamps [m]; NaN when there are none."""
        chosen = self.distance_m[self.settled]
        return float(np.nanmax(chosen)) if chosen.size else float("nan")


def compare_with_replay(live: LiveRun, bag: Path, settings: Settings | None = None) -> Agreement:
    """Replay a bag at the very stamps of live poses.

    Args:
        live: What came out of the live graph.
        bag: What was played into it.
        settings: Those of the live estimator.
    """
    replayed = replay(bag, live.result.swarm, settings, stamp_ns=live.result.stamp_ns)
    difference = live.result.pose - replayed.pose
    located = np.isfinite(live.result.pose).all(axis=2)
    one_only = located != np.isfinite(replayed.pose).all(axis=2)
    turn = np.where(one_only, np.inf, np.abs(se2.wrap_angle(difference[..., 2])))
    distance = np.where(one_only, np.inf, np.hypot(difference[..., 0], difference[..., 1]))
    return Agreement(replayed, distance, turn, _settled(live))


def _settled(live: LiveRun) -> NDArray[np.bool_]:
    """(T,) whether the poses are known to be of all that had arrived by their stamp, and of nothing else."""
    stamp_ns = live.result.stamp_ns
    told_ns = np.array(sorted(live.taken), dtype=np.int64)
    before = np.searchsorted(told_ns, stamp_ns, side="right")
    behind = np.searchsorted(told_ns, stamp_ns, side="left") + 1
    settled = np.ones(stamp_ns.size, dtype=bool)
    for topic, arrival_ns in live.arrival_ns.items():
        # the messages of a topic come in order: as many are the same ones
        taken = np.array([0, *(live.taken[at].get(topic, 0) for at in told_ns.tolist()), arrival_ns.size])
        arrived = np.searchsorted(arrival_ns, stamp_ns, side="right")
        settled &= (taken[before] == arrived) & (taken[behind] == arrived)
    return settled
