"""Model files as by a hostile author: changed arrays with a correct checksum and answer."""

from __future__ import annotations

import json
from contextlib import suppress

import numpy as np

from hmt_ros.body import learned_file
from hmt_ros.body.learned_file import checksum, write_arrays


def arrays_of(path):
    """All arrays of a file."""
    with np.load(path) as content:
        return dict(content)


def forged(arrays, changes, read=None):
    """The arrays with changes (None: without) and the checksum of these.

    Args:
        read: makes the model from its arrays; if possible, the example gets that model's answer.
    """
    result = {name: x for name, x in (arrays | changes).items() if x is not None}
    if read is not None:
        # If the model does not work, the file is written anyway.
        with suppress(Exception), np.errstate(all='ignore'):
            result['example/answer'] = learned_file._answer(read(result), result)
    result['checksum'] = np.array(checksum(result))
    return result


def write_forged(path, old, changes, read=None):
    """Writes the file `old` with changes, and returns the path."""
    return write_arrays(path, forged(arrays_of(old), changes, read))


def mutations(arrays, rng):
    """Names of mutations, and the arrays that each changes (None: removes)."""
    for name, values in arrays.items():
        if name.startswith(('example', 'checksum')):
            continue
        last = name.rpartition('/')[2]
        if last in ('parameters', 'card'):
            for what, text in _texts(json.loads(str(values))):
                yield f'{name}: {what}', {name: np.array(text)}
        elif values.dtype.kind == 'f':
            for what, other in _floats(values, rng):
                yield f'{name}: {what}', {name: other}
        elif values.dtype.kind == 'i':
            for what, other in _whole(values):
                yield f'{name}: {what}', {name: other}
        yield f'{name}: text', {name: np.full(values.shape, 'secret')}
        yield f'{name}: gone', {name: None}
        yield f'{name}: another', {f'{name}x': values}
        yield f'{name}: nested', {'/'.join(['model'] * 1000 + [name]): values}


def _floats(x, rng):
    kind = x.dtype
    for factor in (0.0, -1.0, 1e-3, 1e3, 1e-30, 1e30, 1e-300, 1e300):
        with np.errstate(all='ignore'):
            yield f'times {factor:g}', np.asarray(x * kind.type(factor), kind)
            yield f'times {factor:g}, in double', np.asarray(x.astype(float) * factor)
    for value in (1.0, 1e-320, 65504.0, 1e15, 1e29, np.nan, np.inf):
        with np.errstate(all='ignore'):
            yield f'all {value:g}', np.full_like(x, value)
            yield f'one {value:g}', np.where(np.arange(x.size).reshape(x.shape) == 0, value, x)
    yield 'permuted', rng.permutation(x.ravel()).reshape(x.shape)
    yield 'noise', rng.normal(size=x.shape).astype(kind)
    yield 'transposed', x.T.copy()
    yield 'less', x[1:] if x.ndim else np.zeros(0, kind)
    yield 'last axis less', x[..., 1:] if x.ndim else np.zeros((1, 0), kind)
    yield 'twice', np.concatenate([x, x]) if x.ndim else np.array([x, x])
    yield 'first alone', x[:1] if x.ndim else x[None]
    yield 'one axis more', x[None]
    yield 'scalar', x.ravel()[0]
    yield 'empty', np.zeros((0, *x.shape[1:]), kind)
    for other in (np.float16, np.float32, np.float64, np.int64, np.complex128, np.bool_, '>f8'):
        with np.errstate(all='ignore'):
            yield f'as {other}', x.astype(other)
    yield 'structured', np.zeros(x.shape, [('a', kind), ('b', kind)])
    if x.ndim > 1 and x.shape[-1] == x.shape[-2]:
        eye = np.eye(x.shape[-1], dtype=kind)
        yield 'indefinite', np.asarray(x - 2.0 * np.abs(x).max() * eye, kind)
        yield 'singular', np.asarray(np.ones_like(x) * np.abs(x).max(), kind)
        yield 'asymmetric', np.asarray(x + np.triu(np.full_like(eye, np.abs(x).max()), 1), kind)


def _whole(x):
    for value in (-(10**18), -1, 0, 1, 7, 10**9, 2**62):
        yield f'all {value}', np.full_like(x, value)
        yield f'one {value}', np.where(np.arange(x.size).reshape(x.shape) == 0, value, x)
    yield 'as float', x.astype(float)
    yield 'as int8', x.astype(np.int8)
    yield 'unsigned', x.astype(np.uint64)
    yield 'twice', np.concatenate([x, x]) if x.ndim else np.array([x, x])


def _texts(content):
    yield 'deep', '[' * 100_000
    yield 'deep mapping', '{"a":' * 100_000
    yield 'long', json.dumps(content | {'a': 'b' * 2**21})
    yield 'no mapping', '[1, 2]'
    yield 'cut', json.dumps(content)[:-1]
    yield 'empty', '{}'
    yield 'more', json.dumps(content | {'secret': 1})
    for key in content:
        yield f'without {key}', json.dumps({k: v for k, v in content.items() if k != key})
        for value in (
            *(None, True, -1, 0, 3, 10**9, 10**400, 0.5, 1e308, float('nan'), float('inf')),
            *('secret', '/etc/shadow', '', [], ['secret'], [1.0] * 40, {}, {'secret': -1.0}),
        ):
            yield f'{key} is {str(value)[:20]}', json.dumps(content | {key: value})
        if isinstance(content[key], list):
            own = content[key]
            for what, other in (('reversed', own[::-1]), ('same', own[:1] * len(own))):
                yield f'{key} {what}', json.dumps(content | {key: other})
        if isinstance(content[key], dict):
            for name in content[key]:
                for value in (None, 'secret', -1.0, 0.0, 1e-320, 1e308, float('nan')):
                    yield (
                        f'{key} {name} is {value}',
                        json.dumps(content | {key: content[key] | {name: value}}),
                    )
