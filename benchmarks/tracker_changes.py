"""Settings of the tracker that differ from the defaults, named by their path.

parsed_changes(['max_hypotheses=4', 'likelihood.edges.weight=0.1'])
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any

import yaml

from hmt_ros.tracking import TrackerSettings


def changed(changes: Sequence[tuple[str, Any]]) -> TrackerSettings:
    """Settings with those that are named by their path, such as `likelihood.edges.weight`.

    Raises:
        ValueError: the setting does not exist, or does not take the value.
    """
    settings: Any = TrackerSettings()
    for path, value in changes:
        settings = _with_value(settings, path.split('.'), value, path)
    result: TrackerSettings = settings
    return result


def _with_value(settings: Any, names: list[str], value: Any, path: str) -> Any:
    known = [field.name for field in fields(settings)] if is_dataclass(settings) else []
    if names[0] not in known:
        raise ValueError(f'no setting {path!r}: {names[0]!r} is none of {", ".join(known)}')
    own = getattr(settings, names[0])
    if names[1:]:
        return replace(settings, **{names[0]: _with_value(own, names[1:], value, path)})
    if isinstance(own, float) and isinstance(value, int):
        value = float(value)
    if not isinstance(value, type(own)):
        raise ValueError(f'{path} is a {type(own).__name__}, saw {value!r}')
    return replace(settings, **{names[0]: value})


def parsed_changes(words: Sequence[str]) -> tuple[tuple[str, Any], ...]:
    """Changes from words such as `max_hypotheses=4`.

    Raises:
        ValueError: a word of another form, or no such setting.
    """
    result = []
    for word in words:
        name, equals, value = word.partition('=')
        if not equals:
            raise ValueError(f'wanted SETTING=VALUE, saw {word!r}')
        result.append((name, yaml.safe_load(value)))
    changed(result)
    return tuple(result)
