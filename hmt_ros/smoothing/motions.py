"""Motions: groups of close paths through the modes of a window, and evidence about motions.

    d(a, b) = max over moments of mean_s min((mean_j |a_sj - b_sj|^2)^(1/2), c)             (1)
    z_t = sum_k r_k x_k,  R_t = sum_k r_k (S_k / b + (x_k - z_t)(x_k - z_t)')               (2)

a_sj is the mean position of joint j over span s, a sixth of a second; a moment is three successive
spans. Paths closer than 30 mm are one motion. The mean over joints is of squared distances, so that
one differing limb is not averaged out. The distance in a span is limited to c = 90 mm, so that a
difference in a single span, however large, does not separate two motions. If a path continues an
earlier motion, this motion gives an extra span before the first. Spans without an image are
skipped. In a window shorter than a moment the mean is over the whole window.

A motion's modes in an image are merged into one Gaussian (2); r_k is the fraction of the motion's
paths through mode k. Modes far from the heaviest mode are left out, because the mean of two
opposite poses is not a valid pose. b is the image's share of evidence about changes
(`CueErrors.of_changes`). R includes the covariance between the modes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.linear_algebra import distances, mean_distances, product

SECOND_NS = 10**9
# Distance below which two paths are one motion, and limit c of the distance in a span, m.
SAME_MOTION_DISTANCE, MAX_SPAN_DISTANCE = 0.03, 0.09
# Distance above which two modes of an image are not merged, m.
OPPOSITE_DISTANCE = 0.1
# Length of a span, s, and number of spans of a moment.
SPAN_TIME, SPANS_PER_MOMENT = 1.0 / 6.0, 3


class MotionEvidence(NamedTuple):
    """Evidence from the images of a window about M motions, equation (2).

    Attributes:
        means: (M, T, d) z_t of each motion.
        covariances: (M, T, d, d) R_t of each motion.
        disagreements: (M, T, d, d) covariance between the merged modes, which is included in
            `covariances`.
    """

    means: Array
    covariances: Array
    disagreements: Array


def path_distances(
    nodes: Index, points: Sequence[Array], stamps: Sequence[int], before: Array | None = None
) -> tuple[Array, Array]:
    """Return distances (N, N) between paths, m: equation (1), and means over spans without limit c.

    Args:
        nodes: (N, T) modes of the paths.
        points: T arrays (K_t, P, 3), points of the modes, m.
        stamps: (T,) stamps of the images, ns.
        before: (N, P, 3) points of each path in the span before the first image, m; None: unknown.
    """
    ages = (stamps[-1] - np.asarray(stamps, dtype=np.int64)) / SECOND_NS
    spans = np.floor(ages / SPAN_TIME + 1e-3).astype(np.intp)
    apart = {
        span: _apart([points[t][nodes[:, t]] for t in np.flatnonzero(spans == span).tolist()])
        for span in np.unique(spans).tolist()
    }
    if before is not None:
        apart[max(apart) + 1] = _apart([before])
    known = np.array([*apart])
    # Oldest span of each moment; moments that contain the same images are evaluated once.
    ends = (
        np.unique([known, known + SPANS_PER_MOMENT - 1])
        .clip(SPANS_PER_MOMENT - 1)
        .clip(max=known.max())
    )
    most = np.zeros((len(nodes), len(nodes)))
    for end in np.unique(ends):
        moment = [apart[span] for span in known.tolist() if end - SPANS_PER_MOMENT < span <= end]
        np.maximum(most, np.minimum(moment, MAX_SPAN_DISTANCE).mean(0), out=most)
    return most, np.mean([*apart.values()], axis=0)


def _apart(places: Sequence[Array]) -> Array:
    """Return distances (N, N) between paths over a span, m, from points (N, P, 3) in each image."""
    means = np.mean(places, axis=0)
    apart = distances(means.reshape(len(means), -1))
    return np.asarray(apart / np.sqrt(means.shape[1]))


def grouped(weights: Array, distances: Array, means: Array, most: int, least: float) -> Index:
    """Return the motion (N,) of each path, numbered by weight.

    Motions are found one by one: the next leader is the path with the largest remaining weight of
    paths within `SAME_MOTION_DISTANCE`. Every path belongs to the leader at the smallest mean
    distance.

    Args:
        weights: (N,) weights of the paths, with sum 1.
        distances, means: (N, N) distances between the paths, m, see `path_distances`.
        most: maximum number of motions.
        least: minimum weight of a motion; paths of lighter motions are assigned to the remaining
            motions.
    """
    near, left, leaders = distances <= SAME_MOTION_DISTANCE, weights.copy(), list[int]()
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
    # Renumber, because a leader may have lost all its paths to others.
    return np.asarray(np.unique(labels, return_inverse=True)[1].reshape(-1))


def evidence_of_motions(
    nodes: Index,
    weights: Array,
    labels: Index,
    mixtures: Sequence[GaussianMixture],
    points: Sequence[Array] | None = None,
) -> MotionEvidence:
    """Compute the evidence from images about each motion.

    Args:
        nodes: (N, T) modes of the paths.
        weights, labels: (N,) weight and motion of each path.
        mixtures: T likelihoods, with covariances S_k / b.
        points: T arrays (K_t, P, 3), points of the modes, m; None: all modes are merged.
    """
    count, times, d = int(labels.max()) + 1, len(mixtures), mixtures[0].dimension
    means = np.empty((count, times, d))
    covariances, apart = np.empty((2, count, times, d, d))
    for t, mixture in enumerate(mixtures):
        shares = np.zeros((count, len(mixture)))
        np.add.at(shares, (labels, nodes[:, t]), weights)
        if points is not None:
            heaviest = points[t][shares.argmax(1), None]
            shares[mean_distances(heaviest, points[t]) > OPPOSITE_DISTANCE] = 0.0
        shares /= shares.sum(1, keepdims=True)
        means[:, t] = product(shares, mixture.means)
        offsets = mixture.means - means[:, t, None]
        apart[:, t] = product((offsets * shares[:, :, None]).swapaxes(1, 2), offsets)
        flat = product(shares, mixture.covariances.reshape(len(mixture), -1))
        covariances[:, t] = flat.reshape(-1, d, d)
    covariances += apart
    return MotionEvidence(means, covariances, apart)
