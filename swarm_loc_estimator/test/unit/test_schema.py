"""The JSON Schema of swarm descriptions accepts and refuses what `load_swarm` does."""

import json
import re
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest

from swarm_loc_estimator.cli import schema as command
from swarm_loc_estimator.common.parameters import number_specs
from swarm_loc_estimator.common.yaml_tree import read_tree
from swarm_loc_estimator.swarm import swarm_file
from swarm_loc_estimator.swarm.schema import schema_text, swarm_schema
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import (
    MODELS,
    SCHEMA_FILE,
    SwarmFileError,
    load_swarm,
    parse_swarm,
    save_swarm,
)

ROOT = Path(__file__).parents[3]
WRITTEN = ROOT / "swarm_loc_estimator" / "doc" / SCHEMA_FILE
EXAMPLES = sorted(path for path in (ROOT / "bags").glob("*/*.yaml") if "fileversion" in path.read_text())
EXAMPLES = [path for path in EXAMPLES if "robots:" in path.read_text(encoding="utf-8")]
TYPES: dict[str, type] = {"object": dict, "array": list, "string": str, "boolean": bool, "null": type(None)}
WHOLE = {
    "fileversion": 1,
    "defaults": {"sensor": {"range_sigma": 0.1}, "landmark": {"size": 0.06}},
    "types": {
        "epuck": {
            "odometry": {"wheel_separation": 0.053},
            "response": {"speeds": [0], "turn_rates": [0], "speed_share": [[1]], "turn_share": [[1]]},
            "camera": {"x": 0.035},
            "faces": {"front": {"x": 0.035, "yaw": None}, "back": None, "top": {"z": 0.1, "lies": True}},
            "imu": {"turn_noise_density": 1e-3},
            "uwb": {"x": 0.1},
        },
        "droplet": {"odometry": None, "camera": None, "ir": {"platform": "droplet", "dead_sensors": [1]}},
    },
    "robots": {
        "epuck1": {
            "type": "epuck",
            "ids": {"front": 12, "top": 13},
            "start": {"x": 0.0, "y": 0.0, "theta": 0.0},
            "uwb": {"address": "0x1F"},
        },
        "droplet1": {
            "type": "droplet",
            "random_walk": {"position": 1e-4},
            "ir": {"id": "0x6B6F", "gains": {"sensor": [1] * 6, "emitter": [1] * 6}},
        },
    },
    "landmarks": {100: {"x": 1.2, "y": -0.4, "yaw": None}},
    "cameras": {"up": {"x": 0.0, "y": 0.0, "z": 2.5, "sensor": {"residual_position_sigma": 0.001}}},
    "anchors": [{"address": 7, "x": 0.0, "y": 5.0}],
}


def kind_is(value: Any, kind: str) -> bool:
    if kind in TYPES:
        return isinstance(value, TYPES[kind])
    whole = isinstance(value, int) and not isinstance(value, bool)
    return whole or (kind == "number" and isinstance(value, float))


def faults(tree: Any, rule: dict[str, Any], place: str = "") -> Iterator[str]:
    """Where a tree breaks a schema of those words of draft 7 that ours uses."""
    words = {"$ref", "$schema", "title", "description", "default", "definitions", "type", "const", "enum"}
    words |= {"minimum", "exclusiveMinimum", "maximum", "pattern", "maxLength", "not", "anyOf", "items"}
    words |= {"properties", "patternProperties", "additionalProperties", "propertyNames", "required"}
    words |= {"minProperties", "maxProperties"}
    assert set(rule) <= words
    if "$ref" in rule:
        yield from faults(tree, swarm_schema()["definitions"][rule["$ref"].rpartition("/")[2]], place)
        return
    kinds = rule.get("type", [])
    if kinds and not any(kind_is(tree, kind) for kind in ([kinds] if isinstance(kinds, str) else kinds)):
        yield f"{place}: no {kinds}"
        return
    if (isinstance(tree, bool) and kinds != "boolean") or ("const" in rule and tree != rule["const"]):
        yield f"{place}: {tree}"
    if tree not in rule.get("enum", [tree]) or ("not" in rule and not list(faults(tree, rule["not"]))):
        yield f"{place}: {tree}"
    if "anyOf" in rule and all(list(faults(tree, one)) for one in rule["anyOf"]):
        yield f"{place}: none of several"
    if isinstance(tree, str) and not re.search(rule.get("pattern", ""), tree):
        yield f"{place}: {tree}"
    if isinstance(tree, str) and len(tree) > rule.get("maxLength", len(tree)):
        yield f"{place}: too long"
    if isinstance(tree, int | float):
        low = rule.get("exclusiveMinimum", float("-inf"))
        if not (low < tree and rule.get("minimum", tree) <= tree <= rule.get("maximum", tree)):
            yield f"{place}: {tree} is out of range"
    for index, item in enumerate(tree if isinstance(tree, list) else []):
        yield from faults(item, rule.get("items", {}), f"{place}[{index}]")
    if isinstance(tree, dict):
        yield from faults_of_mapping(tree, rule, place)


