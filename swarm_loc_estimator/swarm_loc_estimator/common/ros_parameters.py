"""Parameters of a dataclass (see `common/parameters.py`) as parameters of a ROS 2 node."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from swarm_loc_estimator.common.parameters import ParameterSpec, Value, from_values, parameter_specs

Parameters = TypeVar("Parameters")


def declare_parameters(node: Node, cls: type) -> None:
    """Declare the parameters of a dataclass, which may have any value until they are read."""
    node.add_on_set_parameters_callback(_refuse_clock_change)
    for spec in parameter_specs(cls):
        node.declare_parameter(spec.name, spec.default, ParameterDescriptor(dynamic_typing=True))


def read_parameters(node: Node, cls: type[Parameters], *, read_only: bool = True) -> Parameters:
    """The values of declared parameters, which are checked; see `read_parameter`."""
    specs = parameter_specs(cls)
    values = {spec.name: read_parameter(node, spec, read_only=read_only) for spec in specs}
    return from_values(cls, values)


def _refuse_clock_change(parameters: Sequence[Parameter]) -> SetParametersResult:
    """Refuse a change of use_sim_time: stamps of the two clocks are not comparable."""
    changed = any(parameter.name == "use_sim_time" for parameter in parameters)
    reason = "use_sim_time is read at the start only: restart the node." if changed else ""
    return SetParametersResult(successful=not changed, reason=reason)


def read_parameter(node: Node, spec: ParameterSpec, *, read_only: bool) -> Value:
    """The value of a declared parameter, which has its type and descriptor from now on.

    rclpy would refuse a value with a traceback that lacks the unit. So the value is checked here, while the
    parameter still has a dynamic type; then it gets its descriptor.

    Raises:
        ParameterError: The value has the wrong type or is out of range.
    """
    value = spec.checked(node.get_parameter(spec.name).value)
    node.set_parameters([Parameter(spec.name, _TYPES[type(spec.default)], value)])
    node.set_descriptor(spec.name, _descriptor(spec, read_only=read_only))
    return value


_TYPES = {
    bool: Parameter.Type.BOOL,
    int: Parameter.Type.INTEGER,
    float: Parameter.Type.DOUBLE,
    str: Parameter.Type.STRING,
    tuple: Parameter.Type.STRING_ARRAY,
}


def _descriptor(spec: ParameterSpec, *, read_only: bool) -> ParameterDescriptor:
    """The descriptor that `ros2 param describe` prints."""
    kind = _TYPES[type(spec.default)].value
    descriptor = ParameterDescriptor(type=kind, description=spec.doc, read_only=read_only)
    descriptor.additional_constraints = spec.range_text
    number = spec.number
    if number is None:
        return descriptor
    if isinstance(spec.default, int):
        descriptor.integer_range = [IntegerRange(from_value=int(number.low), to_value=int(number.high))]
    else:
        descriptor.floating_point_range = [FloatingPointRange(from_value=number.low, to_value=number.high)]
    return descriptor
