"""Files of learned models: one .npz of plain arrays, verified with an example on reading.

An archive names its format, the version of the format and the kind of model. It contains the
constructor's parameters as JSON and the learned arrays. The arrays of a model inside another model
have a prefix (`nested`, `part`). A complete file also has

- `card`: training data, licence and method; JSON,
- `checksum`: SHA-256 of all other arrays, to distinguish damaged files from wrong models,
- `example/input` and `example/answer`: an input, and the model's prediction for it.

A reader builds the model, whose code checks shapes and ranges. The arrays that the model would
write must match the arrays in the file in name, type and shape. For the stored input, the model
must give the stored answer, a mixture of finite means and positive definite covariances.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.model_file import load_body, model_names
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import cholesky
from hmt_ros.inference.mixture import GaussianMixture
from msg_tools.files.array_file import read_archive
from msg_tools.files.error_line import error_line
from msg_tools.files.new_folder import new_file

FORMAT = 'hmt_ros model'
VERSION = 2

Arrays = dict[str, NDArray[Any]]

# Maximum sizes of a file: numbers and bytes of all arrays, characters of a text. A neighbour model
# with 80,000 silhouettes and a model for rule (1) has 19 million numbers.
MAX_VALUES, MAX_TEXT = 20_000_000, 2**20
MAX_FILE_BYTES = 8 * MAX_VALUES
# Maximum number of inputs or outputs of a model; a descriptor has a few hundred, a pose forty.
MAX_INPUTS = 10_000
# Ranges of positive numbers and of variances, and maximum ratio of variances. They keep products of
# a few numbers finite, and small variances significant in sums of covariances.
MIN_POSITIVE, MAX_POSITIVE = 1e-15, 1e30
MIN_VARIANCE, MAX_VARIANCE, MAX_RATIO = 1e-25, 1e12, 1e13
# Minimum eigenvalue of a correlation matrix for its Cholesky factor.
MIN_EIGENVALUE = 1e-13
# Maximum difference of an answer from the stored answer, in standard deviations and in nats per
# variable. Networks compute in single precision, which differs by up to 1e-5 between machines.
TOLERANCE = 1e-3
# Exceptions that wrong arrays can cause.
ARRAY_ERRORS = (
    OSError,
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    ArithmeticError,
    RuntimeError,
    MemoryError,
    np.linalg.LinAlgError,
)

_HEADER_FIELDS = ('format', 'version', 'kind')
_TEXT_FIELDS = ('format', 'kind', 'parameters', 'card', 'checksum')
_INTEGER_FIELDS = ('version', 'shape', 'active', 'n_experts')
_EXAMPLE_INPUT, _EXAMPLE_OUTPUT = 'example/input', 'example/answer'


class LearnedModel(Protocol):
    """Interface of a model that can be stored in a file."""

    def to_arrays(self) -> Arrays:
        """The header and the learned arrays."""

    def answer(self, given: Array) -> GaussianMixture:
        """Return the prediction of the model for an input."""


Model = TypeVar('Model', bound=LearnedModel)


@contextmanager
def named_faults(where: str) -> Iterator[None]:
    """Convert exceptions caused by invalid arrays to a one-line ValueError that names the file.

    Only messages of ValueErrors are repeated, because these never quote the file.
    """
    try:
        with np.errstate(all='ignore'):
            yield
    except ARRAY_ERRORS as fault:
        text = error_line(fault)[:150] if isinstance(fault, ValueError) else type(fault).__name__
        raise ValueError(
            f'{where}: not a model file that can be used ({text}); train or learn it again'
        ) from fault


def require(condition: object, what: str) -> None:
    """Raise ValueError with the given message unless the condition is true."""
    if not condition:
        raise ValueError(what)


def header(kind: str, parameters: Mapping[str, Any]) -> Arrays:
    """The arrays that identify an archive.

    Args:
        parameters: Constructor's parameters, serialisable as JSON.
    """
    return {
        'format': np.array(FORMAT),
        'version': np.array(VERSION),
        'kind': np.array(kind),
        'parameters': np.array(json.dumps(dict(parameters), sort_keys=True)),
    }


def check_header(arrays: Mapping[str, NDArray[Any]], kind: str) -> None:
    """Raise ValueError unless the arrays have the header of a model of the given kind."""
    single = [name for name in _HEADER_FIELDS if name in arrays and not arrays[name].ndim]
    found = {name: str(arrays[name]) for name in single}
    require(found.get('format') == FORMAT, 'it is none of hmt_ros')
    require(found.get('version') == str(VERSION), 'it is of another version')
    require(found.get('kind') == kind, f'it is none of kind {kind!r}')


def parameters_of(arrays: Mapping[str, NDArray[Any]], name: str = 'parameters') -> dict[str, Any]:
    """Read the constructor's parameters, or the card, from an archive.

    Raises:
        ValueError: the text is not a mapping in JSON.
    """
    result = json.loads(str(arrays[name]))
    require(isinstance(result, dict), f'{name} are no mapping')
    return dict(result)


def body_of(parameters: Mapping[str, Any]) -> Body:
    """Load the shipped body named in a file; a name cannot open any other file.

    Raises:
        ValueError: no body ships under this name.
    """
    require(parameters['body'] in model_names(), 'it is for a body that does not ship: give it')
    return load_body(parameters['body'])


def check_positive(name: str, values: Any) -> None:
    """Raise ValueError if numbers are not positive or are out of range."""
    require(
        np.min(values) >= MIN_POSITIVE and np.max(values) <= MAX_POSITIVE,
        f'{name} must be positive, from {MIN_POSITIVE:g} to {MAX_POSITIVE:g}',
    )


def check_covariances(name: str, values: Array, slack: float = -MIN_EIGENVALUE) -> None:
    """Checks covariances (..., D, D).

    Args:
        slack: number added to the eigenvalues of correlation matrices; a positive number allows
            semidefinite matrices.

    Raises:
        ValueError: the covariances are not symmetric and positive definite, or variances are out of
            range.
    """
    variances = np.diagonal(values, axis1=-2, axis2=-1)
    least, largest = variances.min(initial=1.0), variances.max(initial=1.0)
    require(
        least >= MIN_VARIANCE and largest <= min(MAX_VARIANCE, MAX_RATIO * least),
        f'{name} has variances out of {MIN_VARIANCE:g} to {MAX_VARIANCE:g}, or apart',
    )
    deviations = np.sqrt(variances)
    correlations = values / deviations[..., None] / deviations[..., None, :]
    same = np.allclose(correlations, np.swapaxes(correlations, -1, -2), atol=1e-6)
    require(same, f'{name} is not symmetric')
    cholesky(correlations + slack * np.eye(values.shape[-1]))


def write_model(
    path: str | Path,
    model: LearnedModel,
    read: Callable[[Arrays], LearnedModel],
    card: Mapping[str, Any],
    example: Array,
) -> Path:
    """Write a model completely or not at all, after checking that it can be read.

    Args:
        path: File to write; '.npz' is appended if it is missing.
        read: builds the model from its arrays.
        card: training data, licence and method, serialisable as JSON.
        example: an input, for `LearnedModel.answer`.

    Returns:
        The path written.

    Raises:
        ValueError: a reader would refuse the file.
    """
    arrays = model.to_arrays()
    whole = {**card, 'numbers': sum(values.size for values in arrays.values())}
    arrays |= {'card': np.array(json.dumps(whole, sort_keys=True)), _EXAMPLE_INPUT: example}
    with named_faults(str(path)):
        # Read the model back, so that its answer has the precision of the file.
        arrays[_EXAMPLE_OUTPUT] = _answer(read(arrays), arrays)
        arrays['checksum'] = np.array(checksum(arrays))
        checked_model(arrays, read)
    return write_arrays(path, arrays)


def read_model(path: str | Path, kind: str, read: Callable[[Arrays], Model]) -> Model:
    """Read the model in a file.

    Args:
        read: builds the model from its arrays.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file has an unsupported format or version, is of a different kind, damaged
            or invalid.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f'{path}: no such model file; train or learn one')
    with named_faults(str(path)):
        arrays = read_archive(path, MAX_FILE_BYTES)
        check_header(arrays, kind)
        return checked_model(arrays, read)


