"""Mixtures over the angles of a body that are their own mirror image, and the files they ship in.

    p(a) = w_0 N(a; m_0, S_0) + sum_k w_k/2 [N(a; m_k, S_k) + N(Ra; m_k, S_k)]

a are the angles of a pose, R their mirror image, left for right. Component 0 is broad: it bounds
the energy of a pose that resembles nothing learned.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from hmt_ros.body.body import Body
from hmt_ros.body.mirror import mirror_order
from hmt_ros.body.model_file import load_body, shipped_file
from hmt_ros.body.skeleton import Skeleton
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.mixture import GaussianMixture
from msg_tools.files.array_file import read_archive

FORMAT = 'hmt_ros pose prior'
VERSION = 1
LARGEST_FILE = 10_000_000  # bytes of all arrays; the file that ships has some tens of kB
MOST_COMPONENTS = 1000
# Steps of the climb to the highest density, and the step at which it ends, rad.
CLIMB, ARRIVED = 1000, 1e-7
SAME = 1e-4  # difference of two rotations at rest that single precision explains

_ARRAYS = ('format', 'version', 'body', 'dofs', 'mounts', 'weights', 'means', 'factors', 'card')


@dataclass(frozen=True, eq=False)
class AngleMixture:
    """A mixture over some of the angles of a body, left for right its own mirror image.

    Attributes:
        skeleton: whose angles; its lengths do not matter.
        dofs: names of the n degrees of freedom that it covers.
        components: broad component first, then K components; the weight of each of these is that
            of the component and its mirror image together.
        card: data, method and licence, text by heading.

    Raises:
        ValueError: names that the body does not have or that lack their mirror image, or
            components that are none; one line.
    """

    skeleton: Skeleton
    dofs: tuple[str, ...]
    components: GaussianMixture
    card: Mapping[str, str]

    def __post_init__(self) -> None:
        unknown = [name for name in self.dofs if name not in self.skeleton.dof_names]
        if unknown:
            raise ValueError(f'{self.skeleton.name} has no degrees of freedom {unknown}')
        rotation = self.skeleton.dof_is_rotation[self.indices]
        if len(set(self.dofs)) != len(self.dofs) or not rotation.all():
            raise ValueError(f'wanted different angles, saw {list(self.dofs)}')
        count, total = len(self.components), float(self.components.weights.sum())
        if self.components.dimension != len(self.dofs) or not 2 <= count <= MOST_COMPONENTS:
            raise ValueError(
                f'{count} components over {self.components.dimension} angles, wanted 2 to '
                f'{MOST_COMPONENTS} over {len(self.dofs)}'
            )
        if not abs(total - 1.0) < 1e-3 or not (self.components.weights > 0).all():
            raise ValueError(f'weights must be positive and sum to 1, saw a sum of {total:g}')
        self.components.cholesky()
        _ = self._mirror_order

    @cached_property
    def indices(self) -> Index:
        """Degrees of freedom (n,) of the body that the mixture covers."""
        return np.asarray(self.skeleton.dof_index(self.dofs), dtype=np.intp)

    @cached_property
    def whole(self) -> GaussianMixture:
        """The mixture with the mirror images as components of their own, weights that sum to 1."""
        order, signs = self._mirror_order
        own = self.components
        halves = own.weights[1:] / 2.0
        image = own.covariances[1:][:, order[:, None], order] * np.outer(signs, signs)
        return GaussianMixture(
            np.concatenate([own.weights[:1], halves, halves]),
            np.concatenate([own.means, own.means[1:][:, order] * signs]),
            np.concatenate([own.covariances, image]),
        ).normalised()

    @cached_property
    def whitening(self) -> Array:
        """Inverse Cholesky factors (C, n, n) of the covariances of `whole`, lower triangular."""
        return np.ascontiguousarray(np.tril(np.linalg.inv(self.whole.cholesky())))

    @cached_property
    def precisions(self) -> Array:
        """Inverse covariances (C, n, n) of `whole`."""
        result: Array = np.einsum('cki,ckj->cij', self.whitening, self.whitening)
        return result

    @cached_property
    def highest(self) -> float:
        """The largest log density."""
        whole, precisions = self.whole, self.precisions
        pulled = np.einsum('cij,cj->ci', precisions, whole.means)
        points = whole.means.copy()
        for _ in range(CLIMB):
            log = whole.component_log_densities(points) + np.log(whole.weights)
            shares = np.exp(log - logsumexp(log, axis=1, keepdims=True))
            # The minimum of the quadratic that touches -log p here and lies above it elsewhere.
            curvature = np.einsum('nc,cij->nij', shares, precisions)
            moved = np.linalg.solve(curvature, (shares @ pulled)[..., None])[..., 0]
            step, points = float(np.abs(moved - points).max()), moved
            if step < ARRIVED:
                break
        return float(whole.log_density(points).max())

    def log_density(self, poses: Array) -> Array:
        """log p (N,) of the angles of poses (N, d), rad^-n."""
        return self.whole.log_density(poses[:, self.indices])

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of a file; numbers in single precision."""
        own, n = self.components, len(self.dofs)
        lower = np.tril_indices(n)
        return {
            'format': np.array(FORMAT),
            'version': np.array(VERSION),
            'body': np.array(self.skeleton.name),
            'dofs': np.array(self.dofs),
            'mounts': self.skeleton.mounts.astype(np.float32),
            'weights': own.weights.astype(np.float32),
            'means': own.means.astype(np.float32),
            'factors': own.cholesky()[:, lower[0], lower[1]].astype(np.float32),
            'card': np.array(json.dumps(dict(self.card), sort_keys=True)),
        }

    @cached_property
    def _mirror_order(self) -> tuple[Index, Array]:
        """The mirror image of angles a (n,) is signs * a[order]."""
        order, signs = mirror_order(self.skeleton)
        place = {int(j): i for i, j in enumerate(self.indices)}
        wanted = order[self.indices].tolist()
        lonely = [name for name, j in zip(self.dofs, wanted, strict=True) if j not in place]
        if lonely:
            raise ValueError(f'the mirror images of {lonely} are missing')
        return np.array([place[j] for j in wanted], dtype=np.intp), signs[self.indices]


