"""What a node prints for --help: how it is run, and its parameters."""

from __future__ import annotations

import math
import sys
import textwrap
from collections.abc import Iterable
from typing import Any

from hmt_ros.nodes.session_node import SessionNode
from hmt_ros.sessions.declared_parameters import DeclaredParameter, declared_parameters
from hmt_ros.sessions.parameter_file import yaml_scalar

_WIDTH = 100
_TYPES = {bool: 'bool', int: 'int', float: 'float', str: 'string', tuple: 'list of floats'}


def wants_help(arguments: Iterable[str]) -> bool:
    """Whether a command line asks for help, before --ros-args or behind."""
    return any(word in ('-h', '--help') for word in arguments)


def usage(kind: type[SessionNode[Any, Any]]) -> str:
    """The help of a node: usage, and all parameters with types, ranges, defaults and effects."""
    name = kind.NAME
    # "<name>: what comes in, what goes out; how it is made."
    module = sys.modules[kind.__module__].__doc__ or name
    purpose = module.splitlines()[0].partition(';')[0].rstrip('.')
    published = ', '.join(kind.SESSION.TOPICS)
    head = [
        f'usage: ros2 run hmt_ros {name} [--ros-args [-p NAME:=VALUE] [-r TOPIC:=NAME]',
        '           [-r __ns:=NAMESPACE] [--params-file FILE] [--log-level LEVEL] ...]',
        '',
        f'{purpose}.',
        '',
        *textwrap.wrap(f'Publishes {published}.', _WIDTH),
        f'"ros2 node info /{name}" lists all topics and services of the running node, and',
        f'"ros2 param describe /{name} NAME" describes a parameter.',
        '',
        'parameters, all optional, with type, range, default, and when a new value takes effect:',
    ]
    lines = [line for each in declared_parameters(kind.DEFAULTS) for line in _described(each)]
    return '\n'.join([*head, *lines]) + '\n'


def _described(parameter: DeclaredParameter) -> list[str]:
    kind = _TYPES[type(parameter.default)]
    default = yaml_scalar(parameter.default)
    facts = [kind, *_range(parameter), f'default {default}', parameter.effect]
    text = textwrap.wrap(
        parameter.description,
        _WIDTH,
        initial_indent=6 * ' ',
        subsequent_indent=6 * ' ',
        break_on_hyphens=False,
    )
    return ['', f'  {parameter.name} ({"; ".join(facts)})', *text]


def _range(parameter: DeclaredParameter) -> list[str]:
    if parameter.limits is None:
        return []
    low, high = parameter.limits
    if high == math.inf:
        return [f'at least {low:g}']
    if isinstance(parameter.default, int):
        return [f'{low:.0f} to {high:.0f}']
    return [f'{low:g} to {high:g}']
