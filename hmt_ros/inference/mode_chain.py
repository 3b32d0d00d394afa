"""Markov chain of a filter's modes: weights and paths given all images.

    W_T(k) = w_k                                                        the newest image T  (1)
    W_t(j) = sum_k W_(t+1)(k) P(j | k)                                  t < T               (2)
    p(k_1 .. k_T | all images) = w_(k_T) prod_t P(k_t | k_(t+1))                            (3)

This is the backward pass of forward filtering, backward smoothing [Doucet, Godsill and Andrieu,
2000]. P(j | k) is the probability that mode k continues mode j of the previous image. The evidence
of an image for a mode is a factor of w_k only: it cancels in P(j | k), and is passed to image t by
(1) and (2). So (2) and (3) are exact for the filter's own chain, and add no parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.linear_algebra import product


class Link(NamedTuple):
    """Modes of an image in the chain.

    Attributes:
        weights: (K,) posterior probabilities given this image and earlier images.
        origins: (K, M) probability that mode k continues mode m of the previous image; rows sum to
            1. M is 0 at the start of the chain.
    """

    weights: Array
    origins: Array


def backward_weights(links: Sequence[Link]) -> list[Array]:
    """Return probabilities (K_t,) of modes at each time given all images, by (1) and (2)."""
    result = [links[-1].weights]
    for link in reversed(links[1:]):
        result.append(product(result[-1], link.origins))
    return result[::-1]


def drawn_paths(links: Sequence[Link], count: int, seed: int) -> tuple[Index, Array]:
    """Draw paths from (3); paths with the same first mode share its smoothed weight.

    Paths are drawn forwards, with P(k | j) = W_(t+1)(k) P(j | k) / W_t(j). Each mode of the oldest
    image with a positive weight (2) starts at least one path, and the weights of its paths sum
    exactly to this weight. Paths through one mode are distributed over its successors by systematic
    sampling in a random order.

    Args:
        count: approximate number of paths.
        seed: random seed.

    Returns:
        Modes (N, T) of the paths, and their weights (N,), which sum to 1.
    """
    rng = np.random.default_rng(seed)
    smoothed = backward_weights(links)
    copies = np.ceil(count * smoothed[0]).astype(np.intp)
    at = np.repeat(np.arange(len(copies)), copies)
    shares = (smoothed[0] / np.maximum(copies, 1))[at]
    nodes = np.empty((len(at), len(links)), dtype=np.intp)
    nodes[:, 0] = at
    for t in range(1, len(links)):
        onwards = np.cumsum(links[t].origins.T * smoothed[t], axis=1)
        order = rng.permutation(len(at))
        order = order[np.argsort(at[order], kind='stable')]
        total = np.bincount(at, shares, minlength=len(onwards))
        before = (np.cumsum(total) - total)[at[order]]
        reached = np.cumsum(shares[order]) - before - rng.random() * shares[order]
        level = reached / total[at[order]] * onwards[at[order], -1]
        at[order] = (level[:, None] > onwards[at[order], :-1]).sum(1)
        nodes[:, t] = at
    return nodes, shares


def reachable_origins(away: Array, weights: Array, reach: float) -> Array:
    """Return origins (K, M) of modes with unknown ancestors: previous modes within reach.

    Args:
        away: (K, M) distances from the modes of the previous image, m.
        weights: (M,) weights of the modes of the previous image.
        reach: maximum motion between the images, m; if no mode is within reach, all modes are used.
    """
    near = (away <= reach) * weights
    lost = ~near.any(1)
    near[lost] = weights
    return np.asarray(near / near.sum(1, keepdims=True))
