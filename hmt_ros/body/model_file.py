"""Bodies from YAML model files; `models/human37.yaml` explains the format.

Lengths vary over people by a common stature and by individual proportions:

    l_i = l0_i exp(s + e_i),    s ~ N(0, t^2),  e_i ~ N(0, p_i^2)
    S_l = L0 (t^2 1 1' + diag(p^2)) L0,    L0 = diag(l0)

to first order in the spreads. t is the spread of the stature, p_i the spread of the proportion of
length i. Measurements of a person give linear functions H l of the lengths, with covariance R:

    S_l <- S_l - S_l H' (H S_l H' + R)^-1 H S_l
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import deepcopy
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.body.body import Body, PartShape, symmetries_of
from hmt_ros.body.skeleton import Skeleton
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import length, product, solve
from msg_tools.files.plain_yaml import load_plain_yaml, read_plain_yaml

AXES = {
    'x': (0, True),
    'y': (1, True),
    'z': (2, True),
    'tx': (0, False),
    'ty': (1, False),
    'tz': (2, False),
}
MIRROR = np.array([-1.0, 1.0, 1.0])
DIFFUSION = (0.25, 1.4)  # default diffusion of a root in one second, m and rad
MAX_COORDINATE = 1000.0  # upper bound of lengths, m
MAX_RINGS = 100
MAX_FILE_BYTES = 250_000  # maximum size of a model file, bytes; usual is a few kB


def model_names() -> list[str]:
    """Names of the bodies that ship with the package."""
    folder = resources.files('hmt_ros.body') / 'models'
    return sorted(
        f.name.removesuffix('.yaml') for f in folder.iterdir() if f.name.endswith('.yaml')
    )


def shipped_file(body: str, kind: str) -> Path | None:
    """Return the shipped file of a body, of kind 'prior' or 'motion', or None if missing.

    Names may come from messages, so they must not open other files.
    """
    file = Path(__file__).parent / 'models' / f'{body}_{kind}.npz'
    return file if body in model_names() and file.is_file() else None


def load_body(source: str | Path) -> Body:
    """Load a body from a YAML file, or by a shipped name: 'human37', 'human34' or 'human32'.

    `hmt_learning.motion.motion_file.read_skeleton` reads the skeleton of a motion file.

    Raises:
        FileNotFoundError: the argument is neither a file nor a known name.
        ValueError: the file does not describe a body; the message names the file and the entry.
    """
    try:
        with np.errstate(all='ignore'):  # a body whose numbers overflow is refused
            return _build(_read(source))
    except (KeyError, TypeError, AttributeError, IndexError) as fault:
        raise ValueError(
            f'{source}: not a body model ({type(fault).__name__}: {fault}); '
            'compare with human37.yaml'
        ) from fault
    except ValueError as fault:
        text = ' '.join(str(fault).split())
        raise ValueError(
            f'{source}: not a body model ({text}); compare with human37.yaml'
        ) from fault


def named_body(name: str) -> Body:
    """Return a shipped body by name; names from messages cannot open other files.

    Raises:
        FileNotFoundError: no body ships under this name.
    """
    known = model_names()
    if name not in known:
        raise FileNotFoundError(f'no body {name!r}: wanted one of {known}')
    return _built(name)


@cache
def _built(name: str) -> Body:
    """Return a shipped body; cached, because each message with new lengths needs it."""
    return load_body(name)


def _read(source: str | Path) -> dict[str, Any]:
    """Read a model file, merged with the model that it extends."""
    if str(source) in model_names():
        return deepcopy(_shipped(str(source)))
    path = Path(source)
    if not path.is_file():
        raise FileNotFoundError(
            f'no body {str(source)!r}: wanted one of {model_names()}, or a YAML file'
        )
    return _whole(read_plain_yaml(path, MAX_FILE_BYTES))


@cache
def _shipped(name: str) -> dict[str, Any]:
    """Read a shipped model file; cached, because reading takes 50 ms."""
    file = resources.files('hmt_ros.body') / 'models' / f'{name}.yaml'
    return _whole(load_plain_yaml(file.read_text('utf-8')))


def usual_symmetries() -> Mapping[str, float]:
    """Return the symmetries of human37, the default for bodies without their own table."""
    result: Mapping[str, float] = _shipped('human37')['symmetries']
    return result


def usual_postures() -> Mapping[str, Mapping[str, Any]]:
    """Return the postures of human37, for all bodies; see `body.postures`."""
    result: Mapping[str, Mapping[str, Any]] = _shipped('human37')['postures']
    return result


def joint_errors_of(joint_names: Sequence[str], table: Mapping[str, float] | None = None) -> Array:
    """Return the errors (J,) of joints, m, from a table, by default human37's; see `Body`.

    A joint that the table lacks gets the largest error in the table.

    Raises:
        ValueError: an entry is negative or not finite, or names a joint that the body lacks.
    """
    known = _shipped('human37')['joint_errors'] if table is None else table
    errors = {joint: float(error) for name, error in known.items() for joint, _ in _sides(name)}
    if not errors or not all(0.0 <= error < math.inf for error in errors.values()):
        raise ValueError(f'joint_errors: wanted numbers of at least 0 by joint, saw {known}')
    strange = sorted(errors.keys() - set(joint_names))
    if table is not None and strange:
        raise ValueError(f'joint_errors names {strange}, which the body does not have')
    return np.array([errors.get(name, max(errors.values())) for name in joint_names])


def _whole(content: Any) -> dict[str, Any]:
    """Merge the content of a model with the shipped model that it extends."""
    if not isinstance(content, dict):
        raise ValueError(f'wanted a mapping, saw {type(content).__name__}')
    if 'extends' in content:
        name = content.pop('extends')
        if name not in model_names():
            raise ValueError(f'it extends {str(name)[:40]!r}, wanted one of {model_names()}')
        base = deepcopy(_shipped(name))
        fixed = [*base.get('fixed', []), *content.pop('fixed', [])]
        return {**base, **content, 'fixed': fixed}
    return content


def _sides(template: str) -> list[tuple[str, str]]:
    """Expand a template to (name, side) pairs; names without a side get the right side."""
    sides = ('left', 'right') if '{side}' in template else ('right',)
    return [(template.replace('{side}', side), side) for side in sides]


def _linear(term: Any, names: tuple[str, ...]) -> tuple[float, Array]:
    """Parse a number or 'factor * length' to a constant and the coefficients of all lengths."""
    coefficients = np.zeros(len(names))
    if isinstance(term, (int, float)):
        return float(term), coefficients
    factor, _, name = (x.strip() for x in str(term).rpartition('*'))
    if name not in names:
        raise ValueError(f'{term!r} is neither a number nor a multiple of one of {list(names)}')
    coefficients[names.index(name)] = float(factor) if factor else 1.0
    return 0.0, coefficients


def _mount(entry: dict[str, Any]) -> Array:
    """Return the rotation with the given x axis whose -z axis points along the segment."""
    x = np.array(entry.get('x_axis', [1, 0, 0]), dtype=float)
    down = np.array(entry.get('points', [0, 0, -1]), dtype=float)
    x /= length(x)
    down = down - x * product(x, down)
    if not length(down) > 1e-6:
        raise ValueError(f'segment {entry["name"]}: `points` and `x_axis` must differ in direction')
    z = -down / length(down)
    return np.stack([x, np.cross(z, x), z], axis=1)


KEYS = {
    'name',
    'lengths',
    'stature_spread',
    'stature',
    'stature_extra',
    'segments',
    'joints',
    'chains',
    'fixed',
    'symmetries',
    'joint_errors',
    'postures',
}
SEGMENT_KEYS = {
    'name',
    'parent',
    'offset',
    'points',
    'x_axis',
    'length',
    'diffusion',
    'dofs',
    'flesh',
}
FLESH_KEYS = {'centre', 'radii', 'exponents', 'taper', 'bend', 'extend', 'rings', 'size'}


def _check_keys(entry: dict[str, Any], known: set[str], what: str) -> None:
    unknown = sorted(str(key) for key in entry if key not in known)
    if unknown:
        raise ValueError(f'{what} has unknown entries {unknown}; known are {sorted(known)}')


def _named(name: str, names: tuple[str, ...], what: str) -> int:
    if name not in names:
        raise ValueError(f'{what} {name!r} is not one of {list(names)}')
    return names.index(name)


def _build(content: dict[str, Any]) -> Body:
    _check_keys(content, KEYS, 'the model')
    length_names = tuple(content['lengths'])
    lengths = np.array([float(v[0]) for v in content['lengths'].values()])
    relative = np.array([float(v[1]) for v in content['lengths'].values()])
    if not (np.abs([lengths, relative]) < MAX_COORDINATE).all():
        raise ValueError(
            f'lengths must be finite and below {MAX_COORDINATE:g} m, saw {content["lengths"]}'
        )
    stature_spread = float(content.get('stature_spread', STATURE_SPREAD))
    for name in content['stature']:
        _named(name, length_names, 'stature:')
    fixed_dofs = {name for entry in content.get('fixed', []) for name, _ in _sides(entry)}
    left_over = set(fixed_dofs)

    names: list[str] = []
    parents, mounts, fixed, basis = [], [], [], []
    dofs: list[tuple[str, int, int, bool, float, float, float, float]] = []
    diffusions: list[tuple[float, float]] = []
    rates: list[float] = []
    shapes: list[PartShape] = []
    own_length: list[int | None] = []
    sided = [(entry, *own) for entry in content['segments'] for own in _sides(entry['name'])]
    for entry, name, side in sided:
        _check_keys(entry, SEGMENT_KEYS, f'segment {name}')
        mirrored, parent_name = side == 'left', entry.get('parent')
        parent = -1 if parent_name is None else names.index(parent_name.replace('{side}', side))
        sign = MIRROR if mirrored else np.ones(3)
        mount = _mount(entry) * (np.outer(MIRROR, MIRROR) if mirrored else 1.0)
        constant, coefficients = np.zeros(3), np.zeros((3, len(length_names)))
        if 'offset' in entry:
            for i, term in enumerate(entry['offset']):
                constant[i], coefficients[i] = _linear(term, length_names)
        elif parent >= 0 and own_length[parent] is not None:
            coefficients[2, own_length[parent]] = -1.0
        segment = len(names)
        names.append(name)
        parents.append(parent)
        mounts.append(mount)
        fixed.append(sign * constant)
        basis.append(sign[:, None] * coefficients)
        inherited = diffusions[parent] if parent >= 0 else DIFFUSION
        diffusions.append(_diffusion(entry, inherited))
        span = entry.get('length')
        own_length.append(
            None if span is None else _named(span, length_names, f'segment {name}: length')
        )
        for dof in entry.get('dofs', []):
            dof_name = dof[0].replace('{side}', side)
            if dof_name in fixed_dofs:
                left_over.discard(dof_name)
                continue
            dofs.append((dof_name, segment, *_dof(dof, mirrored)))
            rates.append(diffusions[-1][int(dofs[-1][3])] ** 2)
        if 'flesh' in entry:
            shapes.append(_shape(entry['flesh'], segment, own_length[-1], length_names, mirrored))
    if left_over:
        raise ValueError(f'`fixed` names {sorted(left_over)}, which the body does not have')

    joint_names, joint_segments, joint_basis = [], [], []
    for template, (segment_template, end) in content['joints'].items():
        for joint, side in _sides(template):
            segment = names.index(segment_template.replace('{side}', side))
            coefficients = np.zeros((3, len(length_names)))
            if end == 'end':
                coefficients[2, own_length[segment]] = -1.0
            elif end != 'start':
                raise ValueError(f'joint {joint}: wanted start or end of a segment, saw {end!r}')
            joint_names.append(joint)
            joint_segments.append(segment)
            joint_basis.append(coefficients)
    chains = {}
    for template, members in content.get('chains', {}).items():
        for chain, side in _sides(template):
            chains[chain] = tuple(names.index(m.replace('{side}', side)) for m in members)

    columns = list(zip(*dofs, strict=True))
    skeleton = Skeleton(
        name=str(content['name']),
        segment_names=tuple(names),
        parents=tuple(parents),
        mounts=np.array(mounts),
        fixed_offsets=np.array(fixed),
        offset_basis=np.array(basis),
        dof_names=tuple(columns[0]),
        dof_segments=np.array(columns[1], dtype=np.intp),
        dof_axes=np.array(columns[2], dtype=np.intp),
        dof_is_rotation=np.array(columns[3], dtype=bool),
        lower=np.array(columns[4]),
        upper=np.array(columns[5]),
        joint_names=tuple(joint_names),
        joint_segments=np.array(joint_segments, dtype=np.intp),
        joint_basis=np.array(joint_basis),
        length_names=length_names,
        lengths=lengths,
        chains=chains,
    )
    return Body(
        skeleton=skeleton,
        shapes=tuple(shapes),
        prior_mean=np.array(columns[6]),
        prior_sigma=np.array(columns[7]),
        rates=np.array(rates),
        length_covariance=length_covariance(lengths, relative, stature_spread),
        stature_lengths=tuple(content['stature']),
        stature_extra=float(content['stature_extra']),
        default_lengths=lengths,
        symmetries=symmetries_of(content.get('symmetries', usual_symmetries())),
        joint_errors=joint_errors_of(joint_names, content.get('joint_errors')),
    )


def _diffusion(entry: dict[str, Any], inherited: tuple[float, float]) -> tuple[float, float]:
    """Standard deviations of a segment's translations and rotations after one second, m and rad."""
    given = entry.get('diffusion', inherited)
    shift, turn = given if isinstance(given, (list, tuple)) else (inherited[0], given)
    return float(shift), float(turn)


