"""Measure at run time which modules and containers a message passes, from its bytes to the bytes of poses.

The way is that of the estimator node: `Ingest.read`, `Estimator.receive`, `Estimator.tick`, then the estimate
is encoded as SwarmPoses. A profiler notes each function of the product that runs. Compiled functions do not
call the profiler; they are found by the global names that their callers use.
"""

from __future__ import annotations

import math
import sys
import tempfile
from collections.abc import Collection, Iterator, Mapping
from dataclasses import is_dataclass
from functools import cache
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Any, NamedTuple

import numpy as np
from numba.core.dispatcher import Dispatcher

from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.messages.cdr import LASER_SCAN, ODOMETRY, RANGES, encode
from swarm_loc_estimator.common.messages.poses import SwarmPosesEncoder
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.mapping.grid import OccupancyMap
from swarm_loc_estimator.mapping.map_file import save_map
from swarm_loc_estimator.sensors.inputs import Ingest
from swarm_loc_estimator.swarm.error_models import LidarModel
from swarm_loc_estimator.swarm.swarm import Anchor, Robot, Swarm, UwbDevice
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.estimator import Estimator

_BAGS = Path(__file__).resolve().parents[1] / "bags"
_STEP_NS, _END_NS = 50_000_000, 3_000_000_000  # Period and end of simulated messages
_WALL_X, _WALL_Y, _CELL = 2.0, 1.5, 0.05  # Half sides of the simulated room and cell of its map [m]

Message = tuple[str, bytes, int]  # Topic, serialized message, arrival [ns]


class Kind(NamedTuple):
    """A kind of message to look at."""

    topic: str  # Last part of its topic
    bag: str = ""  # Where it is recorded; "": it is simulated
    warm_up_s: float = 1.0  # How long the estimator runs before: until all robots are tracked


KINDS = {
    "detection": Kind("detections", "eight_five_robots", 4.0),
    "odometry": Kind("odom", "eight_five_robots", 4.0),
    "range": Kind("ranges"),
    "scan": Kind("scan"),
    "brightness": Kind("brightness", "droplets_twenty", 45.0),
}


class Passed(NamedTuple):
    """What a message passes, in order of first use."""

    modules: list[str]  # Dotted names
    # Module and name of each class of tuples or data that is constructed, but those of the estimator's state
    containers: list[str]


@cache
def passed(name: str) -> Passed:
    """What a message of a kind passes: the first one after warm-up that is used, or the first odometry.

    Raises:
        LookupError: No message is used.
    """
    kind = KINDS[name]
    with tempfile.TemporaryDirectory() as folder:
        swarm = load_swarm(_BAGS / kind.bag / "swarm.yaml") if kind.bag else _room(Path(folder))
        ingest, estimator = Ingest(swarm), Estimator(swarm)
    messages = _recorded(kind.bag, ingest.handle_of) if kind.bag else _simulated(name, swarm)
    encoder = SwarmPosesEncoder([robot.name for robot in swarm.robots], ingest.map_frame)
    begin_ns = None
    for topic, data, arrival_ns in messages:
        begin_ns = arrival_ns if begin_ns is None else begin_ns
        is_one = topic.endswith(f"/{kind.topic}") and arrival_ns > begin_ns + 1e9 * kind.warm_up_s
        idle, used, trace = _Trace(), estimator.used, _Trace()
        if is_one:  # what a tick and a checkpoint construct without a message does not carry it
            sys.setprofile(idle.note)
            _publish(estimator, encoder, arrival_ns)
            estimator._timeline.state.copy()  # noqa: SLF001
        message = SerializedMessage(ingest.handle_of[topic], data, arrival_ns)
        sys.setprofile(trace.note if is_one else None)
        try:
            for batch in ingest.read(MessageBatch.of([message])):
                estimator.receive(batch)
            _publish(estimator, encoder, arrival_ns)
        finally:
            sys.setprofile(None)
        if is_one and (name == "odometry" or estimator.used > used):
            found, of_state = trace.result(), set(idle.result().containers)
            return found._replace(containers=[one for one in found.containers if one not in of_state])
    raise LookupError(f"no message of the kind {name} is used")


def _publish(estimator: Estimator, encoder: SwarmPosesEncoder, now_ns: int) -> None:
    """Encode the poses at an instant, as the node does."""
    e = estimator.tick(now_ns)
    encoder.encode(e.stamp_ns, e.poses, e.covariances, e.fix_age_s, e.status, e.heading_known)