def shipped_prior(body: Body) -> AngleMixture | None:
    """The learned prior that ships for a body; None: there is none for bodies with its angles."""
    mixture = _shipped(body.name)
    return (
        mixture if mixture is not None and _same_angles(mixture.skeleton, body.skeleton) else None
    )


@lru_cache(maxsize=16)
def _shipped(name: str) -> AngleMixture | None:
    file = shipped_file(name, 'prior')
    return None if file is None else read_pose_prior(file, load_body(name))


def _same_angles(first: Skeleton, second: Skeleton) -> bool:
    return (
        first.dof_names == second.dof_names
        and np.array_equal(first.dof_axes, second.dof_axes)
        and first.mounts.shape == second.mounts.shape
        # The root may be levelled otherwise.
        and np.allclose(first.mounts[1:], second.mounts[1:], atol=SAME)
    )


def read_pose_prior(path: str | Path, body: Body) -> AngleMixture:
    """The learned prior in a file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, none of this format, or of another body; one line.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f'{path}: no such file; learn one with `learn prior`')
    arrays = _read(path)
    skeleton, mounts = body.skeleton, arrays['mounts']
    name = str(arrays['body'])
    if (
        name != body.name
        or mounts.shape != skeleton.mounts.shape
        or mounts.dtype.kind != 'f'
        or not np.allclose(mounts, skeleton.mounts, atol=SAME)
    ):
        raise ValueError(
            f'{path}: a pose prior of the body {name!r}, wanted one of {body.name!r} with the same '
            'frames at rest; learn one with `learn prior --body`'
        )
    try:
        return _mixture_of(arrays, skeleton)
    except (ValueError, TypeError, IndexError, RecursionError) as fault:
        raise ValueError(f'{path}: a damaged pose prior ({fault}); learn it again') from fault


def _read(path: Path) -> dict[str, NDArray[Any]]:
    try:
        arrays = read_archive(path, LARGEST_FILE)
    except (OSError, ValueError) as fault:
        text = ' '.join(str(fault).split())
        raise ValueError(
            f'{path}: not a pose prior ({text}); learn one with `learn prior`'
        ) from fault
    missing = [name for name in _ARRAYS if name not in arrays]
    if missing or str(arrays['format']) != FORMAT:
        seen = f'it lacks {missing[0]}' if missing else f'its format is {str(arrays["format"])!r}'
        raise ValueError(f'{path}: not a pose prior ({seen}); learn one with `learn prior`')
    version = str(arrays['version'])
    if version != str(VERSION):
        raise ValueError(
            f'{path}: pose prior of version {version!r}, wanted {VERSION}; learn it again'
        )
    return arrays


def _mixture_of(arrays: Mapping[str, NDArray[Any]], skeleton: Skeleton) -> AngleMixture:
    dofs = tuple(map(str, arrays['dofs'].tolist()))
    n = len(dofs)
    weights, means, packed = (
        np.asarray(arrays[name], dtype=np.float64) for name in ('weights', 'means', 'factors')
    )
    count = len(weights) if weights.ndim == 1 else 0
    shapes = (count, n), (count, n * (n + 1) // 2)
    if (means.shape, packed.shape) != shapes or not np.isfinite(packed).all():
        raise ValueError(
            f'means {means.shape} and factors {packed.shape}, wanted finite ones of '
            f'{shapes[0]} and {shapes[1]}'
        )
    factors = np.zeros((count, n, n))
    lower = np.tril_indices(n)
    factors[:, lower[0], lower[1]] = packed
    card = json.loads(str(arrays['card']))
    if not isinstance(card, dict):
        raise ValueError(f'the card is a {type(card).__name__}, wanted a mapping')
    covariances = factors @ factors.transpose(0, 2, 1)
    texts = {str(key): str(text) for key, text in card.items()}
    return AngleMixture(skeleton, dofs, GaussianMixture(weights, means, covariances), texts)
