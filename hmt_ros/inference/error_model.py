"""How much measurements say whose errors last: neighbours in space and in time repeat each other.

    energy of cue g in an image     s_g E_g                        s_g: share that is independent
    its share in time               a_g(dt) = (1 - rho) / (1 + rho) = tanh(dt / (2 tau_g)),
                                    rho = exp(-dt / tau_g)

An error that lasts for tau is an AR(1) process: between two measurements dt apart its correlation
is rho. n measurements in a row tell as much of a constant as a(dt) n independent ones (n large), so
that each counts with the share a(dt) [Bartlett 1946]. For small dt the share is dt / (2 tau): what
is told in a second does not depend on the rate of the measurements. For large dt it is 1.

What lasts moves along: how a pose changes from one measurement to the next they tell better, by the
new part of the error alone, 1 - rho^2 of its variance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


def seconds(nanoseconds: int) -> float:
    """A difference of stamps, in s."""
    return 1e-9 * nanoseconds


def share_of_time(dt: float, tau: float) -> float:
    """The share a(dt) of an independent measurement that a measurement counts for.

    Args:
        dt: time since the measurement before, s; infinite: there is none before.
        tau: how long the errors last, s; 0: they are independent.

    Raises:
        ValueError: a time that is negative or not a number.
    """
    if not (dt >= 0.0 and tau >= 0.0):
        raise ValueError(f'wanted times that are not negative, saw dt {dt} and tau {tau} s')
    return 1.0 if tau == 0.0 else math.tanh(0.5 * dt / tau)


@dataclass(frozen=True)
class CueErrors:
    """How the errors of a cue last.

    Attributes:
        independent: Share of the cue's energy in one image that is independent.
        time: Time for which errors of the cue last, s.
        constant: Share c of the variance of what an image tells that is the same in all images.
    """

    independent: float
    time: float
    constant: float = 0.0

    def share(self, dt: float) -> float:
        """Share of the energy, or of its curvature, that an image adds dt s after the last one."""
        return self.independent * share_of_time(dt, self.time)

    def of_modes(self, dt: float) -> float:
        """Share of the log weights by which an image tells modes apart, dt s after the last one.

        That of time alone: neighbours in space repeat each other's errors, which makes a mode look
        sharper than it is, but they do so in all modes. Chosen on clips (docs/smoothing.md).
        """
        return share_of_time(dt, self.time)

    def together(self, count: float) -> float:
        """Factor on what images tell together of what does not change.

        The mean of n of them has the variance 1 / n + c: they tell n / (1 + c n) of one.

        Args:
            count: n, the sum of their shares.
        """
        return 1.0 / (1.0 + self.constant * count)

    def of_changes(self, dt: float) -> float:
        """Share of the curvature by which an image tells how a pose has changed in dt s.

        An error that lasts has not changed: s / (1 - rho^2), the variance of what is new of it.
        """
        new = -math.expm1(-2.0 * dt / self.time) if self.time > 0.0 else 1.0
        return self.independent / new

    def lasting(self, dt: float) -> float:
        """Ratio of both shares, 1 / (1 - rho)^2: variance that stays, over that of changes."""
        return self.of_changes(dt) / self.share(dt)


def errors_of_cues(amounts: Mapping[str, float]) -> CueErrors:
    """The one pair (s, tau) that stands for a likelihood made of several cues.

        s = sum_g c_g s_g / C,    s / tau = sum_g c_g s_g / tau_g / C,    C = sum_g c_g

    c_g is how much cue g brings to the likelihood: of the curvature, the number of variables that
    it determines. At low rates the likelihood then counts with the mean of the shares of its cues,
    and at high rates a second of images tells what the cues tell in a second; in between the share
    is an approximation, and exact where all tau_g are one.

    Args:
        amounts: c_g by name of the cue in `ERRORS`, none negative, not all 0.

    Raises:
        ValueError: amounts that are negative, not finite, or all 0.
    """
    total = sum(amounts.values())
    if not (0.0 < total < math.inf and min(amounts.values()) >= 0.0):
        raise ValueError(f'wanted amounts that are not negative, and not all 0, saw {amounts}')
    parts = [(amount / total, ERRORS[name]) for name, amount in amounts.items() if amount > 0.0]
    share = sum(part * errors.independent for part, errors in parts)
    if any(errors.time == 0.0 for _, errors in parts):
        return CueErrors(share, 0.0)
    rate = sum(part * errors.independent / errors.time for part, errors in parts)
    return CueErrors(share, share / rate)


# What all images so far leave of the covariance of a pose, as a share of what the last one leaves
# by itself, of which only its own share of the evidence is believed: `benchmarks/joint_errors.py`.
TOGETHER = 0.29

# Chosen, not learned, at 30 and 3 images a second (docs/tracking.md). The prior of the pose is
# counted like a cue, because the same pose is judged again in every image. `lifted` is what experts
# say of depths, beside a weight of their own. `shape` is what an image says of lengths and flesh:
# poses that differ tell of these apart, but not of clothes. Its constant share was chosen on clips
# that are shown back and forth for 45 s: 0.03, 0.12 and 0.3 were tried.
ERRORS: Mapping[str, CueErrors] = MappingProxyType(
    {
        'image': CueErrors(0.15, 0.019),
        'keypoints': CueErrors(0.35, 0.053),
        'lifted': CueErrors(1.0, 0.067),
        'prior': CueErrors(0.15, 0.019),
        'shape': CueErrors(0.35, 0.053, 0.12),
    }
)
# Factor on what experts say where it is counted as keypoints are: the ratio of what both tell in a
# second of many images.
LIFTED_AS_KEYPOINTS = (
    ERRORS['lifted'].independent / ERRORS['lifted'].time
    * ERRORS['keypoints'].time / ERRORS['keypoints'].independent
)  # fmt: skip
