"""Outputs for robots over time: forecasts and the keep-out space."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.body.keep_out import Capsules, reach_after
from hmt_ros.inference import GaussianMixture
from hmt_ros.sessions.fixed_frame import OPTICAL_TO_BODY, FixedFrame
from hmt_ros.sessions.robot_outputs import LastSeen, RobotOutputs
from hmt_ros.sessions.transform_buffer import Transform
from msg_tools.messages.headers import SECOND_NS
from msg_tools.messages.keep_out import KeepOutState
from msg_tools.messages.pose_mixtures import MixtureKind, TrackState

BODY = load_body('human37')
START = 1_700_000_000_000_000_000
FOUND, LOST, NOBODY = KeepOutState.TRACKING, KeepOutState.LOST, KeepOutState.NOBODY


def seen(stamp, fixed=None):
    pose = BODY.prior_mean.copy()
    pose[2] = 3.0
    posterior = GaussianMixture([1.0], [pose], [1e-4 * np.eye(BODY.dimension)])

    def at(stamp_ns):
        later = (stamp_ns - stamp) / SECOND_NS
        moved = pose.copy()
        moved[0] += later
        return GaussianMixture([1.0], [moved], [(1e-4 + later) * np.eye(BODY.dimension)])

    forecaster = SimpleNamespace(at=at, modes=SimpleNamespace(identities=np.array([5])))
    return LastSeen(stamp, 'lens', BODY, posterior, forecaster, fixed, 0.99)


@pytest.fixture
def robot():
    one = RobotOutputs()
    one.update(START, 'lens', FOUND, 3, 0.9, seen(START))
    return one


def capsules(content):
    return Capsules(content.starts, content.ends, content.radii)


def test_before_the_first_image_nothing_is_known():
    content = RobotOutputs().keep_out(0.95)
    assert content.state is KeepOutState.UNKNOWN
    assert (len(content.radii), content.probability) == (0, 0.95)
    assert math.isnan(content.unseen)
    assert RobotOutputs().keep_out(0.95, silence=1.0).state is KeepOutState.STALE
    with pytest.raises(ValueError, match='nobody is tracked'):
        RobotOutputs().forecast(START)


def test_a_person_who_is_seen_is_inside(robot):
    content = robot.keep_out(0.5)
    assert (content.state, content.stamp_ns, content.unseen) == (FOUND, START, 0.0)
    # The probability of the image, not the one requested now.
    assert content.probability == 0.99
    joints = BODY.joint_positions(seen(START).posterior.means)[0]
    assert capsules(content).contain(joints).all()


def test_who_is_lost_may_be_as_far_as_people_move(robot):
    before = robot.keep_out(0.99)
    robot.update(START + SECOND_NS // 2, 'lens', LOST, 3, 0.6)
    after = robot.keep_out(0.99)
    assert (after.state, after.unseen) == (LOST, 0.5)
    np.testing.assert_allclose(after.radii, before.radii + reach_after(0.5))
    # Neither images without information nor a silent camera stop it.
    silent = robot.keep_out(0.99, silence=0.25)
    assert (silent.state, silent.unseen) == (KeepOutState.STALE, 0.75)
    assert silent.stamp_ns == START + 3 * SECOND_NS // 4
    np.testing.assert_allclose(silent.radii, before.radii + reach_after(0.75))


def test_only_an_image_without_anybody_frees_the_space(robot):
    robot.update(START + SECOND_NS, 'lens', NOBODY, 3, 0.05)
    assert (robot.keep_out(0.99).state, len(robot.keep_out(0.99).radii)) == (NOBODY, 0)
    # If the camera then stops, nothing is known about later times.
    assert robot.keep_out(0.99, silence=2.0).state is KeepOutState.STALE
    robot.forget()
    assert robot.keep_out(0.99).state is KeepOutState.UNKNOWN


def test_a_fixed_frame_has_its_own_places():
    camera = Transform(OPTICAL_TO_BODY, np.array([10.0, 0.0, 1.5]))
    fixed = FixedFrame('odom', camera)
    robot = RobotOutputs()
    robot.update(START, 'odom', FOUND, 1, 0.9, seen(START, fixed))
    joints = BODY.joint_positions(seen(START).posterior.means)[0]
    placed = joints @ OPTICAL_TO_BODY.T + camera.translation
    assert capsules(robot.keep_out(0.99)).contain(placed).all()
    assert robot.keep_out(0.99).frame_id == 'odom'
    forecast = robot.forecast(START)
    assert forecast.frame_id == 'odom_optical'
    np.testing.assert_allclose(forecast.joint_positions[0] @ OPTICAL_TO_BODY.T, placed, atol=1e-9)


def test_forecasts_are_of_the_time_that_is_asked_for(robot):
    found = robot.forecast(START + SECOND_NS // 5)
    assert (found.kind, found.state) == (MixtureKind.FORECAST, TrackState.TRACKING)
    assert found.stamp_ns == START + SECOND_NS // 5
    assert found.means[0, 0] - BODY.prior_mean[0] == pytest.approx(0.2)
    assert (found.track_id, found.identities.tolist()) == (3, [5])
    robot.update(START + SECOND_NS // 10, 'lens', LOST, 3, 0.5)
    assert robot.forecast(START + SECOND_NS // 5).state is TrackState.LOST
    for stamp in (START, START + 11 * SECOND_NS):
        with pytest.raises(ValueError, match='wanted a time from then to 10 s later, saw'):
            robot.forecast(stamp)


def test_each_time_of_a_grid_is_told_of_once(robot):
    first = list(robot.due(100.0, 0.05))
    assert first == [START + 10_000_000 * k for k in range(1, 6)]
    assert list(robot.due(100.0, 0.05)) == []
    robot.update(START + 33_333_333, 'lens', FOUND, 3, 0.9, seen(START + 33_333_333))
    # The grid is one of time, not of images.
    assert list(robot.due(100.0, 0.05)) == [START + 10_000_000 * k for k in (6, 7, 8)]
    assert list(robot.due(0.0, 0.05)) == []


def test_a_grid_need_not_be_of_whole_nanoseconds():
    robot, stamps = RobotOutputs(), []
    for i in range(300):
        stamp = START + round(i * SECOND_NS / 29.97)
        robot.update(stamp, 'lens', FOUND, 1, 0.9, seen(stamp))
        due = list(robot.due(90.0, 0.1))
        assert all(stamp < each <= stamp + SECOND_NS // 10 for each in due)
        stamps += due
    steps = np.diff(stamps)
    assert steps.min() >= 11_111_111
    assert steps.max() <= 11_111_112
