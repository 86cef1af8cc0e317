"""Swarm descriptions: read `swarm.yaml` to a `Swarm`, and write one.

doc/swarm_description.md has an example with all sections. Numbers, units, ranges and defaults are those of
the classes in `swarm/swarm.py`. When a description is written, values common to all robots of a type are
written with the type.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Collection, Iterable, Mapping
from os.path import relpath
from pathlib import Path
from typing import Any

from swarm_loc_estimator.common.codec import WHOLE_FILE, Tree, TreeChecks, entry_specs, nearest, to_tree
from swarm_loc_estimator.common.parameters import ParameterError, UserError, number_specs, parameter_specs
from swarm_loc_estimator.common.yaml_tree import read_tree, write_tree
from swarm_loc_estimator.swarm import swarm as parts
from swarm_loc_estimator.swarm.calibration_states import ParameterTable
from swarm_loc_estimator.swarm.error_models import MotionResponse, OdometryModel
from swarm_loc_estimator.swarm.ir_board import IrPlatform, IrPlatformFileError, RobotIr, load_ir_platform
from swarm_loc_estimator.swarm.swarm import Landmark, Robot, Swarm

FILE_VERSION = 1
SCHEMA_FILE = "swarm.schema.json"  # Name of the schema next to a description
SCHEMA_COMMENT = f"yaml-language-server: $schema={SCHEMA_FILE}"
"""First comment of a description, by which editors find the schema."""

_SECTIONS = (
    *("fileversion", "defaults", "types", "robots", "landmarks", "cameras", "anchors", "map_error"),
    *("range_topic", "map", "topics", "localizer"),
)
_MODELS = ("odometry", "imu", "lidar", "random_walk", "camera", "sensor", "fix", "clock", "start_sigma")
LAYER = (
    *("odometry", "imu", "lidar", "random_walk", "response", "camera", "sensor", "fix", "clock", "ir"),
    *("uwb", "faces", "start_sigma"),
)
_ROBOT = ("type", *LAYER, "ids", "start")
MODELS: dict[str, type] = {name: type(getattr(Robot, name)) for name in _MODELS}
SECTIONS: dict[str, type] = {**MODELS, "ir": RobotIr, "uwb": parts.UwbDevice}
MAY_BE_NONE = ("odometry", "camera", "ir", "uwb")
OWN = ("id", "address", "name")  # Entries of sections that only a robot has
PLACED = ("x", "y")  # Entries that landmarks and anchors must have
START = {name: number_specs(Landmark)[name] for name in PLACED}
START["theta"] = number_specs(parts.CameraMount)["yaw"]
LANDMARK_DEFAULTS = {name: number_specs(Landmark)[name] for name in ("size", "position_sigma", "yaw_sigma")}
MOUNT = ("x", "y", "z", "yaw", "pitch", "roll")  # Numbers that transforms tell where no description does
MAX_ID = 2**32 - 1
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
RANGE_TOPIC = re.compile(r"/?(?:\w|\{from\}|\{to\})+(?:/(?:\w|\{from\}|\{to\})+)*")
ROBOT = "<robot>"  # Stands for the name of each robot in a topic
TOPIC = re.compile(r"/?(?:\w|<robot>)+(?:/(?:\w|<robot>)+)*")
MAX_NAME = 64  # Maximum length of a robot name; DDS limits the length of topic names
_RESERVED = (
    *("aerial", "clock", "diagnostics", "estimator", "map", "mapper", "odom", "parameter_events"),
    *("player", "rosout", "swarm", "tf", "tf_static", "visitation", "watch"),
)
RESERVED_NAMES = frozenset(_RESERVED)  # Of topics, nodes and frames; no robot may have them
MAX_ROBOTS = 5000  # Maximum number of robots; larger swarms have not been tested
MAX_PARAMETERS = 10_000  # States but the poses; the dense filter's covariance then has 800 MB per checkpoint


class SwarmFileError(UserError):
    """An invalid swarm description; the message is one sentence with file, key and value."""


def load_swarm(path: Path | str) -> Swarm:
    """Read and check a swarm description.

    Raises:
        SwarmFileError: One sentence with file, dotted key, value and what is allowed.
    """
    path = Path(path)
    return parse_swarm(read_tree(path, SwarmFileError), path)


def parse_swarm(tree: Tree, path: Path) -> Swarm:
    """Parse the content of a swarm description, see `load_swarm`; relative paths start at that of `path`."""
    return _Loader(path, SwarmFileError).swarm(tree)


Layer = dict[str, Any]  # Entries of a section or type, faces by name; None: null in the file


class _Loader(TreeChecks):
    """Converts the tree of one file to the dataclasses, and checks it."""

    def __init__(self, path: Path, error: type[ValueError]) -> None:
        super().__init__(path, error)
        self._folder = path.parent
        self._platforms: dict[str, IrPlatform] = {}

    def swarm(self, tree: Tree) -> Swarm:
        sections = self.mapping(tree, WHOLE_FILE, _SECTIONS)
        self.version(sections.get("fileversion"), FILE_VERSION)
        # what robots have in common, then the robots
        defaults = self._layer(sections.get("defaults", {}), "defaults", (*LAYER, "landmark"))
        kinds = self._named(sections.get("types", {}), "types")
        types = {name: self._layer(tree, f"types.{name}", LAYER) for name, tree in kinds}
        named = self._named(sections.get("robots", {}), "robots")
        if not named:
            raise self.said("robots is empty but must name at least one robot")
        if len(named) > MAX_ROBOTS:
            raise self.said(f"robots names {len(named)} robots but must name at most {MAX_ROBOTS}")
        robots = tuple(self._robot(name, tree, defaults, types) for name, tree in named)
        # what is fixed in map
        shared = self.mapping(sections.get("defaults", {}), "defaults").get("landmark", {})
        common, specs = self.values(shared, "defaults.landmark", LANDMARK_DEFAULTS), entry_specs(Landmark)
        places = self.mapping(sections.get("landmarks", {}), "landmarks")
        landmarks = tuple(
            Landmark(self._marker_id(number, key), **{**common, **self.values(place, key, specs, PLACED)})
            for number, place in places.items()
            for key in [f"landmarks.{number}"]
        )
        specs = entry_specs(parts.FixedCamera)
        cameras = tuple(
            parts.FixedCamera(name, **self.values(tree, f"cameras.{name}", specs, ("x", "y", "z")))
            for name, tree in self._named(sections.get("cameras", {}), "cameras")
        )
        specs, radios = entry_specs(parts.Anchor), sections.get("anchors")
        anchors = tuple(
            parts.Anchor(**self.values(tree, f"anchors[{k}]", specs, (*PLACED, "address")))
            for k, tree in enumerate(self.items([] if radios is None else radios, "anchors"))
        )
        shared = self.values(sections.get("map_error"), "map_error", entry_specs(parts.MapError))
        name = sections.get("map")
        if name is not None and (not isinstance(name, str) or not name):
            raise self.error("map", name, "must be the path of a map's .yaml file, from here, or topic")
        file = name if name in (None, parts.MAP_BY_TOPIC) else (self._folder / name).resolve()
        ranges = sections.get("range_topic")
        is_pattern = isinstance(ranges, str) and RANGE_TOPIC.fullmatch(ranges)
        if ranges is not None and not (is_pattern and ranges.count("{from}") == ranges.count("{to}") == 1):
            rule = "must be a topic with {from} and {to} once each, for names or addresses"
            raise self.error("range_topic", ranges, rule)
        # the swarm as a whole
        names = [one.name for one in robots] + [one.name for one in cameras]
        bodies = {"robots": robots, "landmarks": landmarks, "cameras": cameras, "anchors": anchors}
        swarm = self.made(
            "",
            Swarm,
            **bodies,
            map=file,
            range_topic=(ranges or "").lstrip("/"),
            topics=self._topics(sections.get("topics"), names, len(robots)),
            localizer=self._localizer(sections.get("localizer")),
            map_error=parts.MapError(**shared),
        )
        states = ParameterTable.of(swarm.robots, swarm.surveyed).filter_size - 3 * len(robots)
        if states > MAX_PARAMETERS:
            rule = f"must make at most {MAX_PARAMETERS}"
            raise self.said(f"what has a sigma makes {states} states beside the poses but {rule}")
        return swarm

    def _robot(self, name: str, tree: Tree, defaults: Layer, types: Mapping[str, Layer]) -> Robot:
        key = f"robots.{name}"
        mapping = self.mapping(tree, key, _ROBOT)
        type_name = mapping.get("type", "")
        if type_name not in (None, "") and (not isinstance(type_name, str) or type_name not in types):
            raise self.error(f"{key}.type", type_name, f"must be one of the types{nearest(type_name, types)}")
        own = self._layer(mapping, key, _ROBOT, of_robot=True)
        layers = [defaults, *([types[type_name]] if type_name else []), own]
        sections = {section: _merged(layers, section) for section in SECTIONS}
        models: Layer = {
            section: None
            if (values := sections[section]) is None
            else self.made(f"{key}.{section}.", cls, **values)
            for section, cls in MODELS.items()
        }
        start = mapping.get("start")
        if start is not None:  # else it is unknown
            pose = self.values(start, f"{key}.start", START, START)
            start = tuple(float(pose[axis]) for axis in START)
        uwb = sections["uwb"]
        if uwb:
            self.require(uwb, f"{key}.uwb", {"address": entry_specs(parts.UwbDevice)["address"]})
        return Robot(
            name=name,
            type=type_name or "",
            response=next((layer["response"] for layer in reversed(layers) if "response" in layer), None),
            faces=self._faces(key, layers, mapping.get("ids", {})),
            start=start,
            stands=models["odometry"] is None,
            ir=self._board(sections["ir"], f"{key}.ir"),
            uwb=parts.UwbDevice(**uwb) if uwb else None,
            said=frozenset(f"{name}.{key}" for name, values in sections.items() for key in values or ()),
            **{**models, "odometry": models["odometry"] or OdometryModel()},
        )

    def _layer(self, tree: Tree, key: str, known: Collection[str], *, of_robot: bool = False) -> Layer:
        mapping = self.mapping(tree, key, known)
        if isinstance(mapping.get("ir"), dict) and "estimator" in mapping["ir"]:
            gone = "is no longer an option: poses are always estimated by likelihood; remove it"
            raise self.said(f"{key}.ir.estimator {gone}")
        layer: Layer = {
            section: None
            if mapping[section] is None and section in MAY_BE_NONE
            else self.values(
                mapping[section], f"{key}.{section}", entry_specs(cls, without=() if of_robot else OWN)
            )
            for section, cls in SECTIONS.items()
            if section in mapping
        }
        if "platform" in (layer.get("ir") or {}):
            layer["ir"]["platform"] = self._platform(layer["ir"]["platform"], f"{key}.ir.platform")
        if "response" in mapping:  # null or a whole one: those of layers are not merged
            specs, tree = entry_specs(MotionResponse), mapping["response"]
            values = {} if tree is None else self.values(tree, f"{key}.response", specs, required=specs)
            layer["response"] = self.made(f"{key}.", MotionResponse, **values) if values else None
        faces = self._named(mapping.get("faces", {}), f"{key}.faces")
        layer["faces"] = {
            name: None if face is None else self.values(face, f"{key}.faces.{name}", entry_specs(parts.Face))
            for name, face in faces
        }
        return layer

    def _topics(self, tree: Tree, sources: Collection[str], robots: int) -> dict[str, str]:
        topics: dict[str, str] = {}
        for own, topic in self.mapping(tree, "topics").items():
            key, (source, _, name) = f"topics.{own}", str(own).partition("/")
            if source not in (ROBOT, *sources) or not name:
                raise self.said(f"{key} must begin with {ROBOT} or the name of a robot or camera, and /")
            if not isinstance(topic, str) or not TOPIC.fullmatch(topic):
                raise self.error(key, topic, f"must be a topic, in which {ROBOT} stands for each robot")
            if topic in topics.values() or (robots > 1 and source == ROBOT and ROBOT not in topic):
                raise self.error(key, topic, "must be the topic of only one robot")
            topics[own] = topic
        return topics

    def _localizer(self, tree: Tree) -> parts.Localizer | None:
        """Parse the localizer, whose keys are the parameters of `localizer_bridge`."""
        specs = {spec.name: spec for spec in parameter_specs(parts.Localizer)}
        given = self.mapping(tree, "localizer", specs)
        try:
            values: Layer = {name: specs[name].checked(value) for name, value in given.items()}
        except ParameterError as error:
            said = str(error).removeprefix("parameter ").removesuffix(".")
            raise self.said(f"localizer.{said}") from error
        return parts.Localizer(**values) if tree is not None else None

    def _board(self, values: Layer | None, key: str) -> RobotIr | None:
        """The infrared board of a robot from the merged values of its layers."""
        if not values:
            return None
        self.require(values, key, {name: entry_specs(RobotIr)[name] for name in ("platform", "id")})
        source = values["platform"]
        platform, gains = self._platforms[source], values.get("gains")
        if gains is not None and len(gains.sensor) != platform.n:
            rule = f"must have the {platform.n} of its platform"
            raise self.said(f"{key}.gains has {len(gains.sensor)} sensors and emitters but {rule}")
        for name in ("dead_sensors", "dead_emitters"):
            if wrong := [k for k in values.get(name, ()) if k >= platform.n]:
                rule = f"elements are numbered 0 to {platform.n - 1}"
                raise self.said(f"{key}.{name} has {wrong[0]} but {rule}")
        return RobotIr(**{**values, "platform": platform, "source": source})

    def _platform(self, name: str, key: str) -> str:
        """The source of a platform; also loads the platform."""
        source = str((self._folder / name).resolve()) if name.endswith((".yaml", ".yml")) else name
        try:
            self._platforms[source] = self._platforms.get(source) or load_ir_platform(source)
        except IrPlatformFileError as error:
            raise self.said(f"{key}: {str(error).removesuffix('.')}") from error
        return source

    def _faces(self, key: str, layers: Iterable[Layer], ids_tree: Tree) -> tuple[parts.Face, ...]:
        """Parse the robot's markers: poses from the layers, marker ids from the robot."""
        places: dict[str, Layer] = {}
        for layer in layers:
            for name, values in layer["faces"].items():
                if values is None:
                    places.pop(name, None)
                else:
                    places[name] = {**places.get(name, {}), **values}
        ids = self.mapping(ids_tree, f"{key}.ids", places)
        missing = [name for name in places if name not in ids]
        if missing:
            advice = f"give one or set faces.{missing[0]} to null"
            raise self.said(f"{key}.ids has no id for face '{missing[0]}'; {advice}")
        numbers = {name: self._marker_id(ids[name], f"{key}.ids.{name}") for name in places}
        return tuple(parts.Face(name, numbers[name], **values) for name, values in places.items())

    def _marker_id(self, value: Tree, key: str) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MAX_ID:
            raise self.error(key, value, f"must be a marker id, a whole number in [0, {MAX_ID}]")
        return value

    def _named(self, tree: Tree, key: str) -> list[tuple[str, Tree]]:
        """Parse a mapping whose keys are valid names for topics and frames."""
        mapping = self.mapping(tree, key)
        for name in mapping:
            if not isinstance(name, str) or not NAME.fullmatch(name):
                rule = "must be letters, digits and underscores and start with a letter"
                raise self.error(f"a name in {key}", name, rule)
            if len(name) > MAX_NAME:
                raise self.error(f"a name in {key}", name, f"must have at most {MAX_NAME} characters")
            if key in ("robots", "cameras") and name in RESERVED_NAMES:
                rule = f"must be none of {', '.join(sorted(RESERVED_NAMES))}"
                raise self.error(f"a name in {key}", name, f"{rule}, which topics, nodes and frames have")
        return list(mapping.items())


