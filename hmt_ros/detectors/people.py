"""Detects several people per image with BlazePose, and keeps their identities.

- The person network reliably finds people who fill 0.4 to 0.8 of its input. It searches the whole
  image and overlapping tiles; the smallest tiles suit people `MIN_HEIGHT` px high. The first image
  is searched completely, later images a few tiles at a time, so that each tile is searched once in
  `SEARCH_TIME` s. The expected place of a lost person is searched, too. Known people are ignored.
- The landmark network sees a square around each person: the square of the last image, shifted by
  the person's velocity.
- If two squares show the same body, the detection of better quality is kept.
- Detections are assigned to known people by position, velocity and the colours of clothes. The
  assignment has the smallest sum of costs, nats (`_Person.cost`, `clothes`).
- A person who is lost near a visible person is searched for with the visible people painted over.
  A person who is lost for longer than `KEPT_TIME` gets a new identity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from hmt_ros.detectors.blazepose import SCHEME, Followed, Found, Networks
from hmt_ros.detectors.clothes import MIN_VISIBILITY, Clothes
from hmt_ros.detectors.square import Square
from hmt_ros.image.association import ImageTrack, Sighting
from hmt_ros.image.keypoint_schemes import schemes
from hmt_ros.image.still_picture import StillPicture
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array, Image
from hmt_ros.inference.error_model import seconds

MAX_PEOPLE = 4  # maximum number of people
# Time for one search of all tiles, interval between searches for a lost person, and time after
# which a lost person is forgotten, s.
SEARCH_TIME, LOOK_INTERVAL, KEPT_TIME = 1.0, 0.1, 3.0
# Gap after which smoothing restarts, s; time after which a doubtful person is confirmed, s; minimum
# quality of a person who is confirmed at once.
LOST_TIME, CONFIRMATION_TIME, EVIDENT_QUALITY = 0.5, 0.3, 0.75
# Height of the smallest people, px; fraction of the smallest tile filled by such a person; maximum
# ratio of successive tile sizes; overlap of neighbouring tiles, as a fraction of a tile.
MIN_HEIGHT, FILLED_FRACTION, TILE_RATIO, TILE_OVERLAP = 150.0, 0.4, 1.9, 0.4
# Time without change after which a person is taken for a picture, and interval between checks, s.
PICTURE_TIME, COMPARISON_INTERVAL = 10.0, 1.0
# Limits within which two detections are one person: distance between new circles, in radii;
# distance between landmarks, in sizes; difference from a known circle, in radii; overlap, as a
# fraction of the smaller box.
SAME_CIRCLE_DISTANCE, SAME_BODY_DISTANCE, ALIKE_DISTANCE, CONTAINED_FRACTION = 0.6, 0.08, 0.25, 0.8
# Size ratio above which two detections are different people; distance below which people are
# neighbours, in sizes.
MAX_RATIO, APART_DISTANCE = 1.6, 1.0
# Grey level with which people are painted over.
GREY_LEVEL = 128
# Factors on the radius of a detected circle, because detected circles may be too small.
SCALES = (1.0, 1.5, 2.4)
# Standard deviation of a person's position, in sizes; growth of this deviation per second; and
# fraction of the speed that adds to the growth, because a moving person may turn round.
PLACE_SIGMA, SIGMA_GROWTH, SPEED_SHARE = 0.08, 0.35, 0.5
# Distance between clothes that is equally likely for one person and for two, change of the distance
# that is worth 1 nat, and maximum effect, nats. 99 % of distances within a person are below 0.47,
# and 95 % of distances between people are above 0.47.
NEUTRAL_DISTANCE, DISTANCE_PER_NAT, MAX_NATS = 0.4, 0.06, 4.0
# Maximum cost of an assignment, and cost below which the clothes of a person are updated, nats.
MAX_COST, LEARNING_COST = 3.0, 0.0
# Time constant of the mean colours of clothes, s; minimum number of visible landmarks.
CLOTHES_TIME, MIN_LANDMARKS = 2.0, 8

# Indices of the landmarks of trunk and limbs, and permutation of these that exchanges the sides.
_NAMES = schemes()[SCHEME].names
_JOINTS = [
    f'{side}_{x}'
    for x in ('shoulder', 'elbow', 'wrist', 'hip', 'knee', 'ankle')
    for side in ('left', 'right')
]
_BODY = [_NAMES.index(x) for x in _JOINTS]
_SWAP = [i ^ 1 for i in range(len(_JOINTS))]


class SeenPerson(NamedTuple):
    """A person in an image.

    Attributes:
        name: identity, such as p1 or p2.
        keypoints: landmarks of the scheme 'mediapipe33'.
        corners: (2, 2) top left and bottom right corner of the visible landmarks, px.
        still: whether the region of the person has not changed for `PICTURE_TIME` s, as on a
            poster.
    """

    name: str
    keypoints: Keypoints
    corners: Array
    still: bool = False


@dataclass(eq=False)
class _Person:
    """A known person.

    Attributes:
        name: identity.
        place: last position and velocity in the image.
        clothes: mean colours of the clothes over recent images.
        followed: smoothed landmarks and circle.
        keypoints: keypoints in the last image that showed the person.
        seen, begun: stamps of the last and of the first image that showed the person, ns.
        looked: stamp of the last search around the expected place while the person was lost, ns.
        sure: whether the person is confirmed; a new detection next to a known person may be a
            duplicate.
        picture: last image that had changed in the region of the person; compared once a second.
        changed, compared: stamps of the last change around the person and of the last comparison,
            ns.
    """

    name: str
    place: ImageTrack
    clothes: Clothes
    followed: Followed
    keypoints: Keypoints
    seen: int
    begun: int
    looked: int
    sure: bool
    picture: StillPicture
    changed: int
    compared: int

    def cost(self, one: _Sighted, stamp: int) -> float:
        """Cost of assigning a detection to this person, from position and colours, nats."""
        dt = seconds(stamp - self.place.stamp)
        speed = float(np.linalg.norm(self.place.velocity)) / self.place.size
        away = self.place.cost(one.sighting, stamp) / (
            PLACE_SIGMA + (SIGMA_GROWTH + SPEED_SHARE * speed) * dt
        )
        colours = (self.clothes.distance(one.clothes) - NEUTRAL_DISTANCE) / DISTANCE_PER_NAT
        return 0.5 * away * away + float(np.clip(np.nan_to_num(colours), -MAX_NATS, MAX_NATS))

    def update(self, image: Image, one: _Sighted, stamp: int) -> None:
        """Updates the person from a detection in a new image."""
        if seconds(stamp - self.compared) >= COMPARISON_INTERVAL:
            self.compared = stamp
            if not self.picture.shows_again(image, one.keypoints):
                self.changed = stamp
        interval = seconds(stamp - self.seen)
        known = seconds(stamp - self.begun)
        if known < CLOTHES_TIME or self.cost(one, stamp) < LEARNING_COST:
            share = interval / min(known, CLOTHES_TIME)
            self.clothes = self.clothes.mixed(one.clothes, min(share, 1.0))
        if interval > LOST_TIME:
            self.followed = Followed()
        self.keypoints = self.followed.smooth(one.found, interval)
        self.place.update(one.sighting, stamp)
        self.seen, self.sure = stamp, self.sure or known >= CONFIRMATION_TIME


@dataclass(frozen=True, eq=False)
class _Sighted:
    """A detection of a person in an image.

    Attributes:
        found: output of the landmark network.
        keypoints: landmarks in this image, not smoothed.
        sighting: visible landmarks and their bounding box.
        clothes: colours of the clothes.
    """

    found: Found
    keypoints: Keypoints
    sighting: Sighting
    clothes: Clothes

    @property
    def circle(self) -> Array:
        """Centre of the circle around the body and a point on the circle, (2, 2), px."""
        return self.found.points[-2:]


class PeopleDetector:
    """Detects and tracks several people.

    Args:
        most: maximum number of people.

    Attributes:
        left_out: number of new people in the last image who exceeded `most` and were ignored.

    Raises:
        DetectorError: the detector is not installed.
    """

    def __init__(self, most: int = MAX_PEOPLE, networks: Networks | None = None) -> None:
        self.left_out = 0
        self._most = most
        self._networks = networks or Networks()
        self._people: list[_Person] = []
        self._size, self._newest, self._count = (0, 0), 0, 0
        # Index of the next tile, and number of tiles that are due.
        self._next_tile, self._due_tiles = 0, 0.0

    def detect(self, image: Image, stamp_ns: int) -> list[SeenPerson]:
        """People in an image, with identities, in the order of their first appearance.

        An image starts a new sequence if it is not newer than the previous image, or differs in
        size. Identities are never reused.

        Args:
            image: (H, W, 3) BGR.
            stamp_ns: stamp of the image.
        """
        interval = stamp_ns - self._newest
        if interval <= 0 or image.shape[:2] != self._size:
            self._people, interval = [], round(SEARCH_TIME * 1e9)
        self._size, self._newest = image.shape[:2], stamp_ns
        known = [x for x in self._people if x.seen + interval == stamp_ns]
        sighted = [
            self._look(image, x.followed.circle + x.place.shift(stamp_ns)) for x in known
        ]  # fmt: skip
        found = [x for x in sighted if x is not None]
        lost = [x for x in self._people if x not in known]
        lost += [x for x, one in zip(known, sighted, strict=True) if one is None]
        found += self._searched(image, found, self._tiles_due(interval) + _places(lost, stamp_ns))
        self._assign(image, _single(found), stamp_ns)
        self._people = [
            x for x in self._people if seconds(stamp_ns - x.seen) <= (KEPT_TIME if x.sure else 0.0)
        ]
        return [
            SeenPerson(
                x.name,
                x.keypoints,
                x.place.sighting.corners,
                seconds(stamp_ns - x.changed) >= PICTURE_TIME,
            )
            for x in self._people
            if x.seen == stamp_ns and x.sure
        ]

    # Finding.

    def _look(self, image: Image, circle: Array, scales: tuple[float, ...] = ()) -> _Sighted | None:
        """Best detection in the square around a circle and in upright, scaled squares, or None."""
        found = self._networks.landmarks(image, Square.about(circle))
        for scale in scales:
            radius = scale * float(np.linalg.norm(circle[1] - circle[0]))
            other = circle[0] + np.array([[0.0, 0.0], [0.0, -radius]])
            for _ in range(2):
                again = self._networks.landmarks(image, Square.about(other))
                if again is None:
                    break
                if found is None or again.quality > found.quality:
                    found = again
                other = again.points[-2:]
        if found is None:
            return None
        keypoints = Followed().smooth(found, 0.0)
        seen = keypoints[np.flatnonzero(keypoints.confidences >= MIN_VISIBILITY)]
        if len(seen.names) < MIN_LANDMARKS:
            return None
        corners = np.stack([seen.pixels.min(0), seen.pixels.max(0)])
        clothes = Clothes.of(image, keypoints)
        return _Sighted(found, keypoints, Sighting.of(seen, corners), clothes)

    def _tiles_due(self, interval: int) -> list[Square]:
        """Tiles to search in an image, `interval` ns after the previous image."""
        tiles = _tiles(*self._size[::-1])
        due = self._due_tiles + len(tiles) * seconds(interval) / SEARCH_TIME
        count = int(min(due, len(tiles)))
        result = [tiles[(self._next_tile + i) % len(tiles)] for i in range(count)]
        self._next_tile, self._due_tiles = self._next_tile + count, min(due - count, 1.0)
        return result

    def _searched(
        self, image: Image, known: list[_Sighted], squares: list[Square]
    ) -> list[_Sighted]:
        """Detections in squares of an image, without circles close to those of known detections."""
        looked: list[Array] = []
        result = []
        for square in squares:
            for _, circle in self._networks.circles(image, square):
                if any(_apart(x, circle) < SAME_CIRCLE_DISTANCE for x in looked):
                    continue
                looked.append(circle)
                if not any(_alike(x.circle, circle) for x in known):
                    one = self._look(image, circle, SCALES)
                    result += [] if one is None else [one]
        return result

    # Identities.

    def _assign(self, image: Image, sighted: list[_Sighted], stamp: int) -> None:
        """Assigns detections to people, searches for hidden people, and adds new ones."""
        costs = np.array([[x.cost(one, stamp) for one in sighted] for x in self._people])
        pairs: dict[int, _Person] = {}
        if costs.size:
            rows, columns = linear_sum_assignment(np.minimum(costs, MAX_COST))
            pairs = {j: self._people[i] for i, j in zip(rows, columns) if costs[i, j] < MAX_COST}
        room = self._most - len(pairs)
        left = [one for j, one in enumerate(sighted) if j not in pairs]
        left.sort(key=lambda x: -x.sighting.size)
        self.left_out = max(len(left) - room, 0)
        hidden = [x for x in self._people if x not in pairs.values()]
        for j, person in pairs.items():
            person.update(image, sighted[j], stamp)
        for person in hidden:
            one = self._behind(image, person, sighted, stamp)
            if one is not None:
                person.update(image, one, stamp)
                sighted = [*sighted, one]
        for one in left[:room]:
            self._people.append(self._new(one, stamp))

    def _behind(
        self, image: Image, person: _Person, sighted: list[_Sighted], stamp: int
    ) -> _Sighted | None:
        """Detection of a lost person with the visible people nearby painted over, or None."""
        circle = person.followed.circle + person.place.shift(stamp)
        before = [x for x in sighted if _apart(x.circle, circle) < APART_DISTANCE]
        if not before:
            return None
        painted = image.copy()
        for other in before:
            body = other.found.square.spread(other.found.mask, self._size) > 0.0
            painted[body] = GREY_LEVEL
        one = self._look(painted, circle)
        if one is None or any(_same_body(one, other) for other in before):
            return None
        return one if person.cost(one, stamp) < MAX_COST else None

    def _new(self, one: _Sighted, stamp: int) -> _Person:
        self._count += 1
        before = [x for x in self._people if x.begun < stamp]
        beside = any(x.place.cost(one.sighting, stamp) < APART_DISTANCE for x in before)
        followed = Followed()
        keypoints = followed.smooth(one.found, 0.0)
        return _Person(
            f'p{self._count}', ImageTrack(one.sighting, stamp), one.clothes, followed, keypoints,
            stamp, stamp, stamp,
            one.found.quality >= EVIDENT_QUALITY and not beside, StillPicture(), stamp,
            stamp,
        )  # fmt: skip


def _places(lost: list[_Person], stamp: int) -> list[Square]:
    """Squares around the expected places of lost people, if a search is due."""
    result = []
    for person in lost:
        if seconds(stamp - person.looked) >= LOOK_INTERVAL:
            person.looked = stamp
            middle = person.place.sighting.middle + person.place.shift(stamp)
            result.append(Square((middle[0], middle[1]), person.place.size / FILLED_FRACTION, 0.0))
    return result


@lru_cache(maxsize=4)
def _tiles(width: int, height: int) -> list[Square]:
    """The whole image and overlapping square tiles of the image, largest first."""
    whole, least = float(max(width, height)), MIN_HEIGHT / FILLED_FRACTION
    levels = max(math.ceil(math.log(whole / least) / math.log(TILE_RATIO)), 0)
    result = [Square((width / 2, height / 2), whole, 0.0)]
    for level in range(1, levels + 1):
        side = whole * (least / whole) ** (level / levels)
        across, down = (_middles(x, side) for x in (width, height))
        result += [Square((x, y), side, 0.0) for y in down for x in across]
    return result


def _middles(length: int, side: float) -> list[float]:
    """Centres of the tiles along one axis of the image."""
    beyond = length - (1.0 + 0.25 * TILE_OVERLAP) * side
    count = 1 + max(math.ceil(beyond / ((1.0 - TILE_OVERLAP) * side)), 0)
    if count == 1:
        return [length / 2]
    return [float(x) for x in np.linspace(side / 2, length - side / 2, count)]


def _apart(circle: Array, other: Array) -> float:
    """Distance between the centres of circles (2, 2), in units of the smaller radius."""
    radius = min(float(np.linalg.norm(x[1] - x[0])) for x in (circle, other))
    return float(np.linalg.norm(circle[0] - other[0])) / max(radius, 1.0)


def _alike(circle: Array, other: Array) -> bool:
    one, two = (float(np.linalg.norm(x[1] - x[0])) for x in (circle, other))
    return _apart(circle, other) < ALIKE_DISTANCE and max(one, two) < (1.0 + ALIKE_DISTANCE) * min(
        one, two
    )


def _single(sighted: list[_Sighted]) -> list[_Sighted]:
    """For each body, the detection of best quality."""
    kept: list[_Sighted] = []
    for one in sorted(sighted, key=lambda x: -x.found.quality):
        if not any(_same_body(one, other) for other in kept):
            kept.append(one)
    return kept


def _same_body(one: _Sighted, other: _Sighted) -> bool:
    """Whether two detections show one body: landmarks are close, or one box contains the other.

    Left and right may be exchanged. If only the boxes overlap, the colours must be similar.
    """
    sizes = sorted((one.sighting.size, other.sighting.size))
    if sizes[1] > MAX_RATIO * sizes[0]:
        # A child in front of an adult is another person.
        return False
    first, second = (x.keypoints.pixels[_BODY] for x in (one, other))
    away = min(float(np.median(np.linalg.norm(first - x, axis=1))) for x in (second, second[_SWAP]))
    if away < SAME_BODY_DISTANCE * sizes[0]:
        return True
    low, high = one.sighting.corners, other.sighting.corners
    common = np.minimum(low[1], high[1]) - np.maximum(low[0], high[0])
    areas = [float(np.prod(x[1] - x[0])) for x in (low, high)]
    within = float(np.prod(common.clip(0.0))) > CONTAINED_FRACTION * min(areas)
    return within and not one.clothes.distance(other.clothes) > NEUTRAL_DISTANCE
