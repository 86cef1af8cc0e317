"""What the event cameras of PushBots see along their ways, as packets of events."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from swarm_loc_drivers.pushbot.hardware import SENSOR_PX
from swarm_loc_drivers.sim.pushbot import optics
from swarm_loc_drivers.sim.pushbot.event_camera import CameraNoise
from swarm_loc_drivers.sim.pushbot.sight import HallSight
from swarm_loc_drivers.sim.recording.bag import Stream
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.event_encoding import ENCODING, Events, encode_events
from swarm_loc_estimator.common.messages.typestore import MESSAGE_PACKAGE, encode, typestore

EVENTS = f"{MESSAGE_PACKAGE}/msg/EventPacket"
STEP_US = 5_000
"""Of a packet, as the driver makes them."""


def event_streams(
    names: Sequence[str],
    poses: FloatArray,
    begin_ns: int,
    sight: HallSight,
) -> list[Stream]:
    """Packets of events of all robots.

    Args:
        names: Of the robots.
        poses: (K, N, 3) true poses at every `STEP_US`, in map.
        begin_ns: Stamp of the first.
        sight: Their cameras.
    """
    lights = [optics.lights_of(robot) for robot in range(len(names))]
    streams = []
    for robot, name in enumerate(names):
        stamps: list[int] = []
        data: list[bytes] = []
        for step in range(len(poses) - 1):
            span_us = step * STEP_US, (step + 1) * STEP_US
            seen = sight.look(robot, poses[step], poses[step + 1], span_us, lights)
            if len(seen.x):
                events = Events(
                    seen.x.astype(np.uint16),
                    seen.y.astype(np.uint16),
                    seen.polarity == 0,
                    1000 * (seen.time_us - seen.time_us[0]),
                )
                stamps.append(begin_ns + 1000 * int(seen.time_us[0]))
                data.append(_packet(name, stamps[-1], len(data), events))
        arrival_ns = np.array(stamps, dtype=np.int64) + 1000 * STEP_US
        streams.append(Stream(f"{name}/events", EVENTS, arrival_ns, data))
    return streams


def header_at(stamp_ns: int, frame: str) -> Any:
    """The header of a message."""
    types = typestore().types
    stamp = types["builtin_interfaces/msg/Time"](
        sec=stamp_ns // 1_000_000_000, nanosec=stamp_ns % 1_000_000_000
    )
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def _packet(name: str, stamp_ns: int, number: int, events: Events) -> bytes:
    message = typestore().types[EVENTS](
        header=header_at(stamp_ns, f"{name}/event_camera_optical_frame"),
        height=SENSOR_PX,
        width=SENSOR_PX,
        seq=number,
        time_base=stamp_ns,
        encoding=ENCODING,
        is_bigendian=False,
        events=np.frombuffer(encode_events(events), np.uint8),
    )
    return encode(message, EVENTS)


def poses_between(traces: Sequence[FloatArray], period_us: int, duration_us: int) -> FloatArray:
    """Poses (K, N, 3) at every `STEP_US` of traces (n, 3) of unwrapped headings every `period_us`."""
    at_us: IntArray = np.arange(0, duration_us + 1, STEP_US)
    columns = [
        [np.interp(at_us, period_us * np.arange(len(trace)), trace[:, k]) for k in range(3)]
        for trace in traces
    ]
    poses: FloatArray = np.array(columns).transpose(2, 0, 1)
    return poses


def sight_of(walls: FloatArray, seed: int, robots: int) -> HallSight:
    """The cameras of robots in a hall."""
    built = optics.assembled_robots(seed, robots)
    return HallSight(walls, built, CameraNoise(), np.random.default_rng([seed, 2]))
