"""Numbers with unit, range and meaning beside their default."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any


@dataclass(frozen=True)
class NumberSpec:
    """What one number may be.

    Attributes:
        unit: SI unit, "1" for none.
        low: Smallest allowed value, itself allowed unless `above`.
        high: Largest allowed value.
        above: Whether `low` itself is refused.
        doc: One line for people.
        optional: Whether None is allowed and means unknown.
    """

    unit: str
    low: float
    high: float
    above: bool
    doc: str
    optional: bool = False

    def allows(self, value: float) -> bool:
        """Whether the value is finite and in range."""
        return (
            math.isfinite(value)
            and (self.low < value if self.above else self.low <= value)
            and value <= self.high
        )

    @property
    def range_text(self) -> str:
        """The allowed range for an error message, such as "(0, 10] m"."""
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{'(' if self.above else '['}{self.low:g}, {self.high:g}]{unit}"


def number(
    default: float | None, unit: str, low: float, high: float, doc: str, *, above: bool = False
) -> Any:
    """A dataclass field that carries its `NumberSpec`; a default of None says that None is allowed."""
    return field(default=default, metadata={"spec": NumberSpec(unit, low, high, above, doc, default is None)})


def number_specs(cls: type) -> dict[str, NumberSpec]:
    """The numbers of a dataclass: field name -> what it may be, in the order of definition."""
    return {f.name: f.metadata["spec"] for f in fields(cls) if "spec" in f.metadata}
