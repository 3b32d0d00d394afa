"""Weights of the modes of an image, smoothed over the L images after it.

    W_T(k) = w_k                                                        the newest image T  (1)
    W_t(j) = sum_k W_(t+1)(k) P(j | k)                                  T - L <= t < T      (2)
    P(j | k) = w_j p(x_k | x_j) / sum_l w_l p(x_k | x_l)

This is the backward half of forward filtering, backward smoothing (Doucet, Godsill and Andrieu,
"On sequential Monte Carlo sampling methods for Bayesian filtering", 2000). The evidence of an image
for mode k, or for the way that it faces (`classes`), is a factor of w_k alone: it cancels in
P(j | k), the probability that the history of k went through j, and reaches image t by (1). So the
lagged weights agree with the published ones, which are those of L = 0: they are the sum over all
histories of the modes. Where a mode stands for several hypotheses, P is their mean
(`weighting.pooled_origins`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from hmt_ros.inference.arrays import Array
from hmt_ros.inference.mixture import GaussianMixture


class Lagged(NamedTuple):
    """The posterior of an image, with weights by later images.

    Attributes:
        stamp: of the image, ns.
        posterior: of the image; its components are in the order in which it was published, their
            weights are the lagged ones.
    """

    stamp: int
    posterior: GaussianMixture


class LaggedWeights:
    """Posteriors of a track, each with the weights that the next `lag` images give it.

        lagged = LaggedWeights(10)
        for stamp, image in images:
            posterior, _ = tracker.step(image, stamp)
            if posterior is not None:
                found += lagged.update(stamp, posterior, tracker.origins)
        found += lagged.finish()

    Args:
        lag: number of images, L; 0 gives back the published posteriors.

    Raises:
        ValueError: the lag is negative.
    """

    def __init__(self, lag: int) -> None:
        if lag < 0:
            raise ValueError(f'lag must not be negative, saw {lag}')
        self.lag = lag
        # Posteriors without a result, with the origins of each in the one before; L + 1 at most.
        self._waiting: list[tuple[Lagged, Array]] = []

    def update(self, stamp: int, posterior: GaussianMixture, origins: Array) -> list[Lagged]:
        """Takes in the posterior of the next image.

        Args:
            stamp: of the image, ns.
            posterior: K components.
            origins: (K, M) probability that each continues component m of the image before; M is 0
                where a track begins.

        Returns:
            The image L before this one, if it is of the same track; where a track begins, all that
            were left of the one before. Oldest first.

        Raises:
            ValueError: origins of another shape.
        """
        begins = origins.shape[1] == 0
        result = self.finish() if begins else []
        before = len(self._waiting[-1][0].posterior) if self._waiting else origins.shape[1]
        if origins.shape != (len(posterior), before):
            raise ValueError(f'wanted origins {(len(posterior), before)}, saw {origins.shape}')
        self._waiting.append((Lagged(stamp, posterior.normalised()), origins))
        if len(self._waiting) > self.lag:
            result.append(self._smoothed()[0])
            del self._waiting[0]
        return result

    def finish(self) -> list[Lagged]:
        """The images that are left; fewer than L images weigh these."""
        result, self._waiting = self._smoothed(), []
        return result

    def _smoothed(self) -> list[Lagged]:
        """The waiting images by all that follow them."""
        result: list[Lagged] = []
        weights = None
        for one, origins in reversed(self._waiting):
            weights = one.posterior.weights if weights is None else weights
            result.append(one._replace(posterior=replace(one.posterior, weights=weights)))
            weights = weights @ origins
        return result[::-1]
