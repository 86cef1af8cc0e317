"""Whole graphs of two PushBots whose drivers restart at random instants, in real time over DDS and TCP.

Once both robots are located, a driver, or those of both, is killed and started again, stopped, or loses its
connection for two to six seconds; once more after ten seconds in every third case. The next restart comes
when these are located again. Figures are `restart.live.HALL.NAME`: misleading poses among the fixes of the
mapper and among all TRACKED poses, RMS position errors of fixes with and without restarts and their ratio,
the share of restarts after which the robots were located, and after how long (median).
"""

from __future__ import annotations

import asyncio
import math
import os
import signal
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from multiprocessing import get_context

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped

from bench.robustness.pauses import misleading_share, simulated, stopped, trajectories
from bench.shared.common import ProgressLine
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.cdr import nanoseconds
from swarm_loc_estimator.common.messages.poses import yaw_of
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.common.trajectory import DEFAULT_GAP_NS, Trajectory, interpolate
from swarm_loc_estimator.offline.live_run import ESTIMATOR, START_PATIENCE_S, LiveGraph
from swarm_loc_estimator.offline.metrics import is_misleading
from swarm_loc_estimator.watch.server import free_port

PLANS = ("corridor", "office")
_ROBOTS = ("pushbot1", "pushbot2")
_AGAIN_S, _PATIENCE_S = 10.0, 240.0
_BETWEEN_S = (2.0, 30.0)  # From when all are located until the next restart: within two drives and scans


async def _pass_on(port: int, robot_port: int) -> None:
    """Pass bytes between a robot and one driver at a time; those of the robot are lost without a driver."""
    from_robot, to_robot = await asyncio.open_connection("localhost", robot_port)
    drivers: list[asyncio.StreamWriter] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        drivers.append(writer)
        with suppress(OSError), closing(writer):
            while data := await reader.read(4096):
                to_robot.write(data)
                await to_robot.drain()
        drivers.remove(writer)

    async def pull_or_plug_in() -> None:
        while True:
            async with await asyncio.start_server(serve, "localhost", port):
                await switched.wait()
            switched.clear()
            for driver in drivers:
                driver.close()
            await switched.wait()
            switched.clear()

    switched = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGUSR1, switched.set)
    switching = asyncio.create_task(pull_or_plug_in())
    while data := await from_robot.read(4096):
        for driver in [one for one in drivers if not one.is_closing()]:
            with suppress(OSError):
                driver.write(data)
                await driver.drain()
    switching.cancel()


def _run_cable(port: int, robot_port: int) -> None:
    asyncio.run(_pass_on(port, robot_port))


