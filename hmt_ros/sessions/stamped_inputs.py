"""What belongs to images and comes on topics of its own: keypoints, predictions."""

from __future__ import annotations

from typing import Generic, TypeVar

T = TypeVar('T')

# Stamps that are remembered.
_REMEMBERED = 256


class StampedInputs(Generic[T]):
    """Measurements that wait for the image of exactly their stamp; of several the last counts.

    None stands for a measurement that says nothing: a detector that saw nobody.
    """

    def __init__(self) -> None:
        self._content: dict[int, T | None] = {}
        self._newest = -1

    def put(self, stamp_ns: int, content: T | None) -> None:
        """A measurement has come."""
        self._newest = max(self._newest, stamp_ns)
        self._content[stamp_ns] = content
        while len(self._content) > _REMEMBERED:
            del self._content[min(self._content)]

    def is_settled(self, stamp_ns: int) -> bool:
        """Whether nothing more is to be expected for an image: it has come, or a later one has."""
        return stamp_ns in self._content or self._newest > stamp_ns

    def take(self, stamp_ns: int) -> T | None:
        """What has come for an image; what is as old or older is forgotten."""
        result = self._content.get(stamp_ns)
        for stamp in [stamp for stamp in self._content if stamp <= stamp_ns]:
            del self._content[stamp]
        return result

    def clear(self) -> None:
        """Time begins anew."""
        self._content.clear()
        self._newest = -1
