"""Errors of estimated poses against ground truth, and whether the covariances admit them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from swarm_loc_estimator.core import se2

if TYPE_CHECKING:
    from collections.abc import Sequence

FloatArray = npt.NDArray[np.float64]
StampArray = npt.NDArray[np.int64]

DEFAULT_GAP_NS = 500_000_000
"""Ground truth is not interpolated over longer gaps than this."""


class MetricsError(ValueError):
    """Arrays that do not belong together; the message is one sentence."""


@dataclass(frozen=True)
class Track:
    """Poses over time.

    Attributes:
        stamp_ns: (N,) not decreasing.
        pose: (N, 3) x [m], y [m], theta [rad] in map.

    Raises:
        MetricsError: The lengths differ, or time goes back.
    """

    stamp_ns: StampArray
    pose: FloatArray

    def __post_init__(self) -> None:
        if self.pose.shape != (len(self.stamp_ns), 3):
            raise MetricsError(f"{len(self.stamp_ns)} stamps do not fit poses of shape {self.pose.shape}.")
        if np.any(np.diff(self.stamp_ns) < 0):
            raise MetricsError("the stamps of a track go back in time.")


@dataclass(frozen=True)
class Errors:
    """Estimate minus truth of one robot, where both are known.

    Attributes:
        stamp_ns: (N,).
        error: (N, 3) x [m], y [m], heading [rad, wrapped] in map.
        sigma: (N, 3) one standard deviation of x, y, theta as estimated; NaN where unknown.
        nees: (N,) squared error normalised by the covariance, ideally 3 on average; infinite where the
            covariance is not positive definite, NaN where there is none.
    """

    stamp_ns: StampArray
    error: FloatArray
    sigma: FloatArray
    nees: FloatArray

    @property
    def position(self) -> FloatArray:
        """(N,) distance between estimate and truth [m]."""
        return np.asarray(np.hypot(self.error[:, 0], self.error[:, 1]))


@dataclass(frozen=True)
class ErrorSummary:
    """A row of an error table; NaN throughout when there was nothing to compare.

    Attributes:
        count: Number of compared poses.
        position_rmse: [m]; likewise mean, median, p95 (95 %) and max.
        heading_rmse: [rad]; likewise of the absolute heading error.
        nees: Mean normalised squared error, ideally 3.
    """

    count: int
    position_rmse: float
    position_mean: float
    position_median: float
    position_p95: float
    position_max: float
    heading_rmse: float
    heading_mean: float
    heading_median: float
    heading_p95: float
    heading_max: float
    nees: float


def interpolate(
    track: Track, query_ns: StampArray, max_gap_ns: int
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Poses of a track at other times, along the arc between the neighbours.

    Args:
        track: What is known.
        query_ns: (M,) when it is asked for.
        max_gap_ns: Longest distance of the two neighbours.

    Returns:
        (M, 3) poses, NaN where there is none, and (M,) whether there is one: a track is not continued beyond
        its ends nor across longer gaps; at its own stamps it is always known.
    """
    poses = np.full((len(query_ns), 3), np.nan)
    if len(track.stamp_ns) == 0:
        return poses, np.zeros(len(query_ns), np.bool_)
    after = np.searchsorted(track.stamp_ns, query_ns, side="left")
    inside = np.minimum(after, len(track.stamp_ns) - 1)
    exact = track.stamp_ns[inside] == query_ns
    before = np.maximum(after - 1, 0)
    gap_ns = track.stamp_ns[inside] - track.stamp_ns[before]
    between = (after > 0) & (after < len(track.stamp_ns)) & (gap_ns <= max_gap_ns) & ~exact
    poses[exact] = track.pose[inside[exact]]
    start, end = track.pose[before[between]], track.pose[inside[between]]
    share = (query_ns[between] - track.stamp_ns[before[between]]) / gap_ns[between]
    poses[between] = se2.compose(start, se2.exp(share[:, None] * se2.log(se2.between(start, end))))
    valid: npt.NDArray[np.bool_] = exact | between
    return poses, valid


