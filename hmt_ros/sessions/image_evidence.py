"""Evidence of images about a pose, for a smoother, and the part of it that counts."""

from __future__ import annotations

import math
from typing import NamedTuple

from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.error_model import CueErrors
from hmt_ros.sessions.smoothed_messages import SmoothedBody
from hmt_ros.smoothing.likelihood import counted, merged_modes, or_missed
from msg_tools import MessageError
from msg_tools.messages.headers import SECOND_NS
from msg_tools.messages.pose_mixtures import MixtureKind, PoseMixture

# Time of the free motion that tells how far a pose may be from where an image shows it, s.
ASTRAY = 1.0


class Evidence(NamedTuple):
    """Evidence of an image about the pose.

    Attributes:
        stamp: of the image.
        mixture: the whole evidence.
        errors: the error model.
        shape: (d, d) covariance of the errors shared by poses of all images; None: unknown.
    """

    stamp: int
    mixture: GaussianMixture
    errors: CueErrors
    shape: Array | None

    def since(self, before: int | None, rates: Array, distance: float) -> GaussianMixture:
        """The part that counts after an image at the stamp `before`; None: no image before.

        Args:
            before: ns.
            rates: (d,) variances of free motion, per second.
            distance: below which modes are merged, in standard deviations of that part.
        """
        dt = self._interval(before)
        share = self.errors.share(dt)
        apart = merged_modes(self.mixture, distance / math.sqrt(share))
        return or_missed(
            counted(apart, self.errors.of_modes(dt), self.errors.of_changes(dt)), ASTRAY * rates
        )

    def lasting(self, before: int | None) -> float:
        """Factor on the variance that is left after it, because its errors last."""
        return self.errors.lasting(self._interval(before))

    def _interval(self, before: int | None) -> float:
        return math.inf if before is None else (self.stamp - before) / SECOND_NS


class KeptMixtures(NamedTuple):
    """Likelihoods that have been smoothed since the window began, the newest.

    Attributes:
        of: person of the poses; None: no mixture has come.
        items: as they were received.
    """

    of: SmoothedBody | None
    items: tuple[Evidence, ...]


def evidence_of(content: PoseMixture) -> Evidence:
    """The evidence in a mixture, with its error model; without one, errors do not last.

    Raises:
        MessageError: there are no components or no covariances; a forecast; a likelihood without an
            error model.
    """
    if content.kind is MixtureKind.FORECAST:
        raise MessageError(
            'mixture is of the kind FORECAST, wanted LIKELIHOOD: no image speaks of a forecast',
            'kind',
        )
    mixture, share, time = content.mixture, content.error_share, content.error_time
    if math.isnan(share) or math.isnan(time):
        if content.kind is MixtureKind.LIKELIHOOD:
            raise MessageError(
                f'likelihood has error_share {share:g} and error_time {time:g}, wanted numbers',
                'error_share and error_time',
            )
        share, time = 1.0, 0.0
    return Evidence(content.stamp_ns, mixture, CueErrors(share, time), content.shape_covariance)
