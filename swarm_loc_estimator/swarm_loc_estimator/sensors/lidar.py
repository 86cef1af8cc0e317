"""Scans of lidars in the map of the swarm description, matched by `timeline/map_scans.py`, and their delays.

A scan in a map shows where the robot was in the middle of its sweep. The motion from one scan to the next is
compared with odometry, at each of many lags: where speed or turn rate changes, only the true one agrees. The
lag is the state of a hidden Markov model, since a driver may fall behind at any time; a robot that drives
straight on tells no lag from another but by the jump back at that moment. Poses are those of all lags
together: what is not known of the lag makes them uncertain along the motion.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.cdr import LASER_SCAN
from swarm_loc_estimator.common.messages.streams import Messages
from swarm_loc_estimator.common.se2 import between, compose, wrap_angle
from swarm_loc_estimator.filter.measurements import NO_MEASUREMENTS, select
from swarm_loc_estimator.filter.models import SCAN
from swarm_loc_estimator.mapping.messages import LidarSweep, decode_scan, read_sweep
from swarm_loc_estimator.sensors.fix import about_robots
from swarm_loc_estimator.sensors.sensor import Change, Sensor
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

# Of delays
_STEP_S, _COUNT = 0.025, 25  # Lags that are compared
_RIGHT, _CHANGES_PER_S = 0.9, 0.003  # Chance that the described delay is right, and rate of changes
_NEW, _SLIP = 0.3, 0.05  # Share of a match's variance that the next one does not have; error of odometry
_BENT = 0.25  # Error of the heading, as a share of the turn in a sweep that was straightened without it
_DOF = 4.0  # Errors have Student's distribution: wheels slip
_GAP_NS = 4_000_000_000  # Scans farther apart are not compared
_WILD, _NOISE_SHARE = 400.0, 0.1
"""Squares from which odometry is wrong at any lag and tells nothing, and weight of one in its usual noise."""
_BACKWARDS, _SURE_ORDER = -2.0, 4.0
"""Log odds that the header says the order of the beams wrongly, at first and from which on it is known."""
_NEAR_S, _REFUTED = 0.06, 0.05  # A delay is refuted if it, and those so near, have less chance than this
_NOWHERE = np.full((3, 3), np.nan)


class ScanRows(NamedTuple):
    """Scans (s,)."""

    robot: IntArray  #: (s,) index of the robot
    stamp_ns: IntArray  #: (s,) time of the first beam
    scan: NDArray[Any]  #: (s,) of `ScanMessage`, and of `LidarSweep` after `ScanSensor.measure`
    arrival_ns: IntArray  #: (s,) arrival times


class SweepStore:
    """Keeps sweeps until they are fused, and measurements that stand for them.

    The stamp of a measurement is the time of its last beam, so all odometry during the sweep is before it.

    Args:
        swarm: Robots with their lidars.

    Attributes:
        drops: None; scans that cannot be used are counted by the sensor.
        sweeps: LidarSweep by robot and stamp of its first beam [ns].
    """

    def __init__(self, swarm: Swarm) -> None:
        self._late_ns = np.array([round(-1e9 * min(0.0, one.lidar.delay_s)) for one in swarm.robots])
        self.drops: Counter[str] = Counter()
        self.sweeps: dict[tuple[int, int], LidarSweep] = {}

    @property
    def counters(self) -> dict[str, int]:
        """Sweeps are counted as measurements."""
        return {}

    def take(self, rows: ScanRows) -> Change:
        """Add sweeps."""
        nothing = np.zeros((len(rows.scan), 3))
        ends_ns = [max(one.stamp_ns, one.stamp_ns + one.duration_ns) for one in rows.scan]
        stamps_ns = np.array(ends_ns) + self._late_ns[rows.robot]
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
            sweep = sweeps[k] = read_sweep(scan, self.swarm.robots[robot].lidar, reasons, Counter())
            for reason in reasons:
                self.drops.add(reason, rows.robot[k : k + 1])
            if sweep is not None:
                shift_ns = stamp_ns - scan.stamp_ns  # of the robot's clock
                times = {"stamp_ns": sweep.stamp_ns + shift_ns, "beam_ns": sweep.beam_ns + shift_ns}
                sweeps[k] = sweep._replace(**times)
        return select(rows._replace(scan=sweeps), np.array([one is not None for one in sweeps], dtype=bool))

    @classmethod
    def expected_of(cls, robot: Robot) -> bool:
        """Whether the description says that the robot has a lidar."""
        return robot.lidar.is_used


class DelayBelief(NamedTuple):
    """What is known of the times of a lidar's beams, and its newest scan."""

    lag_s: FloatArray  # (L,) how much older scans may be than described [s]
    chance: FloatArray  # (L,) of each
    stamp_ns: int  # Stamp of the scan
    seen: FloatArray  # (3,) pose of the robot in the middle of the sweep, in `map`
    covariance: FloatArray  # (3, 3) of this pose, by its own axes
    track: FloatArray  # (L, 3) this pose by odometry, at each lag
    backwards: float = _BACKWARDS  # Log odds that beams are measured in the other order than described
    noise: float = 1.0  # Mean of recent squares: how much worse odometry is than assumed
    #: (3, 3) at its stamp: the pose in `map`, by odometry as it is used, and as it was reported
    anchor: FloatArray = _NOWHERE

    @property
    def is_backwards(self) -> bool:
        """Whether beams are certainly measured in the other order than described."""
        return self.backwards > _SURE_ORDER

    @property
    def mean_s(self) -> float:
        """Mean lag [s]."""
        return float(self.chance @ self.lag_s)

    @property
    def sigma_s(self) -> float:
        """Standard deviation of the lag [s]."""
        return math.sqrt(float(self.chance @ (self.lag_s - self.mean_s) ** 2))

    @property
    def is_refuted(self) -> bool:
        """Whether the described delay is wrong."""
        return bool(self.chance[np.abs(self.lag_s) <= _NEAR_S].sum() < _REFUTED)

    def sentence(self, robot: Robot) -> str:
        """How old the scans of a robot are, and what to describe."""
        older = "older" if self.mean_s > 0.0 else "newer"
        text = f"the scans of {robot.name} are {abs(self.mean_s):.2f} +- {self.sigma_s:.2f} s {older} than"
        text += f" described: set lidar.delay_s to {robot.lidar.delay_s - self.mean_s:.2f}, or correct their"
        return f"{text} stamps"


