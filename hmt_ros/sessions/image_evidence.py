"""Evidence of an image, and links to the previous modes, read from a likelihood mixture."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hmt_ros.inference.arrays import Array
from hmt_ros.inference.error_model import CueErrors
from hmt_ros.inference.linear_algebra import mean_distances
from hmt_ros.inference.mode_chain import reachable_origins
from hmt_ros.sessions.smoothed_messages import SmoothedBody
from hmt_ros.smoothing import ImageModes, Link
from msg_tools import MessageError
from msg_tools.messages.headers import SECOND_NS
from msg_tools.messages.pose_mixtures import MixtureKind, PoseMixture

# Maximum mean speed of the joints relative to the pelvis, m/s, and distance that is allowed in
# addition, m. Both limit which previous modes a mode of unknown ancestry may continue.
MAX_SPEED, MODE_JITTER = 2.0, 0.05


class Evidence(NamedTuple):
    """Evidence of an image about the pose.

    Attributes:
        modes: mixture of the evidence, with the weights and the ancestry of the filter's modes.
        shape: (d, d) covariance of the errors that are the same in all images; None: unknown.
        identities: (K,) identities of the modes in the filter; 0: none.
    """

    modes: ImageModes
    shape: Array | None
    identities: tuple[int, ...]


class KeptMixtures(NamedTuple):
    """Newest likelihoods that have been smoothed since the window began.

    Attributes:
        of: person of the poses; None before the first mixture.
        items: evidence of the likelihoods, oldest first.
    """

    of: SmoothedBody | None
    items: tuple[Evidence, ...]


def evidence_of(content: PoseMixture) -> Evidence:
    """Return the evidence in a mixture; without an error model, errors are independent.

    If the posterior weights of the modes are not given, the weights of the mixture replace them.
    The modes have no ancestry yet, see `continued`.

    Raises:
        MessageError: the mixture has no components or no covariances, is a forecast, or is a
            likelihood without an error model.
    """
    if content.kind is MixtureKind.FORECAST:
        raise MessageError(
            'mixture is of the kind FORECAST, wanted LIKELIHOOD: a forecast contains no '
            'evidence of an image',
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
    weights = mixture.weights if content.posterior_weights is None else content.posterior_weights
    link = Link(weights / weights.sum(), np.empty((len(weights), 0)))
    modes = ImageModes(content.stamp_ns, link, mixture, CueErrors(share, time))
    assert content.identities is not None
    return Evidence(modes, content.shape_covariance, tuple(content.identities.tolist()))


def continued(
    evidence: Evidence, content: PoseMixture, before: Evidence, points: Array, points_before: Array
) -> Evidence:
    """Return the evidence of an image with its modes linked to those of the previous image.

    Args:
        evidence: evidence of the image.
        content: content of the message about the image, with the ancestry from the filter.
        before: evidence of the previous image.
        points, points_before: (K, P, 3) and (M, P, 3) points of the modes of both images, m. They
            are used if the ancestry is unknown or refers to an image that was not received: a mode
            then continues all previous modes within reach.
    """
    modes, others = evidence.modes, before.modes
    ancestry, known = content.ancestry, content.ancestry_stamp_ns == others.stamp_ns
    origins = None
    if ancestry is not None and known and ancestry.shape[1]:
        assert content.ancestry_ids is not None
        columns = {int(name): i for i, name in enumerate(content.ancestry_ids)}
        if set(columns) == set(before.identities):
            origins = ancestry[:, [columns[name] for name in before.identities]]
    if origins is None:
        away = mean_distances(points[:, None], points_before)
        reach = MODE_JITTER + MAX_SPEED * (modes.stamp_ns - others.stamp_ns) / SECOND_NS
        origins = reachable_origins(away, others.link.weights, reach)
    return evidence._replace(modes=modes._replace(link=modes.link._replace(origins=origins)))
