"""The constraints that a pose graph has gathered, and arrays of them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.mapping.pose_graph import constraints as model

_Row = tuple[int, int, FloatArray]


class ConstraintLists:
    """Priors, odometry, ties and bearings in the order in which they came."""

    def __init__(self) -> None:
        self._priors: list[_Row] = []
        self._departures: list[_Row] = []
        self._ties: list[_Row] = []
        self._bearings: list[_Row] = []

    def add_prior(self, stop: int, pose: FloatArray, sigma: FloatArray) -> None:
        """A pose (3,) with sigmas (3,) that a stop is known to have."""
        self._priors.append((stop, stop, np.concatenate([pose, sigma])))

    def add_departure(self, begin: int, end: int, turn: float, motion: FloatArray, sigma: FloatArray) -> None:
        """Odometry from stop to stop, see `constraints.Departures`."""
        self._departures.append((begin, end, np.concatenate([[turn], motion, sigma])))

    def add_tie(self, begin: int, end: int, pose: FloatArray, sigma: FloatArray) -> None:
        """A relative pose, see `constraints.Ties`."""
        self._ties.append((begin, end, np.concatenate([pose, sigma])))

    def add_bearing(self, begin: int, end: int, turn: float, sigma: float) -> None:
        """The light of a robot at another stop, see `constraints.Bearings`."""
        self._bearings.append((begin, end, np.array([turn, sigma])))

    @property
    def tie_count(self) -> int:
        """How many relative poses there are."""
        return len(self._ties)

    @property
    def bearing_count(self) -> int:
        """How many bearings there are."""
        return len(self._bearings)

    def remove_stop(self, stop: int) -> None:
        """Forget everything that says something of a stop."""
        for rows in (self._priors, self._departures, self._ties, self._bearings):
            rows[:] = [one for one in rows if stop not in one[:2]]

    def remove_departure_to(self, stop: int) -> None:
        """Forget how a robot came to a stop, as when it was carried there."""
        self._departures[:] = [one for one in self._departures if one[1] != stop]

    def linearised(self, states: FloatArray) -> Iterator[model.Linearised]:
        """All of them at states (k, 4)."""
        if self._priors:
            stop, _, v = _arrays(self._priors)
            yield model.priors(states, stop, v[:, :3], v[:, 3:])
        if self._departures:
            begin, end, v = _arrays(self._departures)
            yield model.odometry(states, model.Departures(begin, end, v[:, 0], v[:, 1:4], v[:, 4:]))
        if self._ties:
            begin, end, v = _arrays(self._ties)
            yield model.ties(states, model.Ties(begin, end, v[:, :3], v[:, 3:]))
        if self._bearings:
            begin, end, v = _arrays(self._bearings)
            yield model.bearings(states, model.Bearings(begin, end, v[:, 0], v[:, 1]))


def _arrays(rows: list[_Row]) -> tuple[IntArray, IntArray, FloatArray]:
    begin, end, values = zip(*rows, strict=True)
    return np.array(begin), np.array(end), np.array(values)
