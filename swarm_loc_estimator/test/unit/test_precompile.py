"""Once it is warm, the estimator compiles nothing: a tick that does is deaf for seconds."""

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from compiled_code import compiled_since, printed_by_process, signatures

from bench.shared.bags import SharedHead, encode_shared_detections, encode_shared_numbers
from swarm_loc_estimator.common.messages.detections import DETECTION_DTYPE, swarm_key
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.nodes.load import Thinning
from swarm_loc_estimator.offline.recorded_bag import read_bag, unwatched
from swarm_loc_estimator.precompile import Size, precompile, size_of
from swarm_loc_estimator.sensors.inputs import Batch, Ingest
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_estimator.timeline.settings import Policy, Settings

BAGS = Path(__file__).parents[3] / "bags"
SECOND = 1_000_000_000
SPAN_NS = 12 * SECOND
RECORDED = ("aerial_five", "droplets_twenty", "eight_five_robots")


# Each of these takes as long to import as numpy; that of linear algebra is loaded with compiled code.
SLOW = tuple(f"scipy.{part}" for part in ("interpolate", "ndimage", "optimize", "spatial", "special"))


class EnoughError(Exception):
    """The beginning of a bag is enough."""


@pytest.mark.parametrize("size", ["small", "large", "sparse"])
def test_nothing_is_compiled_once_data_come(size: Size) -> None:
    assert printed_by_process(__file__, size) == []


def test_robots_that_see_markers_start_without_the_slow_parts_of_scipy() -> None:
    started = (
        "from swarm_loc_estimator.precompile import precompile\n"
        "precompile('small', False)\n"
        f"import sys; print([part for part in {SLOW} if part in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", started], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize(
    ("name", "settings", "size"),
    [
        ("eight_five_robots", Settings(), "small"),
        ("droplets_twenty", Settings(), "large"),
        ("droplets_twenty", Settings(sparse_from=20), "sparse"),
        ("droplets_twenty", Settings(sparse_from=20, fusion_period_s=0.0), "large"),
    ],
)
def test_what_is_compiled_follows_the_size_of_the_swarm(name: str, settings: Settings, size: Size) -> None:
    assert size_of(load_swarm(BAGS / name / "swarm.yaml"), settings) == size


def compiled_late(size: Size) -> list[str]:
    """What is compiled when robots are replayed though all is warm; in a process of its own."""
    for infrared in (False, True):
        precompile(size, infrared)
    before = signatures()
    eight = BAGS / "eight_five_robots"
    if size == "sparse":
        run(eight, Settings(sparse_from=2))
        run(eight, Settings(sparse_from=2), relayed=True)
        run(BAGS / "droplets_twenty", Settings(sparse_from=2))
    elif size == "large":
        together = Settings(fusion_period_s=0.1, policy=Policy(large_from=2))
        for name in RECORDED:
            run(BAGS / name, together)
        run(eight, together, relayed=True)
    else:
        for name in RECORDED:
            run(BAGS / name, Settings(policy=Policy(large_from=100)))
        run(eight, Settings(), late=True)
        run(eight, Settings(), moved_landmarks=True)
        run(eight, Settings(), relayed=True)
    return compiled_since(before)


def run(
    bag: Path, settings: Settings, *, late: bool = False, moved_landmarks: bool = False, relayed: bool = False
) -> None:
    """Estimate the beginning of a bag as the node does.

    Args:
        bag: Of robots whose description is beside it.
        settings: Of the estimator.
        late: Whether odometry comes out of order.
        moved_landmarks: Whether the map is wrong.
        relayed: Whether robots share their topics, and half of what is seen is left out.
    """
    swarm = load_swarm(bag / "swarm.yaml")
    if moved_landmarks:
        marks = (replace(mark, x=mark.x + 0.3 * (k % 3)) for k, mark in enumerate(swarm.landmarks))
        swarm = replace(swarm, landmarks=tuple(marks))
    estimator, begun_ns = Estimator(swarm, settings), list[int]()
    thinning, ingest = Thinning(len(swarm.robots)), Ingest(swarm)

    def take(inputs: Batch) -> None:
        begun_ns.append(inputs.begin_ns)
        if inputs.begin_ns - begun_ns[0] > SPAN_NS:
            raise EnoughError
        rows = inputs["odometry"]
        turned = type(rows)(*(column[::-1].copy() for column in rows))
        inputs = replace(inputs, rows={**inputs.rows, "odometry": turned}) if late else inputs
        if relayed:
            inputs = thinning.thin(shared(inputs, ingest, swarm), 0.5).messages
        estimator.receive(inputs)
        estimator.tick(inputs.end_ns)
        estimator.contradictions(inputs.end_ns)
        estimator.recent()

    _quietly(lambda: read_bag(bag, swarm, take, unwatched))


def shared(inputs: Batch, ingest: Ingest, swarm: Swarm) -> Batch:
    """The same by topics that all robots share."""
    key, now_ns = swarm_key(robot.name for robot in swarm.robots), inputs.end_ns
    odometry, seen = (
        SharedHead(now_ns, "odom", key, rows.robot, rows.stamp_ns)
        for rows in (inputs["odometry"], inputs["detections"])
    )
    seen_detections = inputs["detections"].detection if seen.robot.size else np.zeros(0, DETECTION_DTYPE)
    messages = {
        "swarm/odom": encode_shared_numbers(odometry, inputs["odometry"].pose),
        "swarm/detections": encode_shared_detections(seen, seen_detections),
    }
    batch = MessageBatch.of(
        [SerializedMessage(ingest.handle_of[name], data, now_ns) for name, data in messages.items()]
    )
    (relayed,) = ingest.read(batch)
    return relayed


def _quietly(work: Callable[[], object]) -> None:
    try:
        work()
    except EnoughError:
        return


if __name__ == "__main__":
    json.dump(compiled_late(cast("Size", sys.argv[1])), sys.stdout)
