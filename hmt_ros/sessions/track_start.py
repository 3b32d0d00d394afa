"""The start of a track: body, background, subject or mixture, all read and checked at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body import Body, Camera, load_body
from hmt_ros.image.background import BackgroundModel
from hmt_ros.inference import GaussianMixture
from hmt_ros.sessions.camera_session import read_picture
from hmt_ros.sessions.filter_parameters import FilterParameters
from hmt_ros.tracking import Subject, Tracker, read_subject
from hmt_ros.tracking.ground import KnownGround
from msg_tools.files.error_line import error_line
from msg_tools.messages.bodies import body_of
from msg_tools.messages.pose_mixtures import pose_mixture_of


@dataclass(frozen=True, eq=False)
class TrackStart:
    """Everything that a new tracker needs besides the camera.

    Attributes:
        parameters: of the track.
        body: the model, or for a mixture the body that its poses are of.
        background: (H, W, 3) BGR image of the empty scene, or None: to be learned.
        initial: prior of the first image; None: a prediction has to start the track.
    """

    parameters: FilterParameters
    body: Body
    background: NDArray[np.uint8] | None
    initial: Subject | GaussianMixture | None

    def tracker(self, camera: Camera, ground: KnownGround | None = None) -> Tracker:
        """A tracker that waits for its first image.

        Args:
            camera: calibrated.
            ground: what is known of gravity and of the floor; None: what the parameters tell.

        Raises:
            ValueError: the background was taken by another camera.
        """
        p = self.parameters
        background = BackgroundModel(p.background)
        if self.background is not None:
            height, width = self.background.shape[:2]
            if (width, height) != (camera.width, camera.height):
                raise ValueError(
                    f'{p.background_file} has {width}x{height} pixels, but the camera gives '
                    f'{camera.width}x{camera.height}'
                )
            background = BackgroundModel.from_image(self.background, p.background)
        known = p.known_ground if ground is None else ground
        tracker = Tracker(
            self.body, camera, p.tracker, background, p.random_seed, known_ground=known
        )
        tracker.reset(self.initial)
        return tracker


def prepare_start(
    parameters: FilterParameters, mixture: Any = None, present: Body | None = None
) -> TrackStart:
    """Reads the files that the parameters name.

    Args:
        parameters: of the track.
        mixture: hmt_msgs/PoseMixture to start from; without components or None: the subject file.
        present: body of the present track, if any: a mixture without segment lengths is about it.

    Raises:
        ValueError: a file or a mixture that can not be used; one line that says why.
    """
    body = _body(parameters.body_model)
    background = read_picture(parameters.background_file) if parameters.background_file else None
    initial: Subject | GaussianMixture | None = None
    if mixture is not None and len(mixture.components):
        content = pose_mixture_of(mixture)
        if present is not None and present.name == body.name:
            body = present
        body, initial = body_of(content, body), content.mixture
    elif parameters.subject_file:
        initial = read_subject(parameters.subject_file, body)
    return TrackStart(parameters, body, background, initial)


def _body(model: str) -> Body:
    try:
        body = load_body(model)
    except OSError as error:
        raise ValueError(f'body_model {model}: {error_line(error)}') from error
    if not body.shapes:
        raise ValueError(f'body_model {model} has no flesh: wanted one such as human37')
    return body
