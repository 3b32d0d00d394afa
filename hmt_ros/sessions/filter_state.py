"""What the filter reports of itself: its diagnostics."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from hmt_ros.body import Body
from hmt_ros.sessions.camera_session import CAMERA_MOVED
from hmt_ros.sessions.session import SessionState
from hmt_ros.tracking import Status

IN_BACKGROUND = 'the background was learned with the person in it'


@dataclass(frozen=True)
class FilterState(SessionState):
    """State of the filter: its status is 'no camera', or a value of `Status`.

    Attributes:
        body: of the present track; None: there is none.
        modes: components of the posterior.
        misfit: share of the image that no mode explains.
        evaluations: of the likelihood in the last image.
        background: what is known of it, in a few words.
        doubted: whether it was learned with the person in it, and is not known again.
        moved: whether the camera has moved since it was taken.
        track_id: number of the present track, or of the last one; 0 before the first.
        started_from: what that track began from; '' before the first.
        existence: probability that a person is in view; NaN: no image yet.
        beliefs: probability that each cue shows the person, and that the track has the person.
    """

    body: Body | None = None
    modes: int = 0
    misfit: float = 0.0
    evaluations: int = 0
    background: str = 'unknown'
    doubted: bool = False
    moved: bool = False
    track_id: int = 0
    started_from: str = ''
    existence: float = math.nan
    beliefs: Mapping[str, float] = field(default_factory=dict)

    def summary(self) -> str:
        """The present estimate in a few words."""
        return f'{self.modes} modes'

    def trouble(self) -> str:
        """Whether the track is lost, nobody is in view, or the background is of no use."""
        if self.status == Status.NOBODY.value:
            return 'nobody in view'
        if self.status == Status.LOST.value:
            lost = f'lost: misfit {self.misfit:.2f}, existence {self.existence:.2f}'
            return f'{lost}; {CAMERA_MOVED}' if self.moved else lost
        if self.moved:
            return CAMERA_MOVED
        return f'{IN_BACKGROUND}; {self.background}' if self.doubted else ''

    def values(self) -> list[tuple[str, str]]:
        """Keys and values of the diagnostics."""
        return [
            ('track', str(self.track_id)),
            ('started from', self.started_from),
            ('probability that a person is in view', f'{self.existence:.3f}'),
            ('modes', str(self.modes)),
            ('entropy of the weights, nats', f'{self.entropy:.3f}'),
            ('misfit', f'{self.misfit:.3f}'),
            *((f'belief in {cue}', f'{p:.2f}') for cue, p in self.beliefs.items()),
            ('background', self.background),
            ('evaluations of the likelihood', str(self.evaluations)),
        ]
