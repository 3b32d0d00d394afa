import numpy as np
import pytest

from hmt_ros.app.import_video.keypoint_files import Choice, Chooser, person

NAMES = ('left_hip', 'right_hip', 'left_knee')


def at(u, v=100.0, size=10.0, track=''):
    pixels = np.array([[u, v], [u + size, v], [u, v + 2 * size]])
    return person(NAMES, pixels, [0.9, 0.9, 0.9], track=track)


def chosen(text, frames, numbers=None):
    """Left end of the box of the person in each frame, and None where there is none."""
    chooser = Chooser(Choice.parse(text))
    found = [
        chooser.of(number, frame) for number, frame in zip(numbers or range(len(frames)), frames)
    ]
    return [None if x is None else float(x.box[0, 0]) for x in found]


def test_what_was_not_seen():
    pixels = [[1.0, 2.0], [0.0, 0.0], [5.0, 6.0], [7.0, 8.0], [np.nan, 1.0]]
    seen = person('abcde', pixels, [0.5, 0.9, 0.0, 1.2, 0.9]).keypoints
    assert seen.names == tuple('abcde')
    assert list(seen.seen) == [True, False, False, True, False]
    assert np.isnan(seen.pixels[~seen.seen]).all()
    assert list(seen.confidences) == [0.5, 0.0, 0.0, 1.0, 0.0]
    assert person('ab', np.zeros((2, 2)), [1.0, 1.0]) is None
    assert person('ab', np.ones((2, 2)), [0.0, np.nan]) is None
    # An axis at zero alone is the border of the image.
    assert person('a', [[0.0, 3.0]], [1.0]).keypoints.seen.all()


def test_largest_in_each_frame():
    frames = [[at(10.0), at(50.0, size=12.0)], [at(11.0, size=15.0), at(51.0)], []]
    assert chosen('largest', frames) == [50.0, 11.0, None]


def test_nearest_to_the_one_before():
    frames = [[at(10.0), at(50.0, size=12.0)], [at(11.0, size=15.0), at(51.0, size=12.0)]]
    assert chosen('nearest', frames) == [50.0, 51.0]


def test_nobody_is_nearest_who_is_far():
    """A person 200 px away is another one, until there was time to go there."""
    frames = [[at(10.0)], [at(210.0)], [], [at(210.0)]]
    assert chosen('nearest', frames, [0, 1, 2, 40]) == [10.0, None, None, 210.0]


def test_place_and_track():
    frames = [[at(10.0, track='7'), at(50.0, track='3')], [at(51.0, track='3')]]
    assert chosen('index:1', frames) == [50.0, None]
    assert chosen('id:7', frames) == [10.0, None]
    assert chosen('id:3', frames) == [50.0, 51.0]


@pytest.mark.parametrize('text', ['', 'tall', 'index:', 'index:x', 'index:-1', 'id:', 'largest:1'])
def test_other_choices_are_refused(text):
    with pytest.raises(ValueError, match='wanted largest, nearest, index:N or id:NAME'):
        Choice.parse(text)
