"""What a tracker is doing."""

from __future__ import annotations

from enum import Enum


class Status(Enum):
    """What the tracker is doing."""

    WAITING = 'waiting'  # for the subject's image, or for somebody
    TRACKING = 'tracking'
    LOST = 'lost'
    NOBODY = 'nobody'  # is in view
