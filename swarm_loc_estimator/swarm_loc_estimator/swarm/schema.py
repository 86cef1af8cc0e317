"""JSON Schema of swarm descriptions, from which editors complete and check `swarm.yaml`."""

from __future__ import annotations

import json
from collections.abc import Iterable

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
    """The schema, of draft 7: what `load_swarm` accepts, but for rules on several entries at once.

    Those are that marker ids are unique, that types and faces exist, and the sizes of tables.
    """
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
    # the whole file
    names = {"maxLength": file.MAX_NAME}
    free_names = {**names, "not": {"enum": sorted(file.RESERVED_NAMES)}}
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
            "types": {
                **_section("types of robots", named={_PATTERN: _section("a type", of_robot)}),
                "propertyNames": names,
            },
            "robots": {
                **_section("the robots", named={_PATTERN: _section("a robot", robot)}),
                "type": "object",
                "minProperties": 1,
                "maxProperties": file.MAX_ROBOTS,
                "propertyNames": free_names,
            },
            "landmarks": _section("static markers, by marker id", named={"^[0-9]+$": landmark}),
            "cameras": {**_section("fixed cameras", named={_PATTERN: camera}), "propertyNames": free_names},
            "anchors": {"type": ["array", "null"], "items": anchor, "description": "fixed radios"},
            "map_error": _section("error that all places with a sigma share", _of_class(MapError)),
            "range_topic": {"type": ["string", "null"], "description": "topic of the ranges of two radios"},
            "topics": {"type": ["object", "null"], "additionalProperties": {"type": "string"}},
            "localizer": _section("motion capture or another localizer", _localizer()),
            "map": {"type": ["string", "null"], "minLength": 1, "description": "map's .yaml; null: none"},
        },
        "definitions": _definitions(),
    }


def _definitions() -> Schema:
    """What defaults, types and robots may say alike."""
    found = {}
    for name, cls in file.MODELS.items():
        first = (cls.__doc__ or "").partition("\n")[0].rstrip(".")
        none = "; null: none" if name in ("odometry", "camera") else ""
        found[name] = _section(f"{first}{none}", _of_class(cls))
    response, face = _of_class(MotionResponse), _section("a marker", _of_class(Face))
    faces = _section("markers on the body", named={_PATTERN: face})
    return {
        **found,
        "response": _section("ratios of true to reported motion", response, required=response),
        "faces": {**faces, "propertyNames": {"maxLength": file.MAX_NAME}},
        **{name: _section(said, _of_class(file.SECTIONS[name], file.OWN)) for name, said in _SAID.items()},
    }


def _localizer() -> Schema:
    """The keys of a localizer, which are checked when they are read."""
    types = {str: "string", bool: "boolean", float: "number", tuple: "array"}
    specs = parameter_specs(Localizer)
    return {one.name: {"type": types[type(one.default)], "description": one.doc} for one in specs}


def _section(
    said: str, known: Schema | None = None, *, named: Schema | None = None, required: Iterable[str] = ()
) -> Schema:
    """A mapping, or null: of known keys, or of names that match a pattern."""
    section: Schema = {"description": said, "type": ["object", "null"], "additionalProperties": False}
    return (
        section
        | ({"properties": known} if known else {})
        | ({"patternProperties": named} if named else {})
        | ({"required": list(required)} if required else {})
    )


def _of_class(cls: type, without: tuple[str, ...] = ()) -> Schema:
    return properties(entry_specs(cls, without), cls)