def _dof(entry: list[Any], mirrored: bool) -> tuple[int, bool, float, float, float, float]:
    _, letter, *numbers = entry
    if letter not in AXES:
        raise ValueError(f'{entry}: axis {letter!r} is not one of {list(AXES)}')
    axis, is_rotation = AXES[letter]
    unit = np.pi / 180 if is_rotation else 1.0
    low, high, *prior = (float(x) * unit for x in numbers)
    mean, sigma = prior or (0.0, np.inf)
    # A mirror reverses rotations about y and z, and translations along x.
    if mirrored and is_rotation == (axis != 0):
        low, high, mean = -high, -low, -mean
    return axis, is_rotation, low, high, mean, sigma


def _shape(
    flesh: dict[str, Any],
    segment: int,
    length: int | None,
    length_names: tuple[str, ...],
    mirrored: bool,
) -> PartShape:
    _check_keys(flesh, FLESH_KEYS, 'flesh')
    size = _named(flesh['size'], length_names, 'flesh: size') if 'size' in flesh else length
    radii = tuple(float(x) for x in flesh['radii'])
    rings = int(flesh.get('rings', 5))
    if not 1 <= rings <= MAX_RINGS:
        raise ValueError(f'rings must be 1 to {MAX_RINGS}, saw {rings}')
    if len(radii) not in (2, 3) or not all(r > 0 for r in radii):
        raise ValueError(f'radii must be two or three positive numbers, saw {list(radii)}')
    spans = len(radii) == 2
    if spans and length is None:
        raise ValueError('flesh with two radii needs a segment with a length')
    sign = -1.0 if mirrored else 1.0
    cx, cy, cz = (float(x) for x in flesh.get('centre', (0, 0, 0)))
    bx, by = (float(x) for x in flesh.get('bend', (0, 0)))
    e1, e2 = (float(x) for x in flesh.get('exponents', (1, 1)))
    tx, ty = (float(x) for x in flesh.get('taper', (0, 0)))
    start, end = (float(x) for x in flesh.get('extend', (0, 0)))
    return PartShape(
        segment=segment,
        length=length if spans else None,
        centre=(sign * cx, cy, cz),
        radii=radii,
        exponents=(e1, e2),
        taper=(tx, ty),
        bend=(sign * bx, by),
        extend=(start, end),
        rings=rings,
        size=size,
    )


