"""The soft prior of the poses of a body: learned, or independent Gaussians.

    E(x) = max log p - log p(a(x)) + 1/2 sum_j ((x_j - mean_j) / sigma_j)^2

p is a mixture over the angles a of a pose (`angle_mixture`); the other degrees of freedom j (lean
of the root, angles missing in recordings) keep the Gaussians of the model file. With the
responsibilities r_c of the components c, their precisions P_c and g_c = P_c (a - m_c):

    dE = sum_c r_c g_c,     H = sum_c r_c P_c,     d2E = H - sum_c r_c g_c g_c' + dE dE'

H is positive definite, and the quadratic with Hessian H that has the same value and gradient as E
is an upper bound of E.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from hmt_ros import core
from hmt_ros.body.angle_mixture import AngleMixture, shipped_prior
from hmt_ros.body.body import Body
from hmt_ros.core import elementary, evaluate_prior_at
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.energy import Energy
from hmt_ros.inference.linear_algebra import product

LEARNED, ANGLES = 'learned', 'angles'
KINDS = (LEARNED, ANGLES)


@dataclass(frozen=True, eq=False)
class AnglePrior:
    """The soft prior of the joint angles: an independent Gaussian for each.

    Attributes:
        body: body with the means and standard deviations.
        weight: factor on the energy.
    """

    body: Body
    weight: float = 1.0

    @cached_property
    def compiled(self) -> PriorModel:
        """The prior as compiled code reads it."""
        return PriorModel(
            np.zeros((1, 0, 0)),
            np.zeros((1, 0, 0)),
            np.zeros((1, 0)),
            np.zeros(1),
            np.zeros((1, 0, 0)),
            np.zeros(0, dtype=np.int64),
            self.body.prior_mean,
            1.0 / self.body.prior_sigma**2,
            self.weight,
        )


@dataclass(frozen=True, eq=False)
class MixturePrior:
    """Energy of the learned prior of the poses, zero at the most probable pose.

    Attributes:
        body: body of the poses; its Gaussians cover degrees of freedom missing in the mixture.
        mixture: mixture over the angles.
        weight: factor on the energy.
    """

    body: Body
    mixture: AngleMixture
    weight: float = 1.0

    @cached_property
    def compiled(self) -> PriorModel:
        """The prior as compiled code reads it."""
        mixture, whole = self.mixture, self.mixture.whole
        n = whole.dimension
        log_det = -elementary.log(np.diagonal(mixture.whitening, axis1=1, axis2=2)).sum(1)
        log_weights = elementary.log(whole.weights)
        rest = 1.0 / self.body.prior_sigma**2
        rest[mixture.indices] = 0.0
        wide = np.zeros((2, len(log_weights), n, n + -n % core.LANES))
        wide[..., :n] = mixture.whitening, mixture.whitening.swapaxes(1, 2)
        return PriorModel(
            wide[0],
            wide[1],
            product(mixture.whitening, whole.means[..., None])[..., 0],
            log_weights - log_det - 0.5 * n * elementary.log(2.0 * math.pi) - mixture.highest,
            mixture.precisions,
            mixture.indices,
            self.body.prior_mean,
            rest,
            self.weight,
        )


def check_kind(kind: str) -> None:
    """Checks the name of a soft prior.

    Raises:
        ValueError: the kind is unknown.
    """
    if kind not in KINDS:
        raise ValueError(f'pose_prior must be one of {KINDS}, saw {kind!r}')


def pose_prior(body: Body, kind: str, weight: float) -> AnglePrior | MixturePrior:
    """The soft prior of the poses of a body.

    Args:
        body: body of the poses.
        kind: 'learned', or 'angles' for the independent Gaussians of the model file; bodies without
            a learned prior always get the latter.
        weight: factor on the energy.

    Raises:
        ValueError: the kind is unknown.
    """
    check_kind(kind)
    mixture = shipped_prior(body) if kind == LEARNED else None
    return AnglePrior(body, weight) if mixture is None else MixturePrior(body, mixture, weight)


def prior_energies(prior: AnglePrior | MixturePrior, poses: Array) -> Energy:
    """Energies of poses (N, d), with derivatives; the Hessians are positive definite."""
    n, d = poses.shape
    value, gradient, hessian = np.empty(n), np.empty((n, d)), np.empty((n, d, d))
    poses = np.ascontiguousarray(poses, dtype=np.float64)
    evaluate_prior_at(prior.compiled, poses, value, gradient, hessian)
    return Energy(value, gradient, hessian)


class PriorModel(NamedTuple):
    """The prior, for compiled code.

    Attributes:
        whitening: (C, n, m) inverse Cholesky factors W of the covariances, lower triangular, with
            rows padded to whole lanes.
        columns: (C, n, m) transposed factors W', padded as well.
        centres: (C, n) whitened means W m.
        constants: (C,) log of the weight times the normalisation, minus the highest log density.
        precisions: (C, n, n) inverse covariances.
        places: (n,) degrees of freedom that the mixture covers.
        means, rest: (d,) means, and precisions of degrees of freedom missing in the mixture.
        weight: factor on the energy.
    """

    whitening: Array
    columns: Array
    centres: Array
    constants: Array
    precisions: Array
    places: Index
    means: Array
    rest: Array
    weight: float
