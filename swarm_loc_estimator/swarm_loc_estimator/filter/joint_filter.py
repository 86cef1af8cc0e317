"""What the estimator asks of a filter: a joint covariance of errors, of which two implementations exist.

A filter knows columns and Jacobians, not robots or sensors. The mean lives outside: an update gives the
correction, which its owner applies on the manifold. Columns 3i..3i+2 are the error of body i, a twist; those
of parameters are behind those of the robots.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.swarm.calibration_states import ParameterTable


class Robots(NamedTuple):
    """Where robots are, so that a filter knows who is near whom.

    Attributes:
        places: (N, 2) [m] in `map`.
        active: (N,) whether each is part of the estimate; what is known of others is forgotten.
    """

    places: FloatArray
    active: BoolArray


class JointFilter(Protocol):
    """The covariance of the errors of all bodies and parameters.

    Attributes:
        covariance: (n, n) of all columns; (0, 0) where only parts of it are kept. Predictions write to it.
        is_dense: Whether it keeps the whole covariance; measurements may then be used one by one, too.
    """

    covariance: FloatArray
    is_dense: bool

    @property
    def marginal(self) -> FloatArray:
        """(bodies, w, w) of each body's error; (0, 3, 3) where `covariance` has it.

        Where anything is calibrated w is 9, of each robot's pose and its parameters, else 3. Either is
        written to by predictions.
        """

    @property
    def transition(self) -> FloatArray:
        """(robots, 4, DRIVES) how predictions have moved errors since the last update, besides by noise.

        Those of a pose by those of the parameters of its motion (3, DRIVES), and what is left of the latter
        (DRIVES,). Where it is not needed it is of no robot.
        """

    def copy(self) -> JointFilter:
        """An independent copy."""

    def set_prior(self, columns: IntArray, covariance: FloatArray) -> None:
        """Give columns (k,) this covariance (k, k), independent of all others.

        They are those of one body, or of parameters, independent of each other.
        """

    def set_body_priors(self, bodies: IntArray, covariances: FloatArray) -> None:
        """Give bodies (k,) covariances (k, 3, 3), each independent of all others."""

    def add(self, columns: IntArray, covariance: FloatArray) -> None:
        """Add a covariance (k, k) to that of columns (k,) as of `block`: errors are larger than was known."""

    def append_columns(self, table: ParameterTable) -> None:
        """Append the columns that a table has more, without error as yet: they are placed next."""

    def correlate(self, columns: IntArray, others: IntArray, mapping: FloatArray) -> None:
        """Add the errors of other columns (m,), mapped by (k, m), to those of columns (k,) just placed."""

    def block(self, columns: IntArray) -> FloatArray:
        """Covariance (k, k) of columns (k,): of one body, or of one robot's parameters."""

    def prepare_update(self, columns: IntArray, robots: Robots, cross_covariance: FloatArray) -> None:
        """Prepare an update, and write covariances of what its measurements (m,) depend on.

        Args:
            columns: (m, 3) the first columns of observers, targets and observers' cameras; -1: there is none.
            robots: Where all are.
            cross_covariance: (m, 3, 5) written, unless `covariance` has it: of the observers' errors with
                the targets', and of these with those of the cameras.
        """

    def update(
        self, columns: IntArray, jacobian: FloatArray, innovation: FloatArray, noise: FloatArray
    ) -> FloatArray:
        """Use measurements (m,) with independent errors at once; return the correction (n,) of all columns.

        `prepare_update` comes before each update.

        Args:
            columns: (m, c) what each depends on, the two bodies' first; a column may be named twice.
            jacobian: (m, 3, c) its Jacobian; a zero row is a component that was not measured.
            innovation: (m, 3) measured minus predicted.
            noise: (m, 3, 3) covariance of the measurement.
        """