def _merged(layers: Iterable[Layer], section: str) -> Layer | None:
    """Merge the values of a section over layers; null removes it, and a later layer can restore it."""
    values: Layer | None = {}
    for layer in layers:
        if section in layer:
            said = layer[section]
            values = None if said is None else {**(values or {}), **said}
    return values


_WHOLE = frozenset({"camera", "faces", "response"})
_WRITTEN = (*(one for one in MODELS if one != "camera"), "response", "camera", "ir", "uwb", "faces")


def save_swarm(swarm: Swarm, path: Path | str, comment: str = "") -> None:
    """Write a swarm description that `load_swarm` reads back equal.

    Its first line names the JSON Schema if that lies next to it, so that editors complete its keys; lines of
    comment follow. An existing file is replaced, a missing folder created.

    Raises:
        SwarmFileError: It has numbers that `load_swarm` refuses; nothing is written.
    """
    path = Path(path)
    tree = _tree(swarm, path.parent)
    parse_swarm(tree, path)
    schema = [SCHEMA_COMMENT] if (path.parent / SCHEMA_FILE).is_file() else []
    # one comment per group of numbers, with the unit of each
    groups = {**MODELS, "uwb": parts.UwbDevice, "faces": parts.Face, "landmarks": Landmark}
    groups |= {"cameras": parts.FixedCamera, "anchors": parts.Anchor, "map_error": parts.MapError}
    units = ["Units:"]
    for name, cls in groups.items():
        said = ", ".join(f"{key} [{spec.unit}]" for key, spec in number_specs(cls).items())
        units += textwrap.wrap(f"{name}: {said}", 100, initial_indent="  ", subsequent_indent="      ")
    write_tree(tree, path, [*schema, *comment.splitlines(), *units])


