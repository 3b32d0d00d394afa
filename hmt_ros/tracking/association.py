"""The same names as `hmt_ros.image.association`, for modules that import them from here."""

from hmt_ros.image.association import (
    GATE,
    ImageTrack,
    Sighting,
    assigned,
    grown,
    hull,
    moved,
    unknown_area,
)

__all__ = [
    'GATE',
    'ImageTrack',
    'Sighting',
    'assigned',
    'grown',
    'hull',
    'moved',
    'unknown_area',
]