def checked_model(arrays: Arrays, read: Callable[[Arrays], Model]) -> Model:
    """Build the model from the arrays of a complete file, and check it.

    Raises:
        Exception: the arrays are damaged or wrong; one of `ARRAY_ERRORS`.
    """
    own = str(arrays.get('checksum'))
    require(own == checksum(arrays), 'it is damaged, its checksum is another one: copy it again')
    _check_values(arrays)
    model = read(arrays)
    numbers = [
        {name: (x.dtype, x.shape) for name, x in some.items() if x.dtype.kind != 'U'}
        for some in (
            arrays,
            model.to_arrays() | {x: arrays[x] for x in (_EXAMPLE_INPUT, _EXAMPLE_OUTPUT)},
        )
    ]
    require(numbers[0] == numbers[1], 'an array has another name, type or shape than usual')
    parameters_of(arrays, 'card')
    answer, stored = _answer(model, arrays), arrays[_EXAMPLE_OUTPUT]
    size = len(answer) // 2
    allowed = TOLERANCE * np.r_[answer[size:-1], answer[size:-1], size]
    same = answer.shape == stored.shape and (np.abs(answer - stored) <= allowed).all()
    require(same, 'it does not answer as when it was written')
    return model


def checksum(arrays: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 of the names, types, shapes and values of all arrays except the checksum."""
    result = hashlib.sha256()
    for name, values in sorted(arrays.items()):
        if name != 'checksum':
            result.update(f'{name} {values.dtype.str} {values.shape} '.encode('utf-8', 'replace'))
            result.update(values.tobytes())
    return result.hexdigest()


def _answer(model: LearnedModel, arrays: Arrays) -> Array:
    """Return mean, deviations (D,) and log density at the mean of the answer to the example."""
    found = model.answer(arrays[_EXAMPLE_INPUT])
    require(abs(found.weights.sum() - 1.0) < TOLERANCE, 'its weights do not sum to 1')
    check_covariances('its answer', found.covariances)
    mean, whole = found.mean(), found.covariance()
    told: Array = np.r_[mean, np.sqrt(np.diagonal(whole)), found.log_density(mean[None])]
    return told


def _check_values(arrays: Arrays) -> None:
    """Raise ValueError for wrong types of arrays and for numbers that are out of range."""
    size = sum(values.size for values in arrays.values())
    require(size <= MAX_VALUES, f'it has more than {MAX_VALUES} numbers')
    for name, values in arrays.items():
        own, kind = name.rpartition('/')[2], values.dtype.kind
        usual = 'U' if own in _TEXT_FIELDS else 'i' if own in _INTEGER_FIELDS else 'f'
        require(kind == usual, 'an array has another type than usual')
        if kind == 'U':
            require(values.nbytes <= 4 * MAX_TEXT, 'a text is too long')
        else:
            largest = float(np.abs(values).max(initial=0))
            require(
                largest <= MAX_POSITIVE, 'an array has values that are not finite, or too large'
            )


def write_arrays(path: str | Path, arrays: Mapping[str, NDArray[Any]]) -> Path:
    """Writes an archive completely or not at all; the same arrays give the same bytes.

    Args:
        path: File to write; '.npz' is appended if it is missing.

    Returns:
        The path written.
    """
    path = Path(path)
    if path.suffix != '.npz':
        path = path.with_name(path.name + '.npz')
    content: dict[str, Any] = dict(arrays)
    with new_file(path) as file:
        np.savez_compressed(file, **content)
    return path


def nested(prefix: str, arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    """Return the arrays under prefixed names, for use in a larger archive."""
    return {f'{prefix}/{name}': value for name, value in arrays.items()}


def part(prefix: str, arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    """Return the arrays that `nested` stored under a prefix."""
    opening = f'{prefix}/'
    return {
        name.removeprefix(opening): value
        for name, value in arrays.items()
        if name.startswith(opening)
    }
