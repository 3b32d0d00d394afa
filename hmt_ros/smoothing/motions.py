"""Motions: paths through the modes of a window that stay together, and what images say of each.

    d(a, b) = max over moments of mean_s min((mean_j |a_sj - b_sj|^2)^(1/2), c)             (1)
    z_t = sum_k r_k x_k,  R_t = sum_k r_k (S_k / b + (x_k - z_t)(x_k - z_t)')               (2)

a_sj is the mean place of joint j over span s, a sixth of a second; a moment is three in a row.
Paths closer than 30 mm are one motion; squares, so that a limb that differs is not lost among the
joints that do not. A span counts with c = 90 mm at most: what shows in one alone is no motion of
its own, however far away it is, and is absorbed by the one nearest in time. Where a path comes from
is a span before the first. Spans without an image do not count; where a window is shorter than a
moment the mean is over the window.

A motion's modes in an image are one Gaussian (2), r_k the share of its paths through each. Modes
far from the heaviest one are left out, because nobody holds the mean of two opposite poses. b is
the share by which the image tells changes (`CueErrors.of_changes`). What the modes disagree by is
in R.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.linear_algebra import distances, mean_distances, product

SECOND_NS = 10**9
# Distance of two paths below which they are one motion, and the most that a span counts with, m.
SAME_MOTION, MOST_APART = 0.03, 0.09
# Distance of two modes of an image from which on they are no one Gaussian, m.
OPPOSITE = 0.1
# Length of a span, s, and spans of a moment.
SPAN, MOMENT = 1.0 / 6.0, 3


class MotionEvidence(NamedTuple):
    """What the images of a window say of M motions, equation (2).

    Attributes:
        means: (M, T, d).
        covariances: (M, T, d, d).
        disagreements: (M, T, d, d) the part of the covariances that modes differ by.
    """

    means: Array
    covariances: Array
    disagreements: Array


def path_distances(
    nodes: Index, points: Sequence[Array], stamps: Sequence[int], before: Array | None = None
) -> tuple[Array, Array]:
    """Distances (N, N) of paths, equation (1), m; and their means over all spans with c infinite.

    Args:
        nodes: (N, T) modes of the paths.
        points: T arrays (K_t, P, 3) of the modes, m.
        stamps: (T,) ns.
        before: (N, P, 3) where each path comes from, a span before the first; None: unknown.
    """
    ages = (stamps[-1] - np.asarray(stamps, dtype=np.int64)) / SECOND_NS
    spans = np.floor(ages / SPAN + 1e-3).astype(np.intp)
    apart = {
        span: _apart([points[t][nodes[:, t]] for t in np.flatnonzero(spans == span).tolist()])
        for span in np.unique(spans).tolist()
    }
    if before is not None:
        apart[max(apart) + 1] = _apart([before])
    known = np.array([*apart])
    # The oldest span of each moment; those between have the same images.
    ends = np.unique([known, known + MOMENT - 1]).clip(MOMENT - 1).clip(max=known.max())
    most = np.zeros((len(nodes), len(nodes)))
    for end in np.unique(ends):
        moment = [apart[span] for span in known.tolist() if end - MOMENT < span <= end]
        np.maximum(most, np.minimum(moment, MOST_APART).mean(0), out=most)
    return most, np.mean([*apart.values()], axis=0)


def _apart(places: Sequence[Array]) -> Array:
    """Distances (N, N) of paths over a span, of whose images places (N, P, 3) are given, m."""
    means = np.mean(places, axis=0)
    apart = distances(means.reshape(len(means), -1))
    return np.asarray(apart / np.sqrt(means.shape[1]))


def grouped(weights: Array, distances: Array, means: Array, most: int, least: float) -> Index:
    """Motion (N,) of each path, numbered by weight.

    Motions are found one by one: the path with the most weight within `SAME_MOTION` leads the
    next. Every path belongs to the leader that is nearest in the mean.

    Args:
        weights: (N,) of paths, which sum to 1.
        distances, means: (N, N) of paths, m, see `path_distances`.
        most: number of motions at most.
        least: weight of a motion; the paths of a lighter one belong to the others.
    """
    near, left, leaders = distances <= SAME_MOTION, weights.copy(), list[int]()
    while len(leaders) < most and left.any():
        leaders.append(int(np.argmax(product(near, left))))
        left[near[leaders[-1]]] = 0.0
    labels = np.argmin(means[leaders], axis=0)
    masses = np.bincount(labels, weights, minlength=len(leaders))
    if masses.min() < least:
        leaders = [leaders[m] for m in np.flatnonzero(masses >= min(least, masses.max()))]
        labels = np.argmin(means[leaders], axis=0)
    order = np.argsort(-np.bincount(labels, weights, minlength=len(leaders)), kind='stable')
    labels = np.argsort(order, kind='stable')[labels]
    # A leader whose paths are nearer to others has none.
    return np.asarray(np.unique(labels, return_inverse=True)[1].reshape(-1))


def evidence_of_motions(
    nodes: Index,
    weights: Array,
    labels: Index,
    mixtures: Sequence[GaussianMixture],
    points: Sequence[Array] | None = None,
) -> MotionEvidence:
    """What images say of each motion.

    Args:
        nodes: (N, T) modes of the paths.
        weights, labels: (N,) of the paths, and the motion of each.
        mixtures: T likelihoods, with covariances S_k / b.
        points: T arrays (K_t, P, 3) of their modes, m; None: any modes are one Gaussian.
    """
    count, times, d = int(labels.max()) + 1, len(mixtures), mixtures[0].dimension
    means = np.empty((count, times, d))
    covariances, apart = np.empty((2, count, times, d, d))
    for t, mixture in enumerate(mixtures):
        shares = np.zeros((count, len(mixture)))
        np.add.at(shares, (labels, nodes[:, t]), weights)
        if points is not None:
            heaviest = points[t][shares.argmax(1), None]
            shares[mean_distances(heaviest, points[t]) > OPPOSITE] = 0.0
        shares /= shares.sum(1, keepdims=True)
        means[:, t] = product(shares, mixture.means)
        offsets = mixture.means - means[:, t, None]
        apart[:, t] = product((offsets * shares[:, :, None]).swapaxes(1, 2), offsets)
        flat = product(shares, mixture.covariances.reshape(len(mixture), -1))
        covariances[:, t] = flat.reshape(-1, d, d)
    covariances += apart
    return MotionEvidence(means, covariances, apart)