def _tree(swarm: Swarm, folder: Path) -> Layer:
    types: Layer = {}
    for robot in swarm.robots:
        if robot.type and robot.type not in types:
            alike = [_layer(other, folder) for other in swarm.robots if other.type == robot.type]
            types[robot.type] = _shared(alike)
    # landmarks without what all of them have, and what is not as usual of a localizer
    landmarks = {mark.id: to_tree(mark, PLACED) for mark in swarm.landmarks}
    shared = _common([*landmarks.values()])
    defaults = {name: value for name, value in shared.items() if name in LANDMARK_DEFAULTS}
    usual, localizer = vars(parts.Localizer()), vars(swarm.localizer) if swarm.localizer else {}
    tree = {
        "fileversion": FILE_VERSION,
        "defaults": {"landmark": defaults} if defaults else {},
        "types": types,
        "robots": {robot.name: _robot(robot, types.get(robot.type, {}), folder) for robot in swarm.robots},
        "landmarks": {number: _without(defaults, mark) for number, mark in landmarks.items()},
        "cameras": {one.name: to_tree(one, ("x", "y", "z")) for one in swarm.cameras},
        "anchors": [to_tree(one, PLACED) for one in swarm.anchors],
        "map_error": to_tree(swarm.map_error),
        "range_topic": swarm.range_topic,
        "topics": dict(swarm.topics),
        "localizer": {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in localizer.items()
            if value != usual[name] or name == "source"
        },
        "map": relpath(swarm.map, folder) if isinstance(swarm.map, Path) else swarm.map,
    }
    return {key: value for key, value in tree.items() if value}


