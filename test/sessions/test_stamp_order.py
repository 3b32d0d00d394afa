"""A single stray timestamp has no effect; a clock set back is followed automatically."""
# ruff: noqa: F811

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.image_inputs import KEYPOINTS
from hmt_ros.sessions.stamp_order import Stamped, StampOrder
from msg_tools.messages.headers import SECOND_NS, stamp_in, time_ns
from msg_tools.messages.message_error import MessageError
from test.sessions.test_tracking_session import session, tracked  # noqa: F401

HOUR = 3600 * SECOND_NS
STEP = SECOND_NS // 10


def used(order, stamps, *, expected=False):
    """The used and the stray ones of some timestamps."""
    result, strays = [], []
    for stamp in stamps:
        turn = order.put(Stamped(stamp, None), expected=expected)
        result += [one.stamp for one in turn.use]
        strays += [one.stamp for one in turn.stray]
        if turn.use:
            order.newest = result[-1]
    return result, strays


@given(
    st.integers(3, 20),
    st.sampled_from([HOUR, -HOUR, 3 * SECOND_NS, -2 * SECOND_NS]),
    st.integers(STEP // 10, 2 * SECOND_NS),
)
def test_a_stray_stamp_is_left_out(place, far, step):
    # A clock that starts at one day; the stray timestamp is between two others.
    stamps = [24 * HOUR + k * step for k in range(25)]
    far = far if abs(far) > 6 * step else 10 * far
    stray = stamps[place] + far + 1
    result, strays = used(StampOrder(), [*stamps[:place], stray, *stamps[place:]])
    assert result == stamps
    assert strays == [stray]


@pytest.mark.parametrize('far', [HOUR, 20 * SECOND_NS, -600 * SECOND_NS])
@pytest.mark.parametrize(('expected', 'agreeing'), [(True, 2), (False, 3)])
def test_another_time_is_followed_once_some_agree(far, expected, agreeing):
    order, before = StampOrder(), [HOUR + k * STEP for k in range(5)]
    after = [HOUR + far + k * STEP for k in range(6)]
    assert used(order, before, expected=expected) == (before, [])
    for k in range(agreeing - 1):
        assert used(order, after[k : k + 1], expected=expected) == ([], [])
    turn = order.put(Stamped(after[agreeing - 1], None), expected=expected)
    assert [one.stamp for one in turn.use] == after[:agreeing]
    assert turn.back == max(before[-1] - after[0], 0)


def test_what_is_put_aside_is_used_at_the_end_unless_it_is_older():
    for far, use in ((20 * SECOND_NS, 1), (-20 * SECOND_NS, 0)):
        order = StampOrder()
        used(order, [HOUR, HOUR + STEP, HOUR + far])
        turn = order.end()
        assert (len(turn.use), len(turn.stray)) == (use, 1 - use)


def test_a_slow_stream_is_no_stray():
    stamps = [k * HOUR for k in range(1, 6)]
    assert used(StampOrder(), stamps) == (stamps, [])
    # A clock that was faster before, with steps longer than any usual ones.
    fast = [k * STEP for k in range(1, 6)]
    result, strays = used(StampOrder(), [*fast, *stamps])
    assert (result, strays) == ([*fast, *stamps], [])


# Sessions.


def shown(one, camera, indices):
    return [one.take(IMAGE, camera.image(index)) for index in indices]


@pytest.mark.parametrize('resets', [False, True])
@pytest.mark.parametrize('far', [36_000, -6_000])
def test_poses_after_a_stray_image_are_the_same(session, outputs, small_camera, far, resets):
    for strays in ((), (far,)):
        one = session(reset_on_time_jump=resets)
        one.take(CAMERA_INFO, small_camera.info())
        handled = shown(one, small_camera, [*range(5), *(x + 5 for x in strays), *range(5, 12)])
        assert [one for one in handled if one.faults] == []
        assert sum(len(one.warnings) for one in handled) == len(strays)
        assert one.state.time_jump == ''
    half = len(outputs) // 2
    assert outputs[:half] == outputs[half:]
    assert len(tracked(outputs)) == 24
    assert one.state.faults == {'stray stamp': 1}


@pytest.mark.parametrize('resets', [False, True])
def test_a_clock_that_went_back_loses_no_image(
    session, outputs, small_camera, resets, stub_tracker
):
    one = session(reset_on_time_jump=resets)
    one.take(CAMERA_INFO, small_camera.info())
    shown(one, small_camera, range(6000, 6005))
    handled = shown(one, small_camera, range(10))
    assert [h for h in handled if h.faults] == []
    assert tracked(outputs)[5:] == [small_camera.stamp(index) for index in range(10)]
    assert len(stub_tracker.made) == 2
    assert one.state.time_jump.startswith('the clock went back by 600 s: image of ')
    assert one.state.time_jump.endswith('the track starts again')


def test_inputs_of_the_images_that_were_put_aside_count(
    session, outputs, small_camera, stub_tracker
):
    one = session(use_keypoints=True)
    one.take(CAMERA_INFO, small_camera.info())
    for index in (6000, 6001, 0, 1, 2, 3):
        one.take(IMAGE, small_camera.image(index))
        one.take(KEYPOINTS, small_camera.keypoints(index))
    assert tracked(outputs)[2:] == [small_camera.stamp(index) for index in range(4)]
    assert all(keypoints is not None for _, keypoints in stub_tracker.made[-1].seen)


@pytest.mark.parametrize('far', [36_000, 100])
def test_a_stray_input_ends_the_wait_of_no_image(session, outputs, small_camera, far):
    one = session(use_keypoints=True)
    one.take(CAMERA_INFO, small_camera.info())
    for index in range(3):
        one.take(KEYPOINTS, small_camera.keypoints(index + far))
        one.take(IMAGE, small_camera.image(index))
        assert len(tracked(outputs)) == index
        one.take(KEYPOINTS, small_camera.keypoints(index))
        assert len(tracked(outputs)) == index + 1


def test_a_flood_of_stray_inputs_drops_no_others(session, outputs, small_camera):
    one = session(use_keypoints=True)
    one.take(CAMERA_INFO, small_camera.info())
    for index in range(1000):
        one.take(KEYPOINTS, small_camera.keypoints(index + 36_000))
    one.take(KEYPOINTS, small_camera.keypoints(0))
    one.take(IMAGE, small_camera.image(0))
    assert tracked(outputs) == [small_camera.stamp(0)]


@pytest.mark.parametrize(
    ('seconds', 'nanoseconds', 'text'),
    [
        (1_700_000_000, 10**9, '1000000000 nanoseconds'),
        (1_700_000_000, 2**32 - 1, '4294967295 nanoseconds'),
        (-5, 0, 'from 1970'),
    ],
)
def test_impossible_stamps_are_faults(session, outputs, small_camera, seconds, nanoseconds, text):
    one = session(use_keypoints=True)
    one.take(CAMERA_INFO, small_camera.info())
    made = {IMAGE: small_camera.image, KEYPOINTS: small_camera.keypoints}
    for index in range(2):
        for source in (IMAGE, KEYPOINTS, CAMERA_INFO):
            message = made.get(source, small_camera.info)(index)
            good = message.header.stamp
            message.header.stamp = replace(good, sec=seconds, nanosec=nanoseconds)
            (fault,) = one.take(source, message).faults
            assert text in fault
        one.take(IMAGE, small_camera.image(index))
        one.take(KEYPOINTS, small_camera.keypoints(index))
    assert tracked(outputs) == [small_camera.stamp(0), small_camera.stamp(1)]


def test_stamps_of_bytes():
    good = bytes([0, 1, 0, 0]) + (5).to_bytes(4, 'little') + (7).to_bytes(4, 'little')
    assert stamp_in(good) == 5 * SECOND_NS + 7
    assert stamp_in(good[:8] + bytes([255] * 4)) == 0
    with pytest.raises(MessageError, match=r'4294967295 nanoseconds'):
        time_ns(type('Time', (), {'sec': 5, 'nanosec': 2**32 - 1}))
