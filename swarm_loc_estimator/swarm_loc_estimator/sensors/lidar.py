"""Scans of lidars in the map of the swarm description, matched by `timeline/map_scans.py`."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.messages.cdr import LASER_SCAN
from swarm_loc_estimator.common.messages.streams import MessageBatch, Messages
from swarm_loc_estimator.filter.measurements import NO_MEASUREMENTS, select
from swarm_loc_estimator.filter.models import SCAN
from swarm_loc_estimator.mapping.messages import LidarSweep, decode_scan, read_sweep
from swarm_loc_estimator.sensors.fix import about_robots
from swarm_loc_estimator.sensors.sensor import Change, DropCounts, Known, Sensor, SensorSettings
from swarm_loc_estimator.swarm.swarm import Robot, Swarm


class ScanRows(NamedTuple):
    """Scans (s,)."""

    robot: IntArray  #: (s,) index of the robot
    stamp_ns: IntArray  #: (s,) time of the first beam
    scan: NDArray[Any]  #: (s,) of `ScanMessage`, and of `LidarSweep` after `ScanSensor.measure`
    arrival_ns: IntArray  #: (s,) arrival times


class SweepStore:
    """Keeps sweeps of a swarm's lidars until they are fused, and measurements that stand for them.

    The stamp of a measurement is the time of its last beam, so all odometry during the sweep is before it.
    """

    def __init__(self, _swarm: Swarm) -> None:
        self.drops: Counter[str] = Counter()  # None: scans that cannot be used are counted by the sensor
        self.sweeps: dict[tuple[int, int], LidarSweep] = {}  # By robot and stamp of the first beam [ns]

    @property
    def counters(self) -> dict[str, int]:
        """Sweeps are counted as measurements."""
        return {}

    def take(self, rows: ScanRows) -> Change:
        """Add sweeps."""
        nothing = np.zeros((len(rows.scan), 3))
        stamps_ns = np.array([one.last_ns for one in rows.scan])
        added = about_robots(rows.robot, stamps_ns, nothing, np.eye(3)[None], SCAN)
        added.reading[:], added.arrival_ns[:] = rows.stamp_ns, rows.arrival_ns
        for key in zip(rows.robot.tolist(), rows.stamp_ns.tolist(), rows.scan, strict=True):
            self.sweeps.setdefault(key[:2], key[2])
        return Change(added, NO_MEASUREMENTS)

    def forget_before(self, oldest_ns: int) -> None:
        """Discard sweeps that ended before an instant."""
        for key in [key for key, sweep in self.sweeps.items() if sweep.beam_ns.max() < oldest_ns]:
            del self.sweeps[key]

    def restart(self) -> None:
        """Discard all sweeps."""
        self.sweeps.clear()


class ScanSensor(Sensor):
    """Lidars of robots, in a swarm with a map."""

    name, topic, message_type = "scans", "scan", LASER_SCAN
    only_expected, needs_map, accumulator = True, True, SweepStore

    decode = staticmethod(decode_scan)

    def __init__(self, swarm: Swarm, settings: SensorSettings, drops: DropCounts) -> None:
        super().__init__(swarm, settings, drops)
        self._lidars = [[*robot.lidar.all.values()] for robot in swarm.robots]

    @classmethod
    def topics_of(cls, robot: Robot) -> tuple[str, ...]:
        """One for each lidar."""
        return tuple(robot.lidar.all)

    @classmethod
    def _read(cls, found: Messages[Any], batch: MessageBatch, robot: IntArray, known: Known) -> Any:
        """Keep the number of the lidar, too."""
        lidars = known.devices[batch.topic[found.valid]].tolist()
        decoded = [one._replace(lidar=lidar) for one, lidar in zip(found.decoded, lidars, strict=True)]
        return super()._read(replace(found, decoded=decoded), batch, robot, known)

    @classmethod
    def columns(cls, messages: Messages[Any]) -> ScanRows:
        """Keep the decoded messages (n,)."""
        scans = np.empty(len(messages.decoded), dtype=object)
        scans[:] = messages.decoded
        return ScanRows(messages.robot, messages.stamp_ns, scans, messages.arrival_ns)

    def measure(self, rows: ScanRows) -> ScanRows:
        """Read the sweeps, and count scans that cannot be used."""
        sweeps, columns = rows.scan.copy(), (rows.robot.tolist(), rows.stamp_ns.tolist(), rows.scan)
        for k, (robot, stamp_ns, scan) in enumerate(zip(*columns, strict=True)):
            reasons: Counter[str] = Counter()
            sweep = sweeps[k] = read_sweep(scan, self._lidars[robot][scan.lidar], reasons, Counter())
            for reason in reasons:
                self.drops.add(reason, rows.robot[k : k + 1])
            if sweep is not None:
                shift_ns = stamp_ns - scan.stamp_ns  # of the robot's clock
                times = {"stamp_ns": sweep.stamp_ns + shift_ns, "beam_ns": sweep.beam_ns + shift_ns}
                sweeps[k] = sweep._replace(**times)
        read = np.array([one is not None for one in sweeps], dtype=bool)
        # one nanosecond tells apart the scans that two lidars of a robot begin at the same time
        apart_ns = np.array([one.lidar for one in rows.scan], dtype=np.int64)
        return select(rows._replace(scan=sweeps, stamp_ns=rows.stamp_ns + apart_ns), read)

    @classmethod
    def expected_of(cls, robot: Robot) -> bool:
        """Whether the description says that the robot has a lidar."""
        return robot.lidar.is_used
