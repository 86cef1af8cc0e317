"""Laser calibrations as YAML files."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from swarm_loc_estimator.io.yaml_tree import YamlTreeError, read_tree
from swarm_loc_estimator.parameters.errors import UserError
from swarm_loc_estimator.parameters.number_spec import number_specs
from swarm_loc_vision.core.laser.calibration import LaserCalibration

_HEAD = (
    "# Laser and event camera of one robot: the spot of what is at depth d lies at the row p_inf + f b / d.\n"
)


class LaserFileError(UserError):
    """A laser calibration that cannot be used; the message is one sentence."""


def save_laser(path: Path, calibration: LaserCalibration) -> None:
    """Write a calibration.

    Raises:
        LaserFileError: It cannot be written there.
    """
    specs = number_specs(LaserCalibration)
    lines = [
        f"{name}: {value:.9g}  # {specs[name].doc} [{specs[name].unit}]"
        for name, value in asdict(calibration).items()
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
    if not isinstance(content, dict) or set(content) != set(specs):
        raise LaserFileError(f"{path} must have exactly the keys {', '.join(specs)}.")
    values = {}
    for name, spec in specs.items():
        value = content[name]
        if isinstance(value, bool) or not isinstance(value, int | float) or not spec.allows(value):
            raise LaserFileError(f"{path}: {name} = {value!r} must be a number in {spec.range_text}.")
        values[name] = float(value)
    if values["min_depth"] >= values["max_depth"]:
        raise LaserFileError(
            f"{path}: min_depth = {values['min_depth']} must be below max_depth = {values['max_depth']}."
        )
    return LaserCalibration(**values)
