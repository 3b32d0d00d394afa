"""The soft prior of the poses of a body: learned, or independent Gaussians.

    E(x) = max log p - log p(a(x)) + 1/2 sum_j ((x_j - mean_j) / sigma_j)^2

p is a mixture over the angles a of a pose (`angle_mixture`); the other degrees of freedom j (lean
of the root, angles that recordings do not show) keep the Gaussians of the model file. With the
responsibilities r_c of the components c, their precisions P_c and g_c = P_c (a - m_c):

    dE = sum_c r_c g_c,     H = sum_c r_c P_c,     d2E = H - sum_c r_c g_c g_c' + dE dE'

H is positive definite, and the quadratic with the value and gradient of E that has it lies above E.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_ros.body.angle_mixture import AngleMixture, shipped_prior
from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import Frames
from hmt_ros.body.pose_terms import AnglePrior, FrameTerm
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.energy import Derivatives, Energy

LEARNED, ANGLES = 'learned', 'angles'
KINDS = (LEARNED, ANGLES)

# Components whose density is this much below the largest are left out, nats: below rounding.
NEGLIGIBLE = 40.0
FAINT = 1e-12  # responsibility below which a component adds nothing to the derivatives


@dataclass(frozen=True, eq=False)
class MixturePrior:
    """The learned prior of the poses; a `FrameTerm`, zero at the most probable pose.

    Attributes:
        body: whose poses; its Gaussians hold for the degrees of freedom beside the mixture.
        mixture: over the angles.
        weight: factor on the energy.
    """

    body: Body
    mixture: AngleMixture
    weight: float = 1.0

    def energy(
        self, frames: Frames, rows: Index, *, derivatives: Derivatives = Derivatives.POSITIVE
    ) -> Energy:
        """See `FrameTerm`."""
        poses = np.ascontiguousarray(frames.poses)
        count, d = poses.shape
        value = np.empty(count)
        asked = count if derivatives else 0
        gradient, hessian = np.empty((asked, d)), np.empty((asked, d, d))
        exact = derivatives == Derivatives.EXACT
        evaluate_prior(self.compiled, poses, exact, value, gradient, hessian)
        return Energy(value, gradient, hessian) if derivatives else Energy(value)

    @cached_property
    def compiled(self) -> PriorModel:
        """As compiled code reads it."""
        mixture, whole = self.mixture, self.mixture.whole
        n = whole.dimension
        log_det = -np.log(np.diagonal(mixture.whitening, axis1=1, axis2=2)).sum(1)
        rest = self.body.prior_sigma**-2.0
        rest[mixture.indices] = 0.0
        return PriorModel(
            mixture.whitening,
            np.einsum('cij,cj->ci', mixture.whitening, whole.means),
            np.log(whole.weights) - log_det - 0.5 * n * np.log(2.0 * np.pi) - mixture.highest,
            mixture.precisions,
            np.array(mixture.indices, dtype=np.int64),
            self.body.prior_mean,
            rest,
            self.weight,
        )


def check_kind(kind: str) -> None:
    """Checks the name of a soft prior.

    Raises:
        ValueError: there is none of this name.
    """
    if kind not in KINDS:
        raise ValueError(f'pose_prior must be one of {KINDS}, saw {kind!r}')


def pose_prior(body: Body, kind: str, weight: float) -> FrameTerm:
    """The soft prior of the poses of a body.

    Args:
        body: whose poses.
        kind: 'learned', or 'angles' for the independent Gaussians of the model file, which bodies
            without a learned prior have in either case.
        weight: factor on the energy.

    Raises:
        ValueError: another kind.
    """
    check_kind(kind)
    mixture = shipped_prior(body) if kind == LEARNED else None
    return AnglePrior(body, weight) if mixture is None else MixturePrior(body, mixture, weight)


class PriorModel(NamedTuple):
    """The prior as the compiled code reads it.

    Attributes:
        whitening: (C, n, n) inverse Cholesky factors W of the covariances, lower triangular.
        centres: (C, n) W m.
        constants: (C,) log of the weight times the normalisation, over the highest density.
        precisions: (C, n, n).
        places: (n,) degrees of freedom that the mixture covers.
        means, rest: (d,) means, and precisions of the degrees of freedom beside the mixture.
        weight: factor on the energy.
    """

    whitening: Array
    centres: Array
    constants: Array
    precisions: Array
    places: Index
    means: Array
    rest: Array
    weight: float


def gaussian_model(body: Body, weight: float) -> PriorModel:
    """The independent Gaussians of the model file as compiled code reads them."""
    nothing = np.zeros((1, 0))
    return PriorModel(
        np.zeros((1, 0, 0)),
        nothing,
        np.zeros(1),
        np.zeros((1, 0, 0)),
        np.zeros(0, dtype=np.int64),
        body.prior_mean,
        body.prior_sigma**-2.0,
        weight,
    )


@njit(cache=True, nogil=True)
def evaluate_prior(
    model: PriorModel, poses: Array, exact: bool, value: Array, gradient: Array, hessian: Array
) -> None:
    """Fills the energies (N,) of poses (N, d), and their derivatives where these have rows.

    Args:
        model: the prior.
        poses: (N, d).
        exact: whether the Hessian is the exact one.
        value, gradient, hessian: (N,), (N, d) and (N, d, d) or no rows: the result.
    """
    count, n = model.centres.shape
    d, places, weight = poses.shape[1], model.places, model.weight
    z, log = np.empty((count, n)), np.empty(count)
    angles, pull, pulls, curvature = np.empty(n), np.empty(n), np.empty(n), np.empty((n, n))
    for p in range(len(poses)):
        for i in range(n):
            angles[i] = poses[p, places[i]]
        best = -np.inf
        for c in range(count):
            # The distance only grows: a component that is far away is given up early.
            most = 2.0 * (model.constants[c] - best + NEGLIGIBLE)
            distance = 0.0
            for i in range(n):
                s = 0.0
                for j in range(i + 1):
                    s += model.whitening[c, i, j] * angles[j]
                s -= model.centres[c, i]
                z[c, i] = s
                distance += s * s
                if distance > most:
                    break
            log[c] = -np.inf if distance > most else model.constants[c] - 0.5 * distance
            best = max(best, log[c])
        total = 0.0
        for c in range(count):
            log[c] = np.exp(log[c] - best)
            total += log[c]
        energy = -best - np.log(total)
        for i in range(d):
            offset = poses[p, i] - model.means[i]
            energy += 0.5 * model.rest[i] * offset * offset
        value[p] = weight * energy
        if len(gradient) == 0:
            continue
        pulls[:] = 0.0
        curvature[:] = 0.0
        for c in range(count):
            share = log[c] / total
            if share < FAINT:
                continue
            pull[:] = 0.0
            for i in range(n):
                for j in range(i + 1):
                    pull[j] += model.whitening[c, i, j] * z[c, i]
            for i in range(n):
                pulls[i] += share * pull[i]
                for j in range(n):
                    curvature[i, j] += share * model.precisions[c, i, j]
            if exact:
                for i in range(n):
                    for j in range(n):
                        curvature[i, j] -= share * pull[i] * pull[j]
        hessian[p] = 0.0
        for i in range(d):
            gradient[p, i] = weight * model.rest[i] * (poses[p, i] - model.means[i])
            hessian[p, i, i] = weight * model.rest[i]
        for i in range(n):
            gradient[p, places[i]] += weight * pulls[i]
            for j in range(n):
                hessian[p, places[i], places[j]] = weight * curvature[i, j]
                if exact:
                    hessian[p, places[i], places[j]] += weight * pulls[i] * pulls[j]
