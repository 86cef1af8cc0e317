"""Solutions: relative poses with covariance, or the reason why there is none."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.swarm.ir_board import IrPlatform, PairGains

DARKEST = -6.0
"""What a sensor reads below is no light, and counts as missing [sigma]."""


class IrOutcome(IntEnum):
    """Whether there is a pose, or the reason why there is none."""

    FOUND = 0
    TOO_WEAK = 1  # what was read is no more than noise
    TOO_FEW = 2  # most readings are missing or no light at all, such as far below zero
    UNDETERMINED = 3  # the readings leave range, bearing or heading open, as where all are saturated
    MISFIT = 4  # no pose explains most of what was read


class IrSolutions(NamedTuple):
    """Relative poses of k pairs: range [m], bearing [rad], heading [rad]; NaN where there is none.

    Attributes:
        poses: (k, 3).
        covariances: (k, 3, 3).
        outcomes: (k,) of `IrOutcome`.
        alternatives: (k, 3) the second-best pose where it is nearly as likely, else NaN.
        odds: (k,) its likelihood relative to the best one's, in [0, 1].
        systematic_share: (k, 3) share of each variance that is the unknown gains' and the same every time.
        misfits: (k,) squares of what is left of the readings, per degree of freedom; about 1 where the
            platform's noise is that of the readings.
    """

    poses: FloatArray
    covariances: FloatArray
    outcomes: NDArray[np.int64]
    alternatives: FloatArray
    odds: FloatArray
    systematic_share: FloatArray
    misfits: FloatArray

    @classmethod
    def none(cls, count: int) -> IrSolutions:
        """Without any pose."""
        return no_solutions(count)


@cached_njit
def no_solutions(count: int) -> IrSolutions:
    """Of so many pairs without any pose, also for compiled code."""
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
            saturation: (k, modes) a reading of it or more tells only that it is at least so bright [count];
                None: the platform's.

        Raises:
            ReadingsError: They have another shape.
        """


def checked(
    platform: IrPlatform, readings: ArrayLike, gains: PairGains | None, saturation: ArrayLike | None
) -> tuple[FloatArray, PairGains, FloatArray]:
    """Readings (k, modes, n, n), gains and saturation (k, modes) as estimators take them.

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
