"""Persons that a detector found in a frame, and which of them is the one to track."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array

LARGEST, NEAREST, INDEX, TRACK = 'largest', 'nearest', 'index', 'id'
# A person moves at most by this much of the diagonal of their box from frame to frame.
_FASTEST = 0.5


@dataclass(frozen=True, eq=False)
class Person:
    """A person in a frame.

    Attributes:
        keypoints: under the detector's names; their covariances are not known (NaN).
        track: what the detector calls the person in all frames; '' if it does not track.
    """

    keypoints: Keypoints
    track: str = ''

    @property
    def box(self) -> Array:
        """(2, 2) least and greatest column and row of the keypoints that were seen."""
        seen = self.keypoints.pixels[self.keypoints.seen]
        return np.stack([seen.min(0), seen.max(0)])

    def distance(self, other: Person) -> float:
        """Mean distance of the keypoints that both have, px; of the boxes if there is none."""
        both = self.keypoints.seen & other.keypoints.seen
        apart = self.keypoints.pixels[both] - other.keypoints.pixels[both]
        if not both.any():
            apart = (self.box.mean(0) - other.box.mean(0))[None]
        return float(np.linalg.norm(apart, axis=1).mean())


def person(
    names: Sequence[str],
    pixels: ArrayLike,
    confidences: ArrayLike | None = None,
    positions: ArrayLike | None = None,
    track: str = '',
) -> Person | None:
    """A person as a detector reports one; None if it sees nothing of the person.

    What lies at (0, 0) or at NaN, or has no confidence, was not seen. Confidences above 1, which
    some detectors give, count as 1.

    Args:
        names: (n,) of the landmarks.
        pixels: (n, 2) px.
        confidences: (n,); None: 1.
        positions: (n, 3) m; None: the detector does not lift.
        track: see `Person`.
    """
    n = len(names)
    places = np.array(pixels, dtype=np.float64)
    sure = np.ones(n) if confidences is None else np.array(confidences, dtype=np.float64)
    sure = np.clip(np.nan_to_num(sure, nan=0.0), 0.0, 1.0)
    unseen = ~np.isfinite(places).all(1) | (places == 0.0).all(1) | (sure == 0.0)
    if unseen.all():
        return None
    places[unseen], sure[unseen] = np.nan, 0.0
    lifted = None if positions is None else np.array(positions, dtype=np.float64)
    unknown = np.full((n, 2, 2), np.nan)
    return Person(Keypoints(tuple(names), places, unknown, sure, lifted), track)


@dataclass(frozen=True)
class Choice:
    """How the person to track is chosen among several.

    Attributes:
        kind: `LARGEST`: box in each frame. `NEAREST`: to the person chosen before; the first is
            the largest. `INDEX`: place in the list of the frame. `TRACK`: what the detector calls
            the person.
        value: the place, or the name.
    """

    kind: str = NEAREST
    value: str = ''

    @classmethod
    def parse(cls, text: str) -> Choice:
        """A choice as the command line has it: largest, nearest, index:N or id:NAME.

        Raises:
            ValueError: another text.
        """
        kind, colon, value = text.partition(':')
        if kind in (LARGEST, NEAREST) and not colon:
            return cls(kind)
        if (kind == INDEX and value.isdecimal()) or (kind == TRACK and value):
            return cls(kind, value)
        raise ValueError(f'wanted largest, nearest, index:N or id:NAME, saw {text!r}')


class Chooser:
    """Chooses a person frame by frame."""

    def __init__(self, choice: Choice) -> None:
        self._choice = choice
        self._last: tuple[int, Person] | None = None

    def of(self, number: int, found: Sequence[Person]) -> Person | None:
        """The person among those in a frame, whose numbers must rise; None: not there."""
        kind, value = self._choice.kind, self._choice.value
        if kind == INDEX:
            return found[int(value)] if int(value) < len(found) else None
        if kind == TRACK:
            return next((x for x in found if x.track == value), None)
        if not found:
            return None
        if kind == LARGEST or self._last is None:
            chosen = max(found, key=lambda x: float(np.prod(x.box[1] - x.box[0])))
        else:
            before, last = self._last
            chosen = min(found, key=last.distance)
            reach = _FASTEST * float(np.linalg.norm(last.box[1] - last.box[0]))
            if chosen.distance(last) > reach * (number - before):
                return None
        self._last = number, chosen
        return chosen
