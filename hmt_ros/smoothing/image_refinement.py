"""Refinement of motions by the likelihood of the images themselves (VMS 5 and 6).

    E(X) = -log p(x_1) - sum_t log p(x_t | x_(t-1)) - sum_t log p(r_t | x_t)                    (1)
    F(q) = E_q[log q(X) - log p(X, R)],    q = sum_i a_i N(M_i, s_i^2 S_i)                      (2)

(1) is minimised within limits, from each distinct motion of a window. All motions use one prior,
which has the largest noise factor of the motions and fixes the feet that rest in the heaviest
motion. If several optima are one motion, the most probable optimum is kept; the sum in (2) is over
the kept optima. The adapted variables of (2) were chosen on clips (docs/smoothing.md). Weights from
the chain of the filter's modes are better than weights from (2), so an optimum gets the total
weight of the motions that converged to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.linear_algebra import product
from hmt_ros.smoothing.likelihood import SequenceLikelihood
from hmt_ros.smoothing.mixture_smoother import trajectory_mixture
from hmt_ros.smoothing.motion_smoother import MotionSmoother, SmoothedMotions
from hmt_ros.smoothing.motions import SECOND_NS, grouped, path_distances
from hmt_ros.smoothing.trajectory_mixture import TrajectoryMixture
from hmt_ros.smoothing.trajectory_refinement import refine
from hmt_ros.smoothing.variational_mixture import minimise_free_energy

# Maximum number of refined motions, and minimum weight of a refined motion.
MAX_MOTIONS, MIN_WEIGHT = 4, 0.01
# Maximum number of steps of a descent, and gain of a step below which the descent ends, nats.
STEPS, TOLERANCE = 30, 0.01
# Number of samples per optimum and number of iterations in the descent of the free energy.
SAMPLES, ITERATIONS = 4, 15


def refined_on_images(
    smoother: MotionSmoother,
    found: SmoothedMotions,
    images: SequenceLikelihood,
    *,
    adapt: Sequence[str] = ('inflation',),
) -> TrajectoryMixture:
    """Refine the distinct motions of a window.

    Args:
        smoother: smoother that estimated the motions.
        found: motions of a whole sequence, without a past.
        images: likelihood of the images of the window, one for each time.
        adapt: adapted variables of the free energy, a subset of 'weights' and 'inflation'.

    Returns:
        The distinct optima with their free energy, and the other motions, unchanged.

    Raises:
        ValueError: the number of images differs from the number of times.
    """
    motions, low_high = found.trajectories, smoother.limits()
    assert motions.stamps_ns is not None
    if images.times != motions.times:
        raise ValueError(f'{images.times} images for {motions.times} times')
    d = motions.dimension
    chosen = _first_of_each(smoother, motions, motions.states, motions.weights, MIN_WEIGHT)[0]
    intervals = np.diff(motions.stamps_ns) / SECOND_NS
    prior = smoother.dynamics.prior(intervals, noise=found.noise_factor[chosen].max())
    if smoother.resting is not None and len(intervals):
        first = chosen[0]
        covariances = found.evidence.covariances[first]
        prior = smoother.resting.constrained_prior(
            prior, motions.means[first], covariances, intervals
        )
    optima = refine(
        motions.states[chosen],
        prior,
        images,
        *(limit[:d] for limit in low_high),
        max_iterations=STEPS,
        tolerance=TOLERANCE,
    )
    optima = optima[np.argsort(optima.energies, kind='stable')]
    origin = chosen[optima.starts]
    kept, labels = _first_of_each(smoother, motions, optima.states, motions.weights[origin], 0.0)
    optima, others = optima[kept], np.setdiff1d(np.arange(len(motions)), chosen)
    # Matrix that maps each motion to a component of the result.
    count = len(kept)
    into = np.zeros((len(motions), count + len(others)))
    into[origin, labels] = 1.0
    into[others, count + np.arange(len(others))] = 1.0
    weights = product(motions.weights, into)
    total = float(weights[:count].sum())
    fitted = minimise_free_energy(
        weights[:count] / total,
        optima.states,
        optima.factors,
        prior,
        images,
        adapt=adapt,
        low=low_high[0],
        high=low_high[1],
        samples=SAMPLES,
        seed=smoother.seed,
        max_iterations=ITERATIONS,
    )
    into[:, :count] *= total * fitted.weights / weights[:count]
    weights = product(motions.weights, into)
    result = trajectory_mixture(
        weights,
        np.concatenate([optima.states, motions.states[others]]),
        [*optima.factors, *(motions.factors[i] for i in others)],
        np.concatenate([fitted.inflation, motions.inflation[others]]),
        prior,
        images,
        motions.stamps_ns,
        *low_high,
    )
    order = np.argsort(-weights, kind='stable')
    which = np.concatenate([origin[kept], others])[order]
    in_time, apart = motions.weights_in_time, motions.disagreements
    return replace(
        result,
        free_energy=fitted.free_energy,
        free_energy_fresh=fitted.fresh,
        strays=motions.strays,
        weights_in_time=None if in_time is None else product(in_time, into[:, order]),
        disagreements=None if apart is None else apart[which],
    )


def _first_of_each(
    smoother: MotionSmoother,
    motions: TrajectoryMixture,
    states: Array,
    weights: Array,
    least: float,
) -> tuple[Index, Index]:
    """Group states (N, T, n) into motions; return each motion's first index, and labels (N,)."""
    assert motions.stamps_ns is not None
    points = smoother.points_of(states[:, :, : motions.dimension]).swapaxes(0, 1)
    nodes = np.broadcast_to(np.arange(len(states))[:, None], states.shape[:2])
    distances = path_distances(nodes, list(points), motions.stamps_ns)
    labels = grouped(weights, *distances, MAX_MOTIONS, least)
    return np.unique(labels, return_index=True)[1], labels
