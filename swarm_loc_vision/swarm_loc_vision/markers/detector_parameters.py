"""Parameters of `marker_detector_node`, and the detector that they describe. No ROS here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.parameters import ParameterError, choice, text, texts
from swarm_loc_estimator.swarm.swarm import CameraMount, Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.common.transports import TRANSPORTS
from swarm_loc_vision.markers.bodies import robot_body, up_of
from swarm_loc_vision.markers.camera_detector import CreateDetector
from swarm_loc_vision.markers.detector import MarkerDetector
from swarm_loc_vision.markers.detector_settings import DetectorSettings
from swarm_loc_vision.markers.families import Family, families, family_named
from swarm_loc_vision.markers.selection import SelectionError, parse_ids, parse_lengths


@dataclass(frozen=True)
class DetectorParameters:
    """Parameters of `marker_detector_node`; those of the detector itself are its settings."""

    image_transport: str = choice("raw", tuple(TRANSPORTS), "how images come: as they are, or as JPEG or PNG")
    family: str = choice("artoolkit_bch_thin", tuple(families()), "kind of marker")
    ids: tuple[str, ...] = texts("ids in use, such as 5 or 0-31; empty: those of swarm_file, or else all")
    lengths: tuple[str, ...] = texts(
        "sides that differ from marker_length, such as 100-119:0.08 [m]; not with swarm_file, which has them"
    )
    swarm_file: str = text(
        "", "path of the swarm description: ids in use, sizes, faces of robots; empty: none"
    )
    robot: str = text("", "whose camera it is in swarm_file: its mount says where up is; empty: a level one")
    settings: DetectorSettings = field(
        default_factory=DetectorSettings, metadata={"numbers_of": DetectorSettings}
    )


def detector_maker(parameters: DetectorParameters) -> CreateDetector:
    """What makes the detector once the camera is known.

    Raises:
        ParameterError: A parameter cannot be used.
        SwarmFileError: The swarm description cannot be used.
    """
    family = family_named(parameters.family)
    swarm = load_swarm(Path(parameters.swarm_file)) if parameters.swarm_file else Swarm()
    robot = _robot(parameters, swarm)
    ids = _ids(parameters, swarm, family)
    lengths = _lengths(parameters, swarm, family)
    up = up_of((robot.camera if robot else None) or CameraMount())
    bodies = [robot_body(other) for other in swarm.robots if other is not robot]

    def create(camera: Camera) -> MarkerDetector:
        return MarkerDetector(
            parameters.settings, [(family, ids)], camera, lengths=lengths, up=up, bodies=bodies
        )

    return create


def _robot(parameters: DetectorParameters, swarm: Swarm) -> Robot | None:
    """Whose camera it is."""
    if not parameters.robot:
        return None
    if not parameters.swarm_file:
        raise ParameterError(f"parameter robot = '{parameters.robot}' needs the parameter swarm_file, too.")
    if parameters.robot not in swarm.index_of:
        known = ", ".join(swarm.index_of)
        raise ParameterError(f"parameter robot = '{parameters.robot}' must be a robot of the swarm: {known}.")
    return swarm.robots[swarm.index_of[parameters.robot]]


def _ids(parameters: DetectorParameters, swarm: Swarm, family: Family) -> IntArray | None:
    """The ids in use; None: all."""
    count = len(family.words)
    if parameters.ids:
        ids: IntArray = _selected("ids", parameters.ids, parse_ids, count)
        return ids
    if not swarm.owner_of:
        return None
    unknown = [marker_id for marker_id in swarm.owner_of if marker_id >= count]
    if unknown:
        raise ParameterError(
            f"{parameters.swarm_file} has marker id {unknown[0]},"
            f" but {family.name} has only 0 to {count - 1}."
        )
    return np.array(sorted(swarm.owner_of), np.int64)


def _lengths(parameters: DetectorParameters, swarm: Swarm, family: Family) -> dict[int, float]:
    """Sides by id: those of the swarm, or those that the parameter says."""
    if parameters.lengths and parameters.swarm_file:
        raise ParameterError(
            "parameter lengths cannot be given along with swarm_file, which has the size of each marker."
        )
    if parameters.swarm_file:
        return {marker_id: owner.marker.size for marker_id, owner in swarm.owner_of.items()}
    lengths: dict[int, float] = _selected("lengths", parameters.lengths, parse_lengths, len(family.words))
    return lengths


def _selected(name: str, values: tuple[str, ...], parse: Callable[..., Any], count: int) -> Any:
    """A list of texts, parsed."""
    try:
        return parse(values, count)
    except SelectionError as error:
        raise ParameterError(f"parameter {name}: {error}") from error
