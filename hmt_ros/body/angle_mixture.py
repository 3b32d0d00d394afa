"""Mirror-symmetric mixtures over the angles of a body, and their files.

    p(a) = w_0 N(a; m_0, S_0) + sum_k w_k/2 [N(a; m_k, S_k) + N(Ra; m_k, S_k)]

a are the angles of a pose, Ra their left-right mirror image. Component 0 is broad: it bounds the
energy of poses unlike the training data.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.learned_file import (
    Arrays,
    header,
    parameters_of,
    read_model,
    require,
)
from hmt_ros.body.mirror import mirror_order
from hmt_ros.body.model_file import load_body, shipped_file
from hmt_ros.body.skeleton import Skeleton
from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.linear_algebra import inverse_triangular, product, solve
from hmt_ros.inference.mixture import GaussianMixture

KIND = 'pose_prior'
MAX_COMPONENTS = 1000
# Maximum number of ascent steps to the mode; step size at which the ascent ends, rad.
MAX_ASCENT_STEPS, ASCENT_TOLERANCE = 1000, 1e-7
ROTATION_TOLERANCE = 1e-4  # maximum difference between equal rest rotations in single precision


@dataclass(frozen=True, eq=False)
class AngleMixture:
    """A mixture over some of the angles of a body, symmetric under left-right mirroring.

    Attributes:
        skeleton: skeleton that the angles belong to; its lengths are not used.
        dofs: names of the n degrees of freedom that the mixture covers.
        components: the broad component, then K components. Each of the K weights is shared with the
            mirror image of the component.
        card: training data, method and licence, serialisable as JSON.

    Raises:
        ValueError: the skeleton lacks an angle, `dofs` lacks the mirror image of an angle, or the
            components are invalid; one-line message.
    """

    skeleton: Skeleton
    dofs: tuple[str, ...]
    components: GaussianMixture
    card: Mapping[str, Any]

    def __post_init__(self) -> None:
        known = {*self.dofs} <= {*self.skeleton.dof_names}
        require(known, f'it names degrees of freedom that {self.skeleton.name} has not')
        rotation = self.skeleton.dof_is_rotation[self.indices]
        different = len(set(self.dofs)) == len(self.dofs)
        require(different and rotation.all(), 'wanted different angles')
        own, total = self.components, float(self.components.weights.sum())
        require(
            own.dimension == len(self.dofs) and 2 <= len(own) <= MAX_COMPONENTS,
            f'{len(own)} components over {own.dimension} angles, wanted 2 to {MAX_COMPONENTS} '
            f'over {len(self.dofs)}',
        )
        right = abs(total - 1.0) < 1e-3 and (own.weights > 0).all()
        require(right, f'weights must be positive and sum to 1, saw a sum of {total:g}')
        self.components.cholesky()
        _ = self._mirror_order

    @cached_property
    def indices(self) -> Index:
        """Degrees of freedom (n,) of the body that the mixture covers."""
        return np.asarray(self.skeleton.dof_index(self.dofs), dtype=np.intp)

    @cached_property
    def whole(self) -> GaussianMixture:
        """The mixture with mirror images as separate components; the weights sum to 1."""
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
        return inverse_triangular(self.whole.cholesky())

    @cached_property
    def precisions(self) -> Array:
        """Inverse covariances (C, n, n) of `whole`."""
        return np.asarray(product(self.whitening.swapaxes(1, 2), self.whitening))

    @cached_property
    def highest(self) -> float:
        """Maximum of the log density over all angles."""
        whole, n = self.whole, self.whole.dimension
        precisions = self.precisions.reshape(len(whole), n * n)
        pulled = product(self.precisions, whole.means[..., None])[..., 0]
        points = whole.means.copy()
        for _ in range(MAX_ASCENT_STEPS):
            log = whole.component_log_densities(points) + elementary.log(whole.weights)
            shares = elementary.exp(log - log.max(axis=1, keepdims=True))
            shares /= shares.sum(1, keepdims=True)
            # Minimise the quadratic that touches -log p at the point and bounds it from above.
            curvature = product(shares, precisions).reshape(-1, n, n)
            moved = solve(curvature, product(shares, pulled)[..., None])[..., 0]
            step, points = float(np.abs(moved - points).max()), moved
            if step < ASCENT_TOLERANCE:
                break
        return float(whole.log_density(points).max())

    def log_density(self, poses: Array) -> Array:
        """Log density (N,) of the angles of poses (N, d); the density is in rad^-n."""
        return self.whole.log_density(poses[:, self.indices])

    def to_arrays(self) -> Arrays:
        """Arrays for a file, with numbers in single precision."""
        own, lower = self.components, np.tril_indices(len(self.dofs))
        parameters = {'body': self.skeleton.name, 'dofs': list(self.dofs)}
        return header(KIND, parameters) | {
            'mounts': self.skeleton.mounts.astype(np.float32),
            'weights': own.weights.astype(np.float32),
            'means': own.means.astype(np.float32),
            'factors': own.cholesky()[:, lower[0], lower[1]].astype(np.float32),
        }

    @classmethod
    def from_arrays(cls, arrays: Arrays, skeleton: Skeleton) -> AngleMixture:
        """Build the mixture over angles of a skeleton from the arrays of a file.

        Raises:
            ValueError, LookupError, TypeError: arrays or parameters are missing or invalid, or they
                belong to a different skeleton.
        """
        parameters, card = parameters_of(arrays), parameters_of(arrays, 'card')
        same = np.allclose(arrays['mounts'], skeleton.mounts, atol=ROTATION_TOLERANCE)
        same = same and parameters['body'] == skeleton.name
        require(same, f'it is for another body than {skeleton.name}, or other frames at rest')
        dofs, means = tuple(map(str, parameters['dofs'])), arrays['means']
        factors = np.zeros((*means.shape, len(dofs)))
        lower = np.tril_indices(len(dofs))
        factors[:, lower[0], lower[1]] = arrays['factors']
        covariances = product(factors, factors.swapaxes(1, 2))
        components = GaussianMixture(arrays['weights'], means, covariances)
        return cls(skeleton, dofs, components, card)

    def answer(self, given: Array) -> GaussianMixture:
        """Return the same mixture for every input."""
        return self.whole

    @cached_property
    def _mirror_order(self) -> tuple[Index, Array]:
        """The mirror image of angles a (n,) is signs * a[order]."""
        order, signs = mirror_order(self.skeleton)
        place = {int(j): i for i, j in enumerate(self.indices)}
        wanted = order[self.indices].tolist()
        lonely = [name for name, j in zip(self.dofs, wanted, strict=True) if j not in place]
        require(not lonely, f'the mirror images of {lonely} are missing')
        return np.array([place[j] for j in wanted], dtype=np.intp), signs[self.indices]


def shipped_prior(body: Body) -> AngleMixture | None:
    """Return the shipped learned prior for a body, or None if no prior matches the angles."""
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
        # Skip the root, because its level may differ.
        and np.allclose(first.mounts[1:], second.mounts[1:], atol=ROTATION_TOLERANCE)
    )


def read_pose_prior(path: str | Path, body: Body) -> AngleMixture:
    """Read a learned prior from a file.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is damaged, has the wrong format, or is for a different body; one-line
            message.
    """
    return read_model(path, KIND, partial(AngleMixture.from_arrays, skeleton=body.skeleton))
