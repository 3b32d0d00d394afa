"""Identities of several people, with stub networks: bodies are coloured bars."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from hmt_ros.detectors.blazepose import LANDMARKS, SCHEME, Found
from hmt_ros.detectors.clothes import Clothes
from hmt_ros.detectors.people import PeopleDetector, _tiles
from hmt_ros.image.keypoint_schemes import schemes
from hmt_ros.image.terms.keypoints import Keypoints

NAMES = schemes()[SCHEME].names
WIDTH, HEIGHT = 640, 480
RED, GREEN, BLUE, WHITE = (40, 40, 200), (40, 180, 40), (200, 60, 40), (230, 230, 230)
# Landmarks of trunk and legs relative to the middle of the hips, in heights.
PLACES = {
    'left_shoulder': (0.1, -0.3), 'right_shoulder': (-0.1, -0.3), 'left_hip': (0.07, 0.0),
    'right_hip': (-0.07, 0.0), 'left_knee': (0.07, 0.25), 'right_knee': (-0.07, 0.25),
    'left_ankle': (0.07, 0.5), 'right_ankle': (-0.07, 0.5),
}  # fmt: skip
BODY = np.array([PLACES.get(x, (0.0, -0.4)) for x in NAMES])


class Person:
    """A bar of one colour, by its middle and height, px; bars are drawn in `order`."""

    def __init__(self, colour, path, height=200.0):
        self.colour, self.path, self.height = colour, path, height

    def at(self, time):
        return np.array(self.path(time), dtype=float)


class Scene:
    """Stub networks of a scene, which see the people that are not hidden."""

    def __init__(self, people, noise=0.0):
        self.people, self.time, self.hidden = people, 0.0, ()
        self.rng, self.noise = np.random.default_rng(0), noise
        self.looks = 0

    def image(self):
        image = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
        for person in self.people:
            x, y = person.at(self.time)
            h = person.height
            corners = [
                (round(x - 0.13 * h), round(y - 0.45 * h)),
                (round(x + 0.13 * h), round(y + 0.5 * h)),
            ]
            cv2.rectangle(image, *corners, person.colour, -1)
            belt = [(corners[0][0], round(y)), (corners[1][0], round(y + 0.05 * h))]
            cv2.rectangle(image, *belt, (0, 0, 0), -1)
        return image

    def seen(self):
        """Visible people, nearest first."""
        result = []
        for person in reversed(self.people):
            near = [
                x
                for x in result
                if abs(x.at(self.time)[0] - person.at(self.time)[0]) < 0.12 * x.height
            ]
            if not near and person not in self.hidden:
                result.append(person)
        return result

    def circles(self, image, square):
        for person in self.seen():
            middle = person.at(self.time)
            inside = np.abs(middle - square.centre).max() < square.side / 2 - 0.3 * person.height
            if inside and 0.25 < person.height / square.side < 0.9:
                yield 0.9, np.array([middle, middle - (0.0, 0.55 * person.height)])

    def landmarks(self, image, square):
        self.looks += 1
        size = square.side / 2.5 / 0.55
        near = [
            x for x in self.seen()
            if np.linalg.norm(x.at(self.time) - square.centre) < 0.5 * x.height
            and 0.5 < x.height / size < 2.0
        ]  # fmt: skip
        if not near:
            return None
        person = min(near, key=lambda x: np.linalg.norm(x.at(self.time) - square.centre))
        middle = person.at(self.time)
        points = middle + person.height * BODY + self.rng.normal(0, self.noise, BODY.shape)
        circle = np.array([middle, middle - (0.0, 0.55 * person.height)])
        return Found(
            square, np.concatenate([points, circle]), np.full(LANDMARKS, 0.9),
            np.zeros((LANDMARKS, 3)), np.zeros((256, 256), np.float32), 1.0,
        )  # fmt: skip


def standing(x, y=240.0):
    return lambda _: (x, y)


def walking(start, end, y=240.0, duration=3.0):
    return lambda time: (start + (end - start) * min(time / duration, 1.0), y)


def names_over(scene, *, seconds=3.0, rate=15.0, most=4, start=10**9, detector=None):
    """Identities in each image, by the nearest person of the scene."""
    detector = detector or PeopleDetector(most, scene)
    result = []
    for number in range(round(seconds * rate)):
        scene.time = number / rate
        found = detector.detect(scene.image(), start + round(scene.time * 1e9))
        named = {}
        for one in found:
            middle = one.keypoints.pixels[[NAMES.index(x) for x in ('left_hip', 'right_hip')]].mean(
                0
            )
            owner = min(scene.people, key=lambda x: np.linalg.norm(x.at(scene.time) - middle))
            assert owner not in named
            named[owner] = one.name
        result.append(named)
    return result


def kept(names, person):
    """The identities of a person, without repetitions."""
    return list(dict.fromkeys(x[person] for x in names if person in x))


@pytest.mark.parametrize('rate', [30.0, 8.0, 3.0])
def test_people_who_stand_keep_their_names(rate):
    people = [Person(RED, standing(150)), Person(GREEN, standing(320)), Person(BLUE, standing(500))]
    names = names_over(Scene(people, noise=1.0), rate=rate)
    assert all(len(x) == 3 for x in names[1:])
    assert sorted(kept(names, x)[0] for x in people) == ['p1', 'p2', 'p3']
    assert all(len(kept(names, x)) == 1 for x in people)


@pytest.mark.parametrize('rate', [30.0, 8.0])
@pytest.mark.parametrize('colours', [(RED, GREEN), (RED, RED)])
def test_two_who_cross(rate, colours):
    """Also in the same clothes, if both keep their direction."""
    people = [Person(c, walking(*x)) for c, x in zip(colours, ((120, 520), (500, 100)))]
    names = names_over(Scene(people, noise=1.0), rate=rate)
    assert [len(kept(names, x)) for x in people] == [1, 1]
    assert kept(names, people[0]) != kept(names, people[1])
    assert np.mean([len(x) == 2 for x in names]) > 0.8


def test_two_who_meet_and_turn_round():
    """Positions suggest that they crossed; clothes show that they did not."""

    def there_and_back(start, end):
        return lambda t: (start + (end - start) * (1 - abs(t - 1.5) / 1.5), 240.0)

    people = [Person(RED, there_and_back(120, 310)), Person(GREEN, there_and_back(520, 312))]
    names = names_over(Scene(people, noise=1.0))
    assert [len(kept(names, x)) for x in people] == [1, 1]


def test_an_occlusion_of_two_seconds_is_bridged_and_one_of_four_is_not():
    person, other = Person(RED, standing(200)), Person(GREEN, standing(450))
    for hidden, same in ((2.0, True), (4.0, False)):
        scene = Scene([person, other], noise=1.0)
        detector = PeopleDetector(4, scene)
        first = names_over(scene, seconds=1.0, detector=detector)
        scene.hidden = (person,)
        names_over(scene, seconds=hidden, detector=detector, start=2 * 10**9)
        scene.hidden = ()
        last = names_over(scene, seconds=2.0, detector=detector, start=round((2 + hidden) * 1e9))
        assert (kept(first, person) == kept(last, person)) == same
        assert kept(first, other) == kept(last, other)


def test_somebody_else_in_the_same_place_is_new():
    red, blue = Person(RED, standing(300)), Person(BLUE, standing(300))
    scene = Scene([red], noise=1.0)
    detector = PeopleDetector(4, scene)
    first = names_over(scene, seconds=1.0, detector=detector)
    scene.people = [blue]
    last = names_over(scene, seconds=2.0, detector=detector, start=3 * 10**9)
    assert kept(first, red) != kept(last, blue)


def test_seven_people_of_whom_four_are_wanted():
    people = [Person(RED, standing(60 + 85 * i), 150.0 + 8 * i) for i in range(7)]
    scene = Scene(people)
    detector = PeopleDetector(4, scene)
    found = detector.detect(scene.image(), 10**9)
    assert len(found) == 4
    assert detector.left_out == 3
    # The largest person.
    assert min(x.corners[0, 0] for x in found) > 250


def test_a_child_before_an_adult():
    adult, child = Person(BLUE, standing(300, 240), 320.0), Person(RED, standing(345, 320), 150.0)
    names = names_over(Scene([adult, child], noise=1.0), seconds=1.0)
    assert [len(kept(names, x)) for x in (adult, child)] == [1, 1]
    assert len(names[-1]) == 2


def test_a_mirror_image_is_another_person():
    people = [Person(RED, walking(100, 280)), Person(RED, walking(540, 360))]
    names = names_over(Scene(people, noise=1.0))
    assert [len(kept(names, x)) for x in people] == [1, 1]


def test_a_poster_is_named_as_one_and_somebody_who_sways_is_not():
    poster = Person(RED, standing(150))
    swaying = Person(GREEN, lambda t: (450 + 4 * np.sin(t), 240.0))
    scene = Scene([poster, swaying])
    detector = PeopleDetector(2, scene)
    still = []
    for number in range(65):
        scene.time = number / 5
        found = detector.detect(scene.image(), 10**9 + number * 200_000_000)
        still.append({x.keypoints.pixels[0, 0] < 300: x.still for x in found})
    assert not any(x[True] for x in still[:50])
    assert still[-1] == {True: True, False: False}


def test_a_new_sequence_gives_new_names():
    scene = Scene([Person(RED, standing(300))])
    detector = PeopleDetector(2, scene)
    (first,) = detector.detect(scene.image(), 2 * 10**9)
    (again,) = detector.detect(scene.image(), 10**9)
    assert (first.name, again.name) == ('p1', 'p2')
    small = cv2.resize(scene.image(), (320, 240))
    detector.detect(small, 11 * 10**8)


def test_nobody():
    assert PeopleDetector(2, Scene([])).detect(np.zeros((480, 640, 3), np.uint8), 1) == []


def test_the_same_images_give_the_same_people():
    def run():
        people = [Person(RED, walking(100, 400)), Person(GREEN, walking(500, 200))]
        scene = Scene(people, noise=2.0)
        detector = PeopleDetector(4, scene)
        result = []
        for i in range(30):
            scene.time = i / 10
            result += [
                (x.name, x.keypoints.pixels.tobytes())
                for x in detector.detect(scene.image(), 10**9 + i * 10**8)
            ]
        return result

    assert run() == run()


@pytest.mark.parametrize(
    ('size', 'smallest'),
    [((640, 480), 375), ((1280, 720), 375), ((320, 240), 320), ((480, 640), 375)],
)
def test_tiles_cover_the_image(size, smallest):
    tiles = _tiles(*size)
    assert tiles[0].side == max(size)
    assert tiles[-1].side == pytest.approx(smallest)
    last = [x for x in tiles if x.side == tiles[-1].side]
    covered = np.zeros(size[::-1], bool)
    for tile in last:
        left, top = (max(round(x), 0) for x in tile.corner)
        covered[top : top + round(tile.side) + 1, left : left + round(tile.side) + 1] = True
    assert covered.all()


def test_clothes_that_are_not_seen_say_nothing():
    image = np.zeros((100, 100, 3), np.uint8)
    nowhere = Keypoints(NAMES, np.full((33, 2), 500.0), np.full((33, 2, 2), np.nan), np.ones(33))
    unseen = Clothes.of(image, nowhere)
    assert np.isnan(unseen.shares).all()
    assert np.isnan(unseen.distance(unseen))
    scene = Scene([Person(RED, standing(300))])
    middle = scene.people[0].at(0.0)
    seen = Keypoints(NAMES, middle + 200 * BODY, np.full((33, 2, 2), np.nan), np.ones(33))
    clothes = Clothes.of(scene.image(), seen)
    assert clothes.distance(clothes) == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_array_equal(unseen.mixed(clothes, 0.1).shares, clothes.shares)
    np.testing.assert_array_equal(clothes.mixed(unseen, 0.1).shares, clothes.shares)