class _Trace:
    """Notes the functions of the product that run, and the objects that they construct."""

    def __init__(self) -> None:
        self._ran: dict[CodeType, Mapping[str, Any]] = {}
        self._constructed: dict[type, None] = {}

    def note(self, frame: FrameType, event: str, _argument: object) -> None:
        """Note a call; for `sys.setprofile`."""
        code = frame.f_code
        if event != "call":
            return
        if code.co_varnames[:1] == ("_cls",) or code.co_name in {"__init__", "_make"}:
            first = frame.f_locals.get(code.co_varnames[0])
            constructed = first if isinstance(first, type) else type(first)
            if _is_container(constructed):
                self._constructed[constructed] = None
        # methods that dataclasses and NamedTuples generate are of no file
        if _is_product(frame.f_globals.get("__name__")) and not code.co_filename.startswith("<"):
            self._ran.setdefault(code, frame.f_globals)

    def result(self) -> Passed:
        """Modules and containers of all functions that ran, and of the compiled ones that they reach."""
        modules: dict[str, None] = {}
        for code, names in compiled_too(self._ran).items():
            modules[names["__name__"]] = None
            if code not in self._ran:
                found = (value for value in named(code, names) if _is_container(value))
                self._constructed |= dict.fromkeys(found)
        return Passed([*modules], [f"{one.__module__}.{one.__qualname__}" for one in self._constructed])


def compiled_too(functions: Mapping[CodeType, Mapping[str, Any]]) -> dict[CodeType, Mapping[str, Any]]:
    """Code and globals of functions, each followed by those of the compiled functions that it reaches."""
    found: dict[CodeType, Mapping[str, Any]] = {}
    left = [*functions.items()][::-1]
    while left:
        code, names = left.pop()
        if code not in found:
            found[code] = names
            reached = [value.py_func for value in named(code, names) if isinstance(value, Dispatcher)]
            left += [(one.__code__, one.__globals__) for one in reversed(reached)]
    return found


def named(code: CodeType, names: Mapping[str, Any]) -> Iterator[Any]:
    """Values of the global names that code uses, and of `module.name`; code inside it included."""
    for name in code.co_names:
        value = names.get(name)
        yield value
        if isinstance(value, ModuleType) and _is_product(value.__name__):
            yield from (vars(value)[one] for one in code.co_names if one in vars(value))
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from named(constant, names)


def _is_product(module: object) -> bool:
    return str(module).startswith("swarm_loc_")


def _is_container(value: object) -> bool:
    """Whether it is a NamedTuple or a dataclass of the product."""
    is_data = isinstance(value, type) and (is_dataclass(value) or hasattr(value, "_fields"))
    return is_data and _is_product(value.__module__)


def _recorded(bag: str, topics: Collection[str]) -> Iterator[Message]:
    """The messages of a bag."""
    with BagReader(_BAGS / bag) as reader:
        for topic, _, log_ns, data in reader.messages(topics):
            yield topic, data, log_ns


def _room(folder: Path) -> Swarm:
    """A robot with a lidar and a radio in the middle of a room with anchors; writes the map to a folder."""
    half = np.array([_WALL_X, _WALL_Y]) + 0.5 * _CELL
    log_odds = np.full(np.round(2.0 * half / _CELL).astype(int), -5.0)
    log_odds[[0, -1]] = log_odds[:, [0, -1]] = 5.0
    walls, _ = save_map(OccupancyMap(-half, _CELL, log_odds), folder / "room")
    robot = Robot("robot1", start=(0.0, 0.0, 0.0), lidar=LidarModel(range_sigma=0.01), uwb=UwbDevice(1))
    anchors = (Anchor(100, -3.0, -3.0, 1.0), Anchor(101, 3.0, -3.0, 1.0), Anchor(102, 0.0, 3.0, 1.0))
    return Swarm((robot,), anchors=anchors, map=walls)


def _simulated(name: str, swarm: Swarm) -> Iterator[Message]:
    """Odometry of the robot in the room, which stands still, and exact ranges or scans."""
    step = 2.0 * math.pi / 360
    angle = step * (0.5 + np.arange(360))
    walls = np.minimum(_WALL_X / np.abs(np.cos(angle)), _WALL_Y / np.abs(np.sin(angle)))
    limits = {"angle_min": angle[0], "angle_max": angle[-1], "angle_increment": step, "range_max": 5.0}
    away = [{"device": one.address, "range": math.hypot(one.x, one.y, one.z)} for one in swarm.anchors]
    content = {"scan": {**limits, "ranges": walls}, "range": {"ranges": away}}[name]
    pose = {"pose": {"orientation": {"w": 1.0}}}
    for at_ns in range(_STEP_NS, _END_NS, _STEP_NS):
        header = {"stamp": at_ns - _STEP_NS}
        yield "robot1/odom", encode({"header": header, "pose": pose}, ODOMETRY), at_ns
        message_type = LASER_SCAN if name == "scan" else RANGES
        yield f"robot1/{KINDS[name].topic}", encode({"header": header, **content}, message_type), at_ns
