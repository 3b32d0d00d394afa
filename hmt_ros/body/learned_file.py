"""Files of learned models: one .npz of plain arrays, which is checked by use when it is read.

An archive names its format, the version of the format and the kind of model. It holds the
constructor's parameters as JSON and the learned arrays. A model inside another one keeps its
arrays under a prefix: `nested` and `part`. A whole file has besides

- `card`: what the model was learned from, under which licence, and how; JSON,
- `checksum`: SHA-256 of all other arrays, which tells damage from a model that is wrong,
- `example/input` and `example/answer`: an input, and what the model predicts for it.

A reader makes the model, whose own code checks shapes and ranges; the arrays that it would write
must have the names, types and shapes of those of the file; and it must answer for the stored input,
by a mixture of finite means and positive definite covariances, as when it was written.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.model_file import load_body, model_names
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.mixture import GaussianMixture
from msg_tools.files.array_file import read_archive
from msg_tools.files.error_line import error_line

FORMAT = 'hmt_ros model'
VERSION = 2

Arrays = dict[str, NDArray[Any]]

# Maximum sizes of a file: bytes and numbers of all arrays, characters of a text.
LARGEST_FILE, MOST_VALUES, LONGEST_TEXT = 2**27, 2**24, 2**20
# Maximum number of inputs or outputs of a model; a descriptor has a few hundred, a pose forty.
MOST_NUMBERS = 10_000
# Range of positive numbers, and of variances. Products of a few of them are finite.
LEAST, LEAST_VARIANCE, LARGEST = 1e-15, 1e-30, 1e30
# Least eigenvalue of a correlation matrix of which Cholesky factors are taken.
LEAST_EIGENVALUE = 1e-13
# Difference of an answer from the stored one, in standard deviations and in nats per variable.
# Networks compute in single precision: that of another machine explains 1e-5.
TOLERANCE = 1e-3
# The exceptions that wrong arrays cause wherever they are used.
FAULTS = (
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    ArithmeticError,
    RuntimeError,
    MemoryError,
)

_HEADER = ('format', 'version', 'kind', 'parameters')
_TEXTS = ('format', 'kind', 'parameters', 'card', 'checksum')
_WHOLE_NUMBERS = ('version', 'shape', 'active', 'n_experts')
_INPUT, _ANSWER = 'example/input', 'example/answer'


class ModelFileError(ValueError):
    """Raised for a file that is no model, or none that can be used; one line with its path."""


class LearnedModel(Protocol):
    """What a file asks of a model."""

    def to_arrays(self) -> Arrays:
        """The header and the learned arrays."""

    def example_input(self) -> Array:
        """An input, of any shape, such as the model meets."""

    def answer(self, given: Array) -> GaussianMixture:
        """What the model predicts for an input."""


Model = TypeVar('Model', bound=LearnedModel)


@contextmanager
def named_faults(where: str) -> Iterator[None]:
    """Makes every exception that wrong arrays cause a `ModelFileError`."""
    try:
        with np.errstate(all='ignore'):
            yield
    except ModelFileError:
        raise
    except FAULTS as fault:
        raise ModelFileError(
            f'{where}: a wrong model file ({type(fault).__name__}: {error_line(fault)}); '
            'train it again'
        ) from fault


def header(kind: str, parameters: Mapping[str, Any]) -> Arrays:
    """The arrays that identify an archive.

    Args:
        parameters: Constructor's parameters; JSON must be able to hold them.
    """
    return {
        'format': np.array(FORMAT),
        'version': np.array(VERSION),
        'kind': np.array(kind),
        'parameters': _json(parameters),
    }


def check_header(arrays: Mapping[str, NDArray[Any]], kind: str, where: str) -> None:
    """Checks the arrays of `header`.

    Raises:
        ModelFileError: the format, the version or the kind is another one.
    """
    single = [name for name in _HEADER if name in arrays and not arrays[name].ndim]
    found = {name: str(arrays[name]) for name in single}
    if len(found) != len(_HEADER) or found['format'] != FORMAT:
        raise ModelFileError(f'{where}: not a model file of hmt_ros; train one')
    if found['version'] != str(VERSION):
        raise ModelFileError(f'{where}: a model file of another version; train it again')
    if found['kind'] != kind:
        raise ModelFileError(f'{where}: not a model of kind {kind!r}; load it as such')


def parameters_of(arrays: Mapping[str, NDArray[Any]], name: str = 'parameters') -> dict[str, Any]:
    """The constructor's parameters in an archive, or its card.

    Raises:
        ValueError: they are no JSON of a mapping.
    """
    result = json.loads(str(arrays[name]), parse_constant=_no_number)
    if not isinstance(result, dict):
        raise ValueError(f'{name} are a {type(result).__name__}, wanted a mapping')
    return result


def body_of(parameters: Mapping[str, Any], where: str) -> Body:
    """The body that ships under the name in a file, which must not lead to other files.

    Raises:
        ModelFileError: none ships under this name.
    """
    if parameters['body'] not in model_names():
        raise ModelFileError(f'{where}: learned for a body that does not ship: give it')
    return load_body(parameters['body'])


def check_shapes(arrays: Mapping[str, NDArray[Any]], **wanted: tuple[int, ...]) -> None:
    """Raises ValueError if arrays have other shapes than those wanted by name."""
    for name, shape in wanted.items():
        if arrays[name].shape != shape:
            raise ValueError(f'{name} has shape {arrays[name].shape}, wanted {shape}')


def check_positive(name: str, values: Any) -> None:
    """Raises ValueError if numbers are not positive, or so small or large that none are."""
    if not ((np.asarray(values) >= LEAST) & (np.asarray(values) <= LARGEST)).all():
        raise ValueError(f'{name} must be positive, from {LEAST:g} to {LARGEST:g}')


def check_covariances(name: str, values: Array, slack: float = -LEAST_EIGENVALUE) -> None:
    """Raises ValueError if covariances (..., D, D) are not symmetric and positive definite.

    Args:
        slack: added to the eigenvalues of the correlations; above 0, they may be semidefinite.
    """
    variances = np.diagonal(values, axis1=-2, axis2=-1)
    if not ((variances >= LEAST_VARIANCE) & (variances <= LARGEST)).all():
        raise ValueError(f'{name} has variances out of {LEAST_VARIANCE:g} to {LARGEST:g}')
    deviations = np.sqrt(variances)
    correlations = values / deviations[..., None] / deviations[..., None, :]
    if not np.allclose(correlations, np.swapaxes(correlations, -1, -2), atol=1e-6):
        raise ValueError(f'{name} is not symmetric')
    try:
        np.linalg.cholesky(correlations + slack * np.eye(values.shape[-1]))
    except np.linalg.LinAlgError:
        raise ValueError(f'{name} is not positive definite') from None


def write_model(
    path: str | Path,
    model: LearnedModel,
    read: Callable[[Arrays, str], LearnedModel],
    card: Mapping[str, Any],
) -> Path:
    """Writes a model that can be read again completely, or not at all.

    Args:
        path: File to write; '.npz' is appended where it is missing.
        read: makes the model from its arrays, given the name of the file for errors.
        card: what it was learned from, licence, method; JSON must be able to hold it.

    Returns:
        The path written.

    Raises:
        ModelFileError: a reader would refuse the file.
    """
    arrays = model.to_arrays()
    size = sum(values.size for values in arrays.values())
    arrays |= {'card': _json({**card, 'numbers': size}), _INPUT: model.example_input()}
    with named_faults(str(path)):
        # In the precision of the file, as a reader computes it.
        arrays[_ANSWER] = _answer(read(arrays, str(path)), arrays)
    arrays['checksum'] = np.array(checksum(arrays))
    checked_model(arrays, read, str(path))
    return write_arrays(path, arrays)


def read_model(path: str | Path, kind: str, read: Callable[[Arrays, str], Model]) -> Model:
    """The model in a file.

    Args:
        read: makes the model from the arrays, given the name of the file for errors.

    Raises:
        FileNotFoundError: there is no such file.
        ModelFileError: the file is none of this format, version and kind, or damaged, or wrong.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f'{path}: no such model file; train one')
    try:
        arrays = read_archive(path, LARGEST_FILE)
    except (OSError, *FAULTS) as fault:
        raise ModelFileError(
            f'{path}: not a model file of hmt_ros ({error_line(fault)}); train one'
        ) from fault
    with named_faults(str(path)):
        check_header(arrays, kind, str(path))
        return checked_model(arrays, read, str(path))


