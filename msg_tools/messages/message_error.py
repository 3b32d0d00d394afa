"""`MessageError` for invalid messages, and common checks in conversions of messages."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Constant = TypeVar('Constant', bound=IntEnum)

# Maximum deviation of the sum of weights from 1.
WEIGHT_TOLERANCE = 1e-6
# Maximum asymmetry of covariances, relative to their largest entry.
SYMMETRY_TOLERANCE = 1e-9


class MessageError(ValueError):
    """A message is invalid; the text is one line with the actual and the required value.

    Attributes:
        fault: kind of the fault, in a word or two.
    """

    def __init__(self, text: str, fault: str = 'contents') -> None:
        super().__init__(text)
        self.fault = fault


def numbers(values: Any, shape: tuple[int, ...], what: str) -> Array:
    """Converts a flat field of a message to an array of floats with a given shape.

    Raises:
        MessageError: wrong number of values.
    """
    array = np.array(values, dtype=np.float64)
    count = math.prod(shape)
    if array.shape != (count,):
        raise MessageError(f'{what} has {array.size} values, wanted {count}')
    return array.reshape(shape)


def complete_mixture(record: Any, what: str) -> None:
    """Checks names, lengths and identities of a mixture dataclass, and converts their types.

    Raises:
        MessageError: a name that occurs twice, a segment length that is not finite, or different
            numbers of identities and weights.
    """
    for name in ('dof_names', 'joint_names'):
        object.__setattr__(record, name, names_of(getattr(record, name), f'{what}: {name}'))
    check_lengths(record.segment_lengths, what)
    identities = identities_of(record.identities, len(record.weights), what)
    object.__setattr__(record, 'identities', identities)


def freeze_arrays(
    record: Any, shapes: Mapping[str, tuple[int, ...]], what: str, optional: Sequence[str] = ()
) -> None:
    """Converts attributes of a frozen dataclass to read-only float arrays of the given shapes.

    Args:
        optional: names of attributes for which None is allowed.

    Raises:
        MessageError: an array has a wrong shape.
    """
    for name, shape in shapes.items():
        value = getattr(record, name)
        if value is None and name in optional:
            continue
        array = np.array(value, dtype=np.float64)
        if array.shape != shape:
            raise MessageError(f'{what}: {name} has shape {array.shape}, wanted {shape}')
        array.setflags(write=False)
        object.__setattr__(record, name, array)


def check_finite(values: Array, what: str) -> None:
    """Raises MessageError if a value is NaN or infinite."""
    if not np.isfinite(values).all():
        raise MessageError(f'{what} has values that are not finite', 'not finite')


def identities_of(values: NDArray[Any] | None, count: int, what: str) -> NDArray[np.uint32]:
    """Read-only identities (count,) of components; None gives zeros.

    Raises:
        MessageError: wrong number of identities.
    """
    result = np.array(np.zeros(count) if values is None else values, dtype=np.uint32)
    if result.shape != (count,):
        raise MessageError(f'{what}: identities has shape {result.shape}, wanted {(count,)}')
    result.setflags(write=False)
    return result


def check_once(identities: NDArray[Any], what: str) -> None:
    """Raises MessageError if an identity occurs twice; 0 means no identity."""
    known, counts = np.unique(identities[identities > 0], return_counts=True)
    if (counts > 1).any():
        raise MessageError(f'{what} has the identity {known[counts > 1][0]} twice', 'identities')


def constant_of(kind: type[Constant], value: Any, fault: str) -> Constant:
    """The member of an enumeration with a given value.

    Args:
        fault: error message.

    Raises:
        MessageError: no member has the value.
    """
    try:
        return kind(int(value))
    except ValueError:
        raise MessageError(fault) from None


def check_weights(weights: Array, what: str) -> None:
    """Raises MessageError if weights are negative or not finite, or do not sum to 1."""
    if not np.isfinite(weights).all() or (weights < 0).any():
        worst = weights[~(weights >= 0) | ~np.isfinite(weights)][0]
        raise MessageError(f'{what} has the weight {worst}, wanted numbers from 0 to 1', 'weights')
    with np.errstate(over='ignore'):
        total = float(weights.sum())
    if abs(total - 1.0) > WEIGHT_TOLERANCE:
        raise MessageError(f'{what} has weights that sum to {total:.9g}, wanted 1', 'weights')


def check_covariances(covariances: Array, what: str, *, singular: bool = False) -> None:
    """Raises MessageError if a covariance is not symmetric and positive definite.

    Args:
        covariances: (..., d, d) covariances.
        singular: whether to accept positive semidefinite covariances.
    """
    check_finite(covariances, f'covariance of {what}')
    if covariances.size == 0:
        return
    asymmetry = covariances - np.swapaxes(covariances, -1, -2)
    if asymmetry.any():
        scale = np.abs(covariances).max(axis=(-1, -2), keepdims=True)
        if (np.abs(asymmetry) > SYMMETRY_TOLERANCE * scale).any():
            raise MessageError(f'covariance of {what} is not symmetric', 'covariances')
    if singular:
        size = covariances.shape[-1]
        largest = np.abs(covariances).max(axis=(-1, -2), keepdims=True)
        margin = SYMMETRY_TOLERANCE * largest + np.finfo(np.float64).tiny
        covariances = covariances + margin * np.eye(size)
    try:
        np.linalg.cholesky(covariances)
    except np.linalg.LinAlgError:
        smallest = float(np.linalg.eigvalsh(covariances).min())
        raise MessageError(
            f'covariance of {what} is not positive definite: smallest eigenvalue {smallest:.3g}',
            'covariances',
        ) from None


def names_of(values: Sequence[str], what: str) -> tuple[str, ...]:
    """Converts names to a tuple, and checks that they are distinct.

    Raises:
        MessageError: a name that occurs twice.
    """
    names = tuple(str(value) for value in values)
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise MessageError(f'{what} has the name {twice!r} twice', 'names')
    return names


def check_names(names: tuple[str, ...], wanted: Sequence[str] | None, what: str) -> None:
    """Raises MessageError if names or their order differ from `wanted`; None accepts any names."""
    if wanted is None or names == tuple(wanted):
        return
    if len(names) != len(wanted):
        raise MessageError(f'{what} has {len(names)} names, wanted {len(wanted)}', 'names')
    index = next(i for i, (a, b) in enumerate(zip(names, wanted, strict=True)) if a != b)
    raise MessageError(f'{what} has {names[index]!r} at {index}, wanted {wanted[index]!r}', 'names')


def array_of_each(components: Sequence[Any], name: str, shape: tuple[int, ...], what: str) -> Array:
    """A flat field of K components as an array (K, *shape).

    Raises:
        MessageError: wrong number of values.
    """
    values, count = [getattr(component, name) for component in components], math.prod(shape)
    for k, own in enumerate(values):
        if len(own) != count:
            text = f'{what}: component {k}: {name} has {len(own)} values, wanted {count}'
            raise MessageError(text)
    return np.concatenate([np.empty(0), *values]).reshape(len(values), *shape)


def array_of_all(
    components: Sequence[Any], name: str, shape: tuple[int, ...], what: str
) -> Array | None:
    """A flat field of K components as an array (K, *shape); None if it is empty in all of them.

    Raises:
        MessageError: only some components have the field, or it has a wrong number of values.
    """
    lengths = [len(getattr(component, name)) for component in components]
    if not any(lengths):
        return None
    if not all(lengths):
        text = f'{what}: component {lengths.index(0)} has no {name}, others have one'
        raise MessageError(text, 'covariances')
    return array_of_each(components, name, shape, what)


def flat(values: Array | None, component: int) -> Array:
    """Row-major values of a component; empty if unknown."""
    return np.empty(0) if values is None else values[component].reshape(-1)


def lengths_of(message: Any, what: str) -> dict[str, float]:
    """Segment lengths of a message by name, m; see `named_numbers`."""
    return named_numbers(message, 'segment_names', 'segment_lengths', what)


def named_numbers(message: Any, names: str, values: str, what: str) -> dict[str, float]:
    """Maps names in one field of a message to numbers in another field; both can be empty.

    Raises:
        MessageError: a name that occurs twice, or different numbers of values and names.
    """
    keys = names_of(getattr(message, names), f'{what}: {names}')
    found = numbers(getattr(message, values), (len(keys),), f'{what}: {values}')
    return dict(zip(keys, found.tolist(), strict=True))


def check_lengths(lengths: Mapping[str, float], what: str) -> None:
    """Raises MessageError if a segment length is not finite."""
    check_finite(np.array(list(lengths.values()), dtype=np.float64), f'{what}: segment_lengths')