def compare(
    estimate: Track, covariance: FloatArray | None, truth: Track, max_gap_ns: int = DEFAULT_GAP_NS
) -> Errors:
    """Errors at every time where estimate and truth are known.

    Dense truth is interpolated at the estimate's stamps. A truth that stands alone, further than the gap from
    its neighbours, would never meet an estimate's stamp; there the estimate is interpolated instead.

    Args:
        estimate: Poses from the estimator; rows that are not finite are not compared.
        covariance: (N, 3, 3) of x, y, theta in map, one per estimate; None when unknown.
        truth: Ground truth.
        max_gap_ns: Longest distance between neighbours to interpolate across.

    Raises:
        MetricsError: The covariances do not fit the estimate.
    """
    if covariance is not None and covariance.shape != (len(estimate.stamp_ns), 3, 3):
        raise MetricsError(
            f"covariances of shape {covariance.shape} do not fit {len(estimate.stamp_ns)} poses."
        )
    truth_there, known = interpolate(truth, estimate.stamp_ns, max_gap_ns)
    known &= np.isfinite(estimate.pose).all(axis=1)
    index = np.flatnonzero(known)
    stamp_ns, found, wanted = estimate.stamp_ns[index], estimate.pose[index], truth_there[index]
    alone = truth.stamp_ns[_alone(truth.stamp_ns, max_gap_ns)]
    alone = alone[~np.isin(alone, stamp_ns)]
    at_alone, reached = interpolate(estimate, alone, max_gap_ns)
    reached &= np.isfinite(at_alone).all(axis=1)
    nearest = _nearest(estimate.stamp_ns, alone[reached])
    lone_truth, _ = interpolate(truth, alone[reached], max_gap_ns)
    stamp_ns = np.concatenate([stamp_ns, alone[reached]])
    order = np.argsort(stamp_ns, kind="stable")
    error = np.concatenate([found - wanted, at_alone[reached] - lone_truth])[order]
    error[:, 2] = se2.wrap_angle(error[:, 2])
    used = np.concatenate([index, nearest])[order]
    matrices = np.full((len(used), 3, 3), np.nan) if covariance is None else covariance[used]
    sigma = np.sqrt(np.diagonal(matrices, axis1=1, axis2=2).clip(min=0.0))
    return Errors(stamp_ns[order], error, sigma, nees(error, matrices))


def nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Normalised squared errors.

    Args:
        error: (N, 3).
        covariance: (N, 3, 3).

    Returns:
        (N,) infinite where the covariance is not positive definite, NaN where it is unknown.
    """
    result = np.full(len(error), np.nan)
    known = np.isfinite(covariance).all(axis=(1, 2))
    values = np.full(len(error), -1.0)
    values[known] = np.linalg.eigvalsh(covariance[known])[:, 0]
    result[known] = np.inf
    good = values > 0.0
    solved = np.linalg.solve(covariance[good], error[good][:, :, None])[:, :, 0]
    result[good] = np.einsum("ni,ni->n", error[good], solved)
    return result


def summarise(errors: Errors) -> ErrorSummary:
    """One row of an error table."""
    position, heading = errors.position, np.abs(errors.error[:, 2])
    if len(position) == 0:
        return ErrorSummary(0, *[float("nan")] * 11)
    known = errors.nees[~np.isnan(errors.nees)]
    return ErrorSummary(
        len(position),
        *_figures(position),
        *_figures(heading),
        nees=float(known.mean()) if known.size else float("nan"),
    )


def pool(errors: Sequence[Errors]) -> Errors:
    """The errors of several robots as one, in the order given."""
    if not errors:
        return Errors(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    return Errors(
        np.concatenate([one.stamp_ns for one in errors]),
        np.concatenate([one.error for one in errors]),
        np.concatenate([one.sigma for one in errors]),
        np.concatenate([one.nees for one in errors]),
    )


def _figures(values: FloatArray) -> tuple[float, float, float, float, float]:
    """Root mean square, mean, median, 95 % and maximum of errors without sign."""
    rmse = float(np.sqrt(np.mean(values * values)))
    median, p95 = (float(figure) for figure in np.percentile(values, [50, 95]))
    return rmse, float(values.mean()), median, p95, float(values.max())


def _alone(stamp_ns: StampArray, max_gap_ns: int) -> npt.NDArray[np.bool_]:
    """(N,) whether a stamp is further than the gap from both neighbours."""
    far = np.diff(stamp_ns) > max_gap_ns
    ends = np.ones(1, np.bool_)
    lonely: npt.NDArray[np.bool_] = np.concatenate([ends, far]) & np.concatenate([far, ends])
    return lonely[: len(stamp_ns)]


def _nearest(stamp_ns: StampArray, query_ns: StampArray) -> npt.NDArray[np.intp]:
    """(M,) index of the closest stamp."""
    if len(query_ns) == 0:
        return np.empty(0, np.intp)
    after = np.searchsorted(stamp_ns, query_ns).clip(1, max(len(stamp_ns) - 1, 1))
    after = np.minimum(after, len(stamp_ns) - 1)
    before = np.maximum(after - 1, 0)
    closer = np.abs(stamp_ns[before] - query_ns) <= np.abs(stamp_ns[after] - query_ns)
    nearest: npt.NDArray[np.intp] = np.where(closer, before, after)
    return nearest
