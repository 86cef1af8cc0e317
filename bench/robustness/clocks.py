"""Clocks that jump, bags that loop, and processes that are stopped for a while: how soon are poses back?

Five robots drive circles in real time, see `source.py`. The clock of all jumps, or the stamps of one robot,
or a process is stopped by SIGSTOP and goes on. "Recovery" is the time from then, or from the first
measurement after it, until all robots are TRACKED in one message; that of a looped bag is from its beginning.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np

from bench.graph.listener import Say
from bench.robustness import pauses
from bench.robustness.load import BREAK_NS, Run, started
from bench.robustness.pauses import PAUSES_S, misleading_share, stopped
from bench.robustness.source import SourceSettings
from bench.shared.common import DEMO_BAG as BAG
from bench.shared.common import OUT
from swarm_loc_estimator.common.launch import GraphOptions, graph_nodes
from swarm_loc_estimator.offline.live_run import (
    ESTIMATOR,
    PLAYER,
    START_PATIENCE_S,
    LiveGraph,
    read_content,
    read_poses,
    resident_mb,
)
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.estimator import Status

_ROBOTS, _IMAGE_HZ = 5, 10.0
JUMPS_S = (10.0, 3600.0, -1.0, -3600.0)
_BETWEEN_S, _PATIENCE_S = 5.0, 60.0
_SECOND = 1_000_000_000
_LOOP_RATE = 5.0


def _recovery_s(run: Run, since_ns: int) -> float:
    """Wait until all robots are TRACKED at a later instant; how long that takes [s], or the patience."""
    watched, begin_s = run.heard, time.monotonic()

    def is_over() -> bool:
        has_jumped = watched.shift_ns == watched.next_shift_ns
        is_back = has_jumped and since_ns <= watched.tracked_ns < since_ns + 100 * _SECOND
        return is_back or time.monotonic() > begin_s + _PATIENCE_S

    watched.tracked_ns = 0
    run.graph.wait_for(is_over, "go on", 2.0 * _PATIENCE_S)
    return time.monotonic() - begin_s


def _pause(run: Run, pid: int, seconds: float) -> float:
    """Stop a process for a while; the time of recovery, from the first measurement after it."""
    with stopped(pid):
        time.sleep(seconds)
    since_ns = time.time_ns()
    run.graph.wait_for(lambda: run.heard.measured_ns > since_ns, "measure", _PATIENCE_S)
    return _recovery_s(run, since_ns)


Break = Callable[[Run], float]
"""Does something to a running graph and returns the time of recovery [s]."""


def _jump(seconds: float) -> Break:
    def jump(run: Run) -> float:
        run.heard.next_shift_ns += (shift_ns := round(seconds * _SECOND))
        return _recovery_s(run, run.source.shift(shift_ns))

    return jump


def _one_robot(seconds: float) -> Break:
    def shift(run: Run) -> float:
        run.source.shift(round(seconds * _SECOND), 0)
        run.go(_BETWEEN_S)
        return _recovery_s(run, run.source.shift(-round(seconds * _SECOND), 0))

    return shift


def _process(find: Callable[[Run], int], seconds: float) -> Break:
    return lambda run: _pause(run, find(run), seconds)


ON_CLOCK: Mapping[str, Break] = {f"clock_{seconds:+g}_s": _jump(seconds) for seconds in JUMPS_S}
"""What happens in simulated time."""
_PROCESSES: Mapping[str, Callable[[Run], int]] = {
    "estimator": lambda run: run.graph.process(ESTIMATOR).pid,
    "robots": lambda run: run.source.pid,
}
ON_WALL: Mapping[str, Break] = {
    **{f"robot_{seconds:+g}_s": _one_robot(seconds) for seconds in (10.0, -1.0, -3600.0)},
    **{
        f"{name}_stopped_{seconds:g}_s": _process(find, seconds)
        for name, find in _PROCESSES.items()
        for seconds in PAUSES_S
    },
}
"""What happens by the computer's clock; robots that go on send what they have measured meanwhile at once."""


def measure_breaks(breaks: Mapping[str, Break], say: Say, *, is_clock: bool) -> dict[str, float]:
    """Figures of each break, one after the other in one graph."""
    figures: dict[str, float] = {}
    settings = SourceSettings(_ROBOTS, _IMAGE_HZ, is_clock=is_clock)
    with started(settings, "clocks") as run:
        run.go(2.0 * _BETWEEN_S)
        for name, cause in breaks.items():
            say(name)
            before = [*run.heard.counts]
            figures[f"time.{name}.recovery_s"] = cause(run)
            run.go(_BETWEEN_S)
            tracked, wrong = np.subtract(run.heard.counts, before).tolist()
            figures[f"time.{name}.misleading_share"] = wrong / max(tracked, 1)
        heard = run.heard
    kind = "clock" if is_clock else "wall"
    return figures | {f"time.{kind}.silent_share": heard.silent / heard.statuses}


def measure_loops(loops: int, say: Say) -> dict[str, float]:
    """Figures of a bag that is looped so many times."""
    swarm = load_swarm(BAG / "swarm.yaml")
    content = read_content(BAG, swarm)
    nodes = [
        replace(node, parameters={**node.parameters, "loop": True}) if node.name == PLAYER else node
        for node in graph_nodes(GraphOptions(str(BAG / "swarm.yaml"), bag=str(BAG), rate=_LOOP_RATE))
    ]
    begins = [0]
    memory_mb: list[float] = []
    with LiveGraph(nodes, OUT / "robustness" / "loops.log") as graph:
        recorder = graph.recorder
        stamps: list[int] = []

        def is_over() -> bool:
            """Note where the stamps go back."""
            for data in recorder.raw[len(stamps) :]:
                stamps.append(read_poses(data).stamp_ns)
                if len(stamps) > 1 and stamps[-1] < stamps[-2] - BREAK_NS:
                    begins.append(len(stamps) - 1)
                    memory_mb.append(resident_mb(graph.process(ESTIMATOR).pid))
                    say(f"loop {len(begins)} of {loops}")
            return len(begins) > loops

        graph.wait_for(is_over, "go on publishing poses", START_PATIENCE_S)
        result = recorder.result("loops", swarm, content.truth)
    # when all robots are TRACKED again, and how wrong they are
    stamp_ns, is_tracked = np.array(result.stamp_ns), result.status == Status.TRACKED
    recoveries_s = []
    for begin, end in pairwise(begins):
        back = np.flatnonzero(is_tracked[begin:end].all(axis=1))
        back_ns = stamp_ns[begin + back[0]] if back.size else content.end_ns
        recoveries_s.append(1e-9 * float(back_ns - content.begin_ns))
    return {
        "time.loops": float(loops),
        "time.loops.recovery_s": max(recoveries_s),
        "time.loops.misleading_share": misleading_share(result, content.truth, content.begin_ns),
        "time.loops.memory_growth": max(memory_mb[1:]) / memory_mb[1] - 1.0,
    }


def measure(loops: int, say: Say) -> dict[str, float]:
    """All figures of clocks, pauses and loops."""
    figures = measure_breaks(ON_CLOCK, say, is_clock=True)
    figures |= measure_breaks(ON_WALL, say, is_clock=False)
    figures |= pauses.measure(say)
    figures |= measure_loops(loops, say)
    shares = [value for name, value in figures.items() if name.endswith("misleading_share")]
    recoveries = [value for name, value in figures.items() if name.endswith("recovery_s")]
    return {"time.misleading_share": max(shares), "time.recovery_s": max(recoveries)} | figures