def described_delay(delay_s: float) -> DelayBelief:
    """The belief before the first scan; the described delay [s] is negative if scans are stamped late."""
    before = min(_COUNT - 1, round(max(0.0, -delay_s) / _STEP_S))  # no scan is newer than its arrival
    lag_s = _STEP_S * (np.arange(_COUNT, dtype=float) - before)
    nothing = np.zeros(3), np.eye(3), np.zeros((_COUNT, 3))
    return DelayBelief(lag_s, _delay_prior(lag_s), -_GAP_NS, *nothing)


def _delay_prior(lag_s: FloatArray) -> FloatArray:
    """Chances (L,) of lags without any scan."""
    chance = np.full(_COUNT, (1.0 - _RIGHT) / (_COUNT - 1))
    chance[np.argmin(np.abs(lag_s))] = _RIGHT
    return chance


def learned_delay(
    before: DelayBelief, stamp_ns: int, seen: FloatArray, covariance: FloatArray, track: FloatArray
) -> DelayBelief:
    """The belief after another scan, of which `DelayBelief` tells the arguments; `covariance` is in `map`."""
    turn, cos, sin = np.eye(3), math.cos(seen[2]), math.sin(seen[2])
    turn[:2, :2] = [[cos, sin], [-sin, cos]]
    own, chance, since_ns = turn @ covariance @ turn.T, before.chance, stamp_ns - before.stamp_ns
    noisiness = before.noise
    if 0 < since_ns < _GAP_NS:
        # (L, L, 3) errors of the motion from a lag of the scan before to one of this scan
        error = between(track, compose(before.track, between(before.seen, seen))[:, None])
        slip = _SLIP * (chance @ between(before.track, track))
        noise = _NEW * (own + before.covariance) + np.diag(slip**2)
        squares = (error @ np.linalg.inv(noise) * error).sum(axis=-1)
        usual = min(float(chance @ np.diag(squares)) / 3.0, _WILD)
        noisiness = max(1.0, noisiness + _NOISE_SHARE * (usual - noisiness))
        # a sweep that turned otherwise than at the likeliest lag was straightened wrongly
        turned = np.gradient(np.unwrap(track[:, 2])) * (1e-9 * since_ns / _STEP_S)
        bent = 1.0 + (_BENT * (turned - turned[chance.argmax()])) ** 2 / noise[2, 2]
        # changes are rare, and more often to what is described
        change = 1.0 - math.exp(-1e-9 * since_ns * _CHANGES_PER_S)
        transition = (1.0 - change) * np.eye(_COUNT) + change * _delay_prior(before.lag_s)
        chance = chance @ (
            transition * (1.0 + squares / (noisiness * bent * _DOF)) ** (-0.5 * (_DOF + 3.0)) / np.sqrt(bent)
        )
        chance = chance / chance.sum() if squares.min() < _WILD else before.chance
    return before._replace(
        chance=chance, stamp_ns=stamp_ns, seen=seen, covariance=own, track=track, noise=noisiness
    )


def at_odometry(belief: DelayBelief, now: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The pose (3,) in `map` at a pose (3,) by odometry, and its covariance (3, 3) by the lag alone."""
    poses = compose(belief.seen, between(belief.track, now))
    off = poses - poses[0]
    off[:, 2] = wrap_angle(off[:, 2])
    mean = belief.chance @ off
    off -= mean
    return poses[0] + mean, (belief.chance * off.T) @ off
