"""Odometry of all robots as tracks: calibrated poses with the noise that they have gathered.

A robot's pose is X(t) = T O(t): the track O, and the transform T from `map` to the track's frame, which
is what the filter estimates. With right-invariant errors X = exp(xi) X_hat the prediction over any time
then leaves T as it is and adds noise to the robot's own block only (F = I):

    P += Ad(T) (G(t2) - G(t1)) Ad(T)^T,    G(t) = sum over steps of Ad(O_mid) Q Ad(O_mid)^T.

So a prediction costs two look-ups however many odometry messages lie between.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.core.compiled import compiled, wrap
from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.core.swarm import OdometryModel

IntArray = NDArray[np.int64]

UNCHANGED_NS = np.iinfo(np.int64).max

_BEFORE_ALL_NS = np.iinfo(np.int64).min
_FIRST_CAPACITY = 256
_ROWS = ("stamp_ns", "raw", "pose", "noise")


class TrackArrays(NamedTuple):
    """The rows of all tracks and the models behind them, as compiled code reads them.

    Attributes:
        count: (N,) rows in use per robot.
        stamp_ns: (N, capacity) instants, calibrated for delay.
        raw: (N, capacity, 3) poses as reported, headings unwrapped.
        pose: (N, capacity, 3) calibrated poses O, headings unwrapped.
        noise: (N, capacity, 3, 3) gathered noise G in the track's frame.
        model: (N,) records of the numbers of `OdometryModel`.
        begin_ns: (N,) instant of the very first row.
        begin_pose: (N, 3) the pose there, where G is zero.
    """

    count: IntArray
    stamp_ns: IntArray
    raw: FloatArray
    pose: FloatArray
    noise: FloatArray
    model: NDArray[np.void]
    begin_ns: IntArray
    begin_pose: FloatArray


_MODEL_DTYPE = np.dtype([(f.name, np.float64) for f in fields(OdometryModel)])


@dataclass(frozen=True)
class TrackSample:
    """Tracks looked up at some instants.

    Attributes:
        pose: (m, 3) calibrated odometry pose O, heading not wrapped.
        raw: (m, 3) the pose that the driver reported, interpolated likewise.
        noise: (m, 3, 3) gathered noise G in the track's frame.
        silence_s: (m,) how long after the newest message of its robot the instant lies; 0 within the track.
    """

    pose: FloatArray
    raw: FloatArray
    noise: FloatArray
    silence_s: FloatArray


@dataclass(frozen=True)
class TrackChange:
    """What `OdometryTracks.extend` did.

    Attributes:
        changed_from_ns: (N,) per robot the instant after which look-ups may now differ, or UNCHANGED_NS.
        duplicates: Rows dropped because the robot has a row with that stamp.
        too_old: Rows dropped because they lie before the oldest stamp kept.
        jumps: Steps that no robot can drive; the step was replaced by unknown motion.
    """

    changed_from_ns: IntArray
    duplicates: int
    too_old: int
    jumps: int


class OdometryTracks:
    """The recent odometry of all robots, in any order of arrival.

    Args:
        models: One motion model per robot.
    """

    def __init__(self, models: Sequence[OdometryModel]) -> None:
        self._robots = len(models)
        names = _MODEL_DTYPE.names or ()
        self._model = np.array(
            [tuple(getattr(m, name) for name in names) for m in models], dtype=_MODEL_DTYPE
        )
        self._delay_ns = np.array([round(m.delay_s * 1e9) for m in models], dtype=np.int64)
        self.clear()

    def clear(self) -> None:
        """Forget every row."""
        self._oldest_ns = _BEFORE_ALL_NS
        self.arrays = self._allocated(_FIRST_CAPACITY)

    def begun(self, robot: int, stamp_ns: int) -> bool:
        """Whether the robot's odometry has begun by an instant."""
        return bool(self.arrays.count[robot] and self.arrays.begin_ns[robot] <= stamp_ns)

    def extend(self, robots: IntArray, stamps_ns: IntArray, raw: FloatArray) -> TrackChange:
        """Add rows, whatever their order and age.

        Args:
            robots: (k,) robot index of each row.
            stamps_ns: (k,) acquisition stamps.
            raw: (k, 3) finite poses as the driver reports them, in its own odom frame.
        """
        stamps = stamps_ns + self._delay_ns[robots]
        fresh = stamps >= self._oldest_ns
        robots, stamps, raw, changed_from = self._take_back_later_rows(
            robots[fresh], stamps[fresh], raw[fresh]
        )
        order = np.lexsort((raw[:, 2], raw[:, 1], raw[:, 0], stamps, robots))
        while np.any(
            self.arrays.count + np.bincount(robots, minlength=self._robots) > self.arrays.stamp_ns.shape[1]
        ):
            self._grow()
        duplicates, jumps = _integrate(self.arrays, robots[order], stamps[order], raw[order])
        return TrackChange(changed_from, duplicates, int((~fresh).sum()), jumps)

    def at(self, robots: IntArray, stamps_ns: IntArray) -> TrackSample:
        """Look tracks up, see `look_up`.

        Args:
            robots: (m,) robot indices.
            stamps_ns: (m,) instants.
        """
        m = robots.size
        sample = TrackSample(np.zeros((m, 3)), np.zeros((m, 3)), np.zeros((m, 3, 3)), np.zeros(m))
        _look_up_all(self.arrays, robots, stamps_ns, sample.pose, sample.raw, sample.noise, sample.silence_s)
        return sample

    def trim(self, oldest_ns: int) -> None:
        """Let rows go that no look-up from `oldest_ns` on needs; older ones are refused from now on."""
        self._oldest_ns = oldest_ns
        capacity = self.arrays.stamp_ns.shape[1]
        for robot in np.flatnonzero(self.arrays.count > capacity // 2):
            count = self.arrays.count[robot]
            first = int(np.searchsorted(self.arrays.stamp_ns[robot, :count], oldest_ns, side="right")) - 2
            if first > capacity // 4:
                for rows in (getattr(self.arrays, name) for name in _ROWS):
                    rows[robot, : count - first] = rows[robot, first:count].copy()
                self.arrays.count[robot] = count - first

    def _allocated(self, capacity: int) -> TrackArrays:
        shape = (self._robots, capacity)
        return TrackArrays(
            count=np.zeros(self._robots, dtype=np.int64),
            stamp_ns=np.zeros(shape, dtype=np.int64),
            raw=np.zeros((*shape, 3)),
            pose=np.zeros((*shape, 3)),
            noise=np.zeros((*shape, 3, 3)),
            model=self._model,
            begin_ns=np.zeros(self._robots, dtype=np.int64),
            begin_pose=np.zeros((self._robots, 3)),
        )

    def _grow(self) -> None:
        old = self.arrays
        capacity = old.stamp_ns.shape[1]
        rows = self._allocated(2 * capacity)
        for name in _ROWS:
            getattr(rows, name)[:, :capacity] = getattr(old, name)
        self.arrays = old._replace(**{name: getattr(rows, name) for name in _ROWS})

    def _take_back_later_rows(
        self, robots: IntArray, stamps: IntArray, raw: FloatArray
    ) -> tuple[IntArray, IntArray, FloatArray, IntArray]:
        """Merge the new rows with those of the tracks that come after them, which are then integrated anew.

        Returns:
            Robots, stamps, raw poses, and per robot the instant after which its track changes.
        """
        arrays = self.arrays
        taken: list[tuple[IntArray, IntArray, FloatArray]] = [(robots, stamps, raw)]
        newest = arrays.stamp_ns[robots, np.maximum(arrays.count[robots] - 1, 0)]
        late = (arrays.count[robots] > 0) & (stamps < newest)
        for robot in np.unique(robots[late]):
            count = arrays.count[robot]
            first = int(
                np.searchsorted(arrays.stamp_ns[robot, :count], stamps[late & (robots == robot)].min())
            )
            rows = slice(first, count)
            taken.append(
                (
                    np.full(count - first, robot),
                    arrays.stamp_ns[robot, rows].copy(),
                    arrays.raw[robot, rows].copy(),
                )
            )
            arrays.count[robot] = first
        changed_from = np.full(self._robots, UNCHANGED_NS)
        last = np.maximum(arrays.count[robots] - 1, 0)
        changed_from[robots] = np.where(
            arrays.count[robots] > 0, arrays.stamp_ns[robots, last], _BEFORE_ALL_NS
        )
        columns = [np.concatenate(parts) for parts in zip(*taken, strict=True)]
        return columns[0], columns[1], columns[2], changed_from


@compiled
def look_up(
    tracks: TrackArrays, robot: int, stamp_ns: int, pose: FloatArray, raw: FloatArray, noise: FloatArray
) -> float:
    """Write the robot's pose O (3,), raw pose (3,) and noise G (3, 3) at an instant; return its silence [s].

    Within a step the motion is an arc of constant twist. Past the newest row the last twist goes on, less and
    less sure; after `timeout_s` the motion since that row counts as unknown. Before the first row the robot
    stands.
    """
    count = tracks.count[robot]
    if count == 0:
        pose[:], raw[:], noise[:] = 0.0, 0.0, 0.0
        return math.inf
    row = np.searchsorted(tracks.stamp_ns[robot, :count], stamp_ns, side="right") - 1
    row = max(0, min(row, count - 2))
    after = min(row + 1, count - 1)
    duration = tracks.stamp_ns[robot, after] - tracks.stamp_ns[robot, row]
    silence = max(0.0, (stamp_ns - tracks.stamp_ns[robot, after]) * 1e-9)
    timeout = tracks.model[robot].timeout_s
    fraction = 0.0
    if duration > 0:
        fraction = max(0.0, (stamp_ns - tracks.stamp_ns[robot, row]) / duration)
        if silence > timeout:
            fraction = 1.0
    _interpolate(tracks.pose[robot, row], tracks.pose[robot, after], fraction, pose)
    _interpolate(tracks.raw[robot, row], tracks.raw[robot, after], fraction, raw)
    for i in range(3):
        for j in range(3):
            start = tracks.noise[robot, row, i, j]
            noise[i, j] = start + fraction * (tracks.noise[robot, after, i, j] - start)
    if 0.0 < silence <= timeout:
        _add_run_on(tracks.model[robot], silence, pose[0], pose[1], pose[2], noise)
    elif silence > timeout:
        _add_unknown_motion(tracks.model[robot], silence, pose[0], pose[1], pose[2], noise)
    return silence


@compiled
def _look_up_all(
    tracks: TrackArrays,
    robots: IntArray,
    stamps_ns: IntArray,
    pose: FloatArray,
    raw: FloatArray,
    noise: FloatArray,
    silence_s: FloatArray,
) -> None:
    for k in range(robots.size):
        silence_s[k] = look_up(tracks, robots[k], stamps_ns[k], pose[k], raw[k], noise[k])


@compiled
def _interpolate(start: FloatArray, end: FloatArray, fraction: float, out: FloatArray) -> None:
    """The pose on the arc of constant twist from `start` to `end`; a `fraction` past 1 runs on."""
    turn = end[2] - start[2]
    back = -0.5 * (1.0 - fraction) * turn
    cos, sin = math.cos(back), math.sin(back)
    dx, dy = end[0] - start[0], end[1] - start[1]
    out[0] = start[0] + fraction * (cos * dx - sin * dy)
    out[1] = start[1] + fraction * (sin * dx + cos * dy)
    out[2] = start[2] + fraction * turn


@compiled
def _integrate(
    tracks: TrackArrays, robots: IntArray, stamps_ns: IntArray, raw: FloatArray
) -> tuple[int, int]:
    """Append rows sorted by robot and stamp; return how many were duplicates, how many steps jumps."""
    duplicates, jumps = 0, 0
    for k in range(robots.size):
        robot = robots[k]
        row = tracks.count[robot]
        if row and stamps_ns[k] <= tracks.stamp_ns[robot, row - 1]:
            duplicates += 1
            continue
        tracks.stamp_ns[robot, row] = stamps_ns[k]
        tracks.raw[robot, row] = raw[k]
        if row == 0:  # a track begins where its driver says
            tracks.pose[robot, 0] = raw[k]
            tracks.noise[robot, 0] = 0.0
            tracks.begin_ns[robot], tracks.begin_pose[robot] = stamps_ns[k], raw[k]
        else:
            tracks.raw[robot, row, 2] = tracks.raw[robot, row - 1, 2] + wrap(
                raw[k, 2] - tracks.raw[robot, row - 1, 2]
            )
            jumps += _integrate_step(tracks, robot, row)
        tracks.count[robot] = row + 1
    return duplicates, jumps


@compiled
def _integrate_step(tracks: TrackArrays, robot: int, row: int) -> int:
    """Fill pose and noise of a row from the row before; return 1 when no robot can have driven the step."""
    model = tracks.model[robot]
    before, after = tracks.raw[robot, row - 1], tracks.raw[robot, row]
    duration_s = (tracks.stamp_ns[robot, row] - tracks.stamp_ns[robot, row - 1]) * 1e-9
    turn = after[2] - before[2]
    middle = before[2] + 0.5 * turn
    dx, dy = after[0] - before[0], after[1] - before[1]
    distance = math.cos(middle) * dx + math.sin(middle) * dy
    lateral = -math.sin(middle) * dx + math.cos(middle) * dy
    # half a robot's width of slack: stamps jitter
    jump = math.hypot(dx, dy) > model.max_speed * duration_s + 0.5 * model.wheel_separation
    unknown = jump or duration_s > model.timeout_s
    distance = model.distance_scale * distance - model.distance_per_turn * abs(turn)
    turn = model.turn_scale * turn
    if unknown:
        distance, lateral, turn = 0.0, 0.0, 0.0
    start = tracks.pose[robot, row - 1]
    middle = start[2] + 0.5 * turn
    cos, sin = math.cos(middle), math.sin(middle)
    step_x, step_y = cos * distance - sin * lateral, sin * distance + cos * lateral
    tracks.pose[robot, row, 0] = start[0] + step_x
    tracks.pose[robot, row, 1] = start[1] + step_y
    tracks.pose[robot, row, 2] = start[2] + turn
    noise = tracks.noise[robot, row]
    noise[:] = tracks.noise[robot, row - 1]
    middle_x, middle_y = start[0] + 0.5 * step_x, start[1] + 0.5 * step_y
    if unknown:
        _add_unknown_motion(model, duration_s, middle_x, middle_y, middle, noise)
    else:
        _add_step_noise(model, distance, turn, duration_s, middle_x, middle_y, middle, noise)
    return int(jump)


@compiled
def _add_step_noise(
    model: np.void,
    distance: float,
    turn: float,
    duration_s: float,
    x: float,
    y: float,
    theta: float,
    noise: FloatArray,
) -> None:
    """Add a step's noise in the track's frame.

    Wheels: covar(ds_r, ds_l) = diag(k |ds_r|, k |ds_l|) (Siegwart and Nourbakhsh), the U Q U^T of the e-puck
    paper's eq. (9), whose Q is not printed.
    """
    separation, wheel = model.wheel_separation, model.wheel_noise
    right, left = abs(distance + 0.5 * separation * turn), abs(distance - 0.5 * separation * turn)
    along = 0.25 * wheel * (right + left) + model.distance_noise * abs(distance)
    heading = wheel * (right + left) / separation**2 + model.turn_noise * abs(turn)
    if right + left > 0.0:
        along += model.distance_drift * duration_s
        heading += model.turn_drift * duration_s
    cross = 0.5 * wheel * (right - left) / separation
    _add_in_track_frame(x, y, theta, along, 0.0, heading, cross, noise)


@compiled
def _add_run_on(model: np.void, silence: float, x: float, y: float, theta: float, noise: FloatArray) -> None:
    """Add the noise of a speed and a turn rate that walk at random while no message tells them."""
    grown = silence**3 / 3.0
    along, heading = model.speed_change**2 * grown, model.turn_rate_change**2 * grown
    _add_in_track_frame(x, y, theta, along, 0.0, heading, 0.0, noise)


@compiled
def _add_unknown_motion(
    model: np.void, duration_s: float, x: float, y: float, theta: float, noise: FloatArray
) -> None:
    """Add the noise of a robot that may have driven anywhere its speed allows."""
    reach = (model.max_speed * duration_s) ** 2 / 3.0
    turned = min(model.max_turn_rate * duration_s, math.pi) ** 2 / 3.0  # pi: any heading
    _add_in_track_frame(x, y, theta, reach, reach, turned, 0.0, noise)


@compiled
def _add_in_track_frame(
    x: float,
    y: float,
    theta: float,
    along: float,
    across: float,
    heading: float,
    cross: float,
    noise: FloatArray,
) -> None:
    """Add Ad(pose) Q Ad(pose)^T for body variances along, across, heading and cov(along, heading)."""
    cos, sin = math.cos(theta), math.sin(theta)
    forward, left, turning = (cos, sin, 0.0), (-sin, cos, 0.0), (y, -x, 1.0)
    for i in range(3):
        for j in range(3):
            noise[i, j] += along * forward[i] * forward[j] + across * left[i] * left[j]
            noise[i, j] += heading * turning[i] * turning[j]
            noise[i, j] += cross * (forward[i] * turning[j] + turning[i] * forward[j])