def checked_model(arrays: Arrays, read: Callable[[Arrays, str], Model], where: str) -> Model:
    """The model of the arrays of a whole file.

    Raises:
        ModelFileError: the arrays are damaged or wrong.
    """
    with named_faults(where):
        if str(arrays.get('checksum')) != checksum(arrays):
            raise ModelFileError(f'{where}: a damaged model file (other checksum); copy it again')
        _check_values(arrays)
        model = read(arrays, where)
        written = {name: (x.dtype, x.shape) for name, x in model.to_arrays().items()}
        found = {name: (x.dtype, x.shape) for name, x in arrays.items()}
        for name in {*written, *found} - {'card', 'checksum', _INPUT, _ANSWER}:
            if name.rpartition('/')[2] not in _TEXTS and written.get(name) != found.get(name):
                raise ValueError(f'an array has another name, type or shape than {FORMAT}s have')
        parameters_of(arrays, 'card')
        answer, stored = _answer(model, arrays), arrays[_ANSWER]
        size = len(answer) // 2
        allowed = TOLERANCE * np.r_[answer[size:-1], answer[size:-1], size]
        if answer.shape != stored.shape or not (np.abs(answer - stored) <= allowed).all():
            raise ValueError('it does not answer as when it was written')
    return model


def checksum(arrays: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 of the names, types, shapes and values of all arrays but the checksum."""
    result = hashlib.sha256()
    for name, values in sorted(arrays.items()):
        if name != 'checksum':
            result.update(f'{name} {values.dtype.str} {values.shape} '.encode('utf-8', 'replace'))
            result.update(values.tobytes())
    return result.hexdigest()


def _answer(model: LearnedModel, arrays: Arrays) -> Array:
    """What a model says for the stored input: mean, deviations (D,) and log density at the mean."""
    found = model.answer(arrays[_INPUT])
    if not abs(float(found.weights.sum()) - 1.0) < TOLERANCE:
        raise ValueError('the weights of its answer do not sum to 1')
    check_covariances('its answer', found.covariances)
    mean, whole = found.mean(), found.covariance()
    return np.r_[mean, np.sqrt(np.diagonal(whole)), found.log_density(mean[None])]


def _check_values(arrays: Arrays) -> None:
    if sum(values.size for values in arrays.values()) > MOST_VALUES:
        raise ValueError(f'it has more than {MOST_VALUES} numbers')
    for name, values in arrays.items():
        own = name.rpartition('/')[2]
        kind = 'U' if own in _TEXTS else 'i' if own in _WHOLE_NUMBERS else 'f'
        if values.dtype.kind != kind or (kind == 'U' and values.ndim):
            raise ValueError('an array has another type than those of model files')
        if kind == 'U' and values.dtype.itemsize > 4 * LONGEST_TEXT:
            raise ValueError(f'a text is longer than {LONGEST_TEXT} characters')
        if kind == 'f' and not float(np.abs(values).max(initial=0.0)) <= LARGEST:
            raise ValueError('an array has values that are not finite, or too large')


def _json(values: Mapping[str, Any]) -> NDArray[Any]:
    return np.array(json.dumps(dict(values), sort_keys=True))


def _no_number(text: str) -> None:
    raise ValueError('a number is not finite')


def write_arrays(path: str | Path, arrays: Mapping[str, NDArray[Any]]) -> Path:
    """Writes an archive completely or not at all; the same arrays give the same bytes.

    Args:
        path: File to write; '.npz' is appended where it is missing.

    Returns:
        The path written.
    """
    path = Path(path)
    if path.suffix != '.npz':
        path = path.with_name(path.name + '.npz')
    content: dict[str, Any] = dict(arrays)
    partial = path.with_name(f'.{path.name}.{secrets.token_hex(4)}.partial')
    try:
        with partial.open('xb') as file:
            np.savez_compressed(file, **content)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    return path


def nested(prefix: str, arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    """The arrays with names under a prefix, as part of a larger archive."""
    return {f'{prefix}/{name}': value for name, value in arrays.items()}


def part(prefix: str, arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    """The arrays that `nested` put under a prefix."""
    opening = f'{prefix}/'
    return {
        name.removeprefix(opening): value
        for name, value in arrays.items()
        if name.startswith(opening)
    }
