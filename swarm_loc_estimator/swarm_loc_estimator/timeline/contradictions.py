"""Reports of detected faults: which robot or landmark contradicts the estimate, by which sensor; lost robots.

Odometry whose pose is constant is noticed by its twist, see `odometry/preintegration.py`; without a twist, as
from shared topics or dead encoders, by the poses of the robot, which move nevertheless.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray
from swarm_loc_estimator.filter.belief import NEVER_NS
from swarm_loc_estimator.filter.integrity import CONFIRMED, excluded_pairs, is_contradicted
from swarm_loc_estimator.filter.measurements import Loss
from swarm_loc_estimator.filter.state import SwarmState
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.estimate import Estimate
from swarm_loc_estimator.timeline.settings import Settings

_MOVES = 3
"""Number of moves that prove motion; one or two may be the correction of a wrong start or calibration."""
_MOVE_M, _MOVE_SIGMAS = 0.05, 3.0
"""Minimum displacement of a move: a length, and a multiple of the standard deviation of both ends."""
_MEMORY_NS = 30_000_000_000  # Time within which these moves happen, and for which they are remembered
_LONG_AGO_NS = np.iinfo(np.int64).min // 2

LOSS_CAUSES = {
    Loss.UNCERTAIN: "its standard deviation exceeded {0.lost_sigma:g} m (lost_sigma) or"
    " {0.lost_heading_sigma:g} rad (lost_heading_sigma)",
    Loss.REFUTED: f"a measurement contradicted its pose before {CONFIRMED} had confirmed it",
    Loss.GATED: "{0.lost_after} measurements in a row were gated",
    Loss.OFF_FIXES: "several absolute fixes in a row were gated",
    Loss.KIDNAPPED: "its measurements can only mean that it is elsewhere",
    Loss.OFF_MAP: "its scans contradict the map",
    Loss.NOT_IN_IMAGE: "aerial images do not show it where it should be",
    Loss.COMMAND: "a command removed it",
    Loss.FRAME: "its local frame ended",
}
"""Why robots are lost, in words; with fields of the settings."""


class LossReport(NamedTuple):
    """Loss of a robot."""

    robot: int  # Its index
    why: Loss  # Reason
    stamp_ns: int  # Stamp of the measurement or command that showed it
    cause: str  # The reason in words, with the settings

    def text(self, now_ns: int) -> str:
        """Message for users at an instant, one sentence."""
        return f"lost {max(0, now_ns - self.stamp_ns) * 1e-9:.1f} s ago: {self.cause}"


def last_loss(state: SwarmState, robot: int, settings: Settings) -> LossReport | None:
    """The last loss of a robot, located again or not; None without one."""
    why = int(state.lost_why[robot])
    if not why:
        return None
    return LossReport(robot, Loss(why), int(state.lost_ns[robot]), LOSS_CAUSES[Loss(why)].format(settings))


class ConstantOdometry:
    """Moves of estimated poses of robots whose odometry has never changed.

    Args:
        robots: Number of robots.
    """

    def __init__(self, robots: int) -> None:
        self._from = np.full((robots, 2), np.nan)
        self._from_variance = np.zeros(robots)
        self._moves_ns = np.full((robots, _MOVES), _LONG_AGO_NS)

    def forget(self, robot: int) -> None:
        """Forget the moves of a robot whose pose was set."""
        self._from[robot] = np.nan
        self._moves_ns[robot] = _LONG_AGO_NS

    def add(self, constant: BoolArray, estimate: Estimate) -> None:
        """Take note of poses; `constant` (N,) tells whose odometry has never changed."""
        variance = 0.5 * np.trace(estimate.covariances[:, :2, :2], axis1=1, axis2=2)
        position = np.where(constant[:, None], estimate.poses[:, :2], np.nan)
        reach = np.maximum(_MOVE_M, _MOVE_SIGMAS * np.sqrt(variance + self._from_variance))
        moved = np.hypot(*(position - self._from).T) > reach  # False for NaN
        self._moves_ns[moved] = np.roll(self._moves_ns[moved], 1, axis=1)
        self._moves_ns[moved, 0] = estimate.stamp_ns
        self._moves_ns[~constant] = _LONG_AGO_NS  # such as a robot that was carried before it drove
        changed = moved | np.isnan(self._from[:, 0]) | np.isnan(position[:, 0])
        self._from[changed], self._from_variance[changed] = position[changed], variance[changed]

    def contradicted(self, now_ns: int) -> BoolArray:
        """Whether measurements contradict the constant odometry of each robot (N,)."""
        return np.asarray(now_ns - self._moves_ns[:, -1] < _MEMORY_NS)


class Contradicted(Enum):
    """Contradicted property of a robot or landmark."""

    ODOMETRY = "odometry"
    RESET = "odometry reset"
    CONSTANT = "constant odometry"
    UNMOVED = "constant odometry of a moving robot"
    POSE = "pose"
    SIGHTINGS = "sightings"
    DESCRIPTION = "description"
    NOISE = "noise"


class Contradiction(NamedTuple):
    """A fault of a robot or landmark."""

    about: str  # Name of the robot, or a landmark such as "landmark 7"
    kind: Contradicted  # Contradicted property
    text: str  # Message for users, one sentence


def contradictions(
    swarm: Swarm, state: SwarmState, tracks: OdometryTracks, unmoved: BoolArray, now_ns: int
) -> list[Contradiction]:
    """All faults detected at an instant.

    Args:
        swarm: Gives the names.
        state: Newest state.
        tracks: Odometry, to detect conflicting sources, resets and constant poses.
        unmoved: (N,) robots that move although their odometry has never changed.
        now_ns: The instant.
    """
    names = [robot.name for robot in swarm.robots] + [f"landmark {mark.id}" for mark in swarm.landmarks]
    names += [f"anchor {anchor.address}" for anchor in swarm.anchors]
    conflicting = tracks.has_conflicting_sources(now_ns)
    reset = tracks.had_fault(now_ns) & ~conflicting
    robots = np.flatnonzero(state.tracked).tolist()
    denied = [robot for robot in robots if is_contradicted(state.integrity, robot)]
    contradicted = np.flatnonzero(state.contradicted_ns > NEVER_NS).tolist()
    aside = excluded_pairs(state.integrity, now_ns)
    return [
        *(_odometry(names[robot]) for robot in np.flatnonzero(conflicting).tolist()),
        *(_reset(names[robot]) for robot in np.flatnonzero(reset).tolist()),
        *(_constant(names[robot]) for robot in np.flatnonzero(tracks.integrates_twist()).tolist()),
        *(_unmoved(names[robot]) for robot in np.flatnonzero(unmoved).tolist()),
        *(_pose(names[robot]) for robot in denied),
        *(_sightings(names[observer], names[source % len(names)]) for observer, source in aside),
        *(_description(names[source], source, state) for source in contradicted),
        *(_noise(names[robot]) for robot in np.flatnonzero(state.integrity.noise_inflation).tolist()),
    ]


def _odometry(name: str) -> Contradiction:
    text = f"the odometry of {name} jumps back and forth: it may have two sources"
    return Contradiction(name, Contradicted.ODOMETRY, text)


def _reset(name: str) -> Contradiction:
    text = f"the odometry of {name} jumped or was reset: its motion at that moment is unknown"
    return Contradiction(name, Contradicted.RESET, text)


def _constant(name: str) -> Contradiction:
    text = f"the odometry of {name} has a constant pose but a twist: integrating the twist"
    return Contradiction(name, Contradicted.CONSTANT, text)


def _unmoved(name: str) -> Contradiction:
    text = f"the odometry of {name} has a constant pose and no twist, although {name} moves"
    return Contradiction(name, Contradicted.UNMOVED, text)


def _pose(name: str) -> Contradiction:
    return Contradiction(name, Contradicted.POSE, f"the newest measurements contradict the pose of {name}")


def _sightings(observer: str, source: str) -> Contradiction:
    text = f"excluding {observer}'s measurements of {source}: inconsistent with all others"
    return Contradiction(observer, Contradicted.SIGHTINGS, text)


def _description(name: str, source: int, state: SwarmState) -> Contradiction:
    """Fault of a robot or landmark whose parameters are re-estimated."""
    robots = state.tracked.size
    if source < robots:
        text = f"{name} contradicts its calibration; re-estimating its camera and odometry parameters"
    else:
        moved = float(np.hypot(*state.landmark[source - robots, :2]))
        text = f"{name} is about {moved:.2f} m from its surveyed place; re-estimating its place"
    return Contradiction(name, Contradicted.DESCRIPTION, text)


def _noise(name: str) -> Contradiction:
    text = f"the measurements of {name} are noisier than described; inflating their noise"
    return Contradiction(name, Contradicted.NOISE, text)
