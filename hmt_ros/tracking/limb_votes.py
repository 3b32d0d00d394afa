"""Votes for limbs and pairs of limbs that may lie in the wrong place of the image.

Two things speak for it: the contour of the limb costs more than it usually does, and the limb is so
uncertain sideways that it may as well lie on the next edge. Limbs that lie over each other may have
been taken for each other, whatever they cost.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import erfc, exp, isfinite, sqrt

import numpy as np

# Stream of random numbers of a seed.
OF_VOTES = 11
# How far the usual cost follows that of the last image, and what it takes over at most, as a
# multiple of itself: what is unusual is not learned at once.
GAIN = 0.1
MOST_LEARNED = 1.5
# A limb that costs so much more than usual, as a share of that, has all votes.
CERTAIN_EXCESS = 1.0
# Costs below this are all alike: noise of the edges.
NOISE = 0.02


class LimbVotes:
    """What the contours of the limbs usually cost, and chance to draw by.

    Votes have random numbers of their own: where none is followed, all else is as without them.

    Args:
        seed: of the random numbers.
    """

    def __init__(self, seed: int = 0) -> None:
        self.usual: dict[str, float] = {}
        self._rng = np.random.default_rng([seed, OF_VOTES])

    def drawn(self, probability: float) -> bool:
        """True with a probability."""
        return bool(self._rng.random() < probability)

    def excess(self, residuals: Mapping[str, float]) -> dict[str, float]:
        """Votes 0 to 1 by how much more than usual limbs cost; a limb that is new has none."""
        result = {}
        for chain, residual in residuals.items():
            usual = self.usual.get(chain, residual) + NOISE
            share = (residual + NOISE - usual) / (CERTAIN_EXCESS * usual)
            result[chain] = min(max(share, 0.0), 1.0) if isfinite(share) else 0.0
        return result

    def learn(self, residuals: Mapping[str, float]) -> None:
        """Takes in what the limbs cost in one image."""
        for chain, residual in residuals.items():
            if not isfinite(residual):
                continue
            usual = self.usual.get(chain, residual)
            most = MOST_LEARNED * (usual + NOISE)
            self.usual[chain] = usual + GAIN * (min(residual, most) - usual)


def displaced(width: float, deviation: float) -> float:
    """Probability that a limb of a width lies sideways by half of it or more, px or px."""
    return erfc(width / (2.0 * sqrt(2.0) * deviation)) if deviation > 0 else 0.0


def exchanged(gaps: Iterable[float], width: float) -> float:
    """Votes 0 to 1 that two limbs were taken for each other, by the gaps of their joints, px."""
    values = list(gaps)
    nearest = min(values) if values else float('inf')
    return exp(-0.5 * (nearest / max(width, 1e-6)) ** 2) if isfinite(nearest) else 0.0
