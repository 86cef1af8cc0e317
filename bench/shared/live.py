"""Which poses of a live graph include the same inputs as those of a replay."""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray
from swarm_loc_estimator.offline.live_run import LiveRun


def settled(live: LiveRun) -> BoolArray:
    """(T,) whether the poses include exactly the inputs that had arrived by their stamp, as far as known.

    There the poses must be equal to those of a replay.
    """
    stamp_ns = live.result.stamp_ns
    counted_ns = np.array(sorted(live.taken), dtype=np.int64)
    before = np.searchsorted(counted_ns, stamp_ns, side="right")
    after = np.searchsorted(counted_ns, stamp_ns, side="left") + 1
    same = np.ones(stamp_ns.size, dtype=bool)
    for topic, arrival_ns in live.arrival_ns.items():
        # the messages of a topic come in order: equal counts mean equal messages
        taken = np.array([0, *(live.taken[at].get(topic, 0) for at in counted_ns.tolist()), arrival_ns.size])
        arrived = np.searchsorted(arrival_ns, stamp_ns, side="right")
        same &= (taken[before] == arrived) & (taken[after] == arrived)
    return same
