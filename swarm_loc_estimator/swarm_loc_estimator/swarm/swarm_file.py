"""Reader of swarm descriptions: `swarm.yaml` to `Swarm`.

```yaml
fileversion: 1
defaults:      # odometry, imu, lidar, random_walk, response, camera, sensor, fix, clock, ir, uwb, faces,
               # start_sigma
  sensor: {range_sigma: 0.1}
  landmark: {size: 0.06, position_sigma: 0.01, yaw_sigma: 0.02}  # without sigmas: surveyed exactly
types:
  epuck:                  # the same keys; what is not said comes from defaults
    odometry: {wheel_separation: 0.053}
    response:                               # null: all of the reported motion is true
      speeds: [0.0, 0.1]
      turn_rates: [0.0, 0.5, 1.0]
      speed_share: [[1.0, 0.9, 0.9], [1.0, 0.8, 0.7]]
      turn_share: [[1.0, 0.9, 0.9], [1.0, 0.9, 0.9]]
    camera: {x: 0.035, z: 0.028}            # null: it has none
    faces:                                  # markers on the body; null takes one away
      front: {x: 0.035, yaw: 0.0, size: 0.036, position_sigma: 0.001}
      top: {z: 0.1, yaw: 0.0, size: 0.05, lies: true}   # lies flat, its own right is forward
  droplet:
    odometry: null                          # null: it has none, and stands where it is
    random_walk: {position: 1e-4, heading: 0.05}   # or moves, nobody knows where to
    camera: null
    ir:                                     # its infrared board; null: it has none
      platform: droplet                     # a packaged one, or the path of a file, from here
robots:
  epuck1:                 # the same keys; what is not said comes from its type
    type: epuck
    ids: {front: 12, top: 13}   # which marker is on which face
    start: {x: 0.0, y: 0.0, theta: 0.0}     # null or left out: unknown
  droplet1:
    type: droplet
    ir:
      id: 0x6B6F          # by which exchanges name it
      gains: {sensor: [1, 1, 1, 1, 1, 1], emitter: [1, 1, 1, 1, 1, 1]}   # null or left out: never calibrated
landmarks:
  100: {x: 1.2, y: -0.4, yaw: 3.14159, size: 0.05}      # yaw null or left out: shows no heading
cameras:                  # fixed ones, which see markers on robots
  ceiling1: {x: -1.0, y: 0.5, z: 2.5, position_sigma: 0.001, sensor: {residual_position_sigma: 0.001}}
anchors:                  # UWB radios, see doc/uwb.md
  - {address: 0x10, x: 0.0, y: 5.0, z: 2.1}
map: floor.yaml           # walls that lidars see, as of map_server, from here; null or left out: none
```
Numbers, units, ranges and defaults are those of the classes in `swarm/swarm.py`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from swarm_loc_estimator.common.parameters import UserError, number_specs
from swarm_loc_estimator.common.yaml_tree import Tree, YamlTreeError, read_tree
from swarm_loc_estimator.swarm.board_file import IrSection, Values
from swarm_loc_estimator.swarm.calibration_states import ParameterTable
from swarm_loc_estimator.swarm.error_models import (
    ClockModel,
    FixModel,
    ImuModel,
    LidarModel,
    MotionResponse,
    MotionResponseError,
    OdometryModel,
    RandomWalk,
    SensorModel,
)
from swarm_loc_estimator.swarm.swarm import (
    CameraMount,
    Face,
    FixedCamera,
    Landmark,
    Pose2,
    Robot,
    StartSigma,
    Swarm,
    SwarmError,
    read_anchors,
    uwb_device,
    uwb_layer,
)
from swarm_loc_estimator.swarm.tree_checks import Numbers, TreeChecks, nearest

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping

FILE_VERSION = 1

_SECTIONS = ("fileversion", "defaults", "types", "robots", "landmarks", "cameras", "anchors", "map")
LAYER = (
    *("odometry", "imu", "lidar", "random_walk", "response", "camera", "sensor", "fix", "clock", "ir"),
    *("uwb", "faces", "start_sigma"),
)
_DEFAULTS = (*LAYER, "landmark")
_ROBOT = ("type", *LAYER, "ids", "start")
MODELS: dict[str, type] = {
    "odometry": OdometryModel,
    "imu": ImuModel,
    "lidar": LidarModel,
    "random_walk": RandomWalk,
    "camera": CameraMount,
    "sensor": SensorModel,
    "fix": FixModel,
    "clock": ClockModel,
    "start_sigma": StartSigma,
}
MAY_BE_NONE = ("odometry", "camera")
START = {
    "x": number_specs(Landmark)["x"],
    "y": number_specs(Landmark)["y"],
    "theta": number_specs(CameraMount)["yaw"],
}
LANDMARK_DEFAULTS = {name: number_specs(Landmark)[name] for name in ("size", "position_sigma", "yaw_sigma")}
RESPONSE = ("speeds", "turn_rates", "speed_share", "turn_share")
MAX_ID = 2**32 - 1
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
MAX_NAME = 64  # Maximum length of a robot name; DDS limits the length of topic names
RESERVED_NAMES = frozenset(
    [
        "aerial",
        "clock",
        "diagnostics",
        "estimator",
        "map",
        "mapper",
        "odom",
        "parameter_events",
        "player",
        "rosout",
        "swarm",
        "tf",
        "tf_static",
        "visitation",
        "watch",
    ]
)
"""Names of topics, nodes and frames that a robot's namespace must not collide with."""
MAX_ROBOTS = 5000  # Maximum number of robots; larger swarms have not been tested
MAX_PARAMETERS = 10_000
"""Maximum number of states beside the poses; the dense filter's covariance then has 800 MB per checkpoint."""


