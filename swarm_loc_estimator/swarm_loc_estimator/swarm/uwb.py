"""UWB radios: devices on robots, anchors in `map`, and their sections of a swarm description."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from swarm_loc_estimator.common.parameters import number, number_specs
from swarm_loc_estimator.common.yaml_tree import Tree
from swarm_loc_estimator.swarm.tree_checks import TreeChecks


@dataclass(frozen=True)
class UwbDevice:
    """Radio on a robot: its antenna in base_link, and the error model of what it measures.

    A measured range is range_scale times the true one, plus the range_bias of both devices.
    """

    address: int  #: Number by which messages name it, unique among robots and anchors
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
    """Radio at a fixed place in `map`."""

    address: int  #: Number by which messages name it, unique among robots and anchors
    x: float = number(0.0, "m", -1e6, 1e6, "in map")
    y: float = number(0.0, "m", -1e6, 1e6, "in map")
    z: float = number(0.0, "m", -1e4, 1e4, "above the ground")
    position_sigma: float = number(
        0.0, "m", 0.0, 100.0, "standard deviation of x and y; 0: exact, else estimated with the poses"
    )
    range_bias: float = number(0.0, "m", -10.0, 10.0, "added to each range to this anchor")


MAX_ADDRESS = 2**64 - 1
_ADDRESS = ("address",)
_DEVICE, _ANCHOR = number_specs(UwbDevice), number_specs(Anchor)

Values = dict[str, Any]


def uwb_layer(checks: TreeChecks, tree: Tree, key: str, *, of_robot: bool) -> Values | None:
    """The section `uwb` of one layer; only a robot has an address. None: no radio."""
    if tree is None:
        return None
    values: Values = {**checks.numbers(tree, key, _DEVICE, others=_ADDRESS if of_robot else ())}
    return values if "address" not in tree else {**values, **_address(checks, tree, key)}


def uwb_device(checks: TreeChecks, values: Values | None, key: str) -> UwbDevice | None:
    """The radio of a robot from the merged values of its layers."""
    return UwbDevice(**{**values, **_address(checks, values, key)}) if values else None


def read_anchors(checks: TreeChecks, tree: Tree) -> tuple[Anchor, ...]:
    """The section `anchors`."""
    anchors = []
    for index, entry in enumerate(checks.items([] if tree is None else tree, "anchors")):
        key = f"anchors[{index}]"
        numbers: Values = {**checks.numbers(entry, key, _ANCHOR, ("x", "y"), _ADDRESS)}
        anchors.append(Anchor(**numbers, **_address(checks, entry, key)))
    return tuple(anchors)


def _address(checks: TreeChecks, tree: Values, key: str) -> Values:
    """The address of a section, which must be there."""
    if "address" not in tree:
        raise checks.said(f"{key} lacks address, a whole number in [1, {MAX_ADDRESS}]")
    return {"address": checks.address(tree["address"], f"{key}.address", MAX_ADDRESS)}
