"""Soak test of file readers with damaged YAML files, model files and images."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.clips import ROOT
from benchmarks.machine import forget_peak, peak_memory, resident_memory
from benchmarks.mutations import damaged
from benchmarks.soak.outcome import Amount, Outcome, place, warnings_as_errors
from benchmarks.soak.scenes import CLIP
from hmt_ros.body import load_body
from hmt_ros.experts import load_predictor
from hmt_ros.sessions.camera_session import read_picture
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.parameter_file import read_parameter_file
from hmt_ros.sessions.tracking_parameters import FilterParameters
from hmt_ros.tracking import read_subject

# Strange values for text files.
_TEXT = """
null .nan -.inf 1e999 -1 0 [] {} '' !!python/name:os.system 999999999999999999999 yes % "
"""
_WORDS = (*_TEXT.split(), '', '&a [*a]', '[[1, 2], 3]', '{a: b}', '2024-01-01', '\t', ': ')
_WORDS = (*_WORDS, '- - -', '\ud7ff', '\x00')


@dataclass(frozen=True)
class _Kind:
    """A kind of file.

    Attributes:
        name: name of the kind.
        suffix: suffix of its files.
        valid: content of a valid file.
        damage: function that damages the content.
        read: function of a node or a command that reads the file.
    """

    name: str
    suffix: str
    valid: bytes
    damage: Callable[[bytes, np.random.Generator], bytes]
    read: Callable[[Path], Any]


def files(amount: Amount, *, quick: bool = False) -> Iterator[Outcome]:
    """Reads damaged files of every kind; each must be used, or refused with one line."""
    kinds = _kinds()[: 3 if quick else None]
    with TemporaryDirectory(prefix='hmt_ros.') as folder:
        for kind in kinds:
            with warnings_as_errors():
                outcome = _read_damaged(kind, Path(folder), amount.part(1.0 / len(kinds)))
            yield outcome


def _kinds() -> list[_Kind]:
    body = load_body('human37')
    config = (ROOT / 'hmt_ros' / 'config' / 'filter_node.yaml').read_bytes()
    subject = (CLIP / 'subject.yaml').read_bytes()
    models = ROOT / 'hmt_ros' / 'experts' / 'models'
    human = (ROOT / 'hmt_ros' / 'body' / 'models' / 'human37.yaml').read_bytes()

    def parameters(path: Path) -> Any:
        return with_values(FilterParameters(), read_parameter_file(path, 'filter_node'))

    def posed(path: Path) -> Any:
        found = load_body(str(path))
        return found.joint_positions(found.prior_mean[None])

    def subjects(path: Path) -> Any:
        return read_subject(path, body)

    def picture(path: Path) -> Any:
        return read_picture(str(path))

    model = (models / 'silhouettes.npz').read_bytes()
    background = (CLIP / 'background.png').read_bytes()
    return [
        _Kind('parameter files', '.yaml', config, _damaged_text, parameters),
        _Kind('subject files', '.yaml', subject, _damaged_text, subjects),
        _Kind('bodies', '.yaml', human, _damaged_text, posed),
        _Kind('model files, bytes', '.npz', model, damaged, load_predictor),
        _Kind('model files, arrays', '.npz', model, _damaged_arrays, load_predictor),
        _Kind('pictures', '.png', background, damaged, picture),
    ]


def _read_damaged(kind: _Kind, folder: Path, amount: Amount) -> Outcome:
    outcome = Outcome(kind.name, 'damaged, and read')
    rng = np.random.default_rng(0)
    path = folder / f'file{kind.suffix}'
    path.write_bytes(kind.valid)
    kind.read(path)
    forget_peak()
    before = resident_memory()
    for _ in amount.counted():
        path.write_bytes(kind.damage(kind.valid, rng))
        outcome.times += 1
        try:
            kind.read(path)
        except (ValueError, OSError) as error:
            outcome.refused += 1
            if '\n' in str(error):
                outcome.fault(f'more than one line: {place(error)}')
        except Exception as error:  # noqa: BLE001
            outcome.fault(place(error))
    outcome.growth_mb = (peak_memory() - before) / 1e6
    path.write_bytes(kind.valid)
    kind.read(path)
    return outcome


def _damaged_text(data: bytes, rng: np.random.Generator) -> bytes:
    """Text with damaged bytes, or with changed, lost, doubled or swapped lines."""
    if rng.random() < 0.3:
        return damaged(data, rng)
    lines = data.decode().split('\n')
    content = [i for i, line in enumerate(lines) if line.strip() and line.lstrip()[0] != '#']
    for _ in range(int(rng.integers(1, 4))):
        at, other = (int(rng.choice(content)) for _ in range(2))
        word = _WORDS[int(rng.integers(0, len(_WORDS)))]
        kind = int(rng.integers(0, 6))
        if kind <= 1:
            lines[at] = f'{lines[at].partition(":")[0]}: {word}'
        elif kind == 2:
            lines[at] = ''
        elif kind == 3:
            lines[at] = f'{lines[at]}\n{lines[at]}'
        elif kind == 4:
            lines[at], lines[other] = lines[other], lines[at]
        else:
            lines[at] = f'{lines[at]} {word}'
    return '\n'.join(lines).encode('utf-8', 'replace')


def _damaged_arrays(data: bytes, rng: np.random.Generator) -> bytes:
    """A valid archive with arrays that are missing or have other shapes, types or numbers."""
    with np.load(io.BytesIO(data)) as archive:
        arrays = {name: archive[name] for name in archive.files}
    names = sorted(arrays)
    for _ in range(int(rng.integers(1, 4))):
        name = names[int(rng.integers(0, len(names)))]
        if name not in arrays:
            continue
        arrays[name] = _damaged_array(arrays[name], rng)
        if rng.random() < 0.1:
            del arrays[name]
    target = io.BytesIO()
    np.savez(target, **arrays)
    return target.getvalue()


def _damaged_array(values: Any, rng: np.random.Generator) -> Any:
    kind = int(rng.integers(0, 8))
    if kind == 0:
        return values.reshape(-1)
    if kind == 1:
        return values[..., None]
    if kind == 2:
        return np.zeros(0, values.dtype)
    if kind == 3:
        # A whole large array as text would be a hundred times as large as the model.
        return values.ravel()[:1000].astype('U') if values.dtype.kind != 'U' else np.array(7)
    if values.dtype.kind == 'f' and values.size:
        wrong = np.array(values)
        wrong.flat[int(rng.integers(0, wrong.size))] = (np.nan, np.inf, -6e4, 0.0)[kind - 4]
        return wrong
    if values.dtype.kind in 'iu' and values.size:
        wrong = np.array(values)
        wrong.flat[int(rng.integers(0, wrong.size))] = (-1, 0, 2**30, 1)[kind - 4]
        return wrong
    if values.dtype.kind == 'U':
        return np.array(damaged(str(values).encode(), rng).decode('utf-8', 'replace'))
    return values[:1] if values.ndim else values
