"""Chooses one person among all detected persons."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hmt_ros.app.import_video.frames import natural_order
from hmt_ros.app.import_video.keypoint_files.persons import FoundPersons, Person
from msg_tools.messages.headers import SECOND_NS

BY_SIZE, BY_DISTANCE, BY_INDEX, BY_ID = 'largest', 'nearest', 'index', 'id'
BY_PLACE, BY_LENGTH = 'at', 'track'
# Maximum motion of a person from frame to frame, in diagonals of their box.
_MAX_MOTION = 0.5
# Margin around the box of a person in which a point selects the person, in diagonals of the box.
_BOX_MARGIN = 0.15
# Maximum number of frames without the person before a track ends.
_MAX_ABSENCE = 30
# Maximum number of person-track pairs compared in a clip: a constant, and an addition per person.
_FREE_PAIRS, _PAIRS_PER_PERSON = 20_000, 100
_MAX_LISTED_NAMES = 8  # maximum number of names in an error message


@dataclass(frozen=True)
class Choice:
    """Criterion that selects one person to track among several.

    Attributes:
        kind: `BY_SIZE`: the largest box in each frame. `BY_DISTANCE`: the largest person in the
            first frame, then the person nearest to their last position. `BY_INDEX`: an index in the
            list of each frame. `BY_ID`: the name from the detector. `BY_PLACE`: the person at an
            image point at a time, then the nearest before and after. `BY_LENGTH`: a rank among the
            tracks of the clip, the longest first.
        value: index, rank or name of the person, depending on `kind`.
        point: for `BY_PLACE`, column and row, px, and time since the first frame, s.
    """

    kind: str = BY_DISTANCE
    value: str = ''
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def parse(cls, text: str) -> Choice:
        """Parses a choice from the command line, such as largest or index:0.

        Raises:
            ValueError: the text is not a valid choice.
        """
        kind, colon, value = text.partition(':')
        if kind in (BY_SIZE, BY_DISTANCE) and not colon:
            return cls(kind)
        if kind == BY_ID and value:
            return cls(kind, value)
        if value.isdecimal() and (kind == BY_INDEX or (kind == BY_LENGTH and int(value) > 0)):
            return cls(kind, value)
        if kind == BY_PLACE:
            try:
                place = [float(x) for x in value.split(',')]
            except ValueError:
                place = []
            if len(place) in (2, 3) and all(map(math.isfinite, place)):
                x, y, t = [*place, 0.0][:3]
                return cls(kind, value, (x, y, t))
        raise ValueError(
            'wanted largest, nearest, index:N, id:NAME, track:N from 1, or at:X,Y or at:X,Y,T in '
            f'px and s, saw {text!r}'
        )


def chosen_person(
    found: FoundPersons, choice: Choice, first: int = 0, rate: float | None = None
) -> dict[int, Person]:
    """The chosen person in each frame that shows the person, by frame key.

    Args:
        first: key of the first frame to search.
        rate: frames per second; required only if `BY_PLACE` has a time and frames are numbered.

    Raises:
        ValueError: no person matches the choice; the message lists alternatives.
    """
    kind, value = choice.kind, choice.value
    if kind == BY_INDEX:
        there = {k: x[int(value)] for k, x in found.frames.items() if int(value) < len(x)}
        most = max(map(len, found.frames.values()), default=0)
        if most and not there:
            raise ValueError(
                f'no frame has a person {value}: the last is --person index:{most - 1}'
            )
        return there
    likely = found.likely()
    if not any(likely.values()):
        return {}
    if kind == BY_ID:
        return _called(found, value)
    many = found.timed and len(likely) > 1
    unit = float(np.median(np.diff([*likely]))) if many else 1.0
    if kind == BY_LENGTH:
        tracks = sorted(tracks_of(likely, unit), key=len, reverse=True)
        if int(value) > len(tracks):
            text = ', '.join(str(len(x)) for x in tracks[:_MAX_LISTED_NAMES])
            raise ValueError(
                f'no track {value}: the clip has {len(tracks)}, of {text} frames; '
                '--person track:1 is the longest'
            )
        return tracks[int(value) - 1]
    if kind == BY_SIZE:
        return {key: _largest(persons) for key, persons in likely.items() if persons}
    keys = [key for key, persons in likely.items() if persons]
    if kind == BY_DISTANCE:
        keys = [key for key in keys if key >= first]
        if not keys:
            return {}
        seen = _largest(likely[keys[0]])
        return dict(_followed(((key, likely[key]) for key in keys), seen, unit))
    column, row, time = choice.point
    if time > 0 and rate is None and not found.timed:
        raise ValueError('the rate of the frames is unknown: give --fps, or --person at:X,Y')
    wanted = time * (SECOND_NS if found.timed else rate or 0.0)
    start = min(keys, key=lambda key: abs(key - wanted))
    seen = _person_at(likely[start], column, row)
    after = [(key, likely[key]) for key in keys if key >= start]
    before = [(key, likely[key]) for key in reversed(keys) if key <= start]
    return dict([*_followed(before, seen, unit), *_followed(after, seen, unit)])


def _largest(persons: Sequence[Person]) -> Person:
    return max(persons, key=lambda x: x.score * float(np.prod(x.box[1] - x.box[0])))


def _called(found: FoundPersons, name: str) -> dict[int, Person]:
    """The person with a given name, in each frame that shows the person."""
    likely = found.likely()
    there = {key: x for key, persons in likely.items() for x in persons if x.track == name}
    if not there:
        names = _names_in(found)
        those = f'the ids are {names}; --person id:NAME' if names else 'there are no ids'
        raise ValueError(f'no person {name}: {those}; or --person at:X,Y or track:1')
    return there


def _names_in(found: FoundPersons) -> str:
    """The names of the persons in a file as text, cut off after `_MAX_LISTED_NAMES` names."""
    names = sorted({x.track for x in found.persons()} - {''}, key=natural_order)
    return ', '.join(x[:40] for x in names[:_MAX_LISTED_NAMES]) + (
        ', ...' if len(names) > _MAX_LISTED_NAMES else ''
    )


def _person_at(persons: Sequence[Person], column: float, row: float) -> Person:
    """The person at or nearest to a point of the image; raises ValueError if nobody is near."""
    point = np.array([column, row])
    low, high = (np.array([x.box[i] for x in persons]) for i in range(2))
    middles = (low + high) / 2
    outside = np.linalg.norm(np.maximum(0.0, np.maximum(low - point, point - high)), axis=1)
    best = np.lexsort((np.linalg.norm(middles - point, axis=1), outside))[0]
    if outside[best] > _BOX_MARGIN * persons[best].size:
        text = ' and '.join(f'at:{x:.0f},{y:.0f}' for x, y in middles[:_MAX_LISTED_NAMES])
        raise ValueError(f'nobody at {column:g},{row:g}: in this frame they are --person {text}')
    return persons[best]


def tracks_of(likely: Mapping[int, list[Person]], unit: float = 1.0) -> list[dict[int, Person]]:
    """The tracks of a clip; a track maps frame keys to one person.

    In each frame persons within reach are assigned to tracks greedily, the nearest pair first.
    Equal names from the detector take precedence over distance; different names never match.

    Args:
        unit: difference between the keys of consecutive frames.

    Raises:
        ValueError: too many persons at the same time.
    """
    tracks: list[dict[int, Person]] = []
    going: list[tuple[int, Person, dict[int, Person]]] = []
    left = _FREE_PAIRS
    for key, persons in likely.items():
        going = [x for x in going if key - x[0] <= _MAX_ABSENCE * unit]
        left += len(persons) * (_PAIRS_PER_PERSON - len(going))
        if left < 0:
            raise ValueError(f'too many persons at once to follow each: {len(going)} tracks')
        pairs = sorted(
            (x.track != last.track, x.distance(last), i, j)
            for j, (before, last, _) in enumerate(going)
            for i, x in enumerate(persons)
            if x.track == last.track or not (x.track and last.track)
            if _in_reach(x, last, (key - before) / unit)
        )
        of_person: dict[int, int] = {}
        for _, _, i, j in pairs:
            if i not in of_person and j not in of_person.values():
                of_person[i] = j
        for i, x in enumerate(persons):
            if i not in of_person:
                of_person[i] = len(going)
                going.append((key, x, {}))
                tracks.append(going[-1][2])
            track = going[of_person[i]][2]
            track[key] = x
            going[of_person[i]] = key, x, track
    return tracks


def _followed(
    frames: Iterable[tuple[int, list[Person]]], person: Person, unit: float
) -> Iterator[tuple[int, Person]]:
    """Follows a person: yields the nearest person in each frame, if within reach."""
    before: int | None = None
    for key, persons in frames:
        if before is not None:
            named = [x for x in persons if x.track and x.track == person.track]
            near = min(named or persons, key=person.distance, default=None)
            if near is None or not _in_reach(near, person, abs(key - before) / unit):
                continue
            person = near
        before = key
        yield key, person


def _in_reach(person: Person, last: Person, gap: float) -> bool:
    """Whether the person `last` can have moved to the place of `person` in `gap` frames."""
    return person.distance(last) <= _MAX_MOTION * last.size * gap
