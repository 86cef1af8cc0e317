"""Five e-pucks located by an overhead camera alone: rendered images, camera node, drivers, the whole graph.

The robots drive an eight; nothing tells them apart, and the estimator does not know where they start. What
`simulate --aerial` starts runs as child processes.
"""

import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from bench.graph.listener import ROBOTS, Listener, starting_swarm
from bench.shared.common import OUT, Cell, ProgressLine, rms, table
from bench.shared.simulated_run import position_rmse
from swarm_loc_drivers.sim.simulation import SimulationOptions, graph_of, seen_from_above
from swarm_loc_drivers.sim.worlds import WORLDS
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.launch import NodeSpec
from swarm_loc_estimator.common.messages.cdr import nanoseconds
from swarm_loc_estimator.common.trajectory import interpolate
from swarm_loc_estimator.offline.live_run import LiveGraph
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import save_swarm
from swarm_loc_estimator.timeline.estimator import Status
from swarm_loc_msgs.msg import AnonymousDetectionArray, RobotIdentities

WORLD = "w2"
WORLDS_RUN, DURATION_S = 3, 30.0
PICTURE = OUT / "aerial_names.png"  # Where an overhead image with names goes
_SETTLED_S = 2.0  # So long after a robot was located its errors count
_PATIENCE_S = 120.0
_MAX_GAP_NS = 200_000_000  # Between true poses
_KEPT = 20  # Images that wait for their detections and identities
_INK, _HALO = (40, 220, 255), (0, 0, 0)

Say = Callable[[str], None]


@dataclass(frozen=True)
class AerialRun:
    """The result of one run."""

    # (N,) when each robot was located, after they began to drive [s]; infinite: it was not
    located: FloatArray
    errors: FloatArray  # (K, 3) x, y [m] and heading [rad] of located robots
    detections_per_image: float  # Mean
    # The last image with the names that the robots found for themselves; None: there is none
    picture: NDArray[np.uint8] | None

    @property
    def position_cm(self) -> float:
        """Root mean square of the distance [cm]."""
        return 100.0 * position_rmse(self.errors)

    @property
    def heading_deg(self) -> float:
        """Root mean square [deg]."""
        return math.degrees(rms(self.errors[:, 2]))


def measure(seed: int, worlds: int = WORLDS_RUN, duration_s: float = DURATION_S) -> dict[str, float]:
    """Run the whole graph in several worlds, with unknown and with known starts; print a table; the figures.

    Args:
        seed: Of the first world.
        worlds: How many.
        duration_s: Of each run [s].
    """
    runs: dict[bool, list[AerialRun]] = {False: [], True: []}
    for k in range(worlds):
        for known_start, kept in runs.items():
            start = "known" if known_start else "unknown"
            folder = OUT / "aerial_rendered" / f"seed{seed + k}_{start}"
            shutil.rmtree(folder, ignore_errors=True)
            say = ProgressLine(f"world {seed + k}, {start} starts")
            kept.append(run_aerial(seed + k, duration_s, folder, say, known_start=known_start))
            print()
    unknown, known = (_together(runs[known_start]) for known_start in (False, True))
    print(
        table(
            [f"{worlds} worlds, {ROBOTS} robots", *_HEADERS], [_row("unknown", unknown), _row("known", known)]
        )
    )
    for run in runs[False]:
        if run.picture is not None:
            OUT.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(PICTURE), run.picture)
            print(f"picture: {PICTURE}")
            break
    located = unknown.located[np.isfinite(unknown.located)]
    return {
        "rendered5.located": len(located) / len(unknown.located),
        "rendered5.located_after_s": float(located.max(initial=0.0)),
        "rendered5.position_cm": unknown.position_cm,
        "rendered5.heading_deg": unknown.heading_deg,
        "rendered5.detections_per_image": unknown.detections_per_image,
        "rendered5.known_start.position_cm": known.position_cm,
        "rendered5.known_start.heading_deg": known.heading_deg,
    }


_HEADERS = ("located", "... after [s]", "position [cm]", "heading [deg]", "detections / image")


def _row(name: str, run: AerialRun) -> list[Cell]:
    located = np.isfinite(run.located)
    return [
        f"{name} starts",
        f"{located.sum()} of {len(located)}",
        float(run.located[located].max(initial=0.0)),
        run.position_cm,
        run.heading_deg,
        run.detections_per_image,
    ]


def _together(runs: Sequence[AerialRun]) -> AerialRun:
    """All runs as one."""
    return AerialRun(
        np.concatenate([run.located for run in runs]),
        np.concatenate([run.errors for run in runs]),
        float(np.mean([run.detections_per_image for run in runs])),
        None,
    )


