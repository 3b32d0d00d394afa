"""How a parameter is declared to ROS: its description, its limits, whether it can change."""

from __future__ import annotations

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

from hmt_ros.sessions.declared_parameters import AT_LAUNCH, EFFECTS, DeclaredParameter


def parameter_descriptor(parameter: DeclaredParameter) -> ParameterDescriptor:
    """The descriptor of a parameter of a settings dataclass."""
    descriptor = ParameterDescriptor(
        description=f'{parameter.description} {EFFECTS[parameter.effect]}',
        read_only=parameter.effect == AT_LAUNCH,
    )
    if parameter.limits is not None:
        low, high = parameter.limits
        if isinstance(parameter.default, int):
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        else:
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(low), to_value=float(high))
            ]
    return descriptor
