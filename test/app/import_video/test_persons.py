import numpy as np
import pytest

from hmt_ros.app.import_video.keypoint_files.choice import Choice, chosen_person
from hmt_ros.app.import_video.keypoint_files.persons import FoundPersons, person

NAMES = ('left_hip', 'right_hip', 'left_knee')


def at(u, v=100.0, size=10.0, track='', score=1.0):
    pixels = np.array([[u, v], [u + size, v], [u, v + 2 * size]])
    return person(NAMES, pixels, [0.9, 0.9, 0.9], track=track, score=score)


def chosen(text, frames, numbers=None, **about):
    """Left end of the chosen person's box in each frame, None without a box."""
    numbers = numbers or range(len(frames))
    found = FoundPersons(frames=dict(zip(numbers, frames)), **about)
    there = chosen_person(found, Choice.parse(text), rate=10.0)
    return [float(there[i].box[0, 0]) if i in there else None for i in numbers]


def test_largest_in_each_frame():
    frames = [[at(10.0), at(50.0, size=12.0)], [at(11.0, size=15.0), at(51.0)], []]
    assert chosen('largest', frames) == [50.0, 11.0, None]


def test_nearest_to_the_one_before():
    frames = [[at(10.0), at(50.0, size=12.0)], [at(11.0, size=15.0), at(51.0, size=12.0)]]
    assert chosen('nearest', frames) == [50.0, 51.0]


def test_nobody_is_nearest_who_is_far():
    """A person 200 px away is another one until there was enough time to walk there."""
    frames = [[at(10.0)], [at(210.0)], [], [at(210.0)]]
    assert chosen('nearest', frames, [0, 1, 2, 40]) == [10.0, None, None, 210.0]


def test_place_and_track():
    frames = [[at(10.0, track='7'), at(50.0, track='3')], [at(51.0, track='3')]]
    assert chosen('index:1', frames) == [50.0, None]
    assert chosen('id:7', frames) == [10.0, None]
    assert chosen('id:3', frames) == [50.0, 51.0]


def test_a_score_tells_who_is_a_person():
    """A large box with a small score is no person, neither in choices nor in tracks."""
    frames = [[at(10.0 + i, score=0.93), at(12.0, size=60.0, score=0.011)] for i in range(3)]
    for text in ('largest', 'nearest', 'track:1', 'at:15,105'):
        assert chosen(text, frames) == [10.0, 11.0, 12.0], text
    assert chosen('index:1', frames) == [12.0] * 3


def test_at_a_point_and_a_time():
    """From there the person is followed forwards and backwards in time."""
    frames = [[at(10.0 + 2 * i), at(90.0 - 2 * i)] for i in range(20)]
    left, right = [10.0 + 2 * i for i in range(20)], [90.0 - 2 * i for i in range(20)]
    assert chosen('at:12,110', frames[:10]) == left[:10]
    assert chosen('at:92,110', frames[:10]) == right[:10]
    # At 10 frames per second 0.8 s is frame 8, where they are at 26 and 74.
    assert chosen('at:78,110,0.8', frames[:10]) == right[:10]
    with pytest.raises(ValueError, match=r'nobody at 500,110: .* at:15,110 and at:95,110'):
        chosen('at:500,110', frames)
    times = [100_000_000 * i for i in range(10)]
    assert chosen('at:78,110,0.8', frames[:10], times, timed=True) == right[:10]


def test_the_longest_tracks():
    """The second person stands elsewhere and comes later; the third comes after both."""
    frames = [[at(10.0)] for _ in range(5)]
    frames += [[at(200.0), at(10.0)] for _ in range(4)]
    frames += [[] for _ in range(40)] + [[at(11.0)] for _ in range(2)]
    assert chosen('track:1', frames) == [10.0] * 9 + [None] * 42
    assert chosen('track:2', frames) == [None] * 5 + [200.0] * 4 + [None] * 42
    assert chosen('track:3', frames) == [None] * 49 + [11.0] * 2
    with pytest.raises(ValueError, match='no track 4: the clip has 3, of 9, 4, 2 frames; --person'):
        chosen('track:4', frames)


def test_an_id_that_does_not_exist():
    frames = [[at(10.0, track='10'), at(60.0, track='9')]]
    with pytest.raises(ValueError, match=r'no person 7: the ids are 9, 10; --person id:NAME'):
        chosen('id:7', frames)
    with pytest.raises(ValueError, match='there are no ids; or --person at:X,Y or track:1'):
        chosen('id:7', [[at(10.0)]])


@pytest.mark.parametrize(
    'text',
    ['', 'tall', 'index:', 'index:x', 'index:-1', 'id:', 'largest:1', 'track:0', 'at:1', 'at:1,x'],
)
def test_other_choices_are_refused(text):
    with pytest.raises(ValueError, match=r'wanted largest, nearest, index:N, id:NAME, track:N'):
        Choice.parse(text)
