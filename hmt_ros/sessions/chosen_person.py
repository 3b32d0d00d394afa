"""Which of the people in an image is the one who is tracked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hmt_ros.image.terms.keypoints import Keypoints
from msg_tools.messages.detections import DetectedPerson
from msg_tools.messages.headers import SECOND_NS

# A person moves less between two images, in sizes of the person.
_FARTHEST = 1.0
# What remains from image to image of the size of a person of whom less is seen now.
_SIZE_KEPT = 0.95


class ChosenPerson:
    """The person who is followed: at first the largest, then the nearest to the last place.

    The place is that of the detections themselves, so that the choice does not depend on the
    tracker, which may be lost.
    """

    def __init__(self) -> None:
        self._last: Keypoints | None = None
        self._stamp = 0
        self._size = 0.0

    def forget(self) -> None:
        """The next choice is the largest person."""
        self._last = None

    def choose(
        self, people: Sequence[DetectedPerson], stamp_ns: int, longest_absence: float
    ) -> Keypoints | None:
        """The person among those who were seen in an image.

        Args:
            people: who was seen.
            stamp_ns: of the image.
            longest_absence: time after which the largest person is chosen anew, s.

        Returns:
            The keypoints; None: the person is not among them.
        """
        seen = [person.keypoints for person in people if person.keypoints.seen.any()]
        if not seen:
            return None
        last = self._last
        if last is None or stamp_ns - self._stamp > longest_absence * SECOND_NS:
            chosen = max(seen, key=_size)
            self._size = 0.0
        else:
            chosen = min(seen, key=lambda keypoints: _distance(keypoints, last))
            if _distance(chosen, last) > _FARTHEST * self._size:
                return None
        self._last, self._stamp = chosen, stamp_ns
        self._size = max(_size(chosen), _SIZE_KEPT * self._size)
        return chosen


def _size(keypoints: Keypoints) -> float:
    """Diagonal of the box around a person, px."""
    pixels = keypoints.pixels[keypoints.seen]
    return float(np.hypot(*np.ptp(pixels, axis=0)))


def _distance(one: Keypoints, other: Keypoints) -> float:
    """Median distance of the landmarks that both have; else that of their middles, px."""
    both = one.seen & other.seen
    if both.any():
        return float(np.median(np.hypot(*(one.pixels - other.pixels)[both].T)))
    middles = [each.pixels[each.seen].mean(0) for each in (one, other)]
    return float(np.hypot(*(middles[0] - middles[1])))
