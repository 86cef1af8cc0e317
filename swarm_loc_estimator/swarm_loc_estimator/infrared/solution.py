"""Solutions: relative poses with covariance, or the reason why there is none."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.swarm.ir_board import IrPlatform, PairGains

DARKEST = -6.0  # Minimum of a valid reading; lower ones count as missing [sigma]


class IrOutcome(IntEnum):
    """Whether a pose was found, or why not."""

    FOUND = 0
    TOO_WEAK = 1  # readings do not exceed noise
    TOO_FEW = 2  # most readings are missing or invalid, such as far below zero
    UNDETERMINED = 3  # range, bearing or heading is not observable, as where all readings are saturated
    MISFIT = 4  # no pose explains most of the readings


class IrSolutions(NamedTuple):
    """Relative poses of k pairs: range [m], bearing [rad], heading [rad]; NaN where there is none."""

    poses: FloatArray  # (k, 3)
    covariances: FloatArray  # (k, 3, 3)
    outcomes: NDArray[np.int64]  # (k,) of `IrOutcome`
    alternatives: FloatArray  # (k, 3) the second-best pose where it is nearly as likely, else NaN
    odds: FloatArray  # (k,) its likelihood relative to the best one's, in [0, 1]
    # (k, 3) share of each variance that is systematic, mostly from unknown gains
    systematic_share: FloatArray
    # (k,) sum of squared residuals per degree of freedom; about 1 where the platform's noise matches the
    # readings
    misfits: FloatArray

    @classmethod
    def none(cls, count: int) -> IrSolutions:
        """Solutions of `count` pairs, all without a pose."""
        return no_solutions(count)


@cached_njit
def no_solutions(count: int) -> IrSolutions:
    """Solutions of `count` pairs, all without a pose; also for compiled code."""
    return IrSolutions(
        np.full((count, 3), np.nan),
        np.full((count, 3, 3), np.nan),
        np.zeros(count, np.int64),
        np.full((count, 3), np.nan),
        np.zeros(count),
        np.full((count, 3), np.nan),
        np.full(count, np.nan),
    )


class ReadingsError(ValueError):
    """Readings that do not belong to the platform; the message is one sentence."""


class IrEstimator(Protocol):
    """One of `ClosedForm` and `MaximumLikelihood`."""

    def solve(
        self, readings: ArrayLike, gains: PairGains | None = None, saturation: ArrayLike | None = None
    ) -> IrSolutions:
        """Relative poses of k pairs.

        Args:
            readings: (k, modes, n, n) [count], [mode, sensor, emitter], NaN where not measured.
            gains: Of the k pairs; None: never calibrated.
            saturation: (k, modes) minimum of saturated readings, which are only lower bounds [count];
                None: the platform's.

        Raises:
            ReadingsError: They have another shape.
        """


def checked(
    platform: IrPlatform, readings: ArrayLike, gains: PairGains | None, saturation: ArrayLike | None
) -> tuple[FloatArray, PairGains, FloatArray]:
    """Validate readings (k, modes, n, n), gains and saturation (k, modes), and fill in defaults.

    Raises:
        ReadingsError: They have another shape.
    """
    values = np.ascontiguousarray(readings, dtype=np.float64)
    wanted = (len(platform.amplitudes), platform.n, platform.n)
    if values.ndim != 4 or values.shape[1:] != wanted:
        raise ReadingsError(
            f"readings have the shape {values.shape} but must have"
            f" (pairs, {wanted[0]}, {wanted[1]}, {wanted[2]})."
        )
    known = platform.unknown_gains(len(values)) if gains is None else gains
    if known.sensor.shape != (len(values), platform.n):
        raise ReadingsError(
            f"gains have the shape {known.sensor.shape} but must have {(len(values), platform.n)}."
        )
    if saturation is None:
        return values, known, np.full(values.shape[:2], platform.saturation)
    limits = np.ascontiguousarray(saturation, dtype=np.float64)
    if limits.shape != values.shape[:2]:
        raise ReadingsError(f"saturation has the shape {limits.shape} but must have {values.shape[:2]}.")
    return values, known, limits
