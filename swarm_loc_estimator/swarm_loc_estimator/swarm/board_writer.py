"""Write infrared boards to YAML, as `board_file` reads them."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

from swarm_loc_estimator.common.parameters import number_specs
from swarm_loc_estimator.common.yaml_tree import tree_text
from swarm_loc_estimator.infrared.curves import Amplitude, PowerCurve, TabulatedCurve
from swarm_loc_estimator.swarm.board_file import FILE_VERSION
from swarm_loc_estimator.swarm.ir_board import IrPlatform


def save_ir_platform(platform: IrPlatform, path: Path, comment: str = "") -> None:
    """Write a board that `load_ir_platform` reads back equal.

    Args:
        platform: What to write.
        path: The file; replaced when it exists, its folder created when missing.
        comment: Lines that say where the numbers come from.
    """
    laws = dict(zip(platform.powers, platform.amplitudes, strict=True))
    tree = {
        "fileversion": FILE_VERSION,
        "angles": list(platform.angles),
        "sensor": _curve(platform.sensor),
        "emitter": _curve(platform.emitter),
        "powers": {name: _numbers(law, Amplitude) for name, law in laws.items()},
        **_numbers(platform, IrPlatform),
    }
    text = "".join(f"# {line}\n" for line in comment.splitlines()) + tree_text(tree)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".part")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)


def _curve(curve: TabulatedCurve | PowerCurve) -> dict[str, object]:
    """A curve as a table or in pieces."""
    if isinstance(curve, TabulatedCurve):
        return {"angles": list(curve.angles), "values": list(curve.values)}
    pieces: list[dict[str, object]] = [
        {"below": piece.below, "terms": [list(term) for term in piece.terms]} for piece in curve.pieces
    ]
    del pieces[-1]["below"]
    return {"pieces": pieces}


def _numbers(holder: IrPlatform | Amplitude, cls: type) -> dict[str, object]:
    """The numbers of a dataclass."""
    names = number_specs(cls)
    return {field.name: getattr(holder, field.name) for field in fields(cls) if field.name in names}
