"""Anonymous detections of robots in aerial images, identified by `timeline/aerial_images.py`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.cdr import ANONYMOUS_DETECTIONS
from swarm_loc_estimator.common.messages.detections import ANONYMOUS_DTYPE, AnonymousMessage, decode_anonymous
from swarm_loc_estimator.common.messages.streams import EachReader, MessageBatch, MessageColumns
from swarm_loc_estimator.filter.measurements import NOBODY, Measurements
from swarm_loc_estimator.filter.models import ANONYMOUS
from swarm_loc_estimator.sensors.fix import about_robots, take_out_headings
from swarm_loc_estimator.sensors.sensor import (
    NO_ROWS,
    Converter,
    DropCounts,
    InputKind,
    Known,
    Sensor,
    SensorSettings,
    of_none,
)
from swarm_loc_estimator.swarm.swarm import Swarm

FOREIGN_FRAME = "aerial_frame"  # Reason to drop an aerial image that is not in the frame `map`
TOO_MANY = "aerial_too_many"  # Reason to drop an aerial image with more detections than MAX_ANONYMOUS
MAX_ANONYMOUS = 2000
_UNKNOWN_VARIANCE = -1.0  # First element of an unknown covariance


class AerialRows(NamedTuple):
    """Anonymous detections of aerial images, a row per detection (d,)."""

    robot: IntArray  # (d,) always -1, the whole swarm
    stamp_ns: IntArray  # (d,) exposure times
    number: IntArray  # (d,) index of the detection in its message
    pose: FloatArray  # (d, 3) x [m], y [m], heading [rad] in `map`; heading NaN: not measured
    covariance: FloatArray  # (d, 3, 3) of the pose; a first element of -1: unknown
    arrival_ns: IntArray  # (d,) arrival times


NO_AERIAL = AerialRows(NO_ROWS, NO_ROWS, NO_ROWS, np.zeros((0, 3)), np.zeros((0, 3, 3)), NO_ROWS)


def _columns(
    found: MessageColumns[AnonymousMessage], batch: MessageBatch, robot: IntArray, known: Known
) -> tuple[AerialRows, Mapping[str, int]]:
    messages = found.messages
    foreign = np.array([m.frame_id != known.map_frame for m in messages], dtype=bool)
    too_many = np.array([m.detections.size > MAX_ANONYMOUS for m in messages], dtype=bool) & ~foreign
    kept = np.flatnonzero(~foreign & ~too_many)
    sizes = [messages[k].detections.size for k in kept]
    detections = np.concatenate([np.zeros(0, ANONYMOUS_DTYPE), *(messages[k].detections for k in kept)])
    rows = AerialRows(
        robot=np.repeat(robot[found.valid][kept], sizes),
        stamp_ns=np.repeat(found.stamp_ns[found.valid][kept], sizes),
        number=np.concatenate([np.zeros(0, dtype=np.int64), *(np.arange(size) for size in sizes)]),
        pose=np.column_stack([detections["x"], detections["y"], detections["theta"]]).astype(float),
        covariance=detections["covariance"].astype(float),
        arrival_ns=np.repeat(batch.log_ns[found.valid][kept], sizes),
    )
    dropped = {FOREIGN_FRAME: int(foreign.sum()), TOO_MANY: int(too_many.sum())}
    return rows, dropped


def _create_converter(_swarm: Swarm, settings: SensorSettings, _drops: DropCounts) -> Converter:
    sigma, heading_sigma = settings.aerial_position_sigma, settings.aerial_heading_sigma
    noise = np.diag(np.square([sigma, sigma, heading_sigma]))

    def convert(rows: AerialRows) -> Measurements:
        shown = about_robots(NOBODY, rows.stamp_ns, rows.pose, rows.covariance, ANONYMOUS)
        shown.reading[:], shown.arrival_ns[:] = rows.number, rows.arrival_ns
        shown.covariance[rows.covariance[:, 0, 0] == _UNKNOWN_VARIANCE] = noise
        take_out_headings(shown, np.isnan(rows.pose[:, 2]))
        return shown

    return convert


AERIAL = Sensor(
    "aerial",
    NO_AERIAL,
    (
        InputKind(
            "aerial",
            "aerial/detections",
            ANONYMOUS_DETECTIONS,
            lambda n, _: EachReader(n, decode_anonymous),
            _columns,
            of_none,
            of_each=False,
            in_map=True,
        ),
    ),
    _create_converter,
    unit=("robot", "stamp_ns"),  # a partial image would imply missing robots
)
"""The sensor, see `registry.SENSORS`."""
