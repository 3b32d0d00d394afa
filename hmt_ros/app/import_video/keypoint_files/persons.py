"""Detected persons by frame."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.app.command_line import MAX_IMAGE_SIDE
from hmt_ros.app.import_video.frames import Frame, FrameSource
from hmt_ros.image.keypoint_schemes import landmark_called, schemes, unnamed_orders
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array

_MATCHING_NS = 10_000_000  # maximum time difference between a row and its frame, ns
MAX_FRAMES = 10_000_000
# Minimum score of a person, as a fraction of the best score of the clip.
_MIN_SCORE_RATIO = 0.2
_MAX_CONFIDENCE = 1e9
_SIDES = {'l': 'left', 'r': 'right', 'left': 'left', 'right': 'right'}
_SYNONYMS = {'mid_hip': 'hip', 'c_hip': 'hip', 'head_top': 'head', 'upper_neck': 'neck'}


@dataclass(frozen=True, eq=False)
class Person:
    """A person in a frame.

    Attributes:
        keypoints: keypoints under the detector's names, with unknown covariances (NaN).
        track: identity of the person over all frames; '' if the detector does not track.
        score: the detector's confidence that this is a person, on any scale.
    """

    keypoints: Keypoints
    track: str = ''
    score: float = 1.0

    @cached_property
    def box(self) -> Array:
        """Minimum and maximum column and row (2, 2) of the seen keypoints."""
        seen = self.keypoints.pixels[self.keypoints.seen]
        return np.stack([seen.min(0), seen.max(0)])

    @cached_property
    def size(self) -> float:
        """Diagonal of the box, px."""
        return float(np.linalg.norm(self.box[1] - self.box[0]))

    def distance(self, other: Person) -> float:
        """Distance to another person, px: mean over common keypoints, or else of box centres."""
        names, theirs = self.keypoints.names, other.keypoints
        pixels, seen = theirs.pixels, theirs.seen
        if names != theirs.names:  # rows of a table may have different keypoints
            place = {name: i for i, name in enumerate(theirs.names)}
            order = np.array([place.get(name, -1) for name in names])
            pixels, seen = pixels[order], seen[order] & (order >= 0)
        both = self.keypoints.seen & seen
        apart = self.keypoints.pixels[both] - pixels[both]
        if not both.any():
            apart = (self.box.mean(0) - other.box.mean(0))[None]
        return float(np.linalg.norm(apart, axis=1).mean())


def person(
    names: Sequence[str] | None,
    pixels: ArrayLike,
    confidences: ArrayLike | None = None,
    positions: ArrayLike | None = None,
    track: str = '',
    score: float = 1.0,
) -> Person | None:
    """Makes a person from detected keypoints; returns None if no keypoint was seen.

    A keypoint at (0, 0) or NaN, or with confidence 0, was not seen.

    Args:
        names: names of the keypoints; None selects the usual order of n points.
        pixels: (n, 2) image positions, px.
        confidences: (n,) confidences on any scale; None sets all to 1.
        positions: (n, 3) 3D positions, m; None without 3D positions.

    Raises:
        ValueError: no order is known for lists of n points.
    """
    places = np.array(pixels, dtype=np.float64)
    sure = np.ones(len(places)) if confidences is None else np.array(confidences, dtype=np.float64)
    if names is None:
        names = schemes()[orders_of(len(places))[0]].names
        places, sure = places[: len(names)], sure[: len(names)]
    sure = np.clip(np.nan_to_num(sure, nan=0.0), 0.0, _MAX_CONFIDENCE)
    unseen = ~np.isfinite(places).all(1) | (places == 0.0).all(1) | (sure == 0.0)
    if unseen.all():
        return None
    places[unseen], sure[unseen] = np.nan, 0.0
    lifted = None if positions is None else np.array(positions, dtype=np.float64)
    unknown = np.full((len(names), 2, 2), np.nan)
    return Person(Keypoints(tuple(names), places, unknown, sure, lifted), track, score)


def orders_of(count: int) -> tuple[str, ...]:
    """Possible schemes of a list of `count` unnamed points, the usual scheme first.

    Raises:
        ValueError: no scheme has this number of points.
    """
    known = unnamed_orders()
    if count in known:
        return known[count]
    if count % 2 == 0 and count // 2 in known:
        raise ValueError(
            f'{count} keypoints without names: of two persons, {count // 2} each? Wanted a list '
            'for each person'
        )
    text = ', '.join(f'{n} ({names[0]})' for n, names in sorted(known.items()))
    raise ValueError(
        f'{count} keypoints without names; wanted {text}, or names: a .csv with NAME_u, NAME_v'
    )


def image_size_of(width: Any, height: Any) -> tuple[int, int] | None:
    """Width and height of the images according to a file, px; None if invalid."""
    known = all(isinstance(side, int) and 0 < side <= MAX_IMAGE_SIDE for side in (width, height))
    return (width, height) if known else None


def landmark_name(name: str) -> str:
    """Landmark name for a marker name, right_big_toe for RBigToe; unknown names stay unchanged."""
    text = name.lower() if name.isupper() else name
    words = [x.lower() for x in re.findall(r'[A-Z]?[a-z]+|[A-Z](?![a-z])|\d+', text)]
    if words and words[-1] in _SIDES and words[0] not in _SIDES:
        words = [words[-1], *words[:-1]]
    if words and len(words[0]) > 1 and words[0][0] in 'lr' and words[0] not in _SIDES:
        words = [words[0][0], words[0][1:], *words[1:]]
    tried = '_'.join([_SIDES.get(x, x) for x in words[:1]] + words[1:])
    tried = _SYNONYMS.get(tried, tried)
    known = landmark_called(name) is None and landmark_called(tried) is not None
    return tried if known else name


@dataclass
class FoundPersons:
    """Persons by frame.

    Attributes:
        path: file or folder of the detector, for error messages.
        frames: persons by number of the frame, or by time since the first frame, ns.
        timed: whether the keys of `frames` are times.
        rows: number of frames, if the file has an entry for every frame; None otherwise.
        size: width and height of the images that the detector used, px; None if unknown.
        unnamed: number of points per person if they have no names; 0 if they have names.
        fractions: whether positions are fractions of the image, not px.
    """

    path: Any = ''
    frames: dict[int, list[Person]] = field(default_factory=lambda: defaultdict(list))
    timed: bool = False
    rows: int | None = None
    size: tuple[int, int] | None = None
    unnamed: int = 0
    fractions: bool = False

    def add(self, key: int, seen: Person | None) -> None:
        """Adds a person to a frame; None adds only the frame.

        Raises:
            ValueError: the number of the frame is too large.
        """
        if not self.timed and key >= MAX_FRAMES:
            raise ValueError(f'frame {key}, wanted at most {MAX_FRAMES} frames')
        self.frames[key] += [] if seen is None else [seen]

    @cached_property
    def keys(self) -> list[int]:
        """The sorted keys; call it only after all persons were added."""
        return sorted(self.frames)

    @property
    def last(self) -> int:
        """Number of the last frame with an entry; -1 without entries, or if keys are times."""
        return -1 if self.timed else max(self.frames, default=-1)

    @property
    def lifts(self) -> bool:
        """Whether the detector gives 3D positions."""
        return any(x.keypoints.positions is not None for x in self.persons())

    def key_of(self, frame: Frame) -> int | None:
        """Key of a frame; None if the file does not have the frame."""
        wanted, apart = (frame.time_ns, _MATCHING_NS) if self.timed else (frame.number, 0)
        at = bisect_left(self.keys, wanted)
        near = [x for x in self.keys[max(at - 1, 0) : at + 1] if abs(x - wanted) <= apart]
        return min(near, key=lambda x: abs(x - wanted), default=None)

    def persons(self) -> Iterator[Person]:
        """All persons of all frames."""
        for found in self.frames.values():
            yield from found

    def likely(self) -> dict[int, list[Person]]:
        """Persons with a sufficient score, by frame in increasing order."""
        best = max((x.score for x in self.persons()), default=0.0)
        return {
            key: [x for x in found if x.score >= _MIN_SCORE_RATIO * best or best <= 0.0]
            for key, found in sorted(self.frames.items())
        }

    def change(self, changed: Callable[[Keypoints], Keypoints]) -> None:
        """Applies a function to the keypoints of each person."""
        for key, found in self.frames.items():
            self.frames[key] = [replace(x, keypoints=changed(x.keypoints)) for x in found]


def numbers_of(labels: Sequence[str | int], source: FrameSource, *, from_one: bool) -> list[int]:
    """Frame numbers, from 0, of the given labels.

    Args:
        from_one: whether the detector numbers frames from 1; ignored if the source defines the
            numbers.

    Raises:
        ValueError: a label refers to no frame.
    """
    numbers = [source.number_of(label) for label in labels]
    shift = from_one and source.first_number == 0 and not source.names and 0 not in numbers
    return [number - shift for number in numbers]
