"""Weights of the modes of an image, smoothed over the next L images.

The weights result from forward filtering and backward smoothing (`inference.mode_chain`) over the
image and the next L images. The evidence of an image for mode k, or for its facing direction
(`classes`), is a factor of w_k only. So the lagged weights are consistent with the published
weights, which have L = 0: both are sums over all histories of the modes. If a mode represents
several hypotheses, P is their mean (`weighting.pooled_origins`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from hmt_ros.inference.arrays import Array
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.inference.mode_chain import Link, backward_weights


class Lagged(NamedTuple):
    """Posterior of an image, with weights smoothed over later images.

    Attributes:
        stamp: timestamp of the image, ns.
        posterior: posterior of the image, with lagged weights; components in the published order.
    """

    stamp: int
    posterior: GaussianMixture


class LaggedWeights:
    """Collects the posteriors of a track; smooths their weights over the next `lag` images.

        lagged = LaggedWeights(10)
        for stamp, image in images:
            posterior, _ = tracker.step(image, stamp)
            if posterior is not None:
                found += lagged.update(stamp, posterior, tracker.origins)
        found += lagged.finish()

    Args:
        lag: number L of later images; 0 returns the published posteriors.

    Raises:
        ValueError: the lag is negative.
    """

    def __init__(self, lag: int) -> None:
        if lag < 0:
            raise ValueError(f'lag must not be negative, saw {lag}')
        self.lag = lag
        # At most L + 1 posteriors that wait for later images, with their origins.
        self._waiting: list[tuple[Lagged, Array]] = []

    def update(self, stamp: int, posterior: GaussianMixture, origins: Array) -> list[Lagged]:
        """Adds the posterior of the next image.

        Args:
            stamp: timestamp of the image, ns.
            posterior: K components.
            origins: (K, M) probability that component k continues component m of the previous
                image; M is 0 at the start of a track.

        Returns:
            Finished posteriors, oldest first: the posterior of L images ago, if it belongs to the
            same track; at the start of a track also all remaining posteriors of the previous track.

        Raises:
            ValueError: the shape of the origins is inconsistent.
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
        """Returns the remaining posteriors, smoothed over fewer than L later images."""
        result, self._waiting = self._smoothed(), []
        return result

    def _smoothed(self) -> list[Lagged]:
        """Returns the waiting posteriors, each smoothed over all later images."""
        if not self._waiting:
            return []
        links = [Link(one.posterior.weights, origins) for one, origins in self._waiting]
        return [
            one._replace(posterior=replace(one.posterior, weights=weights))
            for (one, _), weights in zip(self._waiting, backward_weights(links), strict=True)
        ]
