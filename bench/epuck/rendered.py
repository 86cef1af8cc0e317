"""The eight through rendered pictures, the real detector, emulated firmware and the whole graph over DDS.

What `simulate` starts runs as child processes; this process listens and keeps what robots and cameras send
as a bag. Nothing is drawn onto true poses: errors are those of what sees, drives and computes. Part of
`make bench-epuck`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from bench.graph.listener import TYPE_OF, Listener, Say
from swarm_loc_drivers.sim.scenarios.eight import HALF_WIDTH, EightSettings, Lemniscate, describe
from swarm_loc_drivers.sim.simulation import SimulationOptions, graph_of
from swarm_loc_drivers.sim.worlds import WORLDS
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.cdr import DetectionArrayMessage, decode_detections
from swarm_loc_estimator.common.messages.encoders import UNKNOWN_COVARIANCE, encode_detections
from swarm_loc_estimator.offline.live.graph import LiveGraph, cpu_seconds
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_writer import save_swarm

ROBOTS = 5
WORLD = "w2"
_SILENCE_PATIENCE_S = 120.0
_PICTURES_S = 1.5


@dataclass(frozen=True)
class RenderedRun:
    """What came of one world.

    Attributes:
        seed: Of the world.
        swarm_file: Description that world and estimator were given.
        bag: All that robots and cameras sent, at the times at which it came.
        described_bag: Likewise, but detections leave their noise to the description.
        live: Poses as the graph gave them, from when the robots drove.
        age_s: (A,) of these poses when they were received [s].
        seen: Robot name -> its pictures' detections, in order.
        cpu_s: Node -> CPU time that its process used meanwhile [s].
        pictures: Robot name and stamp -> a picture, of the last ones.
    """

    seed: int
    swarm_file: Path
    bag: Path
    described_bag: Path
    live: ReplayResult
    age_s: NDArray[np.float64]
    seen: dict[str, list[DetectionArrayMessage]]
    cpu_s: dict[str, float]
    pictures: dict[tuple[str, int], Image]

    @property
    def begin_ns(self) -> int:
        """When the robots began to drive."""
        return int(self.live.stamp_ns[0])

    @property
    def end_ns(self) -> int:
        """When it was over."""
        return int(self.live.stamp_ns[-1])

    @property
    def duration_s(self) -> float:
        """Simulated time [s]."""
        return (self.end_ns - self.begin_ns) * 1e-9


def _write(listener: Listener, folder: Path, *, with_noise: bool) -> None:
    """Everything as a bag, in order of arrival; detections tell of their noise, or do not know it."""
    rows = [
        (
            arrival_ns,
            f"{name}/{topic}",
            data if with_noise or topic != "detections" else _without_noise(data),
        )
        for (name, topic), kept in listener.kept.items()
        for arrival_ns, data in zip(*kept, strict=True)
    ]
    with BagWriter(folder, compress=True) as bag:
        for name, topic in listener.kept:
            bag.add_topic(f"{name}/{topic}", TYPE_OF[topic])
        for arrival_ns, topic, data in sorted(rows, key=lambda row: row[0]):
            bag.write(topic, arrival_ns, data)


def _without_noise(data: bytes) -> bytes:
    """Detections whose covariance is unknown, so that the noise counts that the swarm's description gives."""
    message = decode_detections(data)
    detections = message.detections.copy()
    detections["covariance"][:, 0, 0] = UNKNOWN_COVARIANCE[0, 0]
    return encode_detections(message.frame_id, message.stamp_ns, detections)


def starting_swarm() -> Swarm:
    """The robots where the eight begins, as the world describes them."""
    path = Lemniscate(HALF_WIDTH)
    start, _ = path.at(np.arange(ROBOTS) * path.length / ROBOTS)
    return describe(EightSettings(robots=ROBOTS, errors=WORLDS[WORLD]), start)


def run_rendered(swarm: Swarm, seed: int, duration_s: float, folder: Path, say: Say) -> RenderedRun:
    """Let the swarm drive the eight in a rendered world.

    Args:
        swarm: As described to the estimator.
        seed: Of the world.
        duration_s: How long they drive [s].
        folder: Where the description, the nodes' log and the bag go; created.
        say: Is told how far it is.

    Raises:
        LiveError: A node has ended, or nothing goes on.
    """
    links = folder / "links"
    links.mkdir(parents=True)
    swarm_file, names = folder / "swarm.yaml", [robot.name for robot in swarm.robots]
    save_swarm(swarm, swarm_file)
    options = SimulationOptions(str(swarm_file), world=WORLD, seed=seed)
    nodes = graph_of(options, swarm, str(links))
    with LiveGraph(nodes, folder / "nodes.log") as graph:
        listener = Listener(graph, names)
        begin_ns = listener.wait_until_they_drive(say)
        processes = {node.full_name: graph.process(node.full_name).pid for node in nodes}
        used_s = {name: cpu_seconds(pid) for name, pid in processes.items()}

        def is_over() -> bool:
            """Whether they have driven long enough; tell how far it is."""
            now_s = (listener.now_ns - begin_ns) * 1e-9
            if now_s > duration_s - _PICTURES_S and not listener.looked_at:
                listener.listen_to_camera(names[0])
            say(f"{min(now_s, duration_s):.0f} of {duration_s:.0f} simulated s")
            return now_s >= duration_s

        graph.wait_for(is_over, "go on driving", _SILENCE_PATIENCE_S)
        cpu_s = {name: cpu_seconds(pid) - used_s[name] for name, pid in processes.items()}
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
    """The poses as they came out, and the truth; and how old they were then (A,) [s]."""
    recorder = listener.graph.recorder
    live = recorder.result("rendered, live", swarm, listener.truth(swarm))
    driving = live.stamp_ns >= begin_ns
    age_ns = np.array(recorder.received_ns, dtype=np.int64) - live.stamp_ns
    return live.chosen(driving), age_ns[driving].astype(np.float64) * 1e-9


def _seen(listener: Listener, name: str, begin_ns: int) -> list[DetectionArrayMessage]:
    """What a robot's camera saw while it drove."""
    decoded = map(decode_detections, listener.kept[name, "detections"][1])
    return [one for one in decoded if one.stamp_ns >= begin_ns]