def run_aerial(
    seed: int, duration_s: float, folder: Path, say: Say, *, known_start: bool = False
) -> AerialRun:
    """Let the swarm drive under the camera.

    Args:
        seed: Of the world.
        duration_s: How long they drive [s].
        folder: Where descriptions and the nodes' log go; created.
        say: Called with the progress.
        known_start: Whether the estimator knows where the robots start, for comparison.

    Raises:
        LiveError: A node has ended, or nothing goes on.
    """
    links, swarm = folder / "links", starting_swarm(WORLDS[WORLD])
    links.mkdir(parents=True)
    save_swarm(swarm, folder / "swarm.yaml")
    names = [robot.name for robot in swarm.robots]
    options = SimulationOptions(str(folder / "swarm.yaml"), world=WORLD, seed=seed, aerial=True)
    nodes = graph_of(options, swarm, str(links))
    if known_start:
        nodes = _told_the_starts(nodes, swarm, folder / "known_starts.yaml")
    with LiveGraph(nodes, folder / "nodes.log") as graph:
        listener = Listener(graph, names)
        seen = _Overhead(graph)
        begin_ns = listener.wait_until_they_drive(say)

        def is_over() -> bool:
            now_s = (listener.now_ns - begin_ns) * 1e-9
            say(f"{min(now_s, duration_s):.0f} of {duration_s:.0f} simulated s")
            return now_s >= duration_s

        graph.wait_for(is_over, "go on driving", _PATIENCE_S)
    located, errors = _score(listener, swarm, begin_ns)
    return AerialRun(located, errors, seen.mean_count(begin_ns), seen.picture())


def _told_the_starts(nodes: Sequence[NodeSpec], swarm: Swarm, path: Path) -> list[NodeSpec]:
    """The same graph, but the estimator's description has the starts."""
    bare = seen_from_above(swarm).robots
    save_swarm(Swarm(tuple(replace(a, start=b.start) for a, b in zip(bare, swarm.robots, strict=True))), path)
    return [
        replace(node, parameters={**node.parameters, "swarm_file": str(path)})
        if node.name == "estimator"
        else node
        for node in nodes
    ]


def _score(listener: Listener, swarm: Swarm, begin_ns: int) -> tuple[FloatArray, FloatArray]:
    """When robots were located, and their errors from a little later on."""
    live = listener.graph.recorder.result("live", swarm, listener.truth(swarm))
    located = np.full(len(listener.names), np.inf)
    errors: list[FloatArray] = []
    for robot, path in enumerate(live.truth.values()):
        true, is_known = interpolate(path, live.stamp_ns, _MAX_GAP_NS)
        when_s = (live.stamp_ns - begin_ns) * 1e-9
        tracked = live.status[:, robot] == Status.TRACKED
        located[robot] = when_s[tracked].min(initial=np.inf)
        counts = tracked & is_known & (when_s >= max(located[robot], 0.0) + _SETTLED_S)
        error = live.poses[counts, robot] - true[counts]
        error[:, 2] = se2.wrap_angle(error[:, 2])
        errors.append(error)
    return located, np.concatenate(errors)


class _Overhead:
    """Keeps the camera's last image, what was found in it, and who is who."""

    def __init__(self, graph: LiveGraph) -> None:
        self._images: dict[int, Image] = {}
        self._detections: dict[int, AnonymousDetectionArray] = {}
        self._identities: dict[int, RobotIdentities] = {}
        recorder = graph.recorder
        recorder.create_subscription(Image, "aerial/image_raw", self._on_image, 1)
        for kind, topic, kept in (
            (AnonymousDetectionArray, "aerial/detections", self._detections),
            (RobotIdentities, "aerial/identities", self._identities),
        ):
            recorder.create_subscription(
                kind, topic, lambda one, kept=kept: kept.update({nanoseconds(one.header.stamp): one}), 100
            )

    def _on_image(self, message: Image) -> None:
        self._images[nanoseconds(message.header.stamp)] = message
        for old in sorted(self._images)[:-_KEPT]:
            del self._images[old]

    def mean_count(self, begin_ns: int) -> float:
        """Detections in an image since a time, in the mean."""
        counts = [len(one.detections) for stamp_ns, one in self._detections.items() if stamp_ns >= begin_ns]
        return float(np.mean(counts)) if counts else 0.0

    def picture(self) -> NDArray[np.uint8] | None:
        """The last image about which everything is known, with names."""
        whole = sorted(set(self._images) & set(self._detections) & set(self._identities))
        if not whole:
            return None
        stamp_ns = whole[-1]
        return named_picture(self._images[stamp_ns], self._detections[stamp_ns], self._identities[stamp_ns])


def named_picture(
    image: Image, detections: AnonymousDetectionArray, identities: RobotIdentities
) -> NDArray[np.uint8]:
    """An overhead image (height, width, 3) with the names that the robots found for themselves."""
    gray = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width)
    stretched = cv2.normalize(gray, np.empty_like(gray), 0, 255, cv2.NORM_MINMAX)
    picture = cv2.cvtColor(stretched, cv2.COLOR_GRAY2BGR)
    for one in identities.identities:
        if one.detection < 0:
            continue
        at = detections.detections[one.detection]
        centre = round(at.u_px), round(at.v_px)
        text = f"{one.name}  {100.0 * one.probability:.1f} %"
        for colour, width in ((_HALO, 5), (_INK, 2)):
            cv2.circle(picture, centre, 24, colour, width, cv2.LINE_AA)
            place = centre[0] + 30, centre[1] + 8
            cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.7, colour, width, cv2.LINE_AA)
    return np.asarray(picture, np.uint8)
