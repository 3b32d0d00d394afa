"""The filter of one of several people: a `FilterSession` that is handed all shared inputs.

People share image, calibration, background and transforms. Topics lie in `humans/bodies/<id>/`
(REP 155), frames of the links begin with `body_<id>/`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from hmt_ros.body import Body, Camera
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.observation import Box
from hmt_ros.image.person_shape import covered
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array, Mask
from hmt_ros.sessions.camera_frames import CameraFrames
from hmt_ros.sessions.camera_session import WaitingImage
from hmt_ros.sessions.filter_parameters import FilterParameters
from hmt_ros.sessions.filter_session import FilterSession
from hmt_ros.sessions.handled import HandlingLog, Output
from hmt_ros.sessions.track_start import TrackStart
from hmt_ros.tracking import Status, Tracker
from hmt_ros.tracking.association import moved
from hmt_ros.tracking.settings import LIKELY_NATS

BODIES = 'humans/bodies'


def topic_of(person: str, topic: str) -> str:
    """Name of a topic of a person; all people share absolute ones."""
    return topic if topic.startswith('/') else f'{BODIES}/{person}/{topic}'


def person_of(topic: str) -> str:
    """The person whose topic this is; '' for a shared topic."""
    name = topic.removeprefix(f'{BODIES}/')
    return '' if name == topic else name.partition('/')[0]


def _of_person(person: str, parameters: FilterParameters) -> FilterParameters:
    """The parameters of the filter of a person; the background is shared."""
    prefix = f'{parameters.frame_prefix}body_{person}/'
    return replace(parameters, frame_prefix=prefix, background_file='')


class PersonSession(FilterSession):
    """Tracks one of several people; see `Session`.

    Args:
        person: identity, which is part of topics and frames.
        publish, wanted: as for `Session`, of topics with the identity.
        start: that all people share.
        frames: that transforms lead to from the camera, looked up by the caller.
    """

    def __init__(
        self,
        person: str,
        parameters: FilterParameters,
        publish: Callable[[Output], None],
        wanted: Callable[[str], bool],
        start: TrackStart,
        background: BackgroundModel,
        frames: CameraFrames,
        log: HandlingLog,
    ) -> None:
        self._person = person
        self._shared_start = start
        super().__init__(
            _of_person(person, parameters),
            publish,
            lambda topic: wanted(topic_of(person, topic)),
        )
        self.restart(start)
        for topic in self.TOPICS:
            # The publisher opens them now, not at the first message, which would be lost.
            self._wanted(topic)
        self.frames = frames
        self._log = log
        self._background = background

    def use(self, parameters: FilterParameters) -> None:
        """Takes the shared parameters; those that take effect at once do so."""
        self.parameters = _of_person(self._person, parameters)

    def restart(self, start: TrackStart | None = None) -> None:
        """See `FilterSession.restart`; without a start, the shared one is used."""
        super().restart(self._shared_start if start is None else start)

    @property
    def tracker(self) -> Tracker | None:
        """The tracker; None: nothing was tracked yet."""
        return self._tracker

    @property
    def begun(self) -> bool:
        """Whether there is a track."""
        return self._tracker is not None and self._tracker.estimate.status in (
            Status.TRACKING,
            Status.LOST,
        )

    @property
    def ended(self) -> bool:
        """Whether the person whom the track was about is not in view any more."""
        return self._tracker is not None and self._tracker.estimate.status is Status.NOBODY

    def start_in(self, box: Box) -> None:
        """The next image starts the track in a box, px, unless other inputs tell more."""
        self.start = replace(self.start, box=box)

    def follow(
        self,
        waiting: WaitingImage,
        camera: Camera,
        keypoints: Keypoints | None,
        others: Mask | None,
    ) -> None:
        """Takes an image.

        Args:
            keypoints: of this person; without any that was seen: the detector does not see the
                person. None: it has not answered.
            others: (H, W) pixels that other people cover; None: none.
        """
        self._log.prefix = f'{self._person}: '
        try:
            self._follow(waiting, camera, keypoints, None, others)
        finally:
            self._log.prefix = ''

    def area(self, camera: Camera, shift: Array | None = None) -> Mask | None:
        """Where likely modes have the body (H, W), moved by a shift (2,) px; None: no track."""
        if not self.begun:
            return None
        assert self._tracker is not None
        modes = self._tracker.estimate.modes
        result = np.zeros((camera.height, camera.width), dtype=np.bool_)
        for pose in modes.poses[modes.log_weights > -LIKELY_NATS]:
            result |= covered(self._tracker.estimate.body, camera, pose)
        return result if shift is None else moved(result, shift)

    @property
    def depth(self) -> float:
        """Distance of the person along the optical axis, m; infinite without a track."""
        if not self.begun:
            return np.inf
        assert self._tracker is not None
        return float(self._tracker.estimate.modes.poses[0, 2])

    @property
    def body(self) -> Body:
        """The person, as far as it is known."""
        return self.start.body if self._tracker is None else self._tracker.estimate.body

    def stale(self, silence: float, answered: int) -> list[Output]:
        """See `TrackingSession`."""
        found = super().stale(silence, answered)
        return [one._replace(topic=topic_of(self._person, one.topic)) for one in found]

    def _new_tracker(self, camera: Camera) -> Tracker:
        return self.start.tracker(camera, self._known_ground(), self._background)

    def _look_at_frames(self, waiting: WaitingImage) -> None:
        """See `TrackingSession`: the caller has looked."""

    def _publish(self, topic: str, stamp: int, message: Any) -> None:
        super()._publish(topic_of(self._person, topic), stamp, message)
