"""Information of measurements with correlated errors, in space and time.

    energy of cue g in an image     s_g E_g                        s_g: share that is independent
    its share in time               a_g(dt) = (1 - rho) / (1 + rho) = tanh(dt / (2 tau_g)),
                                    rho = exp(-dt / tau_g)

An error with the correlation time tau is an AR(1) process: its correlation between two measurements
dt apart is rho. About a constant, n measurements in a row (n large) have the information of a(dt) n
independent ones, so that each counts with the share a(dt) [Bartlett 1946]. For small dt it is dt /
(2 tau): the information per second does not depend on the rate. For large dt it is 1.

A lasting error cancels in differences: the change of a pose from one measurement to the next is
measured with the new part of the error alone, 1 - rho^2 of its variance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from hmt_ros.core import elementary


def seconds(nanoseconds: int) -> float:
    """A difference of stamps, in s."""
    return 1e-9 * nanoseconds


def share_of_time(dt: float, tau: float) -> float:
    """Return a(dt), the information of a measurement relative to an independent one.

    Args:
        dt: time since the measurement before, s; infinite for the first one.
        tau: correlation time of the errors, s; 0 for independent errors.

    Raises:
        ValueError: a time is negative or not a number.
    """
    if not (dt >= 0.0 and tau >= 0.0):
        raise ValueError(f'wanted times that are not negative, saw dt {dt} and tau {tau} s')
    return 1.0 if tau == 0.0 else float(elementary.tanh(0.5 * dt / tau))


@dataclass(frozen=True)
class CueErrors:
    """Duration of the errors of a cue.

    Attributes:
        independent: Share of the cue's energy in one image that is independent.
        time: Time for which errors of the cue last, s.
        constant: Share c of the error variance of one image that is common to all images.
    """

    independent: float
    time: float
    constant: float = 0.0

    def share(self, dt: float) -> float:
        """Share of its energy, or curvature, that an image adds dt s after the last one."""
        return self.independent * share_of_time(dt, self.time)

    def together(self, count: float) -> float:
        """Factor on the summed information of images about a constant.

        The mean of n of them has the variance 1 / n + c: n / (1 + c n) times the information of 1.

        Args:
            count: n, the sum of their shares.
        """
        return 1.0 / (1.0 + self.constant * count)

    def of_changes(self, dt: float) -> float:
        """Share of the curvature of an image that measures the change of a pose in dt s.

        A lasting error has not changed: s / (1 - rho^2), by the variance of its new part.
        """
        new = -float(elementary.expm1(-2.0 * dt / self.time)) if self.time > 0.0 else 1.0
        return self.independent / new

    def lasting(self, dt: float) -> float:
        """Ratio of both shares, 1 / (1 - rho)^2: lasting variance over variance of changes."""
        return self.of_changes(dt) / self.share(dt)


def errors_of_cues(amounts: Mapping[str, float]) -> CueErrors:
    """Combine the errors of several cues in one likelihood to one pair (s, tau).

        s = sum_g c_g s_g / C,    s / tau = sum_g c_g s_g / tau_g / C,    C = sum_g c_g

    c_g is the contribution of cue g to the likelihood: the number of variables that its curvature
    determines. At low rates the likelihood then counts with the mean of the shares of its cues, and
    at high rates a second of images has the information of its cues; in between the share is an
    approximation, and exact where all tau_g are one.

    Args:
        amounts: c_g by name of the cue in `ERRORS`, none negative, not all 0.

    Raises:
        ValueError: an amount is negative or not finite, or all are 0.
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


# Covariance of a pose given all images so far, over that given the last image alone with its own
# share of the evidence; see `benchmarks/joint_errors.py`.
TOGETHER = 0.29

# Chosen, not learned, at 30 and 3 images a second (docs/tracking.md). The prior of the pose is
# counted like a cue, because the same pose is judged again in every image. `lifted` are the depths
# of experts, beside a weight of their own. `shape` is the evidence of images on lengths and flesh:
# different poses are independent evidence on these, but not on clothes. Its constant share was
# chosen on clips that are shown back and forth for 45 s: 0.03, 0.12 and 0.3 were tried.
_IMAGE, _KEYPOINTS = CueErrors(0.15, 0.019), CueErrors(0.35, 0.053)
ERRORS: Mapping[str, CueErrors] = MappingProxyType(
    {
        'image': _IMAGE,
        'keypoints': _KEYPOINTS,
        'lifted': CueErrors(1.0, 0.067),
        'prior': _IMAGE,
        'shape': replace(_KEYPOINTS, constant=0.12),
    }
)
# Factor on the depths of experts where they are counted like keypoints: the ratio of the
# information of both in a second of many images.
LIFTED_AS_KEYPOINTS = (
    ERRORS['lifted'].independent
    / ERRORS['lifted'].time
    * ERRORS['keypoints'].time
    / ERRORS['keypoints'].independent
)
