"""The start of a track: from which input, and at which image.

    subject      at the image that its joints were seen in
    mixture      at the next image
    box          at the next image; keypoints or a prediction of that image come before it
    nothing      once somebody is in view with the probability `PRESENT` (`existence`), and is shown
                 by one of these:

        keypoints that suffice     most of the trunk, and 6 joints in all, with confidence
        keypoints of a part        a person, with both shoulders or both hips; takes longer
        mask                       takes longer where a side of the image may cut it
        prediction                 at once

After a track has ended the next one starts in the same way; then a silhouette suffices.

Keypoints give poses, depth and lengths (see `initialisation`); a mask or a box gives mean poses of
several headings. A detector may take left for right, and silhouettes do not tell sides at all: with
every pose comes its reversal in depth, and both ways to face are followed (see `classes`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.mirror import reverse_depth
from hmt_ros.experts.lifted_fit import KNOWN_SIZE, poses_of
from hmt_ros.experts.lifter import landmark_rays
from hmt_ros.image.observation import Box, Observation
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.terms.depth import DEPTH
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.tracking.ground import Gravity
from hmt_ros.tracking.initialisation import (
    mixture_from_box,
    poses_from_keypoints,
    poses_from_outline,
    start_from_keypoints,
)
from hmt_ros.tracking.keypoint_evidence import FEWEST_KEYPOINTS, shows_a_part, suffices
from hmt_ros.tracking.person_shape import looks_like_person
from hmt_ros.tracking.proposals import PosePrediction
from hmt_ros.tracking.start_depth import depths_of, moved_to_depth
from hmt_ros.tracking.subject import Subject
from hmt_ros.tracking.view import View

# A person hardly moves in so long a time, ns.
SAME_MOMENT_NS = 200_000_000
# Number of the best poses from keypoints whose reversals in depth are searched, too.
REVERSED = 24


class Source(Enum):
    """The input that a track began from."""

    SUBJECT = 'the subject file'
    MIXTURE = 'a mixture'
    KEYPOINTS = 'keypoints'
    PREDICTION = 'a pose prediction'
    MASK = 'a mask'
    BOX = 'a box'
    ARRIVAL = 'who has come into view'


# Starts whose best pose is near that of the person.
FROM_JOINTS = (Source.SUBJECT, Source.KEYPOINTS)


@dataclass(frozen=True, eq=False)
class Beginning:
    """A start, as `MixtureFilter.begin` takes it; see there.

    Attributes:
        source: the input that it comes from.
    """

    source: Source
    body: Body
    start: GaussianMixture | Array
    clicked: Keypoints | None = None

    @property
    def best(self) -> Array:
        """The most probable pose (1, d)."""
        if isinstance(self.start, GaussianMixture):
            return self.start.means[[int(np.argmax(self.start.weights))]]
        return self.start[:1]


def shows_a_start(view: View, body: Body, *, masked: bool) -> bool:
    """Whether an image shows somebody that a first track can start from, if somebody is there.

    Args:
        view: of the image.
        body: model of the person.
        masked: whether the silhouette is a segmenter's.
    """
    if suffices(view.keypoints, body) or shows_a_part(view.keypoints, body):
        return True
    return masked and view.silhouette is not None and looks_like_person(view.silhouette)


class Starts:
    """Decides at which image a track starts, and from which input.

    Args:
        model: of a person; a subject's lengths replace the model's.
        camera: that sees the person.

    Attributes:
        given: subject or mixture that the track starts from; None: the images start it.
        box: (left, top, right, bottom) of the person in the next image, px; None: unknown.
    """

    def __init__(self, model: Body, camera: Camera) -> None:
        self.given: Subject | GaussianMixture | None = None
        self.box: Box | None = None
        self._model, self._camera = model, camera

    def first(
        self,
        view: View,
        stamp: int,
        body: Body,
        upright: Gravity | None,
        prediction: PosePrediction | None,
        observed: Callable[[], Observation],
        *,
        masked: bool,
        somebody: bool,
    ) -> Beginning | None:
        """The start of the track at an image; None: it does not start there.

        Args:
            view: of the image.
            stamp: of the image, ns.
            body: of the poses of a mixture.
            upright: gravity; None: unknown.
            prediction: by the image, if any.
            observed: makes the observation of the image.
            masked: whether the silhouette is a segmenter's.
            somebody: whether a person is in view.
        """
        given, camera = self.given, self._camera
        model = self._model.levelled(body.level)
        if given is not None and self.box is None:
            if isinstance(given, Subject) and stamp < given.stamp_ns:
                return None
            depths = None
            if isinstance(given, Subject) and stamp - given.stamp_ns <= SAME_MOMENT_NS:
                depths = depths_of(view.depth)
            return beginning_given(given, model, body, camera, upright, depths)
        at_once = prediction is not None and not suffices(view.keypoints, model)
        shown = somebody and shows_a_start(view, model, masked=masked)
        if self.box is None and not at_once and not shown:
            return None
        return beginning_seen(view, model, camera, upright, prediction, self.box, observed)


def beginning_given(
    start: Subject | GaussianMixture, model: Body, body: Body, camera: Camera,
    upright: Gravity | None, depths: ImageMap | None = None,
) -> Beginning:  # fmt: skip
    """The body and the poses that a track begins with, from a given start.

    Args:
        start: subject or mixture that it starts from.
        model: body, whose lengths those of a subject replace.
        body: of the poses of a mixture.
        camera: that sees the person.
        upright: gravity; None: unknown.
        depths: of the image that a subject's joints were seen in; None: unknown.
    """
    if isinstance(start, GaussianMixture):
        return Beginning(Source.MIXTURE, body, start)
    begun = start_from_keypoints(model, camera, start, upright=upright, depths=depths)
    return Beginning(Source.SUBJECT, begun.body, begun.poses, clicked=start.keypoints)


def beginning_seen(
    view: View,
    model: Body,
    camera: Camera,
    upright: Gravity | None,
    prediction: PosePrediction | None,
    box: Box | None,
    observed: Callable[[], Observation],
) -> Beginning | None:
    """The body and the poses that a track begins with, from an image.

    Args:
        view: of the image.
        model: body whose lengths are fitted to keypoints.
        camera: that sees the person.
        upright: gravity; None: unknown.
        prediction: by the image, if any.
        box: in which the person is, if one was given.
        observed: makes the observation of the image.

    Returns:
        None: nobody is shown.
    """
    keypoints = view.keypoints
    enough = suffices(keypoints, model)
    depths = depths_of(view.depth)
    if keypoints is not None and (
        enough or (prediction is None and shows_a_part(keypoints, model))
    ):
        begun = start_from_keypoints(
            model, camera, Subject(0, keypoints, {}), upright=upright, depths=depths
        )
        poses = [with_reversals(begun.body, begun.poses)]
        lifted = lifted_poses(begun.body, camera, keypoints)
        poses.append(moved_to_depth(begun.body, camera, lifted, depths))
        if prediction is not None:
            predicted = prediction.seen_as(begun.body).means
            poses.append(moved_to_depth(begun.body, camera, predicted, depths))
        return Beginning(Source.KEYPOINTS, begun.body, np.concatenate(poses))
    if prediction is not None:
        both = _mixture_at(prediction.both_ways(prediction.body), prediction.body, camera, depths)
        return Beginning(Source.PREDICTION, prediction.body, both)
    if box is not None:
        start = _mixture_at(mixture_from_box(model, camera, box), model, camera, depths)
        return Beginning(Source.BOX, model, start)
    outline = observed().outline
    if outline is None:
        return None
    outlined = moved_to_depth(model, camera, poses_from_outline(model, camera, outline), depths)
    return Beginning(Source.MASK, model, outlined)


def lifted_poses(body: Body, camera: Camera, keypoints: Keypoints) -> Array:
    """Poses (N, d) of a person from the depths of keypoints by experts, if there are any."""
    lifted = keypoints.lifted
    if lifted is None or not lifted.are_whole:
        return np.empty((0, body.dimension))
    rays, confidences = landmark_rays(camera, keypoints)
    (found,) = poses_of(body, [lifted], rays[None], confidences[None], KNOWN_SIZE)
    return found.means


def _mixture_at(
    mixture: GaussianMixture, body: Body, camera: Camera, depths: ImageMap | None
) -> GaussianMixture:
    """A mixture over poses, moved to where a depth image shows their trunks."""
    if depths is None:
        return mixture
    means = moved_to_depth(body, camera, mixture.means, depths)
    return GaussianMixture(mixture.weights, means, mixture.covariances)


def poses_to_search(
    body: Body,
    camera: Camera,
    observation: Observation,
    prediction: PosePrediction | None,
    upright: Gravity | None,
) -> Array | None:
    """Poses (N, d) of a person from an image alone; None: it shows none.

    The body keeps its lengths and flesh. From keypoints come all poses that explain them, from
    a silhouette mean poses of several headings at its place, and predicted poses.
    """
    found = []
    keypoints, depths = observation.keypoints, observation.evidence.get(DEPTH.name)
    if keypoints is not None and keypoints.seen.sum() >= FEWEST_KEYPOINTS:
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
    """Poses (N, d), best first, and the reversals in depth of the best.

    A reversal explains the same keypoints if the detector has taken left for right.
    """
    if not body.trunk_pairs:
        return poses
    return np.concatenate([poses, reverse_depth(body, poses[:REVERSED])])
