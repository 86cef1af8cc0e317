"""Stamps and clocks: stamps beside the time of arrival."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.doctor.evidence import SETTINGS, Evidence, Finding
from swarm_loc_estimator.sensors.ingest import CLOCKS_APART_S

_HOUR_S = 3600.0
_AHEAD_S = 0.05
_LATE_S = 0.8  # Detections that are later than odometry by more are named [s]; a detector takes .15 to .3 s
_BACK = 0.02  # Share of stamps that are older than the stamp of the message before, from which they are named
_SENSORS = ("odometry", "detections", "imu", "ranges", "brightness")
_SET_CLOCK = "Synchronize it with the others (chrony)"


def check_clocks(evidence: Evidence) -> Iterator[Finding]:
    """Stamps are acquisition times, by clocks that agree."""
    delays: dict[str, float] = {}
    for sensor in _SENSORS:
        rows = evidence.rows(sensor)
        for robot in np.unique(rows.robot).tolist():
            own = rows.robot == robot
            topic = f"{evidence.source_name(robot)}'s {sensor}"
            found = _of_topic(topic, rows.stamp_ns[own], rows.arrival_ns[own])
            yield from found
            name, delay_s = evidence.source_name(robot), _delay_s(rows.stamp_ns[own], rows.arrival_ns[own])
            if not found and sensor == "odometry":
                delays[name] = delay_s
            elif not found and sensor == "detections" and delay_s - delays.get(name, delay_s) > _LATE_S:
                problem = f"arrive {delay_s:.2g} s after their stamps, but its odometry {delays[name]:.2g} s"
                remedy = "Stamp images with their exposure, and synchronize the computer of the camera"
                yield Finding(f"{name}'s detections", problem, remedy)
    if len(delays) == 2:  # which of them is wrong cannot be seen
        apart = max(delays.values()) - min(delays.values())
        if apart > CLOCKS_APART_S:
            yield Finding(
                " and ".join(delays), f"have clocks {apart:.2g} s apart", "Synchronize them (chrony)"
            )
    for robot, clock in evidence.read[2].clocks_apart().items():
        if evidence.source_name(robot) in delays:
            yield Finding(evidence.source_name(robot), clock.problem, clock.remedy)


def _delay_s(stamp_ns: IntArray, arrival_ns: IntArray) -> float:
    """Median time from stamps to arrivals [s]."""
    return 1e-9 * float(np.median(arrival_ns - stamp_ns))


def _of_topic(topic: str, stamp_ns: IntArray, arrival_ns: IntArray) -> list[Finding]:
    """Stamps of one topic."""
    delay_s, horizon_s = _delay_s(stamp_ns, arrival_ns), SETTINGS.horizon_s
    if (stamp_ns == 0).mean() > 0.5:
        return [Finding(topic, "has stamps of zero", "Let its node set header.stamp to the acquisition time")]
    if stamp_ns.size > 10 and np.ptp(stamp_ns) == 0:
        return [Finding(topic, "has always the same stamp", "Let its node set header.stamp at each message")]
    if abs(delay_s) > _HOUR_S:
        remedy = "Set use_sim_time alike in all nodes, and synchronize clocks"
        return [Finding(topic, "has stamps of another time than the clock here", remedy)]
    if delay_s < -_AHEAD_S:
        return [
            Finding(topic, f"has stamps {-delay_s:.2g} s in the future", f"Its clock is ahead. {_SET_CLOCK}")
        ]
    if delay_s > horizon_s:
        problem = f"has stamps {delay_s:.2g} s old, which is beyond horizon_s ({horizon_s:g} s)"
        return [Finding(topic, problem, f"Its clock is behind, or its data are queued. {_SET_CLOCK}")]
    back = np.diff(stamp_ns) < 0
    if topic.endswith("odometry") and back.sum() > max(1, _BACK * stamp_ns.size):
        problem = f"has stamps that go back, {int(back.sum())} times"
        return [Finding(topic, problem, "Stop the second publisher, or the node that sets wrong stamps")]
    return []
