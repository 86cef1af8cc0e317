"""Tables of a node's parameters: frozen dataclasses with names, types, defaults, units and ranges.

The dataclass is filled from ROS parameters (`nodes.declare`), and the tables under doc/ are made from it. A
field with the metadata `numbers_of` holds a dataclass of numbers, each of which is a parameter; one with
`is_internal` is none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, TypeVar

from swarm_loc_estimator.common.errors import UserError
from swarm_loc_estimator.common.number_spec import NumberSpec

Value = bool | int | float | str | tuple[str, ...]
Parameters = TypeVar("Parameters")


class ParameterError(UserError):
    """A parameter that cannot be used; the message is one sentence."""


@dataclass(frozen=True)
class ParameterSpec:
    """One parameter.

    Attributes:
        name: Its name.
        default: Value when nobody sets it; its type is the parameter's.
        doc: One line for people.
        number: Unit and range of a number; None for the other types.
        required: Whether an empty text is refused.
        choices: The texts that there are; empty: any.
    """

    name: str
    default: Value
    doc: str
    number: NumberSpec | None = None
    required: bool = False
    choices: tuple[str, ...] = ()

    @property
    def range_text(self) -> str:
        """The values allowed, for people; empty: any."""
        return self.number.range_text if self.number else ", ".join(self.choices)

    def checked(self, value: object) -> Value:
        """The value, with its type made exact; a whole number will do for a real one.

        Raises:
            ParameterError: It has another type or is out of range.
        """
        if isinstance(self.default, float) and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if isinstance(self.default, tuple) and isinstance(value, list | tuple):
            value = tuple(str(item) for item in value)
        if type(value) is not type(self.default):
            raise ParameterError(f"parameter {self.name} = {value!r} must be {self._type_text}.")
        if self.number is not None and isinstance(value, int | float) and not self.number.allows(value):
            raise ParameterError(f"parameter {self.name} = {value} must lie in {self.number.range_text}.")
        if self.choices and value not in self.choices:
            raise ParameterError(f"parameter {self.name} = '{value}' must be one of {self.range_text}.")
        if self.required and value == "":
            raise ParameterError(f"parameter {self.name} is not set: {self.doc}.")
        checked: Value = value
        return checked

    @property
    def _type_text(self) -> str:
        return {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}.get(
            type(self.default), "a list of texts"
        )


def text(default: str, doc: str, *, required: bool = False) -> Any:
    """A dataclass field that is a text; a required one may not be empty."""
    return field(default=default, metadata={"doc": doc, "required": required})


def choice(default: str, choices: Sequence[str], doc: str) -> Any:
    """A dataclass field that is one of some texts."""
    return field(default=default, metadata={"doc": doc, "choices": tuple(choices)})


def flag(default: bool, doc: str) -> Any:
    """A dataclass field that is true or false."""
    return field(default=default, metadata={"doc": doc})


def texts(doc: str) -> Any:
    """A dataclass field that is a tuple of texts, empty when nobody sets it."""
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


def markdown_table(cls: type) -> str:
    """The parameters as a table of Markdown, for the page of the node."""
    lines = ["| Parameter | Default | Range | Meaning |", "|---|---|---|---|"]
    for spec in parameter_specs(cls):
        default = "required" if spec.required and not spec.default else f"`{_shown(spec.default)}`"
        lines.append(f"| `{spec.name}` | {default} | {spec.range_text} | {spec.doc} |")
    return "\n".join(lines)


def _shown(value: Value) -> str:
    """A value as one writes it on the command line."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return str(list(value))
    return f'"{value}"' if isinstance(value, str) else str(value)
