"""The eight through rendered pictures, the real detector, emulated firmware and the whole graph over DDS.

The nodes of `simulate` run as child processes; this process records the messages of robots and cameras as a
bag. Part of `make bench-epuck`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from bench.graph.listener import TYPE_OF, Listener, Say
from swarm_loc_drivers.sim.simulation import SimulationOptions, graph_of
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.detections import (
    DetectionArrayMessage,
    decode_detections,
    encode_detections,
)
from swarm_loc_estimator.common.messages.poses import UNKNOWN_COVARIANCE
from swarm_loc_estimator.offline.live_run import LiveGraph, cpu_seconds
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import save_swarm

WORLD = "w2"
_SILENCE_PATIENCE_S = 120.0
_PICTURES_S = 1.5


@dataclass(frozen=True)
class RenderedRun:
    """Results of one world."""

    seed: int  # Of the world
    swarm_file: Path  # Description for world and estimator
    bag: Path  # Messages of robots and cameras at their times of arrival
    described_bag: Path  # The same, but detections with unknown covariance
    live: ReplayResult  # Poses of the graph while the robots drove
    age_s: NDArray[np.float64]  # (A,) age of these poses when received [s]
    seen: dict[str, list[DetectionArrayMessage]]  # Robot name -> its detections, in order
    cpu_s: dict[str, float]  # Node -> CPU time of its process [s]
    pictures: dict[tuple[str, int], Image]  # Robot name and stamp -> image, of the last ones

    @property
    def begin_ns(self) -> int:
        """When the robots began to drive."""
        return int(self.live.stamp_ns[0])

    @property
    def end_ns(self) -> int:
        """When the run ended."""
        return int(self.live.stamp_ns[-1])

    @property
    def duration_s(self) -> float:
        """Simulated time [s]."""
        return (self.end_ns - self.begin_ns) * 1e-9


def _write(listener: Listener, folder: Path, *, with_noise: bool) -> None:
    """Write all messages as a bag in order of arrival, detections with or without covariance."""
    rows = [
        (arrival_ns, f"{name}/{topic}", data if with_noise or topic != "detections" else _without_noise(data))
        for (name, topic), kept in listener.kept.items()
        for arrival_ns, data in zip(*kept, strict=True)
    ]
    with BagWriter(folder, compress=True) as bag:
        for name, topic in listener.kept:
            bag.add_topic(f"{name}/{topic}", TYPE_OF[topic])
        for arrival_ns, topic, data in sorted(rows, key=lambda row: row[0]):
            bag.write(topic, arrival_ns, data)


def _without_noise(data: bytes) -> bytes:
    """Detections with unknown covariance, for which the noise of the swarm description is used."""
    message = decode_detections(data)
    detections = message.detections.copy()
    detections["covariance"][:, 0, 0] = UNKNOWN_COVARIANCE[0, 0]
    return encode_detections(message.frame_id, message.stamp_ns, detections)


def run_rendered(swarm: Swarm, seed: int, duration_s: float, folder: Path, say: Say) -> RenderedRun:
    """Drive the eight in a rendered world.

    Args:
        swarm: As described to the estimator.
        seed: Of the world.
        duration_s: Of driving [s].
        folder: For description, log and bag; created.
        say: Called with the progress.

    Raises:
        LiveError: A node has ended, or the graph has stopped.
    """
    # the graph of simulated robots
    links = folder / "links"
    links.mkdir(parents=True)
    swarm_file, names = folder / "swarm.yaml", [robot.name for robot in swarm.robots]
    save_swarm(swarm, swarm_file)
    options = SimulationOptions(str(swarm_file), world=WORLD, seed=seed)
    nodes = graph_of(options, swarm, str(links))
    with LiveGraph(nodes, folder / "nodes.log") as graph:
        listener = Listener(graph, names)
        # drive, and look at pictures near the end
        begin_ns = listener.wait_until_they_drive(say)
        processes = {node.full_name: graph.process(node.full_name).pid for node in nodes}
        used_s = {name: cpu_seconds(pid) for name, pid in processes.items()}

        def is_over() -> bool:
            """Whether they have driven long enough; reports the progress."""
            now_s = (listener.now_ns - begin_ns) * 1e-9
            if now_s > duration_s - _PICTURES_S and not listener.looked_at:
                listener.listen_to_camera(names[0])
            say(f"{min(now_s, duration_s):.0f} of {duration_s:.0f} simulated s")
            return now_s >= duration_s

        graph.wait_for(is_over, "go on driving", _SILENCE_PATIENCE_S)
        cpu_s = {name: cpu_seconds(pid) - used_s[name] for name, pid in processes.items()}
    # bags of what was heard, and errors
    _write(listener, folder / "bag", with_noise=True)
    _write(listener, folder / "described_bag", with_noise=False)
    live, age_s = _lived(listener, swarm, begin_ns)
    return RenderedRun(
        seed=seed,
        swarm_file=swarm_file,
        bag=folder / "bag",
        described_bag=folder / "described_bag",
        live=live,
        age_s=age_s,
        seen={name: _seen(listener, name, begin_ns) for name in names},
        cpu_s=cpu_s,
        pictures=listener.pictures,
    )


def _lived(listener: Listener, swarm: Swarm, begin_ns: int) -> tuple[ReplayResult, NDArray[np.float64]]:
    """Poses of the graph while the robots drove, and their ages when received (A,) [s]."""
    recorder = listener.graph.recorder
    live = recorder.result("rendered, live", swarm, listener.truth(swarm))
    driving = live.stamp_ns >= begin_ns
    age_ns = np.array(recorder.received_ns, dtype=np.int64) - live.stamp_ns
    return live.select(driving), age_ns[driving].astype(np.float64) * 1e-9


def _seen(listener: Listener, name: str, begin_ns: int) -> list[DetectionArrayMessage]:
    """Detections of a robot's camera while it drove."""
    decoded = map(decode_detections, listener.kept[name, "detections"][1])
    return [one for one in decoded if one.stamp_ns >= begin_ns]
