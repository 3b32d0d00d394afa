"""Learning of the motion prior of a body from recorded motions.

Velocities are damped and driven by coupled noise. With damping g, velocity variance s and white
noise W, the displacements of a degree of freedom over two consecutive intervals tau have

    var = 2 s / g^2 (g tau - e) + W tau,    cov = s / g^2 e^2,    e = 1 - exp(-g tau)

g, s and W maximise the Gaussian likelihood of all pairs over intervals of 1/30 to 1/5 s (composite
likelihood [Varin, Reid and Firth 2011]); its sufficient statistics are the two moments. The
residuals of the second displacement, given the first, are correlated over the degrees of freedom:
the couplings. A mirrored copy of every motion is included, so that left and right are equal.

The prior does not depend on the camera: translations of the root are isotropic and not coupled, and
only changes of the heading are used.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.optimize import minimize

from hmt_ros.body import Body
from hmt_ros.body.mirror import mirror
from hmt_ros.body.motion_prior import LearnedMotion
from hmt_ros.inference.arrays import Array

# Intervals, in frames, and the one used for the couplings.
INTERVALS = (1, 2, 3, 4, 5, 6)
COUPLED = 3
# Quantile at which displacements are clipped; larger ones are recording errors.
USUAL = 0.995
# Factor by which correlations are shrunk towards 0.
SHRINKAGE = 0.05
# Minimum white-noise variance per second, m^2 or rad^2: 3 mm or 0.2 degrees.
MIN_WHITE = 1e-5
# Bounds of the damping, per second.
DAMPING = (0.2, 60.0)
MIN_PAIRS = 200  # minimum number of pairs of displacements


def learned_motion(
    body: Body, sequences: Sequence[Array], rate: float, card: Mapping[str, Any] | None = None
) -> LearnedMotion:
    """Learns the motion prior of a body.

    Args:
        sequences: poses (T, d) of each motion, in the frame of a camera at rest.
        rate: poses per second.

    Raises:
        ValueError: there is too little motion.
    """
    pairs = {k: _displacements(body, sequences, k) for k in INTERVALS}
    if len(pairs[INTERVALS[-1]]) < MIN_PAIRS:
        raise ValueError(
            f'the motions have {len(pairs[INTERVALS[-1]])} moments to learn from, wanted at least '
            f'{MIN_PAIRS}: give more of them'
        )
    groups = _groups(body)
    d = body.dimension
    damping, variance, white = np.empty((3, d))
    for group in groups:
        moments = np.array([_moments(pairs[k][:, :, group], k / rate) for k in INTERVALS])
        damping[group], variance[group], white[group] = _fitted(moments)
    correlation = _couplings(pairs[COUPLED], damping, variance, white, COUPLED / rate)
    apart = body.skeleton.dof_index(('root_tx', 'root_ty', 'root_tz'))
    correlation[apart, :] = correlation[:, apart] = 0.0
    correlation[apart, apart] = 1.0
    scale = np.sqrt(2.0 * damping * variance)
    diffusion = correlation * np.outer(scale, scale)
    return LearnedMotion(body.name, tuple(body.dof_names), damping, diffusion, white, card or {})


def _displacements(body: Body, sequences: Sequence[Array], step: int) -> Array:
    """Pairs (N, 2, d) of consecutive displacements over `step` frames."""
    found = [np.empty((0, 2, body.dimension))]
    for poses in sequences:
        for seen in (poses, mirror(body, poses)):
            moved = seen[step:] - seen[:-step]
            found.append(np.stack([moved[:-step], moved[step:]], axis=1))
    every = np.concatenate(found)
    if len(every) == 0:
        return every
    limit = np.quantile(np.abs(every), USUAL, axis=(0, 1))
    return np.clip(every, -limit, limit)


def _groups(body: Body) -> list[list[int]]:
    """Degrees of freedom with common parameters: translations, and left with right."""
    names = list(body.dof_names)
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        common = name.removeprefix('left_').removeprefix('right_')
        is_translation = not body.skeleton.dof_is_rotation[i]
        groups.setdefault('translation' if is_translation else common, []).append(i)
    return list(groups.values())


def _moments(pairs: Array, interval: float) -> tuple[float, float, float, float]:
    """Interval, variance and covariance of pairs (N, 2, m), and number of independent ones."""
    variance = float(np.mean(pairs**2))
    # Overlapping intervals are not independent.
    count = len(pairs) * INTERVALS[0] / (interval * len(INTERVALS))
    return interval, variance, float(np.mean(pairs[:, 0] * pairs[:, 1])), count


def modelled_moments(
    interval: float, damping: Array | float, variance: Array | float, white: Array | float
) -> tuple[Array, Array]:
    """Variance and covariance of two consecutive displacements; see above."""
    g = np.asarray(damping, dtype=np.float64)
    lost = -np.expm1(-g * interval)
    var = 2.0 * variance / g**2 * (g * interval - lost) + white * interval
    cov = variance / g**2 * lost**2
    return np.asarray(var, dtype=np.float64), np.asarray(cov, dtype=np.float64)


def _fitted(moments: Array) -> tuple[float, float, float]:
    """Damping, variance of the velocity and white noise from moments (I, 4)."""
    interval, var, cov, count = moments.T
    count = count / count.sum()
    floor = 1e-3 * MIN_WHITE * interval
    var = np.maximum(var, floor)
    cov = np.clip(cov, -var + floor, var - floor)

    def cost(log: Array) -> float:
        g, s, w = np.exp(log)
        seen = [modelled_moments(float(t), g, s, w + MIN_WHITE) for t in interval]
        v, c = np.array(seen).T
        # Sum and difference of the two displacements are independent.
        both = np.log(v + c) + (var + cov) / (v + c) + np.log(v - c) + (var - cov) / (v - c)
        return float((count * both).sum())

    bounds = [np.log(DAMPING), (-30.0, 10.0), (-30.0, 10.0)]
    size = float(np.log(var[-1] / interval[-1] ** 2))
    little = float(np.log(0.01 * var[0] / interval[0]))
    starts = [np.array([np.log(g), size, little]) for g in (1.0, 4.0, 16.0)]
    found = [
        minimize(cost, np.clip(x, -29.0, 9.0), method='L-BFGS-B', bounds=bounds) for x in starts
    ]
    g, s, w = np.exp(min(found, key=lambda one: float(one.fun)).x)
    return float(g), float(s), float(w) + MIN_WHITE


def _couplings(
    pairs: Array, damping: Array, variance: Array, white: Array, interval: float
) -> Array:
    """Correlations (d, d) of the residuals of second displacements given the first ones."""
    var, cov = modelled_moments(interval, damping, variance, white)
    surprise = pairs[:, 1] - cov / var * pairs[:, 0]
    both = surprise.T @ surprise / len(surprise)
    size = np.sqrt(np.maximum(np.diagonal(both), 1e-300))
    correlation = (1.0 - SHRINKAGE) * both / np.outer(size, size)
    np.fill_diagonal(correlation, 1.0)
    return np.asarray(0.5 * (correlation + correlation.T))
