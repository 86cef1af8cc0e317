"""What contradicts the belief, in words: which robot or landmark, by which sensor."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.filter.belief import NEVER_NS
from swarm_loc_estimator.filter.integrity.fault_detection import is_contradicted, pairs_set_aside
from swarm_loc_estimator.filter.state import SwarmState
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.swarm.swarm import Swarm


class Kind(Enum):
    """What is contradicted."""

    ODOMETRY = "odometry"
    POSE = "pose"
    SIGHTINGS = "sightings"
    DESCRIPTION = "description"
    NOISE = "noise"


class Contradiction(NamedTuple):
    """Something that is not as it was believed or described.

    Attributes:
        about: A robot's name, or a landmark as "landmark 7".
        kind: What of it.
        text: The same in words.
    """

    about: str
    kind: Kind
    text: str


def contradictions(
    swarm: Swarm, state: SwarmState, tracks: OdometryTracks, now_ns: int
) -> list[Contradiction]:
    """All that contradicts the belief at an instant.

    Args:
        swarm: Whose names are told.
        state: The belief.
        tracks: Odometry, which may contradict itself.
        now_ns: The instant.
    """
    names = [robot.name for robot in swarm.robots] + [f"landmark {mark.id}" for mark in swarm.landmarks]
    jumping = np.flatnonzero(tracks.contradict_themselves(now_ns)).tolist()
    robots = np.flatnonzero(state.tracked).tolist()
    denied = [robot for robot in robots if is_contradicted(state.integrity, robot)]
    contradicted = np.flatnonzero(state.contradicted_ns > NEVER_NS).tolist()
    aside = pairs_set_aside(state.integrity, now_ns)
    return [
        *(_odometry(names[robot]) for robot in jumping),
        *(_pose(names[robot]) for robot in denied),
        *(_sightings(names[observer], names[source]) for observer, source in aside),
        *(_description(names[source], source, state) for source in contradicted),
        *(_noise(names[robot]) for robot in np.flatnonzero(state.integrity.hidden_noise).tolist()),
    ]


def _odometry(name: str) -> Contradiction:
    return Contradiction(name, Kind.ODOMETRY, f"the odometry of {name} jumps to and fro: has it two sources?")


def _pose(name: str) -> Contradiction:
    return Contradiction(name, Kind.POSE, f"the newest sightings contradict the pose of {name}")


def _sightings(observer: str, source: str) -> Contradiction:
    text = f"what {observer} sees of {source} is set aside: it agrees with nothing else"
    return Contradiction(observer, Kind.SIGHTINGS, text)


def _description(name: str, source: int, state: SwarmState) -> Contradiction:
    """What is said of a robot or landmark that is estimated because it was contradicted."""
    robots = state.tracked.size
    if source < robots:
        text = f"{name} does not see or move as described: its camera and odometry are calibrated anew"
    else:
        moved = float(np.hypot(*state.landmark[source - robots, :2]))
        text = f"{name} is not where it is described, but about {moved:.2f} m off: its place is estimated"
    return Contradiction(name, Kind.DESCRIPTION, text)


def _noise(name: str) -> Contradiction:
    text = f"what {name} measures counts with more noise than described, which has been contradicted"
    return Contradiction(name, Kind.NOISE, text)
