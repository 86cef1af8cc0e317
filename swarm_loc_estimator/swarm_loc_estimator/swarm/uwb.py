"""UWB radios: devices on robots, anchors in `map`, and their sections of a swarm description."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from swarm_loc_estimator.common.parameters import NumberSpec, number, number_specs
from swarm_loc_estimator.common.yaml_tree import Tree
from swarm_loc_estimator.swarm.tree_checks import Numbers, TreeChecks


@dataclass(frozen=True)
class UwbDevice:
    """Radio on a robot: its antenna in base_link, and the error model of what it measures.

    A measured range is range_scale times the true one, plus the range_bias of both devices.

    Attributes:
        address: Number by which messages name it, unique among robots and anchors.
    """

    address: int
    x: float = number(0.0, "m", -10.0, 10.0, "antenna forward of base_link")
    y: float = number(0.0, "m", -10.0, 10.0, "antenna left of base_link")
    z: float = number(0.0, "m", -10.0, 10.0, "antenna above the ground")
    range_sigma: float = number(0.1, "m", 0.0, 10.0, "noise of a range without variance", above=True)
    difference_sigma: float = number(
        0.15, "m", 0.0, 10.0, "noise of a range difference without variance", above=True
    )
    range_bias: float = number(0.0, "m", -10.0, 10.0, "added to each range from or to this device")
    range_scale: float = number(
        1.0, "1", 0.5, 2.0, "measured over true distance, of ranges that this device measures"
    )
    gate_probability: float = number(
        0.999, "1", 0.5, 1.0, "share of good ranges that must pass the gate; 1 passes all"
    )


@dataclass(frozen=True)
class Anchor:
    """Radio at a fixed place in `map`.

    Attributes:
        address: Number by which messages name it, unique among robots and anchors.
    """

    address: int
    x: float = number(0.0, "m", -1e6, 1e6, "in map")
    y: float = number(0.0, "m", -1e6, 1e6, "in map")
    z: float = number(0.0, "m", -1e4, 1e4, "above the ground")
    position_sigma: float = number(
        0.0, "m", 0.0, 100.0, "standard deviation of x and y; 0: exact, else estimated with the poses"
    )
    range_bias: float = number(0.0, "m", -10.0, 10.0, "added to each range to this anchor")


MAX_ADDRESS = 2**64 - 1
_HEXADECIMAL = re.compile(r"0[xX][0-9A-Fa-f]{1,16}")
_DEVICE, _ANCHOR = number_specs(UwbDevice), number_specs(Anchor)

Values = dict[str, Any]


def uwb_layer(checks: TreeChecks, tree: Tree, key: str, *, of_robot: bool) -> Values | None:
    """The section `uwb` of one layer; only a robot has an address. None: no radio."""
    if tree is None:
        return None
    mapping = checks.mapping(tree, key, ("address", *_DEVICE) if of_robot else _DEVICE)
    return _read(checks, mapping, key, _DEVICE)


def uwb_device(checks: TreeChecks, values: Values | None, key: str) -> UwbDevice | None:
    """The radio of a robot from the merged values of its layers."""
    if not values:
        return None
    _require(checks, values, key, ("address",))
    return UwbDevice(**values)


def read_anchors(checks: TreeChecks, tree: Tree) -> tuple[Anchor, ...]:
    """The section `anchors`."""
    anchors = []
    for index, entry in enumerate(checks.items([] if tree is None else tree, "anchors")):
        key = f"anchors[{index}]"
        mapping = checks.mapping(entry, key, ("address", *_ANCHOR))
        _require(checks, mapping, key, ("address", "x", "y"))
        anchors.append(Anchor(**_read(checks, mapping, key, _ANCHOR)))
    return tuple(anchors)


def _require(checks: TreeChecks, values: Values, key: str, names: Iterable[str]) -> None:
    for name in names:
        if name not in values:
            rule = f"a whole number in [1, {MAX_ADDRESS}]" if name == "address" else "a number"
            raise checks.said(f"{key} lacks {name}, {rule}")


def _read(checks: TreeChecks, mapping: Values, key: str, specs: Mapping[str, NumberSpec]) -> Values:
    numbers: Numbers = {
        name: checks.number(value, f"{key}.{name}", specs[name])
        for name, value in mapping.items()
        if name != "address"
    }
    if "address" not in mapping:
        return numbers
    return {"address": _address(checks, mapping["address"], f"{key}.address"), **numbers}


def _address(checks: TreeChecks, value: Tree, key: str) -> int:
    """An address, decimal or hexadecimal with 0x."""
    address = int(value, 16) if isinstance(value, str) and _HEXADECIMAL.fullmatch(value) else value
    if isinstance(address, bool) or not isinstance(address, int) or not 1 <= address <= MAX_ADDRESS:
        raise checks.error(key, value, f"must be a whole number in [1, {MAX_ADDRESS}]")
    return address
