"""Information of measurements with correlated errors, in space and time.

    energy of cue g in an image     s_g E_g                        s_g: share that is independent
    its share in time               a_g(dt) = (1 - rho) / (1 + rho) = tanh(dt / (2 tau_g)),
                                    rho = exp(-dt / tau_g)

An error with the correlation time tau is an AR(1) process: errors of measurements dt apart have the
correlation rho. A long series of n measurements of a constant has the information of a(dt) n
independent measurements, so each measurement has the weight a(dt) [Bartlett 1946]. For small dt the
share is dt / (2 tau): the information per second does not depend on the rate. For large dt the
share is 1.

Persistent errors cancel in differences: the change of a pose between two measurements has only the
new part of the error, with the fraction 1 - rho^2 of the variance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from hmt_ros.core import elementary


def seconds(nanoseconds: int) -> float:
    """Converts a difference of timestamps to seconds."""
    return 1e-9 * nanoseconds


def share_of_time(dt: float, tau: float) -> float:
    """Return a(dt), the information of a measurement relative to an independent measurement.

    Args:
        dt: time since the previous measurement, s; infinite for the first.
        tau: correlation time of the errors, s; 0 for independent errors.

    Raises:
        ValueError: a time is negative or not a number.
    """
    if not (dt >= 0.0 and tau >= 0.0):
        raise ValueError(f'wanted times that are not negative, saw dt {dt} and tau {tau} s')
    return 1.0 if tau == 0.0 else float(elementary.tanh(0.5 * dt / tau))


@dataclass(frozen=True)
class CueErrors:
    """Error model of a cue.

    Attributes:
        independent: Share s of independent information in the cue's energy in one image.
        time: Correlation time tau of the errors of the cue, s.
        constant: Share c of the error variance of one image that is common to all images.
    """

    independent: float
    time: float
    constant: float = 0.0

    def share(self, dt: float) -> float:
        """Weight of the energy, or curvature, of an image dt s after the previous image."""
        return self.independent * share_of_time(dt, self.time)

    def together(self, count: float) -> float:
        """Factor on the information about a constant, summed over many images.

        The mean over n images has the variance 1 / n + c relative to one image, so its information
        is n / (1 + c n) times that of one image.

        Args:
            count: effective number n of images, which is the sum of their shares.
        """
        return 1.0 / (1.0 + self.constant * count)

    def of_changes(self, dt: float) -> float:
        """Weight of an image's curvature as evidence on the change of a pose in dt seconds.

        Only the new part of the error contributes, so the weight is s / (1 - rho^2).
        """
        new = -float(elementary.expm1(-2.0 * dt / self.time)) if self.time > 0.0 else 1.0
        return self.independent / new

    def persistence_ratio(self, dt: float) -> float:
        """Ratio 1 / (1 - rho)^2 of `of_changes` to `share`, which scales variances."""
        return self.of_changes(dt) / self.share(dt)


def errors_of_cues(amounts: Mapping[str, float]) -> CueErrors:
    """Combine the error models of several cues in one likelihood into one pair (s, tau).

        s = sum_g c_g s_g / C,    s / tau = sum_g c_g s_g / tau_g / C,    C = sum_g c_g

    c_g is the contribution of cue g to the likelihood: the number of variables that its curvature
    determines. At low rates the likelihood then has the mean share of its cues. At high rates, the
    images of a second have the same information as with separate cues. At rates in between, the
    share is an approximation; with equal tau_g it is exact.

    Args:
        amounts: contributions c_g by cue name in `ERRORS`; not negative, and not all 0.

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


# Ratio of two covariances of a pose: given all images so far, and given the last image alone with
# its share of the evidence; see `benchmarks/joint_errors.py`.
JOINT_COVARIANCE_RATIO = 0.29

# Chosen, not learned, at 30 and 3 images per second (docs/tracking.md). The prior of the pose is
# discounted like a cue, because it evaluates the same pose again in every image. `lifted` are the
# depths from experts, which also have a separate weight. `shape` is the evidence from images on
# lengths and flesh: different poses are independent evidence on lengths and flesh, but not on
# clothes. The constant share was chosen among 0.03, 0.12 and 0.3 on clips played back and forth for
# 45 s.
_IMAGE_ERRORS, _KEYPOINT_ERRORS = CueErrors(0.15, 0.019), CueErrors(0.35, 0.053)
ERRORS: Mapping[str, CueErrors] = MappingProxyType(
    {
        'image': _IMAGE_ERRORS,
        'keypoints': _KEYPOINT_ERRORS,
        'lifted': CueErrors(1.0, 0.067),
        'prior': _IMAGE_ERRORS,
        'shape': replace(_KEYPOINT_ERRORS, constant=0.12),
    }
)
# Factor on the depths from experts if they are discounted like keypoints: the ratio of the
# information per second of experts and keypoints at a high rate.
LIFTED_INFORMATION_RATIO = (
    ERRORS['lifted'].independent
    / ERRORS['lifted'].time
    * ERRORS['keypoints'].time
    / ERRORS['keypoints'].independent
)
