"""The smoother node itself, over DDS."""

import time

import numpy as np
import pytest

from hmt_ros.sessions.smoothed_messages import TOPICS
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.sessions.smoother_session import SmootherSession
from msg_tools.messages.cdr import serialise
from msg_tools.messages.headers import time_ns

pytestmark = pytest.mark.ros

FINAL = ['smoothed_pose_mixture', 'smoothed_joint_states']


@pytest.fixture
def world(world_of):
    from hmt_msgs.msg import PoseMixture

    from hmt_ros.nodes.smoother_node import SmootherNode

    inputs = {'likelihood_mixture': PoseMixture}

    def make(**values):
        values = {'fixed_lag': 0.1, **values}
        return world_of(SmootherNode, 'smoother_node', inputs, **values)

    return make


@pytest.fixture
def running(world):
    return world().start()


def published(handled):
    return [topic for topic, _ in handled.published]


def listen_to_everything(one):
    from hmt_msgs.msg import PoseMixture, TrajectoryMixture
    from sensor_msgs.msg import JointState
    from visualization_msgs.msg import MarkerArray

    return one.hear(
        {
            'trajectory_mixture': TrajectoryMixture,
            'trajectory_markers': MarkerArray,
            'smoothed_pose_mixture': PoseMixture,
            'smoothed_joint_states': JointState,
        }
    )


def test_mixtures_become_smoothed_poses(running, likelihoods):
    found = listen_to_everything(running)
    assert published(running.send('likelihood_mixture', likelihoods.message(0))) == [*TOPICS][:2]
    handled = running.send('likelihood_mixture', likelihoods.message(1))
    assert published(handled) == [*TOPICS][:4]
    stamps = [stamp for topic, stamp in handled.published if topic in FINAL]
    assert stamps == [likelihoods.stamp(0)] * 2
    # The end of the stream.
    assert running.change_state('deactivate')
    running.spin_until(lambda: len(found['smoothed_joint_states']) == 2)
    assert running.handled[-1].source == 'finish'
    assert published(running.handled[-1]) == FINAL
    poses = found['smoothed_pose_mixture']
    assert [time_ns(m.header.stamp) for m in poses] == [likelihoods.stamp(i) for i in (0, 1)]
    assert {m.kind for m in poses} == {3}
    assert len(found['trajectory_mixture'][-1].stamps) == 2
    assert len(found['trajectory_markers'][-1].markers) == 16
    # A new window begins when it is activated again.
    assert running.change_state('activate')
    running.connect()
    handled = running.send('likelihood_mixture', likelihoods.message(5))
    assert handled.faults == ()
    assert running.session.state.window == 1


def test_parameters_are_those_of_the_file(running):
    running.assert_described(SmootherParameters())
    running.assert_refused(
        ({'fixed_lag': -1.0}, 'out of range'),
        ({'max_hypotheses': 0}, 'out of range'),
        ({'body_model': 'nobody'}, 'nobody: no such file, nor a known name; these are human32'),
        ({'autostart': False}, 'read-only'),
    )
    assert running.set(queue_size=3, max_hypotheses=2) == (True, '')
    assert running.session.parameters.max_hypotheses == 2
    assert running.limit('likelihood_mixture') == 3


def test_windows_are_smoothed_on_demand(running, likelihoods, monkeypatch):
    from builtin_interfaces.msg import Time
    from hmt_msgs.srv import SmoothWindow

    answer = running.call(SmoothWindow, 'smooth_window')
    assert not answer.success
    assert 'no mixture from 0 to 0 ns: none is' in answer.message
    for index in range(4):
        running.send('likelihood_mixture', likelihoods.message(index))
    seconds, nanoseconds = divmod(likelihoods.stamp(1), 10**9)
    answer = running.call(
        SmoothWindow, 'smooth_window', from_time=Time(sec=seconds, nanosec=nanoseconds)
    )
    assert (answer.success, answer.message) == (True, '')
    found = answer.trajectories
    assert [time_ns(stamp) for stamp in found.stamps] == [likelihoods.stamp(i) for i in (1, 2, 3)]
    assert len(found.components[0].marginal_covariances) == 3 * 37 * 37
    # Messages that arrive meanwhile wait, and none is lost.
    smooth_span, count = SmootherSession.smooth_span, len(running.handled)

    def slow(self, *span):
        for index in range(4, 24):
            message = serialise(likelihoods.message(index))
            running.publishers['likelihood_mixture'].publish(message)
        time.sleep(0.5)
        return smooth_span(self, *span)

    monkeypatch.setattr(SmootherSession, 'smooth_span', slow)
    assert len(running.call(SmoothWindow, 'smooth_window').trajectories.stamps) == 4
    running.spin_until(lambda: len(running.handled) == count + 20, 'all that had come')
    assert running.session.state.counts['smoothed'] == 24


def test_a_node_lives_on_after_values_that_are_no_numbers(running, likelihoods):
    running.send('likelihood_mixture', likelihoods.message(0))
    bad = likelihoods.message(1)
    bad.components[0].covariance = np.full(37 * 37, np.nan)
    handled = running.send('likelihood_mixture', bad)
    (fault,) = handled.faults
    assert 'covariance of mixture has values that are not finite' in fault
    assert '\n' not in fault
    handled = running.send('likelihood_mixture', likelihoods.message(2))
    assert handled.faults == ()
    assert running.session.state.window == 2
    assert running.errors() == []


def test_queue_holds_what_was_published(running, likelihoods):
    """Mixtures that arrive during smoothing wait."""
    data = serialise(likelihoods.message(0))
    count = len(running.handled)
    running.receive('likelihood_mixture', data[:60])
    running.receive('likelihood_mixture', data)
    running.spin_until(lambda: len(running.handled) == count + 2)
    first, second = running.handled[-2:]
    assert 'message of likelihood_mixture can not be read' in first.faults[0]
    assert second.faults == ()