class SwarmFileError(UserError):
    """An invalid swarm description; the message is one sentence with file, key and value."""


def load_swarm(path: Path | str) -> Swarm:
    """Read and check a swarm description.

    Args:
        path: The file.

    Raises:
        SwarmFileError: One sentence with file, dotted key, value and what is allowed.
    """
    path = Path(path)
    try:
        tree = read_tree(path)
    except YamlTreeError as error:
        raise SwarmFileError(str(error)) from error
    return parse_swarm(tree, path)


def parse_swarm(tree: Tree, path: Path) -> Swarm:
    """Parse the content of a swarm description, see `load_swarm`; relative paths start at that of `path`."""
    return _Loader(path, SwarmFileError).swarm(tree)


@dataclass
class _Layer:
    """Settings of one layer: defaults, type or robot; keys that the layer omits are omitted here."""

    sections: dict[str, Values | None]  # Values by section; None: null in the file
    response: MotionResponse | None  # Motion response of the layer
    says_response: bool  # True if the layer has the key `response`
    faces: dict[str, Numbers | None]  # Face by name; None: removed


class _Loader(TreeChecks):
    """Converts the tree of one file to the dataclasses, and checks it."""

    def __init__(self, path: Path, error: type[ValueError]) -> None:
        super().__init__(path, error)
        self._ir, self._folder = IrSection(self, path.parent), path.parent

    def swarm(self, tree: Tree) -> Swarm:
        """Parse the whole file."""
        sections = self.mapping(tree, "the file", _SECTIONS)
        version = sections.get("fileversion")
        if version != FILE_VERSION or isinstance(version, bool):
            raise self.error("fileversion", version, f"must be {FILE_VERSION}")
        defaults = self._layer(sections.get("defaults", {}), "defaults", _DEFAULTS)
        types = {
            name: self._layer(tree, f"types.{name}", LAYER)
            for name, tree in self._named(sections.get("types", {}), "types")
        }
        named = self._named(sections.get("robots", {}), "robots")
        if not named:
            raise self.said("robots is empty but must name at least one robot")
        if len(named) > MAX_ROBOTS:
            raise self.said(f"robots names {len(named)} robots but must name at most {MAX_ROBOTS}")
        robots = tuple(self._robot(name, tree, defaults, types) for name, tree in named)
        landmarks = self._landmarks(sections.get("landmarks", {}), sections.get("defaults", {}))
        fixed = self._named(sections.get("cameras", {}), "cameras")
        cameras = tuple(self._fixed_camera(name, tree) for name, tree in fixed)
        anchors = read_anchors(self, sections.get("anchors"))
        try:
            swarm = Swarm(robots, landmarks, cameras, anchors, self._map(sections.get("map")))
        except SwarmError as error:
            raise self.said(str(error).removesuffix(".")) from error
        states = ParameterTable.of(swarm.robots, swarm.surveyed).filter_size - 3 * len(robots)
        if states > MAX_PARAMETERS:
            raise self.said(
                f"what has a sigma makes {states} states beside the poses"
                f" but must make at most {MAX_PARAMETERS}"
            )
        return swarm

    def _map(self, name: Tree) -> Path | None:
        """Parse the path of a map."""
        if name is not None and (not isinstance(name, str) or not name):
            raise self.error("map", name, "must be the path of a map's .yaml file, from here")
        return None if name is None else (self._folder / name).resolve()

    def _robot(self, name: str, tree: Tree, defaults: _Layer, types: Mapping[str, _Layer]) -> Robot:
        """Parse one robot from its three layers."""
        key = f"robots.{name}"
        mapping = self.mapping(tree, key, _ROBOT)
        type_name = mapping.get("type", "")
        if type_name not in (None, "") and (not isinstance(type_name, str) or type_name not in types):
            raise self.error(f"{key}.type", type_name, f"must be one of the types{nearest(type_name, types)}")
        own = self._layer(mapping, key, _ROBOT, of_robot=True)
        layers = [defaults, *([types[type_name]] if type_name else []), own]
        sections = {section: _said(layers, section) for section in (*MODELS, "ir", "uwb")}
        models: dict[str, Any] = {
            section: None if (values := sections[section]) is None else cls(**values)
            for section, cls in MODELS.items()
        }
        return Robot(
            name=name,
            type=type_name or "",
            response=next((layer.response for layer in reversed(layers) if layer.says_response), None),
            faces=self._faces(key, layers, mapping.get("ids", {})),
            start=self._start(mapping.get("start"), f"{key}.start"),
            stands=models["odometry"] is None,
            ir=self._ir.board(sections["ir"], f"{key}.ir"),
            uwb=uwb_device(self, sections["uwb"], f"{key}.uwb"),
            **{**models, "odometry": models["odometry"] or OdometryModel()},
        )

    def _layer(self, tree: Tree, key: str, known: Collection[str], *, of_robot: bool = False) -> _Layer:
        """Parse the settings of one layer."""
        mapping = self.mapping(tree, key, known)
        sections: dict[str, Values | None] = {
            section: None
            if mapping[section] is None and section in MAY_BE_NONE
            else self.numbers(mapping[section], f"{key}.{section}", number_specs(cls))
            for section, cls in MODELS.items()
            if section in mapping
        }
        if "ir" in mapping:
            sections["ir"] = self._ir.layer(mapping["ir"], f"{key}.ir", of_robot=of_robot)
        if "uwb" in mapping:
            sections["uwb"] = uwb_layer(self, mapping["uwb"], f"{key}.uwb", of_robot=of_robot)
        faces = self._named(mapping.get("faces", {}), f"{key}.faces")
        return _Layer(
            sections,
            self._response(mapping.get("response"), f"{key}.response"),
            "response" in mapping,
            {name: None if face is None else self._face(face, f"{key}.faces.{name}") for name, face in faces},
        )

    def _face(self, tree: Tree, key: str) -> Numbers:
        """Parse the place of a marker on a robot."""
        specs = number_specs(Face)
        place = self.numbers(tree, key, specs, others=("lies",))
        if "lies" in self.mapping(tree, key):
            if not isinstance(tree["lies"], bool):
                raise self.error(f"{key}.lies", tree["lies"], "must be true or false")
            place["lies"] = tree["lies"]
        return place

    def _fixed_camera(self, name: str, tree: Tree) -> FixedCamera:
        """Parse one fixed camera."""
        key, specs = f"cameras.{name}", number_specs(FixedCamera)
        pose: Any = self.numbers(tree, key, specs, ("x", "y", "z"), ("sensor",))
        sensor: Any = self.numbers(tree.get("sensor"), f"{key}.sensor", number_specs(SensorModel))
        return FixedCamera(name, **pose, sensor=SensorModel(**sensor))

    def _response(self, tree: Tree, key: str) -> MotionResponse | None:
        """Parse a motion response or null; layers are not merged."""
        if tree is None:
            return None
        mapping = self.mapping(tree, key, RESPONSE)
        for name in RESPONSE:
            if name not in mapping:
                raise self.said(f"{key} lacks {name}, a list of numbers")
        axes = {
            name: self.list_of_numbers(mapping[name], f"{key}.{name}") for name in ("speeds", "turn_rates")
        }
        tables = {
            name: tuple(
                self.list_of_numbers(row, f"{key}.{name}[{index}]")
                for index, row in enumerate(self.items(mapping[name], f"{key}.{name}"))
            )
            for name in ("speed_share", "turn_share")
        }
        try:
            return MotionResponse(
                axes["speeds"], axes["turn_rates"], tables["speed_share"], tables["turn_share"]
            )
        except MotionResponseError as error:
            raise self.said(f"{key.removesuffix('response')}{error}".removesuffix(".")) from error

    def _faces(self, key: str, layers: Iterable[_Layer], ids_tree: Tree) -> tuple[Face, ...]:
        """Parse the robot's markers: poses from the layers, marker ids from the robot."""
        places: dict[str, Numbers] = {}
        for layer in layers:
            for name, numbers in layer.faces.items():
                if numbers is None:
                    places.pop(name, None)
                else:
                    places[name] = {**places.get(name, {}), **numbers}
        ids = self.mapping(ids_tree, f"{key}.ids", places)
        missing = [name for name in places if name not in ids]
        if missing:
            raise self.said(
                f"{key}.ids has no id for face '{missing[0]}'; give one or set faces.{missing[0]} to null"
            )
        return tuple(
            Face(name, self._marker_id(ids[name], f"{key}.ids.{name}"), **numbers)  # type: ignore[arg-type]
            for name, numbers in places.items()
        )

    def _landmarks(self, tree: Tree, defaults: Tree) -> tuple[Landmark, ...]:
        """Parse all landmarks, in the order of the file."""
        shared_tree = self.mapping(defaults, "defaults").get("landmark", {})
        shared = self.numbers(shared_tree, "defaults.landmark", LANDMARK_DEFAULTS)
        result = []
        for number, place in self.mapping(tree, "landmarks").items():
            key = f"landmarks.{number}"
            numbers = self.numbers(place, key, number_specs(Landmark), required=("x", "y"))
            result.append(Landmark(self._marker_id(number, key), **{**shared, **numbers}))  # type: ignore[arg-type]
        return tuple(result)

    def _start(self, tree: Tree, key: str) -> Pose2 | None:
        """Parse a start pose; None if it is unknown."""
        if tree is None:
            return None
        numbers = self.numbers(tree, key, START, required=tuple(START))
        return (float(numbers["x"] or 0.0), float(numbers["y"] or 0.0), float(numbers["theta"] or 0.0))

    def _marker_id(self, value: Tree, key: str) -> int:
        """Parse a marker id."""
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MAX_ID:
            raise self.error(key, value, f"must be a marker id, a whole number in [0, {MAX_ID}]")
        return value

    def _named(self, tree: Tree, key: str) -> list[tuple[str, Tree]]:
        """Parse a mapping whose keys are valid names for topics and frames."""
        mapping = self.mapping(tree, key)
        for name in mapping:
            if not isinstance(name, str) or not NAME.fullmatch(name):
                raise self.error(
                    f"a name in {key}",
                    name,
                    "must be letters, digits and underscores and start with a letter",
                )
            if len(name) > MAX_NAME:
                raise self.error(f"a name in {key}", name, f"must have at most {MAX_NAME} characters")
            if key in ("robots", "cameras") and name in RESERVED_NAMES:
                rule = ", ".join(sorted(RESERVED_NAMES))
                rule = f"must be none of {rule}, which topics, nodes and frames have"
                raise self.error(f"a name in {key}", name, rule)
        return list(mapping.items())


def _said(layers: Iterable[_Layer], section: str) -> Values | None:
    """Merge the values of a section over layers; null removes it, and a later layer can restore it."""
    values: Values | None = {}
    for layer in layers:
        if section in layer.sections:
            said = layer.sections[section]
            values = None if said is None else {**(values or {}), **said}
    return values
