"""Error metrics against ground truth: RMSE of position and heading, NEES for consistency."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.trajectory import DEFAULT_GAP_NS, Trajectory, interpolate

MISLEADING_SIGMAS, MISLEADING_M = 5.0, 0.02  # A position is misleading beyond both [sigma], [m]


class MetricsError(ValueError):
    """Arrays whose sizes do not match."""


@dataclass(frozen=True)
class Errors:
    """Estimate minus truth of one robot, where both are known."""

    stamp_ns: IntArray  #: (N,)
    #: (N, 3) x [m], y [m], heading [rad, wrapped] in map; NaN for an unknown heading
    error: FloatArray
    sigma: FloatArray  #: (N, 3) one standard deviation of x, y, theta as estimated; NaN where unknown
    #: (N,) squared error normalised by the covariance, ideally 3 on average; infinite where the covariance is
    #: not positive definite, NaN where there is none
    nees: FloatArray
    misleading: BoolArray  #: (N,) whether the position is wrong beyond its covariance, see `is_misleading`

    @property
    def position(self) -> FloatArray:
        """(N,) distance between estimate and truth [m]."""
        return np.asarray(np.hypot(self.error[:, 0], self.error[:, 1]))


@dataclass(frozen=True)
class ErrorSummary:
    """Statistics of errors; NaN without poses to compare."""

    count: int  #: Number of compared poses
    position_rmse: float  #: [m]; mean, median, p95 (95 %) and max follow
    position_mean: float
    position_median: float
    position_p95: float
    position_max: float
    heading_rmse: float  #: [rad], of the absolute error of known headings; mean, median, p95 and max follow
    heading_mean: float
    heading_median: float
    heading_p95: float
    heading_max: float
    nees: float  #: Mean normalised squared error, ideally 3


def compare(
    estimate: Trajectory, covariance: FloatArray | None, truth: Trajectory, max_gap_ns: int = DEFAULT_GAP_NS
) -> Errors:
    """Errors wherever estimate and truth are known.

    Dense truth is interpolated at the estimate's stamps. At an isolated true pose, further than `max_gap_ns`
    from its neighbours, the estimate is interpolated at the stamp of the truth instead.

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
    # truth that is farther than the gap from both neighbours
    far = np.diff(truth.stamp_ns) > max_gap_ns
    is_alone = np.concatenate([[True], far]) & np.concatenate([far, [True]])
    alone = truth.stamp_ns[is_alone[: len(truth.stamp_ns)]]
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
    return Errors(stamp_ns[order], error, sigma, nees(error, matrices), is_misleading(error, matrices))


def is_misleading(error: FloatArray, covariance: FloatArray) -> BoolArray:
    """Whether errors (N, 3) of positions exceed 5 sigma and 2 cm; False where the covariance is unknown."""
    far = np.hypot(error[:, 0], error[:, 1]) > MISLEADING_M
    wrong: BoolArray = far & (nees(error[:, :2], covariance[:, :2, :2]) > MISLEADING_SIGMAS**2)
    return wrong


def nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Normalised squared errors (N,) of errors (N, d) with covariances (N, d, d).

    They are infinite where the covariance is not positive definite, NaN where it is unknown.
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
    """Statistics of the errors of one robot, or of several pooled ones."""
    position, heading = errors.position, np.abs(errors.error[np.isfinite(errors.error[:, 2]), 2])
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
        empty = np.empty((0, 3))
        return Errors(np.empty(0, np.int64), empty, empty, np.empty(0), np.empty(0, np.bool_))
    return Errors(*(np.concatenate([getattr(one, each.name) for one in errors]) for each in fields(Errors)))


def _figures(values: FloatArray) -> tuple[float, float, float, float, float]:
    """Root mean square, mean, median, 95th percentile and maximum of absolute errors; NaN without any."""
    if not values.size:
        return (float("nan"),) * 5
    rmse = float(np.sqrt(np.mean(values * values)))
    median, p95 = (float(figure) for figure in np.percentile(values, [50, 95]))
    return rmse, float(values.mean()), median, p95, float(values.max())


def _nearest(stamp_ns: IntArray, query_ns: IntArray) -> npt.NDArray[np.intp]:
    if len(query_ns) == 0:
        return np.empty(0, np.intp)
    after = np.searchsorted(stamp_ns, query_ns).clip(1, max(len(stamp_ns) - 1, 1))
    after = np.minimum(after, len(stamp_ns) - 1)
    before = np.maximum(after - 1, 0)
    closer = np.abs(stamp_ns[before] - query_ns) <= np.abs(stamp_ns[after] - query_ns)
    nearest: npt.NDArray[np.intp] = np.where(closer, before, after)
    return nearest
