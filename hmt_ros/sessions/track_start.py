"""Data that a track starts from: body, background, subject, mixture or box, read and checked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body import Body, Camera, load_body
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.observation import Box
from hmt_ros.inference import GaussianMixture
from hmt_ros.sessions.camera_session import read_picture
from hmt_ros.sessions.keypoint_inputs import known_lifter
from hmt_ros.sessions.named_file import named_file
from hmt_ros.sessions.tracking_parameters import FilterParameters
from hmt_ros.tracking import Subject, Tracker, read_subject
from hmt_ros.tracking.ground import KnownGround
from msg_tools.messages.bodies import body_of
from msg_tools.messages.pose_mixtures import pose_mixture_of


@dataclass(frozen=True, eq=False)
class TrackStart:
    """Everything that a new tracker needs in addition to the camera.

    Attributes:
        parameters: parameters of the track.
        body: body of the track, from the parameters or from an initial mixture.
        background: (H, W, 3) BGR image of the empty scene; None: the background is learned.
        initial: prior of the first image; None: keypoints, a mask or a prediction start the track.
        box: (left, top, right, bottom) of a box around the person in the next image, px, which
            takes precedence over `initial`; None: unknown.
    """

    parameters: FilterParameters
    body: Body
    background: NDArray[np.uint8] | None
    initial: Subject | GaussianMixture | None
    box: Box | None = None

    def wants(self, sources: tuple[str, ...]) -> str:
        """Return the inputs that the start of the track waits for, in words.

        Args:
            sources: inputs that may start a track without a box, subject or mixture.
        """
        if self.box is not None or isinstance(self.initial, GaussianMixture):
            return 'an image'
        if self.initial is not None:
            stamp = self.initial.stamp_ns
            return f'an image of {stamp} ns or later, where the subject was seen'
        if sources:
            return ' or '.join(sources)
        return (
            'subject_file, use_keypoints, use_mask, use_predictions, or ~/reset with a mixture or '
            'a box'
        )

    def tracker(
        self,
        camera: Camera,
        ground: KnownGround,
        shared: BackgroundModel | None = None,
    ) -> Tracker:
        """Return a tracker that waits for its first image.

        Args:
            ground: gravity and floor, if known.
            shared: background that several trackers share and that is learned elsewhere; None:
                the tracker learns its own background.

        Raises:
            ValueError: the background was taken by another camera, or the box is not in the image.
        """
        p = self.parameters
        background = self.background_model(camera) if shared is None else shared
        tracker = Tracker(
            self.body,
            camera,
            p.tracker,
            background,
            p.random_seed,
            known_ground=ground,
            shared_background=shared is not None,
        )
        tracker.reset(self.initial, box=self.box)
        return tracker

    def background_model(self, camera: Camera) -> BackgroundModel:
        """Return the background model for a camera; the model is unknown if none is given.

        Raises:
            ValueError: the background was taken by another camera.
        """
        if self.background is None:
            return BackgroundModel()
        height, width = self.background.shape[:2]
        if (width, height) != (camera.width, camera.height):
            raise ValueError(
                f'{self.parameters.background_file} has {width}x{height} pixels, but the camera '
                f'gives {camera.width}x{camera.height}'
            )
        return BackgroundModel.from_image(self.background)


def prepare_start(
    parameters: FilterParameters,
    mixture: Any = None,
    present: Body | None = None,
    region: Any = None,
) -> TrackStart:
    """Return the data that a track starts from; reads the files that the parameters name.

    Args:
        mixture: hmt_msgs/PoseMixture to start from; if it is None or has no components, the track
            starts from the subject file.
        present: body of the present track, if any; its lengths apply if the mixture has none.
        region: sensor_msgs/RegionOfInterest of the person; None or zero width: unknown.

    Raises:
        ValueError: a file, the mixture or the region can not be used (one-line message).
    """
    body = _body(parameters.body_model)
    known_lifter(parameters.tracker.lifter)  # only a check; the tracker loads it again
    background = read_picture(parameters.background_file) if parameters.background_file else None
    initial: Subject | GaussianMixture | None = None
    if mixture is not None and len(mixture.components):
        content = pose_mixture_of(mixture)
        fixed = parameters.fixed_frame
        if fixed and content.frame_id in (fixed, f'{fixed}_optical'):
            raise ValueError(
                f'the initial mixture is in the frame {content.frame_id}, which does not move: '
                'wanted that of the camera'
            )
        if present is not None and present.name == body.name:
            body = present
        body, initial = body_of(content, body), content.mixture
    elif parameters.subject_file:
        with named_file('subject_file', parameters.subject_file, 'subject'):
            initial = read_subject(parameters.subject_file, body)
    return TrackStart(parameters, body, background, initial, _box_of(region))


def _box_of(region: Any) -> Box | None:
    if region is None or region.width == 0:
        return None
    if region.height == 0:
        raise ValueError(f'box has the width {region.width} and the height 0: wanted an area')
    left, top = int(region.x_offset), int(region.y_offset)
    return left, top, left + int(region.width), top + int(region.height)


def _body(model: str) -> Body:
    with named_file('body_model', model, 'body model'):
        body = load_body(model)
    if not body.shapes:
        raise ValueError(f'body_model {model} has no flesh: wanted one such as human37')
    return body