def _common(entries: list[Layer]) -> Layer:
    first = entries[0] if entries else {}
    return {name: value for name, value in first.items() if all(one.get(name) == value for one in entries)}


def _without(shared: Layer, entry: Layer) -> Layer:
    return {name: value for name, value in entry.items() if name not in shared}


def _layer(robot: Robot, folder: Path) -> Layer:
    """Everything about a robot that a type can say, as far as it differs from the defaults."""
    layer: Layer = {}
    for section in _WRITTEN:
        model = getattr(robot, section)
        said = [key for key in MOUNT if f"{section}.{key}" in robot.said]
        if section == "faces":
            layer[section] = {face.name: to_tree(face) for face in model}
        elif model is not None:
            layer[section] = to_tree(model, keep=said, without=(*OWN, "platform"))
        else:
            layer[section] = None if section == "camera" else {}
    if robot.stands:
        layer["odometry"] = None
    if robot.ir is not None:
        source = robot.ir.source
        source = relpath(source, folder.resolve()) if Path(source).is_absolute() else source
        layer["ir"] = {"platform": source, **layer["ir"]}
    return layer


def _shared(layers: list[Layer]) -> Layer:
    """What all robots of a type have in common; cameras and faces as a whole, the rest number by number."""
    shared: Layer = {}
    for section in layers[0]:
        values = [layer[section] for layer in layers]
        if section not in _WHOLE and None not in values:
            shared[section] = _common(values)
        elif all(value == values[0] for value in values):
            shared[section] = values[0]
    return {section: value for section, value in shared.items() if value != {}}


def _robot(robot: Robot, shared: Layer, folder: Path) -> Layer:
    entry: Layer = {"type": robot.type} if robot.type else {}
    for section, value in _layer(robot, folder).items():
        rest = value
        if section in shared:
            is_whole = section in _WHOLE or value == shared[section]
            rest = {} if is_whole else _without(shared[section], value)
        if rest != {}:
            entry[section] = rest
    if robot.ir is not None:
        entry["ir"] = {"id": robot.ir.id, **entry.get("ir", {})}
    if robot.uwb is not None:
        named = {"name": robot.uwb.name} if robot.uwb.name else {}
        entry["uwb"] = {"address": robot.uwb.address, **named, **entry.get("uwb", {})}
    if robot.faces:
        entry["ids"] = {face.name: face.id for face in robot.faces}
    if robot.start is not None:
        entry["start"] = dict(zip(START, robot.start, strict=True))
    return entry
