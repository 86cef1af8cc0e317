"""Parameters with default, unit, range and documentation, and the base class of users' errors.

A frozen dataclass is filled from ROS parameters, a description or the settings, and gives the tables under
doc/. A field with the metadata `numbers_of` holds a dataclass of numbers, each of which is a parameter.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, TypeVar

Value = bool | int | float | str | tuple[str, ...]
Parameters = TypeVar("Parameters")


class UserError(ValueError):
    """A mistake of a user, such as a wrong file or parameter; the message is one sentence."""


class ParameterError(UserError):
    """A parameter that cannot be used."""


@dataclass(frozen=True)
class NumberSpec:
    """Unit, range and documentation of a number."""

    unit: str  # SI unit, "1" for none
    low: float  # Smallest allowed value, itself allowed unless `above`
    high: float  # Largest allowed value
    above: bool  # Whether `low` itself is refused
    doc: str  # One line of documentation
    optional: bool = False  # Whether None is allowed and means unknown

    def allows(self, value: float) -> bool:
        """Whether the value is finite and in range."""
        return (
            -math.inf < value < math.inf  # also of whole numbers that no float holds
            and (self.low < value if self.above else self.low <= value)
            and value <= self.high
        )

    @property
    def wanted(self) -> str:
        """What is missing where the number is left out, for the end of a sentence."""
        return f"a number in {self.range_text}"

    @property
    def range_text(self) -> str:
        """The allowed range for an error message, such as "(0, 10] m"."""
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{'(' if self.above else '['}{self.low:g}, {self.high:g}]{unit}"


def number(value: float | None, unit: str, low: float, high: float, doc: str, *, above: bool = False) -> Any:
    """A dataclass field with its default and `NumberSpec`; a default of None says that None is allowed."""
    return field(default=value, metadata={"spec": NumberSpec(unit, low, high, above, doc, value is None)})


def positive(value: float, unit: str, high: float, doc: str) -> Any:
    """A `number` in (0, high]."""
    return number(value, unit, 0.0, high, doc, above=True)


def estimated(value: float, unit: str, high: float, of: str) -> Any:
    """A `number` in [0, high]: a standard deviation, from which the error is estimated unless it is zero."""
    relative = "relative " if unit == "1" else ""
    doc = f"{relative}standard deviation of {of}; 0: exact, else estimated"
    return number(value, unit, 0.0, high, doc)


def gate(of: str, value: float = 0.9999) -> Any:
    """A `number`: the gate probability of measurements by their name."""
    return number(value, "1", 0.5, 1.0, f"share of good {of} that must pass the gate; 1 passes all")


def number_specs(cls: type) -> dict[str, NumberSpec]:
    """The numbers of a dataclass: field name -> what it may be, in the order of definition."""
    specs = {one.name: one.metadata.get("spec") for one in fields(cls)}
    return {name: spec for name, spec in specs.items() if isinstance(spec, NumberSpec)}


@dataclass(frozen=True)
class ParameterSpec:
    """One parameter."""

    name: str  # Its name
    default: Value  # Default value; its type is that of the parameter
    doc: str  # One line of documentation
    number: NumberSpec | None = None  # Unit and range of a number; None for the other types
    required: bool = False  # Whether an empty text is refused
    choices: tuple[str, ...] = ()  # Allowed texts; empty: any

    @property
    def range_text(self) -> str:
        """The allowed values as text; empty: any."""
        return self.number.range_text if self.number else ", ".join(self.choices)

    def checked(self, value: object) -> Value:
        """The value, of the exact type; an integer is converted for a float. Raises ParameterError."""
        if isinstance(self.default, float) and isinstance(value, int) and not isinstance(value, bool):
            value = float(str(value))  # infinite where float(value) overflows
        if isinstance(self.default, tuple) and isinstance(value, list | tuple):
            value = tuple(str(item) for item in value)
        if type(value) is not type(self.default):
            texts = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}
            wanted = texts.get(type(self.default), "a list of texts")
            raise ParameterError(f"parameter {self.name} = {value!r} must be {wanted}.")
        if self.number is not None and isinstance(value, int | float) and not self.number.allows(value):
            raise ParameterError(f"parameter {self.name} = {value} must lie in {self.number.range_text}.")
        if self.choices and value not in self.choices:
            raise ParameterError(f"parameter {self.name} = '{value}' must be one of {self.range_text}.")
        if self.required and value == "":
            raise ParameterError(f"parameter {self.name} is not set: {self.doc}.")
        return value


def text(default: str | None, doc: str, *, required: bool = False) -> Any:
    """A dataclass field for a text; a required text must not be empty."""
    return field(default=default, metadata={"doc": doc, "required": required})


def choice(default: str, choices: Sequence[str], doc: str) -> Any:
    """A dataclass field for a text out of a list."""
    return field(default=default, metadata={"doc": doc, "choices": tuple(choices)})


def flag(default: bool, doc: str) -> Any:
    """A dataclass field for a boolean."""
    return field(default=default, metadata={"doc": doc})


def autostart() -> Any:
    """The flag that the parameters of each managed node have, see `common/node.py`."""
    return flag(True, "configure and activate at the start; false: wait for a lifecycle manager")


def texts(doc: str) -> Any:
    """A dataclass field for a tuple of texts, empty by default."""
    return field(default=(), metadata={"doc": doc})


def parameter_specs(cls: type) -> tuple[ParameterSpec, ...]:
    """The parameters of a dataclass, in the order of definition."""
    specs: list[ParameterSpec] = []
    for one in fields(cls):
        about = one.metadata
        number: NumberSpec | None = about.get("spec")
        default: Any = one.default
        if about.get("is_internal"):
            continue
        if "numbers_of" in about:
            specs += parameter_specs(about["numbers_of"])
        elif number is not None:
            specs.append(ParameterSpec(one.name, default, number.doc, number))
        else:
            extra = {name: about[name] for name in ("required", "choices") if name in about}
            specs.append(ParameterSpec(one.name, default, about["doc"], **extra))
    return tuple(specs)


def from_values(cls: type[Parameters], values: Mapping[str, Value]) -> Parameters:
    """Fill the dataclass from values by parameter name."""
    arguments: dict[str, Any] = {}
    for one in fields(cls):  # type: ignore[arg-type]  # any dataclass
        inner = one.metadata.get("numbers_of")
        if one.metadata.get("is_internal"):
            continue
        arguments[one.name] = from_values(inner, values) if inner else values[one.name]
    return cls(**arguments)
