"""JSON Schema of swarm descriptions, from which editors complete and check `swarm.yaml`."""

from __future__ import annotations

import json
from dataclasses import fields
from typing import Any

from swarm_loc_estimator.common.parameters import NumberSpec, number_specs
from swarm_loc_estimator.common.yaml_tree import hexadecimal
from swarm_loc_estimator.swarm.ir_board import GAIN_RANGE, MAX_BOARD_ID, IrGains, RobotIr, packaged_platforms
from swarm_loc_estimator.swarm.swarm import Anchor, Face, FixedCamera, Landmark, UwbDevice
from swarm_loc_estimator.swarm.swarm_file import (
    FILE_VERSION,
    LANDMARK_DEFAULTS,
    LAYER,
    MAX_ADDRESS,
    MAX_ID,
    MAX_NAME,
    MAX_ROBOTS,
    MAY_BE_NONE,
    MODELS,
    NAME,
    RESERVED_NAMES,
    RESPONSE,
    START,
)

Schema = dict[str, Any]
_PATTERN = f"^{NAME.pattern}$"  # Of names


def schema_text() -> str:
    """The schema as the content of a file."""
    return json.dumps(swarm_schema(), indent=1) + "\n"


def swarm_schema() -> Schema:
    """The schema, of draft 7: what `load_swarm` accepts, but for rules on several entries at once.

    Those are that marker ids are unique, that types and faces exist, and the sizes of tables.
    """
    # a robot
    radio = _address(MAX_ADDRESS, "address in messages")
    of_robot = {name: {"$ref": f"#/definitions/{name}"} for name in LAYER}
    robot = {
        "type": {"type": ["string", "null"], "description": "one of types"},
        **of_robot,
        "ir": _section(
            "infrared board; null: none", {"id": _address(MAX_BOARD_ID, "id in exchanges"), **_board()}
        ),
        "uwb": _section("radio; null: none", {"address": radio, **_of_class(UwbDevice)}),
        "ids": _section("marker id of each face", named={_PATTERN: _whole(0, MAX_ID, "marker id")}),
        "start": _section("start pose in map; null: unknown", _numbers(START), required=list(START)),
    }
    # what is fixed in map
    landmark = _section("marker with a fixed pose", _of_class(Landmark), required=["x", "y"])
    landmark["type"] = "object"
    shared = _section("what landmarks have where they say nothing else", _numbers(LANDMARK_DEFAULTS))
    camera = {**_of_class(FixedCamera), "sensor": {"$ref": "#/definitions/sensor"}}
    camera = _section("camera with a fixed pose", camera, required=["x", "y", "z"])
    anchor = {"address": radio, **_of_class(Anchor)}
    anchor = _section("radio at a fixed place", anchor, required=["address", "x", "y"])
    camera["type"] = anchor["type"] = "object"
    # the whole file
    names = {"maxLength": MAX_NAME}
    free_names = {**names, "not": {"enum": sorted(RESERVED_NAMES)}}
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "Description of a robot swarm",
        "type": "object",
        "additionalProperties": False,
        "required": ["fileversion", "robots"],
        "properties": {
            "fileversion": {"const": FILE_VERSION, "description": "version of this format"},
            "defaults": _section(
                "what robots have where neither they nor their types say anything else",
                {**of_robot, "landmark": shared},
            ),
            "types": {
                **_section("types of robots", named={_PATTERN: _section("a type", of_robot)}),
                "propertyNames": names,
            },
            "robots": {
                **_section("the robots", named={_PATTERN: _section("a robot", robot)}),
                "type": "object",
                "minProperties": 1,
                "maxProperties": MAX_ROBOTS,
                "propertyNames": free_names,
            },
            "landmarks": _section("static markers, by marker id", named={"^[0-9]+$": landmark}),
            "cameras": {**_section("fixed cameras", named={_PATTERN: camera}), "propertyNames": free_names},
            "anchors": {"type": ["array", "null"], "items": anchor, "description": "fixed radios"},
            "range_topic": {"type": ["string", "null"], "description": "topic of the ranges of two radios"},
            "map": {"type": ["string", "null"], "minLength": 1, "description": "map's .yaml; null: none"},
        },
        "definitions": {**{name: _model(name) for name in MODELS}, **_other_sections()},
    }


def _other_sections() -> Schema:
    """Sections that are not only numbers."""
    numbers = {"type": "array", "items": {"type": "number"}}
    lists = dict(zip(RESPONSE, (numbers, numbers, *[{"type": "array", "items": numbers}] * 2), strict=True))
    lies = {"type": "boolean", "description": "lies flat and looks up", "default": False}
    face = _section("a marker", {**_of_class(Face), "lies": lies})
    return {
        "response": _section("ratios of true to reported motion", lists, required=list(RESPONSE)),
        "faces": {
            **_section("markers on the body", named={_PATTERN: face}),
            "propertyNames": {"maxLength": MAX_NAME},
        },
        "ir": _section("infrared board; null: none", _board()),
        "uwb": _section("radio; null: none", _of_class(UwbDevice)),
    }


def _address(high: int, said: str) -> Schema:
    """The address of a radio or id of a board, decimal or in hexadecimal."""
    return {"anyOf": [_whole(1, high, said), {"type": "string", "pattern": f"^{hexadecimal(high)}$"}]}


def _model(name: str) -> Schema:
    first = (MODELS[name].__doc__ or "").partition("\n")[0].rstrip(".")
    none = "; null: none" if name in MAY_BE_NONE else ""
    return _section(f"{first}{none}", _of_class(MODELS[name]))


def _board() -> Schema:
    """The entries of an infrared board, but for its id."""
    low, high = GAIN_RANGE
    factors = {"type": "array", "items": {"type": "number", "minimum": low, "maximum": high}}
    elements = {"type": "array", "items": {"type": "integer", "minimum": 0}}
    gains = {"sensor": factors, "emitter": factors, **_of_class(IrGains)}
    platforms = f"one of {', '.join(packaged_platforms())}, or the path of a file"
    return {
        "platform": {"type": "string", "description": platforms},
        "gains": _section("factors of the elements", gains, required=["sensor", "emitter"]),
        "dead_sensors": {**elements, "description": "sensors to ignore"},
        "dead_emitters": {**elements, "description": "emitters to ignore"},
        **_of_class(RobotIr),
    }


def _section(
    said: str, known: Schema | None = None, *, named: Schema | None = None, required: list[str] | None = None
) -> Schema:
    """A mapping, or null: of known keys, or of names that match a pattern."""
    section: Schema = {"description": said, "type": ["object", "null"], "additionalProperties": False}
    return (
        section
        | ({"properties": known} if known else {})
        | ({"patternProperties": named} if named else {})
        | ({"required": required} if required else {})
    )


def _whole(low: int, high: int, said: str) -> Schema:
    return {"type": "integer", "minimum": low, "maximum": high, "description": said}


def _of_class(cls: type) -> Schema:
    """The numbers of a dataclass, with their defaults."""
    defaults = {one.name: one.default for one in fields(cls)}
    return {name: {**one, "default": defaults[name]} for name, one in _numbers(number_specs(cls)).items()}


def _numbers(specs: dict[str, NumberSpec]) -> Schema:
    return {
        name: {
            "type": ["number", "null"] if spec.optional else "number",
            "exclusiveMinimum" if spec.above else "minimum": spec.low,
            "maximum": spec.high,
            "description": f"{spec.doc}{'' if spec.unit == '1' else f' [{spec.unit}]'}",
        }
        for name, spec in specs.items()
    }
