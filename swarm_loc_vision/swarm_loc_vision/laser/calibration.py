"""From the row of the laser's spot to a distance: a hyperbola, fitted to a drive at a wall.

The laser is parallel to the camera's axis, a base b below it, so the spot of something at depth d lies at the
row p = p_inf + f b / d. (The PushBot paper uses a logarithm, figure 2, which is tens of centimetres off
over 10 to 250 cm.) An error sigma_px of the row makes an error d^2 sigma_px / (f b) of the distance.

`WallDrive` collects the samples of the drive, live or from a bag. The hyperbola is fitted first, then the
bias of tracked rows within pixels. The centre of all events of a spot that is hardly larger than a pixel is
pulled towards the middles of pixels (pixel locking). The spot runs along one line of the image as the
distance changes, so this error is a function of the row: a robot that turns in front of a wall makes the same
error in many readings, and averaging over a scan does not remove it as it removes noise.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from swarm_loc_estimator import decode_laser
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.common.codec import WHOLE_FILE, EntrySpec, Tree, TreeChecks, entry, entry_specs
from swarm_loc_estimator.common.files import write_whole
from swarm_loc_estimator.common.messages.cdr import LASER, ODOMETRY, CdrError
from swarm_loc_estimator.common.messages.poses import decode_odometry
from swarm_loc_estimator.common.parameters import NumberSpec, UserError, number, number_specs
from swarm_loc_estimator.common.yaml_tree import read_tree

_MAX_SAMPLES = 100_000
_MAX_OFF_COURSE = 0.1  # A robot that turns by more does not drive straight at a wall [rad]


@dataclass
class WallDrive:
    """Collects rows of the laser's spot with the path driven since the start."""

    start_distance: float  # From base_link to the wall at the start [m]
    stop_distance: float  # From base_link to the wall at the end [m]
    driven: float = 0.0  # Path so far [m]
    _begin: tuple[float, float, float] | None = None
    _odometry: deque[tuple[int, float]] = field(default_factory=lambda: deque(maxlen=1000))
    _waiting: deque[tuple[int, float]] = field(default_factory=lambda: deque(maxlen=1000))
    _samples: list[tuple[float, float]] = field(default_factory=list)

    @property
    def is_done(self) -> bool:
        """Whether the robot has reached `stop_distance`."""
        return self.driven >= self.start_distance - self.stop_distance

    @property
    def count(self) -> int:
        """Samples so far."""
        return len(self._samples)

    def take_odometry(self, stamp_ns: int, x: float, y: float, theta: float) -> None:
        """Add an odometry pose [m, rad].

        Raises:
            CalibrationError: The robot has turned.
        """
        begin = self._begin = self._begin or (x, y, theta)
        turned = abs(np.remainder(theta - begin[2] + np.pi, 2.0 * np.pi) - np.pi)
        if turned > _MAX_OFF_COURSE:
            raise CalibrationError(f"the robot has turned by {turned:.2g} rad on its way to the wall.")
        self.driven = (x - begin[0]) * np.cos(begin[2]) + (y - begin[1]) * np.sin(begin[2])
        self._odometry.append((stamp_ns, self.driven))
        while self._waiting and self._waiting[0][0] <= stamp_ns:
            at_ns, row = self._waiting.popleft()
            stamps, driven = np.array(self._odometry, dtype=float).T
            if at_ns >= stamps[0] and len(self._samples) < _MAX_SAMPLES:
                self._samples.append((float(np.interp(at_ns, stamps, driven)), row))

    def take_row(self, stamp_ns: int, row: float) -> None:
        """Add a row of the spot [px]; it is used once there is odometry before and after it."""
        if np.isfinite(row):
            self._waiting.append((stamp_ns, row))

    def drive(self, start_sigma: float, camera_x: float) -> Drive:
        """The samples, for the fit."""
        driven, rows = np.array(self._samples, dtype=float).reshape(-1, 2).T
        return Drive(self.start_distance, start_sigma, driven, rows, camera_x)


def recorded_drive(bag: Path, robot: str, drive: WallDrive) -> WallDrive:
    """Fill an empty drive from a bag until it is done; returns the drive.

    The bag has `<robot>/odom` and `<robot>/laser`, or those topics without a namespace where the name is "";
    `start_distance` is that at the first odometry.

    Raises:
        CalibrationError: A topic has no usable message, or the robot turns on its way.
        UserError: The bag cannot be read.
    """
    from swarm_loc_estimator.common.bags.reader import BagReader  # noqa: PLC0415 - a live drive reads no bag

    prefix = f"{robot}/" if robot else ""
    types = {f"{prefix}odom": ODOMETRY, f"{prefix}laser": LASER}
    seen = dict.fromkeys(types, 0)
    with BagReader(bag) as reader:
        for topic, message_type, _, data in reader.messages(types):
            if message_type != types[topic] or drive.is_done:
                continue
            seen[topic] += _take(drive, data, is_laser=message_type == LASER)
    for topic, count in seen.items():
        if not count:
            raise CalibrationError(f"'{bag}' has nothing usable on {topic}.")
    return drive


