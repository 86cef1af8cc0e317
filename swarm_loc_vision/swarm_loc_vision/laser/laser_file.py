"""Laser calibrations as YAML files."""

from __future__ import annotations

from pathlib import Path

from swarm_loc_estimator.common.errors import UserError
from swarm_loc_estimator.common.number_spec import NumberSpec, number_specs
from swarm_loc_estimator.common.yaml_tree import Tree, YamlTreeError, read_tree
from swarm_loc_vision.laser.calibration import LaserCalibration
from swarm_loc_vision.laser.row_bias import RowBias

_HEAD = (
    "# Laser and event camera of one robot: the spot of what is at depth d lies at the row p_inf + f b / d.\n"
)
_BIAS = "row_bias"
_FIRST_ROW = NumberSpec("px", -1000.0, 10_000.0, False, "row of the first knot")
_STEP = NumberSpec("px", 0.0, 10.0, True, "from knot to knot")
_OFFSET = NumberSpec("px", -10.0, 10.0, False, "tracked row minus true row at each knot")
_MAX_KNOTS = 10_000


class LaserFileError(UserError):
    """A laser calibration that cannot be used; the message is one sentence."""


def save_laser(path: Path, calibration: LaserCalibration) -> None:
    """Write a calibration.

    Raises:
        LaserFileError: It cannot be written there.
    """
    specs = number_specs(LaserCalibration)
    lines = [
        f"{name}: {getattr(calibration, name):.9g}  # {spec.doc} [{spec.unit}]"
        for name, spec in specs.items()
    ]
    bias = calibration.row_bias
    if bias.offsets:
        offsets = ", ".join(f"{offset:.4f}" for offset in bias.offsets)
        lines += [
            f"{_BIAS}:",
            f"  first_row: {bias.first_row:.9g}  # {_FIRST_ROW.doc} [px]",
            f"  step: {bias.step:.9g}  # {_STEP.doc} [px]",
            f"  offsets: [{offsets}]  # {_OFFSET.doc} [px]",
        ]
    try:
        path.write_text(_HEAD + "\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise LaserFileError(f"{path} cannot be written: {error.strerror}.") from error


def load_laser(path: Path) -> LaserCalibration:
    """Read a calibration.

    Raises:
        LaserFileError: There is none, or a number is missing, unknown or out of its range.
    """
    try:
        content = read_tree(path)
    except YamlTreeError as error:
        raise LaserFileError(str(error)) from error
    specs = number_specs(LaserCalibration)
    if not isinstance(content, dict) or set(content) - {_BIAS} != set(specs):
        raise LaserFileError(f"{path} must have exactly the keys {', '.join(specs)}, and may have {_BIAS}.")
    values = {name: _number(path, name, content[name], spec) for name, spec in specs.items()}
    if values["min_depth"] >= values["max_depth"]:
        raise LaserFileError(
            f"{path}: min_depth = {values['min_depth']} must be below max_depth = {values['max_depth']}."
        )
    return LaserCalibration(
        **values, row_bias=_row_bias(path, content[_BIAS]) if _BIAS in content else RowBias()
    )


def _row_bias(path: Path, content: Tree) -> RowBias:
    if not isinstance(content, dict) or set(content) != {"first_row", "step", "offsets"}:
        raise LaserFileError(f"{path}: {_BIAS} must have exactly the keys first_row, step, offsets.")
    offsets = content["offsets"]
    if not isinstance(offsets, list) or len(offsets) > _MAX_KNOTS:
        raise LaserFileError(f"{path}: {_BIAS}.offsets must be a list of at most {_MAX_KNOTS} numbers.")
    return RowBias(
        _number(path, f"{_BIAS}.first_row", content["first_row"], _FIRST_ROW),
        _number(path, f"{_BIAS}.step", content["step"], _STEP),
        tuple(_number(path, f"{_BIAS}.offsets", offset, _OFFSET) for offset in offsets),
    )


def _number(path: Path, name: str, value: Tree, spec: NumberSpec) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not spec.allows(value):
        raise LaserFileError(f"{path}: {name} = {value!r} must be a number in {spec.range_text}.")
    return float(value)
