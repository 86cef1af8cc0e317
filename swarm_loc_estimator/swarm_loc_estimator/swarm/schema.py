"""JSON Schema of swarm descriptions, from which editors complete and check `swarm.yaml`."""

from __future__ import annotations

import json
from typing import Any

from swarm_loc_estimator.common.codec import Schema, entry_specs, properties
from swarm_loc_estimator.common.parameters import parameter_specs
from swarm_loc_estimator.swarm import swarm_file as file
from swarm_loc_estimator.swarm.error_models import MotionResponse
from swarm_loc_estimator.swarm.swarm import Anchor, Face, FixedCamera, Landmark, Localizer, MapError

_PATTERN = f"^{file.NAME.pattern}$"  # Of names
_SAID = {"ir": "infrared board; null: none", "uwb": "radio; null: none"}


def schema_text() -> str:
    """The schema as the content of a file."""
    return json.dumps(swarm_schema(), indent=1) + "\n"


def swarm_schema() -> Schema:
    """The schema, of draft 7: what `load_swarm` accepts, but for rules on several entries at once."""
    # a robot
    of_robot = {name: {"$ref": f"#/definitions/{name}"} for name in file.LAYER}
    marker_id = {"type": "integer", "minimum": 0, "maximum": file.MAX_ID, "description": "marker id"}
    robot = {
        "type": {"type": ["string", "null"], "description": "one of types"},
        **of_robot,
        **{name: _section(said, _of_class(file.SECTIONS[name])) for name, said in _SAID.items()},
        "ids": _section("marker id of each face", named={_PATTERN: marker_id}),
        "start": _section("start pose in map; null: unknown", properties(file.START), required=file.START),
    }
    # what is fixed in map
    landmark = _section("marker with a fixed pose", _of_class(Landmark), required=file.PLACED)
    shared = _section("what landmarks have where they say nothing else", properties(file.LANDMARK_DEFAULTS))
    camera = _section("camera with a fixed pose", _of_class(FixedCamera), required=("x", "y", "z"))
    anchor = _section("radio at a fixed place", _of_class(Anchor), required=("address", *file.PLACED))
    landmark["type"] = camera["type"] = anchor["type"] = "object"
    # a localizer, whose values are checked when they are read, and the whole file
    types = {str: "string", bool: "boolean", float: "number", tuple: "array"}
    localizer = {
        one.name: {"type": types[type(one.default)], "description": one.doc}
        for one in parameter_specs(Localizer)
    }
    names = {"maxLength": file.MAX_NAME}
    free_names = {**names, "not": {"enum": sorted(file.RESERVED_NAMES)}}
    bounds: Schema = {"type": "object", "minProperties": 1, "maxProperties": file.MAX_ROBOTS}
    robots = {_PATTERN: _section("a robot", robot)}
    # what defaults, types and robots may say alike
    definitions: Schema = {}
    for name, cls in file.MODELS.items():
        first = (cls.__doc__ or "").partition("\n")[0].rstrip(".")
        none = "; null: none" if name in ("odometry", "camera") else ""
        definitions[name] = _section(f"{first}{none}", _of_class(cls))
    response, faces = _of_class(MotionResponse), {_PATTERN: _section("a marker", _of_class(Face))}
    definitions |= {
        "response": _section("ratios of true to reported motion", response, required=response),
        "faces": _section("markers on the body", named=faces, propertyNames=names),
        **{name: _section(said, _of_class(file.SECTIONS[name], file.OWN)) for name, said in _SAID.items()},
    }
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "Description of a robot swarm",
        "type": "object",
        "additionalProperties": False,
        "required": ["fileversion", "robots"],
        "properties": {
            "fileversion": {"const": file.FILE_VERSION, "description": "version of this format"},
            "defaults": _section(
                "what robots have where neither they nor their types say anything else",
                {**of_robot, "landmark": shared},
            ),
            "types": _section(
                "types of robots", named={_PATTERN: _section("a type", of_robot)}, propertyNames=names
            ),
            "robots": _section("the robots", named=robots, **bounds, propertyNames=free_names),
            "landmarks": _section("static markers, by marker id", named={"^[0-9]+$": landmark}),
            "cameras": _section("fixed cameras", named={_PATTERN: camera}, propertyNames=free_names),
            "anchors": {"type": ["array", "null"], "items": anchor, "description": "fixed radios"},
            "map_error": _section("error that all places with a sigma share", _of_class(MapError)),
            "range_topic": {"type": ["string", "null"], "description": "topic of the ranges of two radios"},
            "topics": {"type": ["object", "null"], "additionalProperties": {"type": "string"}},
            "localizer": _section("motion capture or another localizer", localizer),
            "map": {"type": ["string", "null"], "minLength": 1, "description": "map's .yaml; null: none"},
        },
        "definitions": definitions,
    }


def _section(
    said: str, known: Schema | None = None, *, named: Schema | None = None, required: Any = (), **others: Any
) -> Schema:
    """A mapping, or null: of known keys, or of names that match a pattern; `others` are further entries."""
    section: Schema = {"description": said, "type": ["object", "null"], "additionalProperties": False}
    section |= {"properties": known} if known else {}
    section |= {"patternProperties": named} if named else {}
    return section | ({"required": list(required)} if required else {}) | others


def _of_class(cls: type, without: tuple[str, ...] = ()) -> Schema:
    return properties(entry_specs(cls, without), cls)
