"""Interface of the joint filter, the covariance of all errors; it has a dense and a sparse implementation.

A filter operates on columns and Jacobians, not on robots or sensors. It does not hold the mean: an update
returns the correction, which the caller applies on the manifold. Columns 3i..3i+2 are the error twist of
body i; columns of parameters follow those of the robots. `DenseFilter` holds a full covariance matrix, the
sparse implementation is in `sparse/`.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.numerics import assign_matrix, cholesky3, invert_positive, solve3
from swarm_loc_estimator.swarm.calibration_states import BLOCKS, DRIVES, ParameterTable


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

        w is 3 for the pose and for each block of a robot's parameters, up to the last one that any robot has.
        A dense filter has these in `covariance`.
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
            cross_covariance: (m, 3, 6) written by a sparse filter: of the observers with the targets, and of
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


def inverse(matrix: FloatArray) -> FloatArray:
    """Inverse (n, n) of a symmetric positive definite matrix; exactly symmetric.

    Raises LinAlgError if the matrix is not positive definite.
    """
    inverted: FloatArray = matrix.copy()
    invert(inverted)
    return inverted


def invert(matrix: FloatArray) -> None:
    """Invert a matrix (n, n) in place; see `inverse`."""
    if not invert_positive(matrix.reshape(-1), matrix.shape[0]):
        raise np.linalg.LinAlgError("the covariance is not positive definite")
    _mirror(matrix)


@cached_njit
def _mirror(matrix: FloatArray) -> None:
    """Copy the upper triangle, the lower one in Fortran order, to the other triangle."""
    for i in range(matrix.shape[0]):
        for j in range(i):
            matrix[i, j] = matrix[j, i]


class DenseFilter:
    """Full covariance matrix; every update keeps it symmetric positive definite.

    Args:
        size: Number of columns; the prior is the identity.
    """

    is_dense = True

    def __init__(self, size: int) -> None:
        self.covariance: FloatArray = np.eye(size)
        self.marginal: FloatArray = np.zeros((0, 3, 3))
        self.transition: FloatArray = np.zeros((0, 3 + BLOCKS, DRIVES))

    def copy(self) -> DenseFilter:
        """An independent copy."""
        other = DenseFilter(0)
        other.covariance = self.covariance.copy()
        return other

    def set_prior(self, columns: IntArray, covariance: FloatArray) -> None:
        """Set the covariance (k, k) of columns (k,), independent of all others."""
        self.covariance[columns, :] = 0.0
        self.covariance[:, columns] = 0.0
        self.covariance[columns[:, None], columns[None, :]] = covariance

    def set_body_priors(self, bodies: IntArray, covariances: FloatArray) -> None:
        """Set covariances (k, 3, 3) of bodies (k,), each independent of all others."""
        for body, covariance in zip(bodies.tolist(), covariances, strict=True):
            self.set_prior(3 * body + np.arange(3), covariance)

    def add(self, columns: IntArray, covariance: FloatArray) -> None:
        """Add a covariance (k, k) to that of columns (k,)."""
        self.covariance[columns[:, None], columns[None, :]] += covariance

    def append_columns(self, table: ParameterTable) -> None:
        """Append the new columns of a table with zero variance; `set_prior` must follow."""
        size = self.covariance.shape[0]
        grown = np.zeros((table.filter_size, table.filter_size))
        grown[:size, :size] = self.covariance
        self.covariance = grown

    def correlate(self, columns: IntArray, others: IntArray, mapping: FloatArray) -> None:
        """Add the errors of other columns (m,), mapped by (k, m), to independent columns (k,)."""
        common = mapping @ self.covariance[others]
        added = common[:, others] @ mapping.T
        self.covariance[columns, :] += common
        self.covariance[:, columns] += common.T
        self.covariance[np.ix_(columns, columns)] += 0.5 * (added + added.T)

    def block(self, columns: IntArray) -> FloatArray:
        """Covariance (k, k) of columns (k,)."""
        covariance: FloatArray = self.covariance[np.ix_(columns, columns)]
        return covariance

    def prepare_update(self, columns: IntArray, robots: Robots, cross_covariance: FloatArray) -> None:
        """Do nothing: `covariance` contains all cross-covariances."""

    def update(
        self, columns: IntArray, jacobian: FloatArray, innovation: FloatArray, noise: FloatArray
    ) -> FloatArray:
        """Fuse measurements (m,) as one batch, see `JointFilter`; return the correction (n,).

        Eqs. (11)-(14) of the e-puck paper in information form, P = (P^-1 + H^T R^-1 H)^-1: two inversions,
        whose cost does not grow with the number of measurements.
        """
        gradient = np.zeros(self.covariance.shape[0])
        information = inverse(self.covariance)
        _gather(information, gradient, columns, jacobian, innovation, noise)
        invert(information)
        self.covariance = information
        correction: FloatArray = self.covariance @ gradient
        return correction


@cached_njit
def _gather(
    information: FloatArray,
    gradient: FloatArray,
    columns: IntArray,
    jacobian: FloatArray,
    innovation: FloatArray,
    noise: FloatArray,
) -> None:
    """Add H^T R^-1 H to the information (n, n) and H^T R^-1 y to the gradient (n,)."""
    weighted = np.empty((columns.shape[1], 3))
    for k in range(columns.shape[0]):
        factor = cholesky3(noise[k])
        for a in range(columns.shape[1]):
            solve3(factor, jacobian[k, :, a], weighted[a])  # R^-1 H
        for a in range(columns.shape[1]):
            w0, w1, w2 = weighted[a, 0], weighted[a, 1], weighted[a, 2]
            gradient[columns[k, a]] += w0 * innovation[k, 0] + w1 * innovation[k, 1] + w2 * innovation[k, 2]
            for b in range(columns.shape[1]):
                h0, h1, h2 = jacobian[k, 0, b], jacobian[k, 1, b], jacobian[k, 2, b]
                information[columns[k, a], columns[k, b]] += w0 * h0 + w1 * h1 + w2 * h2


def link_covariance(
    joint: JointFilter, columns: IntArray, bodies: tuple[int, int], radio: int, cross_covariance: FloatArray
) -> FloatArray:
    """Covariance (c, c) of the columns (c,) of a link, of which 6 is the bias of the observer's radio.

    Missing ones are arbitrary. `bodies` are the first columns of observer and target, and `radio` is that of
    the bias; -1: none. A sparse filter is prepared for an update, and `cross_covariance` (3, 6) is of this.
    """
    if joint.is_dense:
        return joint.block(columns)
    covariance, (o, t), of_target = np.zeros((columns.size, columns.size)), bodies, np.s_[3:6]
    own = [0, 1, 2, 6] if radio >= 0 else [0, 1, 2]
    if o >= 0:
        covariance[np.ix_(own, own)] = joint.block(columns[own])
    if t >= 0:
        covariance[of_target, of_target] = joint.block(columns[of_target])
        across = np.vstack([cross_covariance[:, :3], cross_covariance[:, 3]])[: len(own)] if o >= 0 else 0.0
        covariance[own, of_target] = across
        covariance[of_target, own] = np.transpose(across)
    return covariance


@cached_njit
def update_one(
    covariance: FloatArray, columns: IntArray, jacobian: FloatArray, innovation: FloatArray, noise: FloatArray
) -> FloatArray:
    """Fuse one measurement: update the covariance (n, n) in place, return the correction (n,).

    Eqs. (11), (13), (14), and (12) in Joseph's form, which keeps the covariance positive definite, expanded
    to P - K H P - (P H^T - K S) K^T, where the last term is the rounding error, and made symmetric. Columns
    (c,) may contain duplicates; the Jacobian is (3, c), the innovation (3,), the noise (3, 3).
    """
    # P H^T (n, 3), and S = H P H^T + R, eq. (13)
    size, s = covariance.shape[0], np.empty((3, 3))
    ph = np.zeros((size, 3))
    for c in range(columns.size):
        column = columns[c]
        for r in range(3):
            slope = jacobian[r, c]
            if slope != 0.0:
                for i in range(size):
                    ph[i, r] += covariance[column, i] * slope
    assign_matrix(s, noise)
    for c in range(columns.size):
        for i in range(3):
            for j in range(3):
                s[i, j] += jacobian[i, c] * ph[columns[c], j]
    # gain K, correction, and change of the covariance
    factor = cholesky3(s)
    gain, one = np.empty((3, size)), np.empty(3)
    change, correction = np.empty((3, size)), np.zeros(size)
    for i in range(size):
        solve3(factor, ph[i], one)
        for r in range(3):
            gain[r, i] = one[r]
            correction[i] += one[r] * innovation[r]
            rest = ph[i, r] - one[0] * s[0, r] - one[1] * s[1, r] - one[2] * s[2, r]
            change[r, i] = 0.5 * (ph[i, r] + rest)
    for i in range(size):
        k0, k1, k2 = gain[0, i], gain[1, i], gain[2, i]
        c0, c1, c2 = change[0, i], change[1, i], change[2, i]
        for j in range(size):  # each pair of terms is the same for (i, j) and (j, i): exactly symmetric
            value = k0 * change[0, j] + c0 * gain[0, j]
            value += k1 * change[1, j] + c1 * gain[1, j]
            value += k2 * change[2, j] + c2 * gain[2, j]
            covariance[i, j] -= value
    return correction
