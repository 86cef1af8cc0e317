"""Validate inputs: finite values, past stamps, valid covariances.

Nothing is kept here but counters; what passes is converted to measurements where that needs nothing else.
"""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.small_matrix import cholesky3
from swarm_loc_estimator.filter.gating import gate_threshold
from swarm_loc_estimator.filter.measurement_model import (
    MEASUREMENT_DTYPE,
    NOBODY,
    Kind,
    MeasurementArray,
)
from swarm_loc_estimator.sensors.camera import SightingConverter
from swarm_loc_estimator.sensors.messages import (
    NO_MEASUREMENTS,
    AerialRows,
    BrightnessRows,
    DetectionRows,
    FixRows,
    OdometryRows,
    RawInputs,
    ValidInputs,
    chosen,
)
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.settings import Settings

VALID = 0
REJECT_REASONS = ("", "non_finite", "absurd", "bad_covariance")
"""What may be wrong with a measurement, by the numbers that `reject_reasons` gives."""

_MAX_DISTANCE_M = 1e6
_MIN_VARIANCE, _MAX_VARIANCE = 1e-14, 1e14
_ASYMMETRY, _ROUNDING = 1e-6, 1e-9
_FIX_GATE = float(gate_threshold(0.9999))
_UNKNOWN_VARIANCE = -1.0
"""What the sender of an anonymous detection writes first into a covariance that it does not know."""

Measured = tuple[MeasurementArray, IntArray]
"""Measurements (m,) and when they arrived (m,)."""


