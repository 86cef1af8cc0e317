"""Odometry of all robots as tracks: calibrated poses with preintegrated noise.

A robot's pose is X(t) = T O(t): the track O, and the transform T from `map` to the track's frame, which
is what the filter estimates. With right-invariant errors X = exp(xi) X_hat the prediction over any time
then leaves T as it is and adds noise to the robot's own block only (F = I):

    P += Ad(T) (G(t2) - G(t1)) Ad(T)^T,    G(t) = sum over steps of Ad(O_mid) Q Ad(O_mid)^T.

So a prediction costs two look-ups however many odometry messages lie between.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.odometry import preintegration, track_arrays
from swarm_loc_estimator.swarm.error_models import MotionResponse
from swarm_loc_estimator.swarm.swarm import Robot

_IDEAL = MotionResponse(speeds=(0.0,), turn_rates=(0.0,), speed_share=((1.0,),), turn_share=((1.0,),))
_FIRST_CAPACITY = 256
_TRIM_EVERY_NS = 1_000_000_000
_JUMPING_NS = 3_000_000_000
_ROWS = (
    *("stamp_ns", "raw", "pose", "covariance", "jacobian", "rate", "twist", "agreed", "fastest", "unmoved"),
    *("known_ns", "jump_ns", "gyro_check"),
)
_GYRO_ROWS = ("gyro_ns", "gyro_rate", "gyro_angle", "gyro_piece")


@dataclass(frozen=True)
class TrackChange:
    """Result of `OdometryTracks.extend`."""

    changed_from_ns: IntArray  # (N,) instant after which look-ups of each robot have changed, or UNCHANGED_NS
    duplicates: int  # Number of dropped rows with the stamp of another row of the robot
    too_old: IntArray  # (k,) robots of dropped rows older than the oldest accepted stamp
    jumps: int  # Number of new rows beyond the robot's maximum speed or turn rate
    # Number of new rows that contradict their twist, or restart at the origin. The steps to rows with a jump
    # or a reset are unknown motion.
    resets: int


class OdometryTracks:
    """Recent odometry of robots, by their models and motion responses; rows may arrive in any order."""

    def __init__(self, robots: Sequence[Robot]) -> None:
        models = [robot.odometry for robot in robots]
        self._robots = len(models)
        self._response = _stacked([robot.response or _IDEAL for robot in robots])
        self._model, self._imu = (
            np.array([tuple(getattr(m, name) for name in dtype.names or ()) for m in some], dtype=dtype)
            for dtype, some in (
                (track_arrays.MODEL_DTYPE, models),
                (track_arrays.IMU_DTYPE, [robot.imu for robot in robots]),
            )
        )
        self._is_stationary = np.array([robot.stands for robot in robots], dtype=bool)
        walks = [robot.random_walk for robot in robots]
        self._walk = np.array([(walk.position, walk.heading) for walk in walks]).reshape(-1, 2)
        self._imu_delay_ns = np.rint(1e9 * self._imu["delay_s"]).astype(np.int64)
        self._delay_ns = np.array([round(m.delay_s * 1e9) for m in models], dtype=np.int64)
        self.clear()

    def clear(self) -> None:
        """Remove all rows."""
        self._oldest_ns = track_arrays.BEFORE_ALL_NS
        self._trimmed_ns = track_arrays.BEFORE_ALL_NS
        has_imu = bool(np.any(self._imu["turn_noise_density"] > 0.0))
        self.arrays = self._allocated(_FIRST_CAPACITY, _FIRST_CAPACITY if has_imu else 0)

    @property
    def lookback_ns(self) -> int:
        """Maximum time before its stamp at which a row may change look-ups [ns]."""
        timeout_ns = np.ceil(self._model["timeout_s"] * 1e9).astype(np.int64)
        delay_ns = np.minimum(self._delay_ns, self._imu_delay_ns)
        return int(np.max(timeout_ns - np.minimum(0, delay_ns), initial=0)) + self.unsettled_ns

    @property
    def unsettled_ns(self) -> int:
        """Time before the newest row for which it may make turns uncertain [ns]; 0 without gyroscopes."""
        return track_arrays.COVER_NS if self.arrays.gyro_check.size else 0

    def has_started(self, robots: IntArray | int, stamps_ns: IntArray | int) -> BoolArray:
        """Whether robots (k,) have odometry before instants (k,); always True for robots without odometry."""
        arrays = self.arrays
        begun = (arrays.filled[robots] > 0) & (arrays.begin_ns[robots] <= stamps_ns)
        return np.asarray(begun | self._is_stationary[robots])

    def is_random_walk(self, robots: IntArray | int) -> BoolArray:
        """Whether robots (k,) are random walks, without odometry."""
        return np.asarray(self._walk[robots].any(axis=-1))

    def integrates_twist(self) -> BoolArray:
        """Whether the twist of each robot (N,) is integrated: its pose or its heading is constant."""
        arrays = self.arrays
        newest_ns = arrays.stamp_ns[np.arange(self._robots), np.maximum(arrays.filled - 1, 0)]
        return (arrays.twist_from_ns < newest_ns) & (newest_ns <= arrays.twist_until_ns)

    def is_constant(self) -> BoolArray:
        """Whether the pose of each robot (N,) has never changed, and its twist is not integrated."""
        newest = np.maximum(self.arrays.filled - 1, 0)
        never = np.isfinite(self.arrays.unmoved[np.arange(self._robots), newest, 0])
        return np.asarray(never & (self.arrays.filled > 1) & ~self.integrates_twist())

    def contradicts_gyroscope(self) -> BoolArray:
        """Whether the wheels of each robot (N,) contradict its gyroscope, whose turns are then not used."""
        if not self.arrays.gyro_check.size:
            return np.zeros(self._robots, dtype=bool)
        newest = np.maximum(self.arrays.filled - 1, 0)
        return np.asarray(self.arrays.gyro_check[np.arange(self._robots), newest, track_arrays.DOUBT] > 0.0)

    def turn_ratio(self, robot: int) -> float:
        """Turn of a robot's gyroscope per turn of its wheels, of all rows; NaN without turns."""
        by_wheels, by_gyro = self.arrays.gyro_check[
            robot, : self.arrays.filled[robot], [track_arrays.WHEELS, track_arrays.GYRO]
        ]
        return float(by_gyro @ by_wheels / (by_wheels @ by_wheels or math.nan))

    def had_faults(self, now_ns: int, count: int) -> BoolArray:
        """Whether the odometry of each robot (N,) has jumped or was reset recently, 1 or 2 times."""
        arrays, robots = self.arrays, np.arange(self._robots)
        fault_ns = arrays.jump_ns[robots, np.maximum(arrays.filled - 1, 0), count - 1]
        recent: BoolArray = (arrays.filled > 0) & (now_ns - fault_ns < _JUMPING_NS)
        return recent

    def extend(
        self, robots: IntArray, stamps_ns: IntArray, raw: FloatArray, twist: FloatArray | None = None
    ) -> TrackChange:
        """Add rows (k,) of robots in any order and of any age, by their acquisition stamps.

        `raw` (k, 3) are finite poses as the driver reports them, in its own odom frame, `twist` (k, 3)
        velocities forward and left [m/s] and turn rates [rad/s]; NaN or None: not known.
        """
        twist = np.full(raw.shape, np.nan) if twist is None else twist
        changed_from = np.empty(self._robots, dtype=np.int64)
        found = preintegration.continue_tracks(
            self.arrays, self._oldest_ns, robots, stamps_ns, raw, twist, changed_from
        )
        if found.jumps >= 0:
            return TrackChange(changed_from, 0, robots[:0], found.jumps, found.resets)
        young = stamps_ns >= self._oldest_ns
        too_old = robots[~young]
        rows = preintegration.NewRows(robots, stamps_ns + self._delay_ns[robots], raw, twist, young)
        rows, changed_from = self._take_back_later_rows(
            preintegration.NewRows._make(column[young] for column in rows)
        )
        robots, stamps, raw = rows[:3]
        order = np.lexsort((wrap_angle(raw[:, 2]), raw[:, 1], raw[:, 0], stamps, robots))
        rows = preintegration.NewRows._make(column[order] for column in rows)
        while np.any(
            self.arrays.filled + np.bincount(robots, minlength=self._robots) > self.arrays.stamp_ns.shape[1]
        ):
            self._grow(_ROWS)
        found = preintegration.integrate(self.arrays, self._oldest_ns, rows, changed_from)
        return TrackChange(changed_from, found.duplicates, too_old, found.jumps, found.resets)

    def extend_turns(self, robots: IntArray, stamps_ns: IntArray, rates: FloatArray) -> TrackChange:
        """Add turn rates of gyroscopes in any order and of any age: (k,) of robots with an IMU.

        They are finite, and about the vertical as measured [rad/s].
        """
        young = stamps_ns >= self._oldest_ns
        too_old = robots[~young]
        robots, rates = robots[young], rates[young]
        stamps_ns = stamps_ns[young] + self._imu_delay_ns[robots]
        needed = np.max(self.arrays.gyro_filled + np.bincount(robots, minlength=self._robots), initial=0)
        while needed > self.arrays.gyro_ns.shape[1]:
            self._grow(_GYRO_ROWS)
        from_ns, changed_from = np.empty((2, self._robots), dtype=np.int64)
        duplicates = preintegration.insert_rates(self.arrays, robots, stamps_ns, rates, from_ns)
        changed_from.fill(preintegration.UNCHANGED_NS)
        preintegration.integrate_again(self.arrays, from_ns, changed_from)
        return TrackChange(changed_from, duplicates, too_old, 0, 0)

    def at(self, robots: IntArray, stamps_ns: IntArray) -> track_arrays.OdometrySample:
        """Look up the tracks of robots (m,) at instants (m,), see `look_up`."""
        return track_arrays.look_up_all(self.arrays, robots, stamps_ns)

    def trim(self, oldest_ns: int, kept_ns: int) -> None:
        """Reject new rows before `oldest_ns`; remove rows not needed for look-ups from `kept_ns` on."""
        self._oldest_ns = oldest_ns
        if kept_ns < self._trimmed_ns + _TRIM_EVERY_NS:
            return
        self._trimmed_ns = kept_ns
        arrays = self.arrays
        for stamp_ns, filled, names in (
            (arrays.stamp_ns, arrays.filled, _ROWS),
            (arrays.gyro_ns, arrays.gyro_filled, _GYRO_ROWS),
        ):
            capacity = stamp_ns.shape[1]
            for robot in np.flatnonzero(filled > capacity // 2):
                count = filled[robot]
                first = int(np.searchsorted(stamp_ns[robot, :count], kept_ns, side="right")) - 2
                if first > capacity // 4:
                    for rows in (getattr(arrays, name) for name in names):
                        rows[robot, : count - first] = rows[robot, first:count].copy()
                    filled[robot] = count - first

    def _allocated(self, capacity: int, rates: int) -> track_arrays.TrackArrays:
        shape, gyro_shape = (self._robots, capacity), (self._robots, rates)
        arrays = track_arrays.TrackArrays(
            # rows of odometry
            filled=np.zeros(self._robots, dtype=np.int64),
            stamp_ns=np.zeros(shape, dtype=np.int64),
            raw=np.zeros((*shape, 3)),
            pose=np.zeros((*shape, 3)),
            covariance=np.zeros((*shape, 3, 3)),
            jacobian=np.zeros((*shape, 3, 3)),
            rate=np.zeros((*shape, 3)),
            twist=np.zeros((*shape, 3)),
            agreed=np.zeros((*shape, 2), dtype=np.int64),
            fastest=np.zeros((*shape, 2)),
            unmoved=np.zeros((*shape, 3)),
            known_ns=np.zeros(shape, dtype=np.int64),
            jump_ns=np.zeros((*shape, 2), dtype=np.int64),
            gyro_check=np.zeros((*shape, track_arrays.CHECKS if rates else 0)),
            twist_from_ns=np.full(self._robots, track_arrays.LATEST_NS),
            twist_until_ns=np.full(self._robots, track_arrays.LATEST_NS),
            # description of the robots
            delay_ns=self._delay_ns,
            model=self._model,
            response=self._response[0],
            response_speed=self._response[1],
            response_turn_rate=self._response[2],
            begin_ns=np.zeros(self._robots, dtype=np.int64),
            begin_pose=np.zeros((self._robots, 3)),
            is_stationary=self._is_stationary,
            imu=self._imu,
            # turn rates of gyroscopes
            gyro_filled=np.zeros(self._robots, dtype=np.int64),
            gyro_ns=np.zeros(gyro_shape, dtype=np.int64),
            gyro_rate=np.zeros(gyro_shape),
            gyro_angle=np.zeros(gyro_shape),
            gyro_piece=np.zeros(gyro_shape, dtype=np.int64),
            walk=self._walk,
        )
        for name in _ROWS:  # touch the memory now, so that page faults do not delay the first data
            getattr(arrays, name).fill(0)
        return arrays

    def _grow(self, names: Sequence[str]) -> None:
        """Double the capacity of rows."""
        old = {name: getattr(self.arrays, name) for name in names}
        new = {name: np.concatenate([rows, np.zeros_like(rows)], axis=1) for name, rows in old.items()}
        self.arrays = self.arrays._replace(**new)

    def _take_back_later_rows(self, rows: preintegration.NewRows) -> tuple[preintegration.NewRows, IntArray]:
        """Merge new rows with later ones, which are taken back, and from when (N,) the tracks change."""
        arrays, (robots, stamps) = self.arrays, rows[:2]
        taken = [rows]
        newest = arrays.stamp_ns[robots, np.maximum(arrays.filled[robots] - 1, 0)]
        # equal stamps: the sort order decides which is kept
        late = (arrays.filled[robots] > 0) & (stamps <= newest)
        for robot in np.unique(robots[late]):
            count = arrays.filled[robot]
            first = int(arrays.stamp_ns[robot, :count].searchsorted(stamps[late & (robots == robot)].min()))
            first = track_arrays.unmark_from(arrays, robot, first)
            later = (getattr(arrays, name)[robot, first:count] for name in ("stamp_ns", "raw", "twist"))
            again = np.zeros(count - first, dtype=bool)
            taken.append(preintegration.NewRows._make([np.full(count - first, robot), *later, again]))
            arrays.filled[robot] = first
        changed_from = np.full(self._robots, preintegration.UNCHANGED_NS)
        last = np.maximum(arrays.filled[robots] - 1, 0)
        newest = arrays.stamp_ns[robots, last]
        changed_from[robots] = np.where(arrays.filled[robots] > 0, newest, track_arrays.BEFORE_ALL_NS)
        return preintegration.NewRows(*map(np.concatenate, zip(*taken, strict=True))), changed_from


def _stacked(responses: Sequence[MotionResponse]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Shares (N, 2, V, W), speeds (N, V) and turn rates (N, W) of all robots; smaller grids are padded."""
    v = max((len(r.speeds) for r in responses), default=1)
    w = max((len(r.turn_rates) for r in responses), default=1)
    shares = np.ones((len(responses), 2, v, w))
    speeds, turn_rates = np.full((len(responses), v), np.inf), np.full((len(responses), w), np.inf)
    for i, r in enumerate(responses):
        speeds[i, : len(r.speeds)], turn_rates[i, : len(r.turn_rates)] = r.speeds, r.turn_rates
        shares[i, :, : len(r.speeds), : len(r.turn_rates)] = r.speed_share, r.turn_share
    return shares, speeds, turn_rates
