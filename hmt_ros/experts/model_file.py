"""Model files: one .npz of plain arrays, without pickled objects.

An archive names its format, the version of the format and the kind of model. It holds the
constructor's parameters as JSON and the learned arrays. A model inside another one keeps its
arrays under a prefix: `nested` and `part`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_tools.files.array_file import read_archive
from msg_tools.files.error_line import error_line
from msg_tools.files.new_folder import new_file

FORMAT = 'hmt_ros model'
VERSION = 1

Arrays = dict[str, NDArray[Any]]

# Maximum number of inputs or outputs of a model; a descriptor has a few hundred, a pose forty.
MOST_NUMBERS = 10_000
# The exceptions that wrong arrays cause wherever they are used.
FAULTS = (KeyError, TypeError, ValueError, IndexError, np.linalg.LinAlgError)

_HEADER = ('format', 'version', 'kind', 'parameters')


def header(kind: str, parameters: Mapping[str, Any]) -> Arrays:
    """The arrays that identify an archive.

    Args:
        parameters: Constructor's parameters; JSON must be able to hold them.
    """
    return {
        'format': np.array(FORMAT),
        'version': np.array(VERSION),
        'kind': np.array(kind),
        'parameters': np.array(json.dumps(dict(parameters), sort_keys=True)),
    }


def check_header(arrays: Mapping[str, NDArray[Any]], kind: str | None, where: str) -> None:
    """Checks the arrays of `header`.

    Raises:
        ValueError: the format, the version or the kind is another one.
    """
    if any(name not in arrays for name in _HEADER) or str(arrays['format']) != FORMAT:
        raise ValueError(f'{where}: not a model file of hmt_ros; train one with `train`')
    version = str(arrays['version'])
    if version != str(VERSION):
        raise ValueError(
            f'{where}: model file of version {version!r}, wanted {VERSION}; train it again'
        )
    found = str(arrays['kind'])
    if kind is not None and found != kind:
        raise ValueError(f'{where}: a model of kind {found!r}, wanted {kind!r}; load it as such')


def parameters_of(arrays: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """The constructor's parameters in an archive."""
    result = json.loads(str(arrays['parameters']))
    if not isinstance(result, dict):
        raise ValueError(f'parameters are a {type(result).__name__}, wanted a mapping')
    return result


def damaged(where: str, fault: Exception) -> ValueError:
    """The error to raise from one of `FAULTS`."""
    kind = type(fault).__name__
    return ValueError(
        f'{where}: a damaged model file ({kind}: {error_line(fault)}); train it again'
    )


def write_arrays(path: str | Path, arrays: Mapping[str, NDArray[Any]]) -> Path:
    """Writes an archive completely or not at all; the same arrays give the same bytes.

    Args:
        path: File to write; '.npz' is appended where it is missing.

    Returns:
        The path written.

    Raises:
        ValueError: there is a link, or something that is no file.
        OSError: it can not be written.
    """
    path = Path(path)
    if path.suffix != '.npz':
        path = path.with_name(path.name + '.npz')
    content: dict[str, Any] = dict(arrays)
    with new_file(path) as file:
        np.savez_compressed(file, **content)
    return path


def read_arrays(path: str | Path, kind: str | None = None) -> Arrays:
    """The arrays of an archive.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not an archive of this format, version and kind.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f'{path}: no such model file; train one with `train`')
    try:
        arrays = read_archive(path)
    except (OSError, ValueError) as fault:
        raise ValueError(f'{path}: not a model file of hmt_ros ({error_line(fault)})') from fault
    check_header(arrays, kind, str(path))
    for name, values in arrays.items():
        if values.dtype.kind == 'f' and not np.isfinite(values).all():
            raise ValueError(
                f'{path}: a damaged model file ({name} has values that are not finite); '
                'train it again'
            )
    return arrays


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