def faults_of_mapping(tree: dict[Any, Any], rule: dict[str, Any], place: str) -> Iterator[str]:
    yield from (f"{place} lacks {name}" for name in rule.get("required", []) if name not in tree)
    if not rule.get("minProperties", 0) <= len(tree) <= rule.get("maxProperties", len(tree)):
        yield f"{place} has {len(tree)} entries"
    for name, value in tree.items():
        key = f"{place}.{name}"
        yield from faults(str(name), rule.get("propertyNames", {}), key)
        patterns = rule.get("patternProperties", {}).items()
        rules = [inner for pattern, inner in patterns if re.search(pattern, str(name))]
        rules += [rule["properties"][name]] if name in rule.get("properties", {}) else []
        if not rules and not rule["additionalProperties"]:
            yield f"{key} is unknown"
        for inner in rules:
            yield from faults(value, inner, key)


def changed(path: str, value: Any) -> dict[Any, Any]:
    tree: dict[Any, Any] = deepcopy(WHOLE)
    inner: Any = tree
    *way, last = [int(name) if name.isdigit() else name for name in path.split(".")]
    for name in way:
        inner = inner.setdefault(name, {}) if isinstance(inner, dict) else inner[name]
    inner[last] = value
    return tree


def test_the_file_is_what_is_generated() -> None:
    assert WRITTEN.read_text(encoding="utf-8") == schema_text(), (
        f"./run swarm_loc_estimator schema > {WRITTEN}"
    )


def test_the_command_prints_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main([]) == 0
    assert json.loads(capsys.readouterr().out) == swarm_schema()


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: str(path.relative_to(ROOT)))
def test_descriptions_of_the_repository_are_valid(path: Path) -> None:
    load_swarm(path)
    assert list(faults(read_tree(path), swarm_schema())) == []


def test_there_are_examples_and_one_with_all_sections() -> None:
    assert len(EXAMPLES) >= 10
    parse_swarm(WHOLE, Path("swarm.yaml"))
    assert list(faults(WHOLE, swarm_schema())) == []


