"""ROS parameters of a node: declaration, and warnings about ineffective values."""

from __future__ import annotations

import difflib
import itertools
import re
from collections.abc import Iterable, Iterator, Mapping, Set
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from hmt_ros.sessions.declared_parameters import (
    AT_LAUNCH,
    EFFECTS,
    DeclaredParameter,
    Settings,
    declared_parameters,
    values_of,
    with_values,
)
from hmt_ros.sessions.parameter_file import MAX_FILE_BYTES, PARAMETERS_KEY
from msg_tools.files.plain_yaml import read_plain_yaml

QOS_OVERRIDES = 'qos_overrides.'
# Minimum similarity of a suggested parameter or node; node names resemble each other more.
_MIN_SIMILARITY, _MIN_NODE_SIMILARITY = 0.5, 0.8


def declare(node: Node, defaults: Settings) -> Settings:
    """Declares the parameters of a settings dataclass.

    Args:
        defaults: settings with the default values.

    Returns:
        The values given to the node.

    Raises:
        ValueError: the values are inconsistent.
    """
    declared = declared_parameters(defaults)
    as_in_ros = values_of(defaults)
    node.declare_parameters('', [(p.name, as_in_ros[p.name], descriptor(p)) for p in declared])
    values = {p.name: node.get_parameter(p.name).value for p in declared}
    settings = with_values(defaults, values)
    lists = {p.name for p in declared if isinstance(p.default, tuple)}
    node.add_pre_set_parameters_callback(partial(with_empty_lists, names=lists))
    # ROS also passes an empty list in a parameter file as an unset value.
    node.set_parameters([Parameter(name) for name in lists if values[name] is None])
    return settings


def descriptor(parameter: DeclaredParameter) -> ParameterDescriptor:
    """The ROS descriptor of a parameter: description, limits, and whether it can change."""
    result = ParameterDescriptor(
        description=f'{parameter.description} {EFFECTS[parameter.effect]}',
        read_only=parameter.effect == AT_LAUNCH,
        # In ROS, an empty list or a list of integers does not have the type of a list of floats.
        dynamic_typing=isinstance(parameter.default, tuple),
    )
    if parameter.limits is not None:
        low, high = parameter.limits
        if isinstance(parameter.default, int):
            result.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        else:
            result.floating_point_range = [
                FloatingPointRange(from_value=float(low), to_value=float(high))
            ]
    return result


def with_empty_lists(parameters: Iterable[Parameter], names: Set[str]) -> list[Parameter]:
    """Replaces the unset values of list parameters by empty lists.

    ROS tools send an empty list as an unset value, and rclpy would delete an unset parameter.

    Args:
        names: names of the parameters that are lists of numbers.
    """
    return [
        Parameter(one.name, Parameter.Type.DOUBLE_ARRAY, [])
        if one.name in names and one.type_ == Parameter.Type.NOT_SET
        else one
        for one in parameters
    ]


def refuse(response: Any, asked: int, reason: str) -> None:
    """Fills the response to a refused request.

    Args:
        asked: number of parameters in the request.
    """
    refused = SetParametersResult(successful=False, reason=reason)
    if hasattr(response, 'results'):
        response.results = [*response.results, *[refused] * (asked - len(response.results))]
    elif isinstance(getattr(response, 'result', None), SetParametersResult):
        response.result = refused
    for field, value in (('success', False), ('message', reason)):
        if hasattr(response, field):
            setattr(response, field, value)


def unknown_parameters(given: Iterable[str], known: Iterable[str]) -> list[str]:
    """Warnings about unknown parameter names, with suggestions.

    Args:
        given: names from the command line and from parameter files.
    """
    names = sorted(known)
    texts = []
    for name in sorted(set(given) - set(names)):
        near = difflib.get_close_matches(name, names, n=1, cutoff=_MIN_SIMILARITY)
        hint = f'; did you mean {near[0]!r}?' if near else ', it is ignored'
        texts.append(f'unknown parameter {name!r}{hint}')
    return texts


def file_folders(given: str) -> tuple[str, ...]:
    """Folders that may contain the files named by parameters of a running node.

    Args:
        given: value of the parameter `file_folders`.
    """
    usual = []
    for find in (partial(get_package_share_directory, 'hmt_ros'), Path.home, Path.cwd):
        # Any of these folders may be missing.
        with suppress(PackageNotFoundError, RuntimeError, OSError):
            usual.append(str(find()))
    # If its home or working folder is the root, a service must not give access to all files.
    named = given.split(':') if given else [folder for folder in usual if folder != '/']
    return tuple(dict.fromkeys(filter(None, named)))


def next_step(node: Node) -> str:
    """Advice after a failed configuration."""
    change = f'ros2 lifecycle set {node.get_fully_qualified_name()}'
    return f'fix that, then: {change} configure; {change} activate'


def files_for_others(arguments: Iterable[str], node: str) -> list[str]:
    """Warnings about parameter files that configure a similarly named node, but not this one.

    A file for nodes with different names causes no warning, as one file may serve many nodes.

    Args:
        node: full name of the node.
    """
    words, texts = list(arguments), []
    for option, path in itertools.pairwise(words):
        if option != '--params-file':
            continue
        try:
            document = read_plain_yaml(Path(path), MAX_FILE_BYTES)
        except ValueError:
            # ROS has accepted this file, so it is valid YAML, but it is not plain YAML.
            continue
        sections = list(_sections(document, '')) if isinstance(document, Mapping) else []
        if any(re.fullmatch(_pattern(section), node) for section in sections):
            continue
        own = node.rpartition('/')[2]
        named = {section.rpartition('/')[2]: section for section in sections}
        near = difflib.get_close_matches(own, named, n=1, cutoff=_MIN_NODE_SIMILARITY)
        if near:
            texts.append(
                f'{path}: its parameters are for {named[near[0]]!r}, and this node is {node!r}: '
                f'none is used; name the section {"/**/" + own!r}'
            )
    return texts


def _sections(document: Mapping[Any, Any], prefix: str) -> Iterator[str]:
    """Full names of the nodes that have a section in a parameter file."""
    for key, value in document.items():
        name = f'{prefix}/{str(key).strip("/")}'
        if key == PARAMETERS_KEY:
            yield prefix
        elif isinstance(value, Mapping):
            yield from _sections(value, name)


def _pattern(section: str) -> str:
    """Regular expression for the full names of the nodes to which a section applies."""
    parts = {'*': '/[^/]+', '**': '(/[^/]+)*'}
    return ''.join(parts.get(part, f'/{re.escape(part)}') for part in section.split('/')[1:])
