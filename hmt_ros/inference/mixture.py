"""Mixtures of Gaussians as immutable values.

    p(x) = sum_k w_k N(x; m_k, S_k)

Posterior, likelihood and prediction of a pose all have this form (KJS 4, VMS 4, BME 2).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.core import elementary
from hmt_ros.inference import linear_algebra
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import log_sum_exp, product
from hmt_ros.inference.random_numbers import standard_normals


@dataclass(frozen=True, eq=False)
class GaussianMixture:
    """A mixture of K Gaussians over R^d.

    Weights need not sum to 1, because the modes of a likelihood are an unnormalised mixture; see
    `normalised`.

    Attributes:
        weights: (K,) weights, not negative.
        means: (K, d) means.
        covariances: (K, d, d) covariances, symmetric and positive definite.

    Raises:
        ValueError: shapes are inconsistent, a value is not finite, or a weight is negative.

    Example:
        >>> two = GaussianMixture([0.5, 0.5], [[-1.0], [1.0]], [[[0.25]], [[0.25]]])
        >>> two.mean(), two.covariance(), two.log_density([[0.0]]).round(3)
        (array([0.]), array([[1.25]]), array([-2.226]))
    """

    weights: Array
    means: Array
    covariances: Array

    def __post_init__(self) -> None:
        for name, ndim in (('weights', 1), ('means', 2), ('covariances', 3)):
            value = np.array(getattr(self, name), dtype=np.float64)
            if value.ndim != ndim:
                raise ValueError(f'{name} has {value.ndim} axes, wanted {ndim}')
            if not np.isfinite(value).all():
                raise ValueError(f'{name} has values that are not finite')
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        k, d = self.means.shape
        if self.weights.shape != (k,) or self.covariances.shape != (k, d, d):
            raise ValueError(
                f'weights {self.weights.shape}, means {self.means.shape} and covariances '
                f'{self.covariances.shape} do not fit: wanted (K,), (K, d), (K, d, d)'
            )
        if (self.weights < 0).any():
            raise ValueError(f'weights must not be negative, saw {self.weights.min()}')

    def __len__(self) -> int:
        return len(self.weights)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, GaussianMixture):
            return NotImplemented
        return all(
            np.array_equal(getattr(self, name), getattr(other, name))
            for name in ('weights', 'means', 'covariances')
        )

    @property
    def dimension(self) -> int:
        """Number of variables, d."""
        return int(self.means.shape[1])

    @cached_property
    def log_determinants(self) -> Array:
        """log |S_k|, (K,)."""
        return linear_algebra.log_determinant(self.covariances)

    def cholesky(self) -> Array:
        """Lower triangular factors (K, d, d) of the covariances.

        Raises:
            ValueError: a covariance is not positive definite.
        """
        try:
            return linear_algebra.cholesky(self.covariances)
        except np.linalg.LinAlgError:
            smallest = linear_algebra.symmetric_eigenvalues(self.covariances)[:, 0]
            worst = int(np.argmin(smallest))
            raise ValueError(
                f'covariance of component {worst} is not positive definite: its smallest '
                f'eigenvalue is {smallest[worst]:.3g}'
            ) from None

    def component_log_densities(self, x: ArrayLike) -> Array:
        """Log densities log N(x; m_k, S_k), (N, K), at points x (N, d)."""
        points = np.asarray(x, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != self.dimension:
            raise ValueError(f'points have shape {points.shape}, wanted (N, {self.dimension})')
        result = np.empty((len(points), len(self)))
        for k, factor in enumerate(self.cholesky()):
            z = linear_algebra.solve_triangular(factor, (points - self.means[k]).T)
            log_det = 2.0 * elementary.log(np.diagonal(factor)).sum()
            result[:, k] = -0.5 * (
                (z * z).sum(0) + log_det + self.dimension * elementary.log(2 * np.pi)
            )
        return result

    def log_density(self, x: ArrayLike) -> Array:
        """Log density log p(x), (N,), at points x (N, d)."""
        with np.errstate(divide='ignore'):
            log_weights = elementary.log(self.weights)
        return np.asarray(log_sum_exp(self.component_log_densities(x) + log_weights))

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """Draws n points, (n, d)."""
        k = rng.choice(len(self), size=n, p=self.normalised().weights)
        noise = standard_normals(rng, (n, self.dimension))
        offsets = product(self.cholesky()[k], noise[..., None])[..., 0]
        return np.asarray(self.means[k] + offsets)

    def mean(self) -> Array:
        """Mean of the normalised mixture, (d,)."""
        return np.asarray(product(self.normalised().weights, self.means))

    def covariance(self) -> Array:
        """Covariance of the normalised mixture, (d, d)."""
        w = self.normalised().weights
        offsets = self.means - self.mean()
        within = product(w, self.covariances.reshape(len(w), -1))
        return np.asarray(within.reshape(offsets.shape[1:] * 2) + product(w * offsets.T, offsets))

    def normalised(self) -> GaussianMixture:
        """Returns the mixture with weights that sum to 1.

        Raises:
            ValueError: there is no component, or all weights are zero.
        """
        total = self.weights.sum()
        if not total > 0:
            raise ValueError(f'a mixture of {len(self)} components with total weight {total}')
        if total == 1.0:
            return self
        return GaussianMixture(self.weights / total, self.means, self.covariances)

    def sorted(self) -> GaussianMixture:
        """Sorts the components, heaviest first (ties keep their order)."""
        return self[np.argsort(-self.weights, kind='stable')]

    def __getitem__(self, index: Any) -> GaussianMixture:
        """Select components; their weights are unchanged."""
        i = np.atleast_1d(np.arange(len(self))[index])
        return GaussianMixture(self.weights[i], self.means[i], self.covariances[i])
