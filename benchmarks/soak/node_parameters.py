"""The case of the soak that changes the parameters of a node while it runs."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks.soak.outcome import Amount, Outcome
from benchmarks.soak.watched_node import Watched
from hmt_ros.sessions.declared_parameters import DeclaredParameter, declared_parameters


def changed_parameters(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """Random values, valid or not, between messages; what was agreed to is there."""
    rng = np.random.default_rng(0)
    declared = [p for p in declared_parameters(watched.scene.parameters) if p.effect != 'at launch']
    names = [parameter.name for parameter in declared]
    usual = dict(zip(names, watched.get(names), strict=True))
    known = dict(usual)
    for number in amount.counted():
        chosen = declared[int(rng.integers(0, len(declared)))]
        value = _any_value(chosen, rng)
        done, why = watched.set(**{chosen.name: value})
        outcome.times += 1
        outcome.refused += not done
        if done:
            known[chosen.name] = value
        elif not why or '\n' in why:
            outcome.fault(f'{chosen.name} = {value!r} is refused with {why!r}')
        (found,) = watched.get([chosen.name])
        if _plain(found) != _plain(known[chosen.name]):
            outcome.lost += 1
            outcome.fault(f'{chosen.name} is {found!r}, was set to {known[chosen.name]!r}')
        if number % 4 == 0:
            watched.next()
        if number % 25 == 24:
            _set_back(watched, usual, known, outcome)
    _set_back(watched, usual, known, outcome)
    watched.next()


def _set_back(
    watched: Watched, usual: Mapping[str, Any], known: dict[str, Any], outcome: Outcome
) -> None:
    changed = {name: usual[name] for name in usual if _plain(known[name]) != _plain(usual[name])}
    if not changed:
        return
    done, why = watched.set(**changed)
    if not done:
        outcome.fault(f'the usual values are refused: {why}')
    known.update(usual)


def _plain(value: Any) -> Any:
    """A value as it is compared: ROS gives lists back as arrays."""
    return list(value) if isinstance(value, list | array | tuple) else value


def _any_value(parameter: DeclaredParameter, rng: np.random.Generator) -> Any:
    """A value of a parameter: near the usual one, at a limit, beyond, or of another type."""
    default, kind = parameter.default, rng.random()
    if kind < 0.1:
        wrong: tuple[Any, ...] = ('', 'pigeon', -1, 2**40, float('nan'), True, [1, 2], [b'x'])
        return wrong[int(rng.integers(0, len(wrong)))]
    if isinstance(default, bool):
        return bool(rng.random() < 0.5)
    if isinstance(default, tuple):
        lists: tuple[Any, ...] = ([], [0.0, 1.0, 0.0], [0, 1, 0], [0.0, 0.0, 0.0], [1.0], ['down'])
        return lists[int(rng.integers(0, len(lists)))]
    if isinstance(default, str):
        return ('', default, 'nowhere', default * 2, '/dev/null', '\n')[int(rng.integers(0, 6))]
    low, high = parameter.limits or (-1e9, 1e9)
    if kind < 0.2:
        value = (low - 1, high + 1, -1e300, np.inf, -np.inf)[int(rng.integers(0, 5))]
        whole = isinstance(default, int) and np.isfinite(value)
        return int(max(value, -(2.0**63))) if whole else value  # as small as a message holds
    near = float(np.clip(default * np.exp2(rng.uniform(-1.0, 1.0)), low, high))
    return near if isinstance(default, float) else round(near)