class _Cable:
    """A TCP connection to a robot that can be pulled, by a process that passes its bytes on.

    The robot keeps one connection, as to a module on its board, and does not notice who comes and goes.
    """

    def __init__(self, port: int, robot_port: int) -> None:
        self._process = get_context("spawn").Process(target=_run_cable, args=(port, robot_port), daemon=True)
        self._process.start()

    def switch(self) -> None:
        """Pull the cable, or plug it in."""
        assert self._process.pid is not None  # noqa: S101 # it has been started
        os.kill(self._process.pid, signal.SIGUSR1)

    def remove(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()


Fix = tuple[int, str, FloatArray, FloatArray]
"""Stamp, robot, pose (3,) and covariance (3, 3)."""


class _Run:
    """A graph whose drivers are killed, stopped and cut off."""

    def __init__(self, graph: LiveGraph, cables: Mapping[str, _Cable]) -> None:
        self._graph, self._cables = graph, cables
        self.fixes: list[Fix] = []
        for name in _ROBOTS:
            take = partial(self._take, name)
            graph.recorder.create_subscription(PoseWithCovarianceStamped, f"{name}/fix", take, 1000)

    def _take(self, name: str, message: PoseWithCovarianceStamped) -> None:
        pose, q = message.pose.pose.position, message.pose.pose.orientation
        covariance = message.pose.covariance.reshape(6, 6)[np.ix_((0, 1, 5), (0, 1, 5))]
        place = np.array([pose.x, pose.y, yaw_of(q.x, q.y, q.z, q.w)])
        self.fixes.append((nanoseconds(message.header.stamp), name, place, covariance))

    @property
    def now_ns(self) -> int:
        """Time of the graph, which passes slowly on a busy computer; 0 before the first poses."""
        poses = self._graph.recorder.poses()
        return poses[-1].stamp_ns if poses else 0

    def go(self, seconds: float, needed: Collection[str] | None = None) -> None:
        """Let time pass; only the nodes that are needed must run."""
        end_ns = self.now_ns + round(seconds * 1e9)
        self._graph.wait_for(lambda: self.now_ns > end_ns, "go on", START_PATIENCE_S, needed)

    def located_s(self, names: set[str], since_ns: int) -> float:
        """Wait until there are fixes of robots later than an instant; how much later they are [s], or NaN."""
        found: dict[str, int] = {}

        def is_over() -> bool:
            found.update({name: at for at, name, *_ in reversed(self.fixes) if at > since_ns})
            return names <= found.keys() or self.now_ns > since_ns + 1e9 * _PATIENCE_S

        self._graph.wait_for(is_over, "go on", START_PATIENCE_S)
        return (max(found[name] for name in names) - since_ns) * 1e-9 if names <= found.keys() else math.nan

    @contextmanager
    def _killed(self, name: str) -> Iterator[None]:
        node = f"{name}/pushbot_driver"
        self._graph.kill(node)
        yield
        self._graph.restart(node)

    @contextmanager
    def _unplugged(self, name: str) -> Iterator[None]:
        self._cables[name].switch()
        yield
        self._cables[name].switch()

    def interrupt(self, kind: str, names: set[str], seconds: float) -> None:
        """Let drivers hear nothing of their robots for a while."""
        ways: Mapping[str, Callable[[str], object]] = {
            "killed": self._killed,
            "unplugged": self._unplugged,
            "stopped": lambda name: stopped(self._graph.process(f"{name}/pushbot_driver").pid),
        }
        with ExitStack() as stack:
            for name in names:
                stack.enter_context(ways[kind](name))  # type: ignore[arg-type]
            self.go(seconds, needed=[ESTIMATOR])


def _errors(fixes: list[Fix], paths: Mapping[str, Trajectory]) -> tuple[FloatArray, int]:
    """Position errors of fixes (n,) [m], and how many are misleading."""
    errors, covariances = [], []
    for stamp_ns, name, pose, covariance in fixes:
        true, known = interpolate(paths[name], np.array([stamp_ns]), DEFAULT_GAP_NS)
        if known[0]:
            errors.append([*(pose - true[0])[:2], wrap_angle(pose[2] - true[0, 2])])
            covariances.append(covariance)
    rows = np.array(errors).reshape(-1, 3)
    wrong = is_misleading(rows, np.array(covariances).reshape(-1, 3, 3))
    return np.hypot(rows[:, 0], rows[:, 1]), int(wrong.sum())


def _run(plan: str, restarts: int, seconds: float, say: ProgressLine) -> tuple[dict[str, float], list[float]]:
    """Errors of a run of so many seconds, or until all restarts are over, and waits for robots [s]."""
    rng, waits = np.random.default_rng([restarts, len(plan)]), []
    port = free_port()
    with ExitStack() as stack:
        graph, swarm, truth = stack.enter_context(simulated("pushbots", plan, port, len(_ROBOTS)))
        cables = {name: _Cable(port + len(_ROBOTS) + k, port + k) for k, name in enumerate(_ROBOTS)}
        for cable in cables.values():
            stack.callback(cable.remove)
        run = _Run(graph, cables)
        graph.wait_for(lambda: run.now_ns > 0, "begin", START_PATIENCE_S)
        first_ns = run.now_ns
        run.located_s({*_ROBOTS}, first_ns)
        begin_ns = run.now_ns
        for number in range(restarts):
            say(f"{plan}, live: restart {number + 1} of {restarts}")
            run.go(rng.uniform(*_BETWEEN_S))
            kind = ("killed", "unplugged", "stopped")[number % 3]
            names = {*_ROBOTS} if number % 4 == 3 else {_ROBOTS[rng.integers(2)]}
            run.interrupt(kind, names, rng.uniform(2.0, 6.0))
            if number % 3 == 2:
                run.go(_AGAIN_S)
                run.interrupt("killed", names, rng.uniform(2.0, 6.0))
            waits.append(run.located_s(names, run.now_ns))
        run.go(max(1.0, seconds - (run.now_ns - first_ns) * 1e-9))
        end_ns, paths = run.now_ns, trajectories(truth)
        result = graph.recorder.result(plan, swarm, paths)
    errors, wrong = _errors(run.fixes, paths)
    return {
        "fixes": len(errors),
        "misleading": wrong,
        "tracked_misleading_share": misleading_share(result, paths, begin_ns),
        "position_cm": 100.0 * math.sqrt(np.square(errors).mean()),
        "worst_cm": 100.0 * float(errors.max()),
        "seconds": (end_ns - first_ns) * 1e-9,
    }, waits


def measure(restarts: int, say: ProgressLine) -> dict[str, float]:
    """Figures of so many restarts in each hall, and of as long a run without one."""
    figures: dict[str, float] = {}
    for plan in PLANS if restarts else ():
        numbers, waits = _run(plan, restarts, 0.0, say)
        say(f"{plan}, live: without restarts")
        plain, _ = _run(plan, 0, numbers["seconds"], say)
        found = [one for one in waits if math.isfinite(one)]
        numbers |= {
            "without_cm": plain["position_cm"],
            "rms_ratio": numbers["position_cm"] / plain["position_cm"],
            "misleading_without": plain["misleading"],
            "located_again": len(found) / len(waits),
            "wait_s": float(np.median(found)) if found else math.inf,
            "restarts": restarts,
        }
        figures |= {f"restart.live.{plan}.{name}": value for name, value in numbers.items()}
    return figures
