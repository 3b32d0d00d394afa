"""The weight of a hypothesis (KJS figure 4, steps 4 and 5).

    log w_k = log p(ancestor) + log p(jumps) - beta (E(x_k) - rho min(e_k, e_ancestor))        (1)

E is the energy of the posterior at the optimum x_k, motion prior included. The inverse temperature
beta is below 1, because neighbouring measurements of an image err together; errors also last from
image to image, so that of the excess e over the least energy only what is new counts (`trust`). The
two ways to face have odds of their own (`facing_odds`). The normaliser
|S_k|^(1/2) of a mode is left out, as in the paper: the Hessian shows how well the image fixes a
pose, and what it fixes badly (depth, a limb behind the trunk) would gain weight by being unseen.

Instead of its ancestor's weight a mode can take over that of the nearest component of the
prediction by the Bhattacharyya distance D (KJS figure 4, step 5):

    log w_k = log p(argmin_j D(k, j)) - beta E(x_k)                                            (2)

Ways to face, each followed by a filter of its own, are weighed by the evidence of their filters,
the sum over images of -beta min_k E(x_k).                                                     (3)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hmt_ros.inference.arrays import Array, Index, Mask
from hmt_ros.inference.mixture import GaussianMixture, bhattacharyya_distances

REWEIGHTINGS = ('ancestry', 'bhattacharyya')


def weigh(log_priors: Array, energies: Array, beta: float) -> Array:
    """Log weights (N,), equation (1), not normalised, as if errors did not last.

    Args:
        log_priors: (N,) log p(ancestor) + log p(jumps).
        energies: (N,) nats.
        beta: inverse temperature.
    """
    return log_priors - beta * energies


def lasting_errors(energies: Array, excess: Array, beta: float, correlation: float) -> Array:
    """What errors that last give back to log weights (N,): beta rho min(e, e_ancestor).

    What a pose cost more than the best in the image before, it costs for the same reason again.

    Args:
        energies: (N,) nats.
        excess: (N,) e_ancestor, of the ancestors' energies over the least in the image before.
        beta: inverse temperature.
        correlation: rho of the errors of two images in a row.
    """
    over = energies - energies.min()
    return np.asarray(beta * correlation * np.minimum(over, excess), dtype=np.float64)


def cost_of_room(hessians: Array, own: Array, usual: Array, jumped: Mask) -> Array:
    """What the wider motion prior of jumps costs (N,), nats: Occam's factor.

        1/2 log |I + H S_own| - 1/2 log |I + H S_usual|

    H is the curvature of all but the motion prior. What the image does not fix costs nothing.

    Args:
        hessians: (N, d, d) at the optimum, motion prior included.
        own: (N, d, d) precisions S_own^-1 of the motion prior of each hypothesis.
        usual: (N, d, d) of those that have not jumped.
        jumped: (N, d) what has jumped.
    """
    result = np.zeros(len(hessians))
    rows = np.flatnonzero(jumped.any(1))
    if len(rows):
        h, a, b = hessians[rows], own[rows], usual[rows]
        logs = [np.linalg.slogdet(x)[1] for x in (h, a, h - a + b, b)]
        result[rows] = np.maximum(0.5 * (logs[0] - logs[1] - logs[2] + logs[3]), 0.0)
    return result


def normalised(log_weights: Array) -> Array:
    """Log weights (N,) whose weights sum to 1."""
    return np.asarray(log_weights - np.logaddexp.reduce(log_weights), dtype=np.float64)


def at_least(log_weights: Array, least: float) -> Array:
    """Normalised log weights (N,), those below `least` raised to it: a mode that may come back."""
    return normalised(np.maximum(log_weights, least))


def inherited_log_weights(
    means: Array, covariances: Array, order: Index, before: GaussianMixture
) -> Array:
    """Log weights (K,) that new modes take over from a mixture before, equation (2).

    A component whose weight was taken over is out of the matching; modes that none is left for get
    the smallest weight. So a track keeps the modes that it had, while new ones may emerge.

    Args:
        means, covariances: (K, d), (K, d, d).
        order: (K,) in which they choose.
        before: the prediction.
    """
    distances = bhattacharyya_distances(means, covariances, before.means, before.covariances)
    log_weights = np.log(np.maximum(before.normalised().weights, np.finfo(np.float64).tiny))
    result = np.full(len(means), log_weights.min())
    for k in order[: len(before)]:
        nearest = int(np.argmin(distances[k]))
        result[k] = log_weights[nearest]
        distances[:, nearest] = np.inf
    return result


def log_shares(evidence: Sequence[float]) -> Array:
    """Log probabilities of ways to face from the evidence of their filters, equation (3)."""
    return normalised(np.asarray(evidence, dtype=np.float64))