class InputValidator:
    """Looks messages through.

    Args:
        swarm: Whom they are about.
        settings: Say by how much a stamp may be ahead of the arrival.

    Attributes:
        drops: Reason -> how much could not be used.
    """

    def __init__(self, swarm: Swarm, settings: Settings) -> None:
        self.drops: Counter[str] = Counter()
        self._converter = SightingConverter(swarm)
        self._stands = np.array([robot.stands for robot in swarm.robots], dtype=bool)
        self._future_ns = round(settings.future_tolerance_s * 1e9)
        sigma, heading_sigma = settings.aerial_position_sigma, settings.aerial_heading_sigma
        self._aerial_noise = np.diag(np.square([sigma, sigma, heading_sigma]))

    def validate(self, messages: RawInputs) -> ValidInputs:
        """Turn messages into what can be used of them, and count the rest."""
        self.drops.update(messages.dropped)
        parts = self._seen(messages.detections), self._fixed(messages.fixes), self._shown(messages.aerial)
        return ValidInputs(
            self._valid_odometry(messages.odometry),
            self._in_time(messages.brightness),
            *_in_order_of_arrival(_in_order_of_arrival(parts[0], parts[1]), parts[2]),
        )

    def valid(self, measurements: MeasurementArray) -> NDArray[np.bool_]:
        """Mark the measurements (m,) that can be used, count the others."""
        reasons = reject_reasons(measurements)
        counts = np.bincount(reasons, minlength=len(REJECT_REASONS)).tolist()
        self.drops.update({REJECT_REASONS[k]: counts[k] for k in range(1, len(REJECT_REASONS)) if counts[k]})
        valid: NDArray[np.bool_] = reasons == VALID
        return valid

    def _all_but(self, reason: str, bad: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Count the bad ones (k,) and mark the others."""
        count = int(np.count_nonzero(bad))
        if count:
            self.drops[reason] += count
        return ~bad

    def _are_in_time(self, stamps_ns: IntArray, arrivals_ns: IntArray) -> NDArray[np.bool_]:
        """Whether stamps (k,) are not ahead of the clock at their arrivals (k,)."""
        return self._all_but("future_stamp", stamps_ns > arrivals_ns + self._future_ns)

    def _valid_odometry(self, rows: OdometryRows) -> OdometryRows:
        """The rows with stamps and numbers to reckon with."""
        if not rows.robot.size:
            return rows
        finite = np.isfinite(rows.pose).all(axis=1)
        near = np.abs(rows.pose).max(axis=1) <= _MAX_DISTANCE_M
        good = self._are_in_time(rows.stamp_ns, rows.arrival_ns)
        good &= self._all_but("no_odometry", good & self._stands[rows.robot])
        good &= self._all_but("odometry_non_finite", good & ~finite)
        good &= self._all_but("odometry_absurd", good & ~near)
        return rows if good.all() else chosen(rows, good)

    def _in_time(self, rows: BrightnessRows) -> BrightnessRows:
        """The matrices whose stamps are not ahead."""
        return chosen(rows, self._are_in_time(rows.stamp_ns, rows.arrival_ns)) if rows.robot.size else rows

    def _seen(self, rows: DetectionRows) -> Measured:
        """What the valid ones of the detections measure."""
        if not rows.robot.size:
            return NO_MEASUREMENTS, rows.arrival_ns
        in_time = self._are_in_time(rows.stamp_ns, rows.arrival_ns)
        rows = rows if in_time.all() else chosen(rows, in_time)
        conversion = self._converter.convert(rows.robot, rows.stamp_ns, rows.detection)
        self.drops.update(conversion.dropped)
        valid = self.valid(conversion.measurements)
        return conversion.measurements[valid], rows.arrival_ns[conversion.measured][valid]

    def _fixed(self, rows: FixRows) -> Measured:
        """What the valid ones of the fixes measure."""
        if not rows.robot.size:
            return NO_MEASUREMENTS, rows.arrival_ns
        rows = chosen(rows, self._are_in_time(rows.stamp_ns, rows.arrival_ns))
        fixes = about_robots(rows.robot, rows.stamp_ns, rows.pose, rows.covariance, Kind.CARTESIAN)
        _take_out_headings(fixes, np.isnan(rows.pose[:, 2]))
        valid = self.valid(fixes)
        return fixes[valid], rows.arrival_ns[valid]

    def _shown(self, rows: AerialRows) -> Measured:
        """What the valid ones of the anonymous detections measure."""
        if not rows.robot.size:
            return NO_MEASUREMENTS, rows.arrival_ns
        rows = chosen(rows, self._are_in_time(rows.stamp_ns, rows.arrival_ns))
        shown = about_robots(NOBODY, rows.stamp_ns, rows.pose, rows.covariance, Kind.ANONYMOUS)
        shown["marker_id"] = rows.number
        shown["covariance"][rows.covariance[:, 0, 0] == _UNKNOWN_VARIANCE] = self._aerial_noise
        _take_out_headings(shown, np.isnan(rows.pose[:, 2]))
        valid = self.valid(shown)
        return shown[valid], rows.arrival_ns[valid]


def _take_out_headings(measurements: MeasurementArray, without: NDArray[np.bool_]) -> None:
    """Take the headings out of those measurements (m,) that have none."""
    measurements["has_heading"][without], measurements["value"][without, 2] = 0, 0.0
    covariance = measurements["covariance"]
    covariance[without, 2, :] = covariance[without, :, 2] = [0.0, 0.0, 1.0]


def about_robots(
    robots: IntArray | int,
    stamps_ns: IntArray | int,
    poses: FloatArray,
    covariances: FloatArray,
    kind: int,
) -> MeasurementArray:
    """Measurements (m,) without observer of poses (m, 3) in `map` with covariances (m, 3, 3)."""
    measurements = np.zeros(len(poses), dtype=MEASUREMENT_DTYPE)
    measurements["stamp_ns"], measurements["kind"] = stamps_ns, kind
    measurements["received_from"] = measurements["target"] = robots
    measurements["observer"] = NOBODY
    measurements["value"], measurements["covariance"] = poses, covariances
    measurements["has_heading"], measurements["gate"] = 1, _FIX_GATE
    return measurements


def reject_reasons(measurements: MeasurementArray) -> IntArray:
    """Why measurements (m,) are rejected, as places in `REJECT_REASONS`; `VALID` where they are not."""
    value = measurements["value"]
    reasons = np.full(measurements.size, VALID)
    _check_covariances(measurements["covariance"], reasons)
    reasons[np.abs(value).max(axis=1) > _MAX_DISTANCE_M] = REJECT_REASONS.index("absurd")
    reasons[~np.isfinite(value).all(axis=1)] = REJECT_REASONS.index("non_finite")
    return reasons


_BAD_COVARIANCE = REJECT_REASONS.index("bad_covariance")


@cached_njit
def _check_covariances(matrices: FloatArray, reasons: IntArray) -> None:
    """Write where a matrix is not symmetric, positive definite, and of a magnitude to reckon with."""
    scaled = np.empty((3, 3))
    for k in range(reasons.size):
        good = True
        for i in range(3):
            good = good and _MIN_VARIANCE <= matrices[k, i, i] <= _MAX_VARIANCE
        if good:
            for i in range(3):
                for j in range(3):
                    scaled[i, j] = matrices[k, i, j] / math.sqrt(matrices[k, i, i] * matrices[k, j, j])
            for i in range(3):
                for j in range(3):
                    good = good and abs(scaled[i, j] - scaled[j, i]) < _ASYMMETRY
                scaled[i, i] -= _ROUNDING
            factor = cholesky3(scaled)  # not a number where it has none
            good = good and math.isfinite(factor[0, 0] + factor[1, 1] + factor[2, 2])
        if not good:
            reasons[k] = _BAD_COVARIANCE


def _in_order_of_arrival(one: Measured, other: Measured) -> Measured:
    """Both together; of those that arrived at the same instant, the first ones come first."""
    if not one[0].size or not other[0].size:
        return one if one[0].size else other
    measurements, arrivals_ns = np.concatenate([one[0], other[0]]), np.concatenate([one[1], other[1]])
    order = np.argsort(arrivals_ns, kind="stable")
    return measurements[order], arrivals_ns[order]
