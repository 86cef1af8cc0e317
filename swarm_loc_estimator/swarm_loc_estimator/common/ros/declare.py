"""Declare a dataclass of parameters to ROS 2, read-only, with descriptions and ranges."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from swarm_loc_estimator.common.parameters import (
    ParameterError,
    ParameterSpec,
    Value,
    from_values,
    parameter_specs,
)

Parameters = TypeVar("Parameters")


def declare_parameters(node: Node, cls: type[Parameters]) -> Parameters:
    """Declare the parameters of a dataclass (see `parameter_table`) and fill it with their values.

    Raises:
        ParameterError: A value has the wrong type or is out of range, or a name is unknown.
    """
    node.add_on_set_parameters_callback(_keep_clock)
    specs = parameter_specs(cls)
    return from_values(cls, {spec.name: _declare(node, spec) for spec in specs})


def _keep_clock(parameters: Sequence[Parameter]) -> SetParametersResult:
    """Refuse another clock: times of the one mean nothing to what was told by the other."""
    changed = any(parameter.name == "use_sim_time" for parameter in parameters)
    reason = "use_sim_time is read at the start only: start the node anew." if changed else ""
    return SetParametersResult(successful=not changed, reason=reason)


def _declare(node: Node, spec: ParameterSpec) -> Value:
    """Declare one parameter and return its value.

    rclpy's own refusal is a traceback without the unit. So the value is checked here first, while the
    parameter is still of any type; then it gets its descriptor.
    """
    given = node.declare_parameter(spec.name, spec.default, ParameterDescriptor(dynamic_typing=True))
    value = spec.checked(given.value)
    node.set_parameters([Parameter(spec.name, _TYPES[type(spec.default)], value)])
    node.set_descriptor(spec.name, _descriptor(spec))
    return value


_TYPES = {
    bool: Parameter.Type.BOOL,
    int: Parameter.Type.INTEGER,
    float: Parameter.Type.DOUBLE,
    str: Parameter.Type.STRING,
    tuple: Parameter.Type.STRING_ARRAY,
}


def _descriptor(spec: ParameterSpec) -> ParameterDescriptor:
    """What `ros2 param describe` tells."""
    kind = _TYPES[type(spec.default)].value
    descriptor = ParameterDescriptor(type=kind, description=spec.doc, read_only=True)
    descriptor.additional_constraints = spec.range_text
    number = spec.number
    if number is None:
        return descriptor
    if isinstance(spec.default, int):
        descriptor.integer_range = [IntegerRange(from_value=int(number.low), to_value=int(number.high))]
    else:
        descriptor.floating_point_range = [FloatingPointRange(from_value=number.low, to_value=number.high)]
    return descriptor


__all__ = ["ParameterError", "declare_parameters"]