@pytest.mark.parametrize(
    "path",
    [
        *("defaults", "types", "landmarks", "types.epuck", "types.epuck.camera", "types.epuck.faces.front"),
        *("types.droplet.odometry", "types.epuck.response", "types.droplet.ir", "types.epuck.sensor"),
        *("robots.droplet1.ir.gains", "robots.epuck1.start", "types.epuck.faces", "landmarks.100.yaw"),
        *("robots.epuck1.uwb", "types.epuck.imu", "cameras", "cameras.up.sensor", "anchors"),
    ],
)
def test_null_is_valid_where_it_means_something(path: str) -> None:
    tree = changed(path, None)
    if path.startswith("types.epuck") or path == "types":
        tree["robots"] = {"one": {}}
    if path == "types.droplet.ir":
        del tree["robots"]["droplet1"]["ir"]
    parse_swarm(tree, Path("swarm.yaml"))
    assert list(faults(tree, swarm_schema())) == []


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("fileversion", 2),
        ("robot", {}),
        ("robots", None),
        ("robots", {}),
        ("robots.map", {}),
        ("robots.two words", {}),
        ("robots." + 65 * "a", {}),
        ("robots.epuck1.colour", "red"),
        ("robots.epuck1.type", 3),
        ("robots.epuck1.ids.front", 1.5),
        ("robots.epuck1.ids.front", -1),
        ("robots.epuck1.ids.front", None),
        ("robots.epuck1.start", {"x": 0.0, "y": 0.0}),
        ("robots.epuck1.start.theta", 7.0),
        ("robots.droplet1.ir.id", 0),
        ("robots.droplet1.ir.id", "6B6F"),
        ("robots.droplet1.ir.gains", {"sensor": [1] * 6}),
        ("robots.droplet1.ir.gains.sensor", [0.01] * 6),
        ("types.droplet.ir.id", 4097),
        ("types.droplet.ir.dead_sensors", None),
        ("types.droplet.random_walk.position", -1.0),
        ("types.epuck.odometry.wheel_separation", 0.0001),
        ("types.epuck.odometry.wheel_separation", None),
        ("types.epuck.odometry.wheel_separation", True),
        ("types.epuck.odometry.wheel_seperation", 0.053),
        ("types.epuck.sensor.forward_sigma", 0.0),
        ("types.epuck.camera", []),
        ("types.epuck.faces.front.yaw", "left"),
        ("types.epuck.response.speeds", "fast"),
        ("types.epuck.response", {"speeds": [0.0]}),
        ("defaults.landmark.x", 0.0),
        ("landmarks.100", {"x": 0.0}),
        ("landmarks.100", None),
        ("landmarks.100.size", 11.0),
        ("landmarks.a", {"x": 0.0, "y": 0.0}),
        ("types.epuck.faces.top.lies", 1),
        ("types.epuck.faces.top.lies", None),
        ("types.epuck.imu.turn_noise_density", -1.0),
        ("types.epuck.uwb.address", 7),
        ("robots.droplet1.ir.id", "0x0"),
        ("robots.droplet1.ir.id", "0x10000"),
        ("robots.epuck1.uwb.address", "0x0"),
        ("robots.epuck1.uwb.range_sigma", 0.0),
        ("cameras.up", None),
        ("cameras.up", {"x": 0.0, "y": 0.0}),
        ("cameras.map", {"x": 0.0, "y": 0.0, "z": 2.5}),
        ("cameras.up.sensor.noise", 0.1),
        ("anchors", {}),
        ("anchors.0", None),
        ("anchors.0.address", 0),
        ("anchors.0.address", 2**64),
        ("anchors.0", {"address": 7, "x": 0.0}),
    ],
)
def test_both_refuse(path: str, value: Any) -> None:
    tree = changed(path, value)
    with pytest.raises(SwarmFileError):
        parse_swarm(tree, Path("swarm.yaml"))
    assert list(faults(tree, swarm_schema())) != []


def test_every_number_has_unit_range_and_meaning() -> None:
    definitions = swarm_schema()["definitions"]
    assert set(definitions) == set(swarm_file.LAYER)
    for name, cls in MODELS.items():
        for key, spec in number_specs(cls).items():
            said = definitions[name]["properties"][key]
            low = said["exclusiveMinimum" if spec.above else "minimum"]
            assert (low, said["maximum"]) == (spec.low, spec.high)
            assert said["description"].startswith(spec.doc)
            assert spec.unit == "1" or said["description"].endswith(f" [{spec.unit}]")


@pytest.mark.parametrize("beside", [True, False])
def test_a_description_names_the_schema_that_lies_beside_it(tmp_path: Path, beside: bool) -> None:
    if beside:
        (tmp_path / SCHEMA_FILE).write_text(schema_text(), encoding="utf-8")
    save_swarm(Swarm((Robot("one"),)), tmp_path / "swarm.yaml", "a comment")
    first = (tmp_path / "swarm.yaml").read_text(encoding="utf-8").partition("\n")[0]
    assert first == (f"# yaml-language-server: $schema={SCHEMA_FILE}" if beside else "# a comment")
