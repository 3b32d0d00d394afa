"""Settings dataclasses as ROS parameters.

A settings dataclass, with the dataclasses inside it, is what a node is parametrised by. Its fields
are the parameters (`likelihood.edges.weight` for a field of a field of a field), its docstring
describes them, and its own checks decide whether values go together. So a field that is added to
the settings is a parameter without being named a second time.
"""

from __future__ import annotations

import dataclasses
import difflib
import inspect
import math
import re
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass, replace
from typing import Any, TypeVar

Value = bool | int | float | str
Settings = TypeVar('Settings')

# Metadata of a field.
LIMITS = 'limits'  # (lowest, highest), or these by name for the fields of this field
EFFECT = 'effect'  # when a new value takes effect
FLAT = 'flat'  # fields of this field are parameters without a prefix

AT_ONCE = 'at once'
NEXT_TRACK = 'next track'
NEXT_WINDOW = 'next window'
NEXT_CONFIGURE = 'next configure'
AT_LAUNCH = 'at launch'
EFFECTS = {
    AT_ONCE: 'A new value takes effect at once.',
    NEXT_TRACK: 'A new value takes effect when the next track starts, after ~/reset for example.',
    NEXT_WINDOW: 'A new value takes effect when the next window starts, after a jump in time say.',
    NEXT_CONFIGURE: 'A new value takes effect when the node is configured the next time.',
    AT_LAUNCH: 'Can only be set at launch.',
}

_LARGEST_INTEGER = 2**31 - 1


def parameter_field(default: Value, effect: str, limits: tuple[float, float] | None = None) -> Any:
    """A field of a settings dataclass that is a parameter.

    Args:
        default: its value.
        effect: one of `EFFECTS`.
        limits: lowest and highest value; None: numbers keep the sign of the default.
    """
    return dataclasses.field(default=default, metadata={EFFECT: effect, LIMITS: limits})


class ParameterError(ValueError):
    """A value that a parameter can not have: one line, what was seen and what was wanted."""


@dataclass(frozen=True)
class DeclaredParameter:
    """A parameter.

    Attributes:
        name: with dots.
        default: its value unless another is given; its type is the type of the parameter.
        description: one sentence or more.
        limits: lowest and highest value, None where the parameter is no number.
        effect: when a new value takes effect; one of `EFFECTS`.
    """

    name: str
    default: Value
    description: str
    limits: tuple[float, float] | None
    effect: str

    def checked(self, value: Any) -> Any:
        """A value from a file or a command line, with the type of the parameter.

        Raises:
            ParameterError: another type, or beyond the limits.
        """
        wanted = type(self.default)
        if wanted is float and type(value) is int:
            value = float(value)
        kind = type(value)
        if kind is not wanted:
            raise ParameterError(f'{self.name} must be a {_NAMES[wanted]}, saw {value!r}')
        if self.limits is not None and not self.limits[0] <= value <= self.limits[1]:
            low, high = self.limits
            raise ParameterError(
                f'{self.name} must lie between {low:g} and {high:g}, saw {value!r}'
            )
        return wanted(value)


_NAMES = {bool: 'truth value', int: 'whole number', float: 'number', str: 'text'}


def declared_parameters(settings: Any, effect: str = NEXT_TRACK) -> list[DeclaredParameter]:
    """The parameters that a settings dataclass stands for; its values are the defaults.

    Args:
        settings: an instance.
        effect: of the fields that do not say it themselves; one of `EFFECTS`.

    Raises:
        TypeError: a field of a type that no parameter has.
    """
    found = list(_parameters(settings, '', effect, {}))
    names = [parameter.name for parameter in found]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise TypeError(f'{type(settings).__name__} gives the parameters {twice} twice')
    return found


def values_of(settings: Any) -> dict[str, Value]:
    """Values of all parameters, by name."""
    return {parameter.name: parameter.default for parameter in declared_parameters(settings)}


def with_values(settings: Settings, values: Mapping[str, Any]) -> Settings:
    """The settings with some parameters changed.

    Raises:
        ParameterError: an unknown name, a value of another type or beyond its limits.
        ValueError: values that do not go together, as the dataclasses say.
    """
    known = {parameter.name: parameter for parameter in declared_parameters(settings)}
    for name in values:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f'; is {near[0]} meant?' if near else ''
            raise ParameterError(f'there is no parameter {name}{hint}')
    checked = {name: known[name].checked(value) for name, value in values.items()}
    return _rebuilt(settings, '', checked)


def described_fields(cls: type) -> dict[str, str]:
    """What the section 'Attributes:' of a docstring says of each name, as one line each."""
    text = inspect.cleandoc(cls.__doc__ or '')
    _, _, section = text.partition('Attributes:\n')
    # Ends where a line is not indented any more.
    block = re.split(r'\n(?=\S)', section, maxsplit=1)[0]
    result: dict[str, str] = {}
    for entry in re.split(r'\n(?=\S)', textwrap.dedent(block)):
        names, colon, words = entry.partition(':')
        if colon:
            for name in names.split(','):
                result[name.strip()] = ' '.join(words.split())
    return result


def _parameters(
    settings: Any, prefix: str, effect: str, limits: Mapping[str, Any]
) -> Iterator[DeclaredParameter]:
    described = described_fields(type(settings))
    for field in fields(settings):
        value = getattr(settings, field.name)
        own_effect = field.metadata.get(EFFECT, effect)
        if is_dataclass(value):
            inner = _inner_prefix(field, prefix)
            named = field.metadata.get(LIMITS, {})
            named = {f'{inner}{name}': pair for name, pair in named.items()}
            group = described.get(field.name, '')
            for parameter in _parameters(value, inner, own_effect, {**limits, **named}):
                yield replace(parameter, description=_in_group(parameter, group, field))
        elif type(value) in _NAMES:
            name = f'{prefix}{field.name}'
            yield DeclaredParameter(
                name,
                value,
                described.get(field.name, ''),
                limits.get(name, _limits(field, value)),
                own_effect,
            )
        else:
            raise TypeError(
                f'{type(settings).__name__}.{field.name} is a {type(value).__name__}, '
                f'wanted one of {[cls.__name__ for cls in _NAMES]} or a dataclass'
            )


def _in_group(parameter: DeclaredParameter, group: str, field: Field[Any]) -> str:
    """The description, opened by that of the group where the same class serves several of them."""
    if field.metadata.get(FLAT) or not group or group.startswith('settings of'):
        return parameter.description
    return f'{group.rstrip(".")}: {parameter.description}'


def _inner_prefix(field: Field[Any], prefix: str) -> str:
    return prefix if field.metadata.get(FLAT) else f'{prefix}{field.name}.'


def _limits(field: Field[Any], value: Any) -> tuple[float, float] | None:
    """The limits that a field names; else numbers keep the sign of their default."""
    limits: tuple[float, float] | None = field.metadata.get(LIMITS)
    if limits is not None or type(value) not in (int, float):
        return limits
    default = value if field.default is MISSING else field.default
    highest = float(_LARGEST_INTEGER) if type(value) is int else math.inf
    return (-highest, highest) if default < 0 else (0.0, highest)


def _rebuilt(settings: Any, prefix: str, values: Mapping[str, Value]) -> Any:
    changes: dict[str, Any] = {}
    for field in fields(settings):
        value = getattr(settings, field.name)
        if is_dataclass(value):
            changes[field.name] = _rebuilt(value, _inner_prefix(field, prefix), values)
        elif f'{prefix}{field.name}' in values:
            changes[field.name] = values[f'{prefix}{field.name}']
    return replace(settings, **changes)
