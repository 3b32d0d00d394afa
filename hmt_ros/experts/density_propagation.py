"""Discriminative density propagation: mixtures through conditional densities (BME 2.1).

Rule (1) needs a model of p(x_t | x_{t-1}, r_t), whose input is the state, then the observation:

    p(x_t | R_t) = integral p(x_t | x_{t-1}, r_t) p(x_{t-1} | R_{t-1}) dx_{t-1}         (BME 1)

Each expert i is linearised at the mean m_j of each previous component. The integral becomes

    sum_ij g_i(m_j, r) w_j N(x; f_i(m_j, r), F_ij S_j F_ij' + c_i O_i),    F = df / dx_{t-1}

Rule (9) needs models of p(x_t | r_t), of the dynamics p(x_t | x_{t-1}), and the equilibrium p(x_t):

    p(x_t | R_t) ~ p(x_t | r_t) / p(x_t)                                                (BME 9)
                   integral p(x_t | x_{t-1}) p(x_{t-1} | R_{t-1}) dx_{t-1}

The M^2 components are reduced to M (`hmt_ros.inference.reduction`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.core import elementary
from hmt_ros.experts.conditional_density import ConditionalDensity
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import (
    inverse,
    log_determinant,
    log_sum_exp,
    product,
    symmetric_eigenvalues,
)
from hmt_ros.inference.reduction import reduced

# Minimum of `ConditionalDensity.support`: below it no kernel fires, the experts have seen nothing
# like the input.
LEAST_SUPPORT = 1e-3


def propagate(
    model: ConditionalDensity,
    previous: GaussianMixture,
    observation: ArrayLike,
    *,
    n_components: int | None = None,
    without_past: GaussianMixture | None = None,
) -> GaussianMixture:
    """p(x_t | R_t) by rule (1).

    Previous components without support of the model give their weight to the prediction from the
    observation alone; without any support, that prediction is the result.

    Args:
        model: Model of p(x_t | x_{t-1}, r_t) with inputs (x_{t-1}, r_t), states first.
        previous: p(x_{t-1} | R_{t-1}) over states (d,).
        observation: r_t (q,); q may be 0.
        n_components: Number of components M of the result; None takes the number of experts.
        without_past: p(x_t | r_t); None trusts the model everywhere.

    Raises:
        ValueError: dimensions do not fit, or the observation is not finite.
    """
    previous = previous.normalised()
    inputs = _inputs(model, previous, observation)
    trusted = np.ones(len(previous), dtype=bool)
    if without_past is not None:
        if without_past.dimension != model.n_outputs_:
            raise ValueError(
                f'without_past has dimension {without_past.dimension}, '
                f'wanted {model.n_outputs_} as the model predicts'
            )
        trusted = model.support(inputs) >= LEAST_SUPPORT
    lost = float(previous.weights[~trusted].sum())
    parts = []
    if trusted.any():
        followed = linearised_products(model, previous[trusted], observation)
        parts.append((1.0 - lost, followed))
    if without_past is not None and lost > 0:
        parts.append((lost, without_past))
    whole = joined(parts)
    count = n_components or model.components(inputs[:1]).means.shape[1]
    return reduced(whole, count).sorted()


def propagate_by_dynamics(
    prior: GaussianMixture,
    predicted: GaussianMixture,
    equilibrium: GaussianMixture,
    *,
    share: float = 1.0,
    forgotten: float = 0.0,
    n_components: int | None = None,
) -> GaussianMixture:
    """p(x_t | R_t) by rule (9).

    Args:
        prior: the integral of rule (9), p(x_t | R_{t-1}): of a model of the dynamics by
            `linearised_products`, or of a motion prior.
        predicted: p(x_t | r_t).
        equilibrium: p(x_t). The division by a single Gaussian is exact where that is wider than the
            product; else each product is weighted by 1 / p at its mean.
        share: of the information of the observation that is new, given those before: the ratio
            p(x_t | r_t) / p(x_t) counts to this power (`inference.error_model`).
        forgotten: probability that the past tells nothing, so that a wrong one is left.
        n_components: Number of components of the result; None takes that of `predicted`.

    Raises:
        ValueError: dimensions do not fit.
    """
    for name, one in (('predicted', predicted), ('equilibrium', equilibrium)):
        if one.dimension != prior.dimension:
            raise ValueError(
                f'{name} has dimension {one.dimension}, wanted {prior.dimension} as the prior'
            )
    if forgotten > 0.0:
        prior = joined([(1.0 - forgotten, prior), (forgotten, equilibrium)])
    whole = divided_product(predicted, prior, equilibrium, share)
    return reduced(whole, n_components or len(predicted)).sorted()


def joined(parts: Sequence[tuple[float, GaussianMixture]]) -> GaussianMixture:
    """One mixture of all components, each mixture with its share of the weight."""
    mixtures = [one for _, one in parts]
    return GaussianMixture(
        np.concatenate([share * one.normalised().weights for share, one in parts]),
        np.concatenate([one.means for one in mixtures]),
        np.concatenate([one.covariances for one in mixtures]),
    )


def linearised_products(
    model: ConditionalDensity, previous: GaussianMixture, observation: ArrayLike
) -> GaussianMixture:
    """The integral of rule (1) with experts linearised at each mean; all products are kept.

    Args:
        model: Model with inputs (x_{t-1}, r_t).
        previous: J components over states (d,); their weights need not sum to 1.
        observation: r_t (q,).
    """
    inputs = _inputs(model, previous, observation)
    found = model.components(inputs)
    slopes = model.jacobians(inputs)[..., : previous.dimension]
    spread = product(product(slopes, previous.covariances[:, None]), np.swapaxes(slopes, -1, -2))
    covariances = spread + found.inflation[:, :, None, None] * found.noise
    weights = elementary.exp(found.log_weights) * previous.weights[:, None]
    d = model.n_outputs_
    return GaussianMixture(
        weights.reshape(-1), found.means.reshape(-1, d), covariances.reshape(-1, d, d)
    )


def divided_product(
    a: GaussianMixture, b: GaussianMixture, divisor: GaussianMixture, share: float = 1.0
) -> GaussianMixture:
    """(a(x) / divisor(x))^share b(x), normalised, one component for each pair.

    The power of a mixture is taken of each component by itself, as if they were apart.
    """
    d = a.dimension
    precision_a, shift_a, constant_a = (share * x for x in _canonical(a))
    precision_b, shift_b, constant_b = _canonical(b)
    precision = (precision_a[:, None] + precision_b).reshape(-1, d, d)
    shift = (shift_a[:, None] + shift_b).reshape(-1, d)
    constant = (constant_a[:, None] + constant_b).reshape(-1)
    exact = np.zeros(len(shift), dtype=bool)
    if len(divisor) == 1:
        divisor = divisor.normalised()
        precision_d, shift_d, constant_d = (share * x for x in _canonical(divisor))
        less = precision - precision_d
        # A divisor that is nearly as narrow as the product leaves no proper Gaussian.
        exact = symmetric_eigenvalues(less)[:, 0] > 1e-3 * symmetric_eigenvalues(precision)[:, 0]
        precision = np.where(exact[:, None, None], less, precision)
        shift = np.where(exact[:, None], shift - shift_d, shift)
        constant = np.where(exact, constant - constant_d, constant)
    spread: Array = inverse(precision).astype(np.float64)
    covariances: Array = 0.5 * (spread + np.swapaxes(spread, -1, -2))
    means = np.einsum('nij,nj->ni', covariances, shift)
    log_det = log_determinant(covariances)
    log = constant + 0.5 * ((shift * means).sum(1) + log_det)
    # Without exact division, one factor (2 pi)^(d/2) more is in the denominator.
    at_mean = 0.5 * d * elementary.log(2.0 * np.pi) + divisor.log_density(means)
    log = np.where(exact, log, log - share * at_mean)
    return GaussianMixture(elementary.exp(log - log_sum_exp(log)), means, covariances)


def _canonical(mixture: GaussianMixture) -> tuple[Array, Array, Array]:
    """Precisions P, shifts P m, and the logarithms of w N at x = 0."""
    precision: Array = inverse(mixture.covariances).astype(np.float64)
    shift = np.einsum('kij,kj->ki', precision, mixture.means)
    square = (shift * mixture.means).sum(1)
    log_det = log_determinant(mixture.covariances)
    with np.errstate(divide='ignore'):
        constant = elementary.log(mixture.weights)
    return precision, shift, constant - 0.5 * (square + log_det)


def _inputs(model: ConditionalDensity, previous: GaussianMixture, observation: ArrayLike) -> Array:
    """Inputs (J, d + q) at the means of the previous components."""
    observation = np.asarray(observation, dtype=np.float64)
    if observation.ndim != 1 or previous.dimension + len(observation) != model.n_inputs_:
        raise ValueError(
            f'states of dimension {previous.dimension} and an observation of shape '
            f'{observation.shape}, wanted {model.n_inputs_} numbers together'
        )
    rows = np.broadcast_to(observation, (len(previous), len(observation)))
    return np.hstack([previous.means, rows])
