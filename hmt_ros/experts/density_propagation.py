"""Discriminative density propagation of mixtures by conditional densities (BME 2.1).

Rule (1) needs a model of p(x_t | x_{t-1}, r_t), whose input is the previous state followed by the
observation:

    p(x_t | R_t) = integral p(x_t | x_{t-1}, r_t) p(x_{t-1} | R_{t-1}) dx_{t-1}         (BME 1)

Each expert i is linearised at the mean m_j of each previous component. The integral becomes

    sum_ij g_i(m_j, r) w_j N(x; f_i(m_j, r), F_ij S_j F_ij' + c_i O_i),    F = df / dx_{t-1}

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
from hmt_ros.inference.linear_algebra import product
from hmt_ros.inference.reduction import reduced

# Minimum of `ConditionalDensity.support`; below it, the input is unlike all training data.
MIN_SUPPORT = 1e-3


def propagate(
    model: ConditionalDensity,
    previous: GaussianMixture,
    observation: ArrayLike,
    *,
    n_components: int | None = None,
    without_past: GaussianMixture | None = None,
) -> GaussianMixture:
    """Compute p(x_t | R_t) by rule (1).

    The weight of previous components that are unlike the training data goes to the prediction from
    the observation alone.

    Args:
        model: Model of p(x_t | x_{t-1}, r_t) with inputs (x_{t-1}, r_t), states first.
        previous: p(x_{t-1} | R_{t-1}) over states (d,).
        observation: r_t (q,); q may be 0.
        n_components: Number of components M of the result; None: the number of experts.
        without_past: p(x_t | r_t), from the observation alone; None uses the model everywhere.

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
        trusted = model.support(inputs) >= MIN_SUPPORT
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


def joined(parts: Sequence[tuple[float, GaussianMixture]]) -> GaussianMixture:
    """Join mixtures into one; each has the given share of the weight."""
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
