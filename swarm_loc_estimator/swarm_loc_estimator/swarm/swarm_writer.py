"""Writer of swarm descriptions; values common to all robots of a type are written with the type."""

from __future__ import annotations

import textwrap
from dataclasses import asdict
from os.path import relpath
from pathlib import Path
from typing import TYPE_CHECKING, Any

from swarm_loc_estimator.common.parameters import number_specs
from swarm_loc_estimator.common.yaml_tree import tree_text
from swarm_loc_estimator.swarm.board_file import ir_tree
from swarm_loc_estimator.swarm.error_models import MotionResponse
from swarm_loc_estimator.swarm.schema import SCHEMA_COMMENT, SCHEMA_FILE
from swarm_loc_estimator.swarm.swarm import (
    Anchor,
    Face,
    FixedCamera,
    Landmark,
    Robot,
    Swarm,
    UwbDevice,
)
from swarm_loc_estimator.swarm.swarm_file import FILE_VERSION, LANDMARK_DEFAULTS, MODELS, parse_swarm

if TYPE_CHECKING:
    from collections.abc import Iterable

_WHOLE = frozenset({"camera", "faces", "response"})
Mapping = dict[Any, Any]


def save_swarm(swarm: Swarm, path: Path | str, comment: str = "") -> None:
    """Write a swarm description that `load_swarm` reads back equal.

    Its first line names the JSON Schema if that lies beside it, so that editors complete its keys.

    Args:
        swarm: What to write.
        path: The file; replaced when it exists, its folder created when missing.
        comment: Comment lines for the top of the file.

    Raises:
        SwarmFileError: It has numbers that `load_swarm` refuses; nothing is written.
    """
    path = Path(path)
    tree = _tree(swarm, path.parent)
    parse_swarm(tree, path)
    schema = [SCHEMA_COMMENT] if (path.parent / SCHEMA_FILE).is_file() else []
    text = "".join(f"# {line}\n" for line in [*schema, *comment.splitlines(), *_units()])
    text += tree_text(tree)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".part")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)


def _units() -> list[str]:
    """One comment per group of numbers, with the unit of each."""
    groups = {**MODELS, "uwb": UwbDevice, "faces": Face, "landmarks": Landmark}
    groups |= {"cameras": FixedCamera, "anchors": Anchor}
    lines = ["Units:"]
    for name, cls in groups.items():
        units = ", ".join(f"{key} [{spec.unit}]" for key, spec in number_specs(cls).items())
        lines += textwrap.wrap(f"{name}: {units}", 100, initial_indent="  ", subsequent_indent="      ")
    return lines


def _tree(swarm: Swarm, folder: Path) -> Mapping:
    """The content of a file in a folder."""
    types: Mapping = {}
    for robot in swarm.robots:
        if robot.type and robot.type not in types:
            alike = [_layer(other, folder) for other in swarm.robots if other.type == robot.type]
            types[robot.type] = _shared(alike)
    robots = {robot.name: _robot(robot, types.get(robot.type, {}), folder) for robot in swarm.robots}
    landmarks = {mark.id: _numbers(mark, keep=("x", "y")) for mark in swarm.landmarks}
    defaults = _taken_out(LANDMARK_DEFAULTS, list(landmarks.values()))
    anchors = [{"address": one.address, **_numbers(one, keep=("x", "y"))} for one in swarm.anchors]
    tree = {
        "fileversion": FILE_VERSION,
        "defaults": {"landmark": defaults} if defaults else {},
        "types": types,
        "robots": robots,
        "landmarks": landmarks,
        "cameras": {one.name: _fixed_camera(one) for one in swarm.cameras},
        "anchors": anchors,
        "map": None if swarm.map is None else relpath(swarm.map, folder),
    }
    return {key: value for key, value in tree.items() if value}


def _fixed_camera(camera: FixedCamera) -> Mapping:
    """A fixed camera."""
    sensor = _numbers(camera.sensor)
    return _numbers(camera, keep=("x", "y", "z")) | ({"sensor": sensor} if sensor else {})


def _taken_out(names: Iterable[str], entries: list[Mapping]) -> Mapping:
    """Those of the named values that all entries share, taken out of them."""
    shared = {name: entries[0][name] for name in names if entries and name in entries[0]}
    shared = {name: value for name, value in shared.items() if all(e.get(name) == value for e in entries)}
    for entry in entries:
        for name in shared:
            del entry[name]
    return shared


def _numbers(model: Any, keep: tuple[str, ...] = ()) -> Mapping:
    """The numbers of a dataclass that differ from its defaults."""
    values = asdict(model)
    defaults = {name: type(model).__dataclass_fields__[name].default for name in number_specs(type(model))}
    return {name: values[name] for name in defaults if values[name] != defaults[name] or name in keep}


def _layer(robot: Robot, folder: Path) -> Mapping:
    """Everything about a robot that a type can say, as far as it differs from the defaults."""
    layer: Mapping = {section: _numbers(getattr(robot, section)) for section in MODELS if section != "camera"}
    layer["response"] = {} if robot.response is None else _lists(robot.response)
    layer["camera"] = None if robot.camera is None else _numbers(robot.camera)
    if robot.stands:
        layer["odometry"] = None
    layer["ir"] = {} if robot.ir is None else ir_tree(robot.ir, folder)
    layer["uwb"] = {} if robot.uwb is None else _numbers(robot.uwb)
    layer["faces"] = {
        face.name: _numbers(face) | ({"lies": True} if face.lies else {}) for face in robot.faces
    }
    return layer


def _lists(response: MotionResponse) -> Mapping:
    """The table of a motion response."""
    return {name: _listed(value) for name, value in asdict(response).items()}


def _listed(value: Any) -> Any:
    """Tuples as lists, which YAML has."""
    return [_listed(item) for item in value] if isinstance(value, tuple) else value


def _shared(layers: list[Mapping]) -> Mapping:
    """What all robots of a type have in common; cameras and faces as a whole, the rest number by number."""
    shared: Mapping = {}
    for section, first in layers[0].items():
        if section in _WHOLE or any(layer[section] is None for layer in layers):
            if all(layer[section] == first for layer in layers):
                shared[section] = first
        else:
            shared[section] = {
                name: value
                for name, value in first.items()
                if all(layer[section].get(name) == value for layer in layers)
            }
    return {section: value for section, value in shared.items() if value != {}}


def _robot(robot: Robot, shared: Mapping, folder: Path) -> Mapping:
    """A robot without what its type says."""
    entry: Mapping = {"type": robot.type} if robot.type else {}
    for section, value in _layer(robot, folder).items():
        rest = value
        if section in shared:
            same = value == shared[section]
            whole = section in _WHOLE
            rest = {} if same or whole else {k: v for k, v in value.items() if k not in shared[section]}
        if rest != {}:
            entry[section] = rest
    if robot.ir is not None:
        entry["ir"] = {"id": robot.ir.id, **entry.get("ir", {})}
    if robot.uwb is not None:
        entry["uwb"] = {"address": robot.uwb.address, **entry.get("uwb", {})}
    if robot.faces:
        entry["ids"] = {face.name: face.id for face in robot.faces}
    if robot.start is not None:
        entry["start"] = dict(zip(("x", "y", "theta"), robot.start, strict=True))
    return entry
