"""Symmetries of a body: poses that a camera takes for each other, and how often it does.

    p(dt) = (1 - exp(-2 q dt)) / 2        q: rate of the symmetry, 1/s                          (1)

A symmetry maps a pose to another one with nearly the same image. p is the probability that after dt
seconds the other pose is taken for the one: of a two-state chain that goes over q times a second.
The model file has the table; what a map does is defined by `MAPS`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

# The maps, and the part of the class of a pose that each changes.
MAPS: Mapping[str, str] = MappingProxyType(
    {
        'reversal': 'the way to face: the whole pose in a mirror across the line of sight',
        'trunk_flip': 'the lean: hips, trunk or shoulders turned towards or away',
        'exchange': 'which limb of a pair is which: each on the image of the other one',
        'limb_flip': 'the bend of a limb: a segment towards or away',
    }
)


@dataclass(frozen=True)
class Symmetry:
    """A symmetry of a body.

    Attributes:
        rate: How often tracks take the mapped pose for the pose, 1/s.
    """

    rate: float

    def __post_init__(self) -> None:
        if not 0.0 < self.rate < math.inf:
            raise ValueError(f'the rate of a symmetry must be positive, saw {self.rate} 1/s')

    def probability(self, dt: float) -> float:
        """p(dt) that the mapped pose is the one dt seconds later, (1)."""
        return -0.5 * math.expm1(-2.0 * self.rate * dt)

    def price(self, dt: float) -> float:
        """-log p(dt), nats; of no time it is infinite."""
        return -math.log(self.probability(dt)) if dt > 0.0 else math.inf

    def after(self, log_odds: float, dt: float) -> float:
        """Log odds of the mapped pose dt seconds later."""
        p = 1.0 / (1.0 + math.exp(-log_odds))
        p += self.probability(dt) * (1.0 - 2.0 * p)
        return math.log(p) - math.log1p(-p)


def symmetries_of(entries: Mapping[str, Any]) -> Mapping[str, Symmetry]:
    """The table of a model file: rates by map.

    Raises:
        ValueError: a map that there is not, one that is missing, or a rate that is not positive.
    """
    if set(entries) != set(MAPS):
        raise ValueError(f'symmetries: wanted rates of {list(MAPS)}, saw {list(entries)}')
    return MappingProxyType({name: Symmetry(float(entries[name])) for name in MAPS})
