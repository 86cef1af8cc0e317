"""Parameters about markers of `marker_detector_node` and `marker_bridge_node`, and what they describe."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.parameters import ParameterError, autostart, choice, text, texts
from swarm_loc_estimator.swarm.swarm import CameraMount, FixedCamera, Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.common.images import TRANSPORTS
from swarm_loc_vision.markers.bodies import Body, robot_body, up_of
from swarm_loc_vision.markers.detector import CreateDetector, DetectorSettings, MarkerDetector
from swarm_loc_vision.markers.families import Family, families, family_named

_IDS = re.compile(r"(\d+)(?:-(\d+))?")
_LENGTH = re.compile(r"(\d+)(?:-(\d+))?:(\d*\.?\d+)")
_LONGEST_M = 10.0


@dataclass(frozen=True)
class MarkersInUse:
    """Parameters about the markers in use and the camera's mount."""

    family: str = choice("artoolkit_bch_thin", tuple(families()), "kind of marker")
    ids: tuple[str, ...] = texts("ids in use, such as 5 or 0-31; empty: those of swarm_file, or all")
    lengths: tuple[str, ...] = texts(
        "sides that differ from marker_length, such as 100-119:0.08 [m]; not with swarm_file"
    )
    swarm_file: str = text(
        "", "path of the swarm description: ids in use, sizes, faces of robots; empty: none"
    )
    robot: str = text(
        "", "robot in swarm_file that carries the camera, or the fixed camera itself; empty: a level camera"
    )


@dataclass(frozen=True)
class DetectorParameters(MarkersInUse):
    """Parameters of `marker_detector_node`."""

    autostart: bool = autostart()
    image_transport: str = choice("raw", tuple(TRANSPORTS), "transport: uncompressed images, or JPEG or PNG")
    settings: DetectorSettings = field(
        default_factory=DetectorSettings, metadata={"numbers_of": DetectorSettings}
    )


class KnownMarkers(NamedTuple):
    """What a description says of markers: `MarkersInUse` with the contents of its files."""

    family: Family  # The family
    ids: IntArray | None  # (N,) ids in use, ascending; None: all
    lengths: Mapping[int, float]  # Sides by id [m]
    up: FloatArray  # (3,) up in the camera frame
    lying: Sequence[int]  # Ids of markers that lie flat
    bodies: Sequence[Body]  # Faces of the other robots


def known_markers(parameters: MarkersInUse) -> KnownMarkers:
    """The markers that parameters describe.

    Raises:
        ParameterError: A parameter cannot be used.
        SwarmFileError: The swarm description cannot be used.
    """
    family = family_named(parameters.family)
    swarm = load_swarm(Path(parameters.swarm_file)) if parameters.swarm_file else Swarm()
    carrier = _carrier(parameters, swarm)
    mount = carrier.camera if isinstance(carrier, Robot) else carrier
    return KnownMarkers(
        family,
        _ids(parameters, swarm, family),
        _lengths(parameters, swarm, family),
        up_of(mount or CameraMount()),
        [face.id for other in swarm.robots for face in other.faces if face.lies],
        [robot_body(other) for other in swarm.robots if other is not carrier],
    )


def detector_maker(parameters: DetectorParameters) -> CreateDetector:
    """Creates the detector for a camera.

    Raises:
        ParameterError: A parameter cannot be used.
        SwarmFileError: The swarm description cannot be used.
    """
    family, ids, lengths, up, lying, bodies = known_markers(parameters)

    def create(camera: Camera) -> MarkerDetector:
        return MarkerDetector(
            parameters.settings, {family: ids}, camera, lengths=lengths, up=up, lying=lying, bodies=bodies
        )

    return create


def _carrier(parameters: MarkersInUse, swarm: Swarm) -> Robot | FixedCamera | None:
    """The robot that carries the camera, or the fixed camera itself."""
    if not parameters.robot:
        return None
    if not parameters.swarm_file:
        raise ParameterError(f"parameter robot = '{parameters.robot}' needs the parameter swarm_file, too.")
    carriers = {one.name: one for one in swarm.sources}
    if parameters.robot not in carriers:
        raise ParameterError(
            f"parameter robot = '{parameters.robot}' must be a robot or fixed camera of the swarm:"
            f" {', '.join(carriers)}."
        )
    return carriers[parameters.robot]


def _ids(parameters: MarkersInUse, swarm: Swarm, family: Family) -> IntArray | None:
    """The ids in use; None: all."""
    count = len(family.words)
    if parameters.ids:
        return parse_ids("ids", parameters.ids, count)
    if not swarm.owner_of:
        return None
    unknown = [marker_id for marker_id in swarm.owner_of if marker_id >= count]
    if unknown:
        raise ParameterError(
            f"{parameters.swarm_file} has marker id {unknown[0]},"
            f" but {family.name} has only 0 to {count - 1}."
        )
    return np.array(sorted(swarm.owner_of), np.int64)


def _lengths(parameters: MarkersInUse, swarm: Swarm, family: Family) -> dict[int, float]:
    """Sides by id, from the swarm or from the parameter."""
    if parameters.lengths and parameters.swarm_file:
        raise ParameterError(
            "parameter lengths cannot be given along with swarm_file, which has the size of each marker."
        )
    if parameters.swarm_file:
        return {marker_id: owner.marker.size for marker_id, owner in swarm.owner_of.items()}
    return parse_lengths(parameters.lengths, len(family.words))


def parse_ids(name: str, selected: Sequence[str], count: int) -> NDArray[np.int64]:
    """Ids (N,), ascending.

    Args:
        name: Parameter, for errors.
        selected: Ids or ranges, such as 5 or 0-31.
        count: Ids that there are.

    Raises:
        ParameterError: A text is not one, or an id does not exist.
    """
    chosen: set[int] = set()
    for one in selected:
        match = _IDS.fullmatch(one.strip())
        if match is None:
            raise ParameterError(
                f"parameter {name}: '{one}' must be an id such as 5 or a range such as 0-31."
            )
        first, last = int(match[1]), int(match[2] or match[1])
        if not first <= last < count:
            raise ParameterError(f"parameter {name}: '{one}' must ascend within 0-{count - 1}.")
        chosen.update(range(first, last + 1))
    return np.array(sorted(chosen), np.int64)


def parse_lengths(selected: Sequence[str], count: int) -> dict[int, float]:
    """Marker id -> side [m].

    Args:
        selected: Each an id or a range, a colon, and a length in metres.
        count: Ids that there are.

    Raises:
        ParameterError: A text is not one, an id does not exist, or a length is out of range.
    """
    lengths: dict[int, float] = {}
    for one in selected:
        match = _LENGTH.fullmatch(one.strip())
        if match is None:
            raise ParameterError(
                f"parameter lengths: '{one}' must be ids and a length in metres, such as 100-119:0.08."
            )
        length = float(match[3])
        if not 0.0 < length <= _LONGEST_M:
            raise ParameterError(f"parameter lengths: '{one}' must give a length in (0, {_LONGEST_M:g}] m.")
        ids = one.partition(":")[0]
        lengths.update(dict.fromkeys(parse_ids("lengths", [ids], count).tolist(), length))
    return lengths
