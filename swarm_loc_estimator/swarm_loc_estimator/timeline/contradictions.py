"""Reports of detected faults: which robot or landmark contradicts the estimate, and by which sensor."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray
from swarm_loc_estimator.filter.belief import NEVER_NS
from swarm_loc_estimator.filter.integrity.fault_detection import excluded_pairs, is_contradicted
from swarm_loc_estimator.filter.state import SwarmState
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.swarm.swarm import Swarm


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
