"""Weights of the modes of an image, smoothed over the L images after it.

They are those of forward filtering, backward smoothing (`inference.mode_chain`) in a window of the
image and the L after it. The evidence of an image for mode k, or for the way that it faces
(`classes`), is a factor of w_k alone. So the lagged weights agree with the published ones, which
are those of L = 0: they are the sum over all histories of the modes. Where a mode stands for
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
        if not self._waiting:
            return []
        links = [Link(one.posterior.weights, origins) for one, origins in self._waiting]
        return [
            one._replace(posterior=replace(one.posterior, weights=weights))
            for (one, _), weights in zip(self._waiting, backward_weights(links), strict=True)
        ]
