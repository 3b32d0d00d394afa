"""What the node for several people reports of itself: its diagnostics."""

from __future__ import annotations

from dataclasses import dataclass

from hmt_ros.sessions.camera_session import CAMERA_MOVED
from hmt_ros.sessions.session import SessionState


@dataclass(frozen=True)
class PeopleState(SessionState):
    """State of the node: its status is 'no camera', 'waiting', 'nobody' or 'tracking'.

    Attributes:
        people: identities of those who are tracked.
        followed: identities of those who are tracked, or about to be.
        detected: number of people in the last detections.
        moved: whether the camera has moved since the background was taken.
    """

    people: tuple[str, ...] = ()
    followed: tuple[str, ...] = ()
    detected: int = 0
    moved: bool = False

    def summary(self) -> str:
        """The present estimate in a few words."""
        return f'{len(self.people)} of {self.detected} people'

    def trouble(self) -> str:
        """Whether the background is of no use."""
        return CAMERA_MOVED if self.moved else ''

    def values(self) -> list[tuple[str, str]]:
        """Keys and values of the diagnostics."""
        return [('people', ' '.join(self.people)), ('people detected', str(self.detected))]
