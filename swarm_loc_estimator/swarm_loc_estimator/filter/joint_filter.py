"""Interface of the joint filter, the covariance of all errors; it has a dense and a sparse implementation.

A filter operates on columns and Jacobians, not on robots or sensors. It does not hold the mean: an update
returns the correction, which the caller applies on the manifold. Columns 3i..3i+2 are the error twist of
body i; columns of parameters follow those of the robots.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.swarm.calibration_states import ParameterTable


class Robots(NamedTuple):
    """Positions of robots, from which a sparse filter selects neighbours."""

    places: FloatArray  # (N, 2) positions in `map` [m]
    active: BoolArray  # (N,) True if the robot is part of the estimate; correlations of others are dropped


class JointFilter(Protocol):
    """Covariance of the errors of all bodies and parameters."""

    covariance: FloatArray  # (n, n) of all columns, (0, 0) for a sparse filter. Predictions write to it.
    is_dense: bool  # True for a full covariance, which also supports sequential updates

    @property
    def marginal(self) -> FloatArray:
        """Marginal covariances (bodies, w, w); (0, 3, 3) for a dense filter. Predictions write to them.

        w is 9 if parameters are estimated, for each robot's pose and its parameters, else 3. A dense filter
        has these blocks in `covariance`.
        """

    @property
    def transition(self) -> FloatArray:
        """Transition (robots, 3 + BLOCKS, DRIVES) of the errors by predictions since the last update.

        Jacobian of the pose by the parameters of its motion (3, DRIVES), then the decay factors of the
        parameters by block (BLOCKS, DRIVES). Has no rows if it is not needed.
        """

    def copy(self) -> JointFilter:
        """An independent copy."""

    def set_prior(self, columns: IntArray, covariance: FloatArray) -> None:
        """Set the covariance (k, k) of columns (k,), independent of all others.

        The columns are those of one body, or of mutually independent parameters.
        """

    def set_body_priors(self, bodies: IntArray, covariances: FloatArray) -> None:
        """Set covariances (k, 3, 3) of bodies (k,), each independent of all others."""

    def add(self, columns: IntArray, covariance: FloatArray) -> None:
        """Add a covariance (k, k) to that of columns (k,); columns as in `block`."""

    def append_columns(self, table: ParameterTable) -> None:
        """Append the new columns of a table with zero variance; `set_prior` must follow."""

    def correlate(self, columns: IntArray, others: IntArray, mapping: FloatArray) -> None:
        """Add the errors of other columns (m,), mapped by (k, m), to independent columns (k,)."""

    def block(self, columns: IntArray) -> FloatArray:
        """Covariance (k, k) of columns (k,) of one body or of one robot's parameters."""

    def prepare_update(self, columns: IntArray, robots: Robots, cross_covariance: FloatArray) -> None:
        """Prepare an update with measurements (m,), and write their cross-covariances.

        Args:
            columns: (m, 3) first columns of observers, targets and observers' cameras; -1: none.
            robots: Positions of all robots.
            cross_covariance: (m, 3, 5) written by a sparse filter: of the observers with the targets, and of
                the targets with the cameras.
        """

    def update(
        self, columns: IntArray, jacobian: FloatArray, innovation: FloatArray, noise: FloatArray
    ) -> FloatArray:
        """Fuse measurements (m,) with independent errors as one batch; return the correction (n,).

        `prepare_update` must be called before each update.

        Args:
            columns: (m, c) filter columns of each, first those of the two bodies; may contain duplicates.
            jacobian: (m, 3, c) Jacobians; a zero row for a component that was not measured.
            innovation: (m, 3) measured minus predicted.
            noise: (m, 3, 3) covariance of the measurement.
        """
