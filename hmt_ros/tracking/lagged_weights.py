"""Weights of the modes of an image, smoothed over the L images after it.

They result from forward filtering, backward smoothing (`inference.mode_chain`) in a window of the
image and the L after it. The evidence of an image for mode k, or for its facing direction
(`classes`), is a factor of w_k alone. So the lagged weights are consistent with the published ones,
which are those of L = 0: they are sums over all histories of the modes. If a mode represents
several hypotheses, P is their mean (`weighting.pooled_origins`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from hmt_ros.inference.arrays import Array
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.inference.mode_chain import Link, backward_weights


class Lagged(NamedTuple):
    """The posterior of an image, with weights by later images.

    Attributes:
        stamp: of the image, ns.
        posterior: of the image, with lagged weights; components are in the published order.
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
        lag: number of images, L; 0 returns the published posteriors.

    Raises:
        ValueError: the lag is negative.
    """

    def __init__(self, lag: int) -> None:
        if lag < 0:
            raise ValueError(f'lag must not be negative, saw {lag}')
        self.lag = lag
        # At most L + 1 posteriors without a result, with their origins in the previous one.
        self._waiting: list[tuple[Lagged, Array]] = []

    def update(self, stamp: int, posterior: GaussianMixture, origins: Array) -> list[Lagged]:
        """Adds the posterior of the next image.

        Args:
            stamp: of the image, ns.
            posterior: K components.
            origins: (K, M) probability that each continues component m of the previous image; M is
                0 where a track starts.

        Returns:
            The image L before this one, if it is of the same track; where a track starts, all
            remaining images of the previous one. Oldest first.

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
        """The remaining images, weighted by fewer than L later ones."""
        result, self._waiting = self._smoothed(), []
        return result

    def _smoothed(self) -> list[Lagged]:
        """The waiting images, each weighted by all later ones."""
        if not self._waiting:
            return []
        links = [Link(one.posterior.weights, origins) for one, origins in self._waiting]
        return [
            one._replace(posterior=replace(one.posterior, weights=weights))
            for (one, _), weights in zip(self._waiting, backward_weights(links), strict=True)
        ]