def _take(drive: WallDrive, data: bytes, *, is_laser: bool) -> bool:
    """Add a message to the drive; whether it could be used."""
    try:
        if is_laser:
            seen = decode_laser(data)
            drive.take_row(seen.stamp_ns, seen.row)
            return math.isfinite(seen.row)
        odometry = decode_odometry(data)
    except CdrError:
        return False
    if not all(map(math.isfinite, odometry.pose)):
        return False
    drive.take_odometry(odometry.stamp_ns, *odometry.pose)
    return True


MIN_SAMPLES = 50
_MIN_SPREAD = 2.0  # Least ratio of the largest to the smallest depth; below, f b and p_inf look alike
_MAX_RESIDUAL_PX = 1.0
_START_PX = 0.1
# The prior of the bias: checked by test_laser.py; figures: calibrate_laser.md.
_BEND_PX = 0.05  # Prior standard deviation of a knot off the line between its neighbours [px]
_SIZE_PX = 0.3  # Prior standard deviation of a knot [px]
_LEAST_SAMPLES = 4
"""Least number of samples between two knots. Near the wall rows change fast, samples are few and matter
least."""
_EDGE_SIGMAS = 2.0  # Rows so close to that of the farthest reading are left out: only low noise lies there
_OUTLIER_SIGMAS = 10.0
_ITERATIONS = 5
_CAUCHY_SIGMAS = 2.4


class CalibrationError(UserError):
    """A drive that does not determine a calibration; the message is one sentence."""


@dataclass(frozen=True)
class Drive:
    """A drive straight at a wall."""

    start_distance: float  # From base_link to the wall at the start, measured by hand [m]
    start_sigma: float  # Its standard deviation [m]
    driven: FloatArray  # (N,) path since the start, by odometry [m]
    rows: FloatArray  # (N,) rows of the laser's spot at the same instants [px]
    camera_x: float  # Position of the camera ahead of base_link [m]

    @property
    def depths(self) -> FloatArray:
        """(N,) from the camera to the wall [m]."""
        return np.asarray(self.start_distance - self.camera_x - self.driven)


def fit_hyperbola(drive: Drive) -> LaserCalibration:
    """The most likely calibration, with a Cauchy loss against outliers.

    The start distance is estimated as well, with its measured value as prior: close to the wall, millimetres
    are pixels. The residuals as a function of the row then give the bias of the tracker within pixels.

    Raises:
        CalibrationError: Too few samples, too short a drive, or rows that do not follow a hyperbola.
    """
    depths = drive.depths
    # the drive must be long enough
    if len(depths) < MIN_SAMPLES:
        raise CalibrationError(
            f"the laser was seen {len(depths)} times on the way to the wall, {MIN_SAMPLES} are needed."
        )
    nearest, farthest = float(depths.min()), float(depths.max())
    if nearest <= 0.0:
        raise CalibrationError(
            f"the robot drove {-nearest:.2g} m farther than to the wall: start_distance is too small."
        )
    if farthest < _MIN_SPREAD * nearest:
        raise CalibrationError(
            f"the way from {farthest:.2g} to {nearest:.2g} m is too short: it must halve the distance."
        )
    # the hyperbola and the start, with a loss whose scale depends on the noise, which depends on the fit
    weight = _START_PX / max(drive.start_sigma, 1e-6)

    def residuals(parameters: FloatArray) -> FloatArray:
        row_at_infinity, focal_base, shift = parameters
        wrong = drive.rows - row_at_infinity - focal_base / np.maximum(depths + shift, 1e-3)
        return np.append(wrong, shift * weight)

    design = np.column_stack([np.ones_like(depths), 1.0 / depths])
    begin = np.append(np.linalg.lstsq(design, drive.rows, rcond=None)[0], 0.0)
    scale = _START_PX
    for _ in range(3):
        found = least_squares(residuals, begin, loss="cauchy", f_scale=scale, x_scale=[1.0, 1.0, 0.01])
        begin = found.x
        scale = _scale_of(residuals(begin)[:-1])
    row_at_infinity, focal_base, shift = (float(value) for value in begin)
    if scale > _MAX_RESIDUAL_PX or focal_base <= 0.0:
        raise CalibrationError(
            f"the spot's rows follow no hyperbola: {scale:.2g} px off with f b = {focal_base:.3g} px m."
        )
    # what is left is the bias of the tracker, and noise
    wrong = residuals(begin)[:-1]
    bias = fit_row_bias(drive.rows, wrong, scale)
    noise = _scale_of(wrong - bias.at_each(drive.rows))
    near, far = 0.95 * (nearest + shift), 1.05 * (farthest + shift)
    return LaserCalibration(row_at_infinity, focal_base, noise, drive.camera_x, near, far, bias)


