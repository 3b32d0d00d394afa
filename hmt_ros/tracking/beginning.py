"""Start of a track, from the first available source in a table.

    source        needs                                             sure (nats, plus existence)
    subject       a subject file, and an image at or after it       given
    mixture       a given mixture                                   given
    keypoints     most of the trunk, and 6 joints in all            -
    prediction    poses that a regression predicts                  PREDICTION_LOG_ODDS
    keypoints     of a part: a person, both shoulders or hips       -
    box           a box around the person                           given
    mask          a mask with the shape of a person                 -

A track starts once

    log odds of existence + sure + log p(distance) >= log odds of PRESENT_PROBABILITY

p(distance) is log-normal and wide, without a limit: a lens of 60 degrees sees people at 0.4 to 15
m, and these distances grow with the focal length. After a track has ended, a silhouette in front of
a known background also suffices.

Keypoints give poses, depth and lengths (see `initialisation`); a mask or a box gives mean poses at
several headings. A detector may confuse left and right, and silhouettes do not distinguish sides.
So the poses reversed in depth are hypotheses too, and both facing directions are tracked (see
`classes`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera, log_prior_of_distance
from hmt_ros.body.mirror import reverse_depth
from hmt_ros.core import elementary
from hmt_ros.experts.lifted_fit import KNOWN_SIZE, poses_of
from hmt_ros.experts.lifter import landmark_rays
from hmt_ros.image.joint_depths import depths_of, moved_to_depth
from hmt_ros.image.keypoint_evidence import MIN_KEYPOINTS, shows_a_part, suffices
from hmt_ros.image.observation import Box, Observation, observe
from hmt_ros.image.person_shape import looks_like_person
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.subject import Subject
from hmt_ros.image.terms.depth import DEPTH
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.error_model import seconds
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.tracking.existence import CLEAR_CUE, Existence
from hmt_ros.tracking.ground import Gravity
from hmt_ros.tracking.hypotheses import PosePrediction
from hmt_ros.tracking.initialisation import (
    Start,
    mixture_from_box,
    poses_from_keypoints,
    poses_from_outline,
    start_from_keypoints,
)
from hmt_ros.tracking.observer import View
from hmt_ros.tracking.settings import MAX_STARTS, PRESENT_PROBABILITY, SAME_MOMENT_TIME

# Log odds of existence that a prediction adds, nats; the first image may have no other evidence.
PREDICTION_LOG_ODDS = 1.5 * CLEAR_CUE.nats
PRESENT_LOG_ODDS = float(elementary.log(PRESENT_PROBABILITY / (1.0 - PRESENT_PROBABILITY)))
# Number of keypoint poses, best first, whose depth reversals become hypotheses too.
MAX_REVERSED_POSES = MAX_STARTS // 4


class Source(Enum):
    """Input from which a track started."""

    SUBJECT = 'the subject file'
    MIXTURE = 'a mixture'
    KEYPOINTS = 'keypoints'
    PREDICTION = 'a pose prediction'
    MASK = 'a mask'
    BOX = 'a box'
    ARRIVAL = 'who has come into view'


# Sources that contain joints, and sources that may use only a silhouette.
JOINT_SOURCES = (Source.SUBJECT, Source.KEYPOINTS)
SILHOUETTE_SOURCES = (Source.PREDICTION, Source.ARRIVAL)


@dataclass(frozen=True, eq=False)
class Shown:
    """An image, and the start given by the user.

    Attributes:
        view: view of the image.
        model: body of an average person, before a subject's lengths are applied.
        body: body for the poses of a given mixture.
        camera: camera that sees the person.
        upright: gravity; None: unknown.
        given: subject or mixture from which the track starts; None: the track starts from an image.
        box: bounding box (left, top, right, bottom) of the person, px; None: unknown.
    """

    view: View
    model: Body
    body: Body
    camera: Camera
    upright: Gravity | None
    given: Subject | GaussianMixture | None
    box: Box | None

    @property
    def depths(self) -> ImageMap | None:
        """Depths of the image; None if unknown."""
        return depths_of(self.view.depth)


def _from_subject(shown: Shown) -> Start:
    subject = shown.given
    assert isinstance(subject, Subject)
    fresh = seconds(shown.view.stamp - subject.stamp_ns) <= SAME_MOMENT_TIME
    begun = start_from_keypoints(
        shown.model,
        shown.camera,
        subject,
        upright=shown.upright,
        depths=shown.depths if fresh else None,
    )
    return replace(begun, clicked=subject.keypoints)


def _from_mixture(shown: Shown) -> Start:
    assert isinstance(shown.given, GaussianMixture)
    return Start(shown.body, shown.given.means, shown.given)


def _from_keypoints(shown: Shown) -> Start:
    keypoints, camera, depths = shown.view.keypoints, shown.camera, shown.depths
    assert keypoints is not None
    begun = start_from_keypoints(
        shown.model, camera, Subject(0, keypoints, {}), upright=shown.upright, depths=depths
    )
    more = [lifted_poses(begun.body, camera, keypoints)]
    if shown.view.prediction is not None:
        more.append(shown.view.prediction.seen_as(begun.body).means)
    poses = [moved_to_depth(begun.body, camera, x, depths) for x in more]
    return Start(begun.body, np.concatenate([with_reversals(begun.body, begun.poses), *poses]))


def _from_prediction(shown: Shown) -> Start:
    prediction = shown.view.prediction
    assert prediction is not None
    return _at_depth(shown, prediction.body, prediction.both_ways(prediction.body))


def _from_box(shown: Shown) -> Start:
    assert shown.box is not None
    return _at_depth(shown, shown.model, mixture_from_box(shown.model, shown.camera, shown.box))


def _at_depth(shown: Shown, body: Body, mixture: GaussianMixture) -> Start:
    """Start from a mixture over poses, moved to the measured depths of the trunk, if any."""
    means = moved_to_depth(body, shown.camera, mixture.means, shown.depths)
    return Start(body, means, replace(mixture, means=means))


def _from_mask(shown: Shown) -> Start | None:
    view, model, camera = shown.view, shown.model, shown.camera
    seen = observe(
        view.image, view.silhouette, wanted=('coverage',), unsure=view.unsure, others=view.others
    )
    if seen.outline is None:
        return None
    poses = poses_from_outline(model, camera, seen.outline)
    return Start(model, moved_to_depth(model, camera, poses, shown.depths))


def _masked(shown: Shown) -> bool:
    silhouette, mask = shown.view.silhouette, shown.view.mask
    return mask is not None and silhouette is not None and looks_like_person(silhouette)


# Columns: source; test for its inputs; `sure`, the log odds of existence that it adds, nats
# (infinite for a given start); function that returns the start, or None if impossible.
STARTS: tuple[
    tuple[Source, Callable[[Shown], bool], float, Callable[[Shown], Start | None]], ...
] = (
    (
        Source.SUBJECT,
        lambda x: (
            isinstance(x.given, Subject) and x.box is None and x.view.stamp >= x.given.stamp_ns
        ),
        math.inf,
        _from_subject,
    ),
    (
        Source.MIXTURE,
        lambda x: isinstance(x.given, GaussianMixture) and x.box is None,
        math.inf,
        _from_mixture,
    ),
    (Source.KEYPOINTS, lambda x: suffices(x.view.keypoints, x.model), 0.0, _from_keypoints),
    (
        Source.PREDICTION,
        lambda x: x.view.prediction is not None,
        PREDICTION_LOG_ODDS,
        _from_prediction,
    ),
    (Source.KEYPOINTS, lambda x: shows_a_part(x.view.keypoints, x.model), 0.0, _from_keypoints),
    (Source.BOX, lambda x: x.box is not None, math.inf, _from_box),
    (Source.MASK, _masked, 0.0, _from_mask),
)


def first_start(shown: Shown, existence: Existence) -> tuple[Source, Start] | None:
    """Returns the first available source and its start; None if no track starts in the image."""
    awaited = shown.given is not None and shown.box is None
    usable = (
        (source, sure, begin)
        for source, has, sure, begin in STARTS
        if has(shown) and (sure == math.inf or not awaited)
    )
    first = next(usable, None)
    if first is None:
        return None
    source, sure, begin = first
    if shown.box is not None:
        sure = math.inf
    log_odds = existence.log_odds + sure
    if log_odds < PRESENT_LOG_ODDS or (not sure and existence.last.llr <= 0.0):
        return None
    begun = begin(shown)
    if begun is None:
        return None
    log_odds += log_prior_of_distance(shown.camera, float(begun.best[0, 2]))
    return (source, begun) if log_odds >= PRESENT_LOG_ODDS else None


def lifted_poses(body: Body, camera: Camera, keypoints: Keypoints) -> Array:
    """Poses (N, d) of a person from keypoints lifted by experts; empty without experts."""
    lifted = keypoints.lifted
    if lifted is None or not lifted.are_whole:
        return np.empty((0, body.dimension))
    rays, confidences = landmark_rays(camera, keypoints)
    (found,) = poses_of(body, [lifted], rays[None], confidences[None], KNOWN_SIZE)
    return found.means


def poses_to_search(
    body: Body,
    camera: Camera,
    observation: Observation,
    prediction: PosePrediction | None,
    upright: Gravity | None,
) -> Array | None:
    """Poses (N, d) of a person from one image alone; None if it contains no usable input.

    The lengths and flesh of the body are fixed. Keypoints give all poses that explain them. Without
    keypoints, mean poses with several headings are placed at the silhouette. Poses of a predictor
    are added.
    """
    found = []
    keypoints, depths = observation.keypoints, observation.evidence.get(DEPTH.name)
    if keypoints is not None and keypoints.seen.sum() >= MIN_KEYPOINTS:
        explained = poses_from_keypoints(body, camera, keypoints, upright, depths)
        found.append(with_reversals(body, explained))
        found.append(lifted_poses(body, camera, keypoints))
    elif observation.outline is not None:
        poses = poses_from_outline(body, camera, observation.outline)
        found.append(moved_to_depth(body, camera, poses, depths))
    if prediction is not None:
        found.append(prediction.both_ways(body).means)
    return np.concatenate(found) if found else None


def with_reversals(body: Body, poses: Array) -> Array:
    """Appends depth reversals of the best poses to poses (N, d), which are sorted best first.

    A reversed pose explains the same keypoints if the detector has exchanged left and right.
    """
    if not body.trunk_pairs:
        return poses
    return np.concatenate([poses, reverse_depth(body, poses[:MAX_REVERSED_POSES])])