# Default relative standard deviation of the stature over people.
STATURE_SPREAD = 0.06


def length_covariance(
    lengths: ArrayLike, proportions: ArrayLike, stature: float = STATURE_SPREAD
) -> Array:
    """Covariance (L, L) of lengths over people, m^2.

    Args:
        lengths: (L,) lengths of the typical person, m.
        proportions: (L,) relative standard deviations of the proportions.
        stature: relative standard deviation of the common stature.

    Raises:
        ValueError: a spread is negative or not finite.
    """
    typical, own = (np.asarray(x, dtype=np.float64) for x in (lengths, proportions))
    if not 0.0 <= stature < MAX_COORDINATE:
        raise ValueError(f'stature_spread must be a number of at least 0, saw {stature}')
    if not (np.isfinite(own).all() and (own >= 0).all()):
        raise ValueError(f'spreads of lengths must be numbers of at least 0, saw {own.tolist()}')
    common = stature * typical
    result: Array = np.diag((own * typical) ** 2) + np.outer(common, common)
    return result


def conditioned_covariance(covariance: Array, functions: ArrayLike, sigma: ArrayLike) -> Array:
    """Condition the covariance (L, L) of lengths on known linear functions of them.

    Args:
        covariance: (L, L) prior covariance.
        functions: (M, L) matrix H.
        sigma: (M,) standard deviations of the known values of H l, positive.
    """
    rows = np.asarray(functions, dtype=np.float64)
    noise = np.diag(np.asarray(sigma, dtype=np.float64) ** 2)
    cross = product(rows, covariance)
    result = covariance - product(cross.T, solve(product(cross, rows.T) + noise, cross))
    symmetric: Array = 0.5 * (result + result.T)
    return symmetric