def _scale_of(residuals: FloatArray) -> float:
    """Robust standard deviation of residuals [px], from their median magnitude."""
    return max(1.4826 * float(np.median(np.abs(residuals))), 1e-3)


def fit_row_bias(rows: FloatArray, residuals: FloatArray, sigma: float) -> RowBias:
    """Fit the bias to residuals; empty unless a fit to either half lowers the residuals of the other half.

    Residuals (N,) are tracked rows (N,) minus those of the hyperbola, and sigma is the scale of their Cauchy
    loss [px].
    """
    edge = float((rows - residuals).min()) + _EDGE_SIGMAS * sigma
    usual = (np.abs(residuals) < _OUTLIER_SIGMAS * sigma) & (rows >= edge)
    rows, residuals = rows[usual], residuals[usual]
    # knots from the edge up to where samples are too few
    counts = np.bincount(((rows - edge) / STEP_PX).astype(np.int64))
    sparse = np.flatnonzero(counts < _LEAST_SAMPLES)
    cells = int(sparse[0]) if len(sparse) else len(counts)
    knots = np.asarray(edge + STEP_PX * np.arange(cells + 1), np.float64)
    if len(knots) < 2:
        return RowBias()
    # a fit to each half must serve the other half
    is_even = np.arange(len(rows)) % 2 == 0
    gained = 0.0
    for chosen in (is_even, ~is_even):
        half = _fit(knots, rows, residuals, chosen, sigma)
        others = residuals[~chosen]
        gained += _loss(others, sigma) - _loss(others - half.at_each(rows[~chosen]), sigma)
    return _fit(knots, rows, residuals, np.ones(len(rows), dtype=bool), sigma) if gained > 0.0 else RowBias()


def _fit(
    knots: FloatArray, rows: FloatArray, residuals: FloatArray, chosen: BoolArray, sigma: float
) -> RowBias:
    """The most likely offsets of the knots, given their prior and the chosen residuals."""
    inside = chosen & (rows < knots[-1])
    place: FloatArray = (rows[inside] - knots[0]) / STEP_PX
    below = np.minimum(place.astype(np.int64), len(knots) - 2)
    design = np.zeros((len(place), len(knots)))
    index = np.arange(len(place))
    design[index, below], design[index, below + 1] = 1.0 - (place - below), place - below
    bends = np.diff(np.eye(len(knots)), 2, axis=0) / _BEND_PX
    prior = bends.T @ bends + np.eye(len(knots)) / _SIZE_PX**2
    offsets = np.zeros(len(knots))
    for _ in range(_ITERATIONS):
        off = (residuals[inside] - design @ offsets) / (_CAUCHY_SIGMAS * sigma)
        weighted = design / (sigma**2 * (1.0 + off * off))[:, None]
        offsets = np.linalg.solve(prior + weighted.T @ design, weighted.T @ residuals[inside])
    return RowBias(float(knots[0]), STEP_PX, tuple(offsets.tolist()))


def _loss(residuals: FloatArray, sigma: float) -> float:
    return float(np.log1p((residuals / (_CAUCHY_SIGMAS * sigma)) ** 2).sum())


STEP_PX = 0.2  # Distance of two knots: the bias has a period of one pixel, with harmonics


_OFFSET = NumberSpec("px", -10.0, 10.0, False, "tracked row minus true row at each knot")
_MAX_KNOTS = 10_000


def _read_offsets(checks: TreeChecks, tree: Tree, key: str) -> tuple[float, ...]:
    offsets = checks.items(tree, key)
    if len(offsets) > _MAX_KNOTS:
        raise checks.said(f"{key} has {len(offsets)} numbers but must have at most {_MAX_KNOTS}")
    return tuple(checks.number(offset, f"{key}[{k}]", _OFFSET) or 0.0 for k, offset in enumerate(offsets))


@dataclass(frozen=True)
class RowBias:
    """Tracked row minus true row, linear between knots."""

    first_row: float = number(0.0, "px", -1000.0, 10_000.0, "row of the first knot")
    step: float = number(STEP_PX, "px", 0.0, 10.0, "from knot to knot", above=True)
    # (K,) bias at each knot [px]; empty: unknown
    offsets: tuple[float, ...] = field(default=(), metadata=entry(EntrySpec(_read_offsets, {})))

    def reaches(self, row: float) -> bool:
        """Whether a tracked row [px] lies between knots."""
        return 0.0 <= (row - self.first_row) / self.step < len(self.offsets) - 1

    def at(self, row: float) -> float:
        """The bias at a tracked row [px]; zero beyond the knots."""
        if not self.reaches(row):
            return 0.0
        share, k = math.modf((row - self.first_row) / self.step)
        return (1.0 - share) * self.offsets[int(k)] + share * self.offsets[int(k) + 1]

    def at_each(self, rows: FloatArray) -> FloatArray:
        """The bias (N,) at tracked rows (N,) [px]."""
        return np.array([self.at(row) for row in rows.tolist()])


class Distance(NamedTuple):
    """A distance and its standard deviation [m]; NaN where there is none."""

    distance: float
    sigma: float


UNKNOWN = Distance(math.nan, math.nan)


def _read_bias(checks: TreeChecks, tree: Tree, key: str) -> RowBias:
    specs = entry_specs(RowBias)
    return RowBias() if tree is None else RowBias(**checks.values(tree, key, specs, specs))


@dataclass(frozen=True)
class LaserCalibration:
    """Geometry of one robot's laser and camera; `row_bias` is subtracted from tracked rows."""

    row_at_infinity: float = number(64.0, "px", -1000.0, 10_000.0, "p_inf, row of the spot at infinity")
    focal_base: float = number(6.3, "px m", 0.01, 10_000.0, "f b, focal length times base")
    row_sigma: float = number(0.1, "px", 0.001, 10.0, "standard deviation of the spot's row")
    camera_x: float = number(0.04, "m", -1.0, 1.0, "position of the camera ahead of base_link")
    min_depth: float = number(0.1, "m", 0.001, 100.0, "smallest depth, from the camera, that was calibrated")
    max_depth: float = number(2.5, "m", 0.01, 100.0, "largest depth")
    row_bias: RowBias = field(default=RowBias(), metadata=entry(EntrySpec(_read_bias, {})))

    def row(self, depth: float) -> float:
        """Row [px] of the spot on an object at a depth from the camera [m]."""
        return self.row_at_infinity + self.focal_base / depth

    def distance(self, row: float, row_variance: float, locking: float = 0.0) -> Distance:
        """Distance from base_link to what the laser hits, by the row of its spot; NaN outside the depths.

        The variance of the row is that by the tracker, at least that of the calibration [px^2]; its part
        `locking`, the bias within pixels, is left out where `row_bias` is known.
        """
        offset = row - self.row_bias.at(row) - self.row_at_infinity
        if not self.focal_base / self.max_depth <= offset <= self.focal_base / self.min_depth:
            return UNKNOWN
        depth = self.focal_base / offset
        noise = row_variance - locking if self.row_bias.reaches(row) else row_variance
        sigma_px = math.sqrt(max(noise, self.row_sigma**2))
        return Distance(self.camera_x + depth, depth**2 * sigma_px / self.focal_base)


_HEAD = (
    "# Laser and event camera of one robot: the spot of what is at depth d lies at the row p_inf + f b / d.\n"
)
_BIAS = "row_bias"


class LaserFileError(UserError):
    """A file that is no laser calibration; the message is one sentence."""


def save_laser(path: Path, calibration: LaserCalibration) -> None:
    """Write a calibration.

    Raises:
        FileError: It cannot be written there.
    """
    lines = _lines(calibration)
    bias = calibration.row_bias
    if bias.offsets:
        offsets = ", ".join(f"{offset:.4f}" for offset in bias.offsets)
        within = [*_lines(bias), f"offsets: [{offsets}]  # {_OFFSET.doc} [px]"]
        lines += [f"{_BIAS}:", *(f"  {line}" for line in within)]
    write_whole(path, _HEAD + "\n".join(lines) + "\n")


def _lines(numbers: LaserCalibration | RowBias) -> list[str]:
    return [
        f"{name}: {getattr(numbers, name):.9g}  # {spec.doc} [{spec.unit}]"
        for name, spec in number_specs(type(numbers)).items()
    ]


def load_laser(path: Path) -> LaserCalibration:
    """Read a calibration.

    Raises:
        LaserFileError: There is none, or a number is missing, unknown or out of its range.
    """
    checks, specs = TreeChecks(path, LaserFileError), entry_specs(LaserCalibration)
    tree = read_tree(path, LaserFileError)
    calibration = LaserCalibration(**checks.values(tree, WHOLE_FILE, specs, number_specs(LaserCalibration)))
    if calibration.min_depth >= calibration.max_depth:
        raise checks.error(
            "min_depth", calibration.min_depth, f"must be below max_depth = {calibration.max_depth}"
        )
    return calibration
