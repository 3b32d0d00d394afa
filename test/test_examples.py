"""The programs in examples/: their results, and that they run."""

from __future__ import annotations

import math
import runpy
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hmt_ros.app.replay.one_bag import replay_bag
from hmt_ros.app.replay.options import ReplayOptions
from hmt_ros.body import load_body
from hmt_ros.inference import GaussianMixture
from msg_tools import BagReader, RosbagsMessages
from msg_tools.messages.cdr import serialise
from msg_tools.messages.detections import NO_KEYPOINTS, DetectedPerson, people_message
from msg_tools.messages.keep_out import KeepOut, KeepOutState, keep_out_message
from msg_tools.messages.pose_mixtures import (
    MixtureKind,
    PoseMixture,
    TrackState,
    pose_mixture_message,
)

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / 'examples'
MESSAGES = RosbagsMessages()
NAN = math.nan
# Share of 10 m by 10 m under the capsule of `keep_out`, 2 m long, with half the diagonal of a cell.
LYING = (2.0 * 2.0 * 0.2854 + math.pi * 0.2854**2) / 100.0


def example(name):
    return runpy.run_path(str(EXAMPLES / f'{name}.py'))


def test_the_readme_names_every_example():
    text = (EXAMPLES / 'README.md').read_text('utf-8')
    programs = [path.name for path in EXAMPLES.iterdir() if path.suffix in ('.py', '.cpp')]
    assert len(programs) == 9
    assert all(f'`{name}`' in text for name in programs)


def keep_out(state, away=1.5, unseen=0.0, frame='eye'):
    """Message of a person `away` m from the origin, if the state has one."""
    some = state not in (KeepOutState.NOBODY, KeepOutState.UNKNOWN)
    starts, ends = np.array([[-1.0, 0.0, away + 0.25]]), np.array([[1.0, 0.0, away + 0.25]])
    none = np.empty((0, 3))
    content = KeepOut(
        10**9, frame, state, starts if some else none, ends if some else none,
        np.full(int(some), 0.25), unseen=unseen if some else NAN,
    )  # fmt: skip
    return keep_out_message(MESSAGES, content)


def test_a_robot_slows_down_and_stops_where_nothing_is_known():
    told = example('keep_distance')
    scale = told['speed_scale']
    assert told['distance_to_capsules']([0, 0, 1], [0, 0, 1], [0.2]) == pytest.approx(0.8)
    assert told['distance_to_capsules']([3, 4, 0], [3, -4, 0], [1]) == pytest.approx(2.0)
    assert told['distance_to_capsules']([3, -4, 0], [3, 4, 0], [9]) == 0.0
    for message, wanted in (
        (keep_out(KeepOutState.NOBODY), 1.0),
        (keep_out(KeepOutState.UNKNOWN), 0.0),
        (keep_out(KeepOutState.STALE, 9.0), 0.0),
        (keep_out(KeepOutState.TRACKING, 0.4), 0.0),
        (keep_out(KeepOutState.TRACKING, 1.25), 0.5),
        (keep_out(KeepOutState.TRACKING, 9.0), 1.0),
        (keep_out(KeepOutState.LOST, 9.0, 0.4), 1.0),
        (keep_out(KeepOutState.LOST, 9.0, 0.6), 0.0),
    ):
        assert scale(message) == pytest.approx(wanted)


def test_the_nearest_of_several_people_counts():
    nearest = example('keep_distance')['Nearest']()
    # Without a list nothing is known.
    assert nearest.scale(0.0) == 0.0
    nearest.listed = [], 10.0
    assert nearest.scale(10.1) == 1.0
    nearest.listed = ['p1', 'p2'], 10.2
    nearest.scales = {'p1': (0.8, 10.1)}
    assert nearest.scale(10.3) == 0.0
    nearest.scales['p2'] = 0.4, 10.2
    assert nearest.scale(10.3) == 0.4
    # A person no longer on the list counts as long as messages arrive.
    nearest.listed = ['p1'], 10.4
    assert nearest.scale(10.5) == 0.4
    nearest.scales['p1'] = 0.7, 10.8
    nearest.listed = ['p1'], 10.8
    assert nearest.scale(10.9) == 0.7
    assert nearest.scale(11.5) == 0.0


def mixture(*heights, weights=(0.75, 0.25)):
    """Modes with the right wrist at these heights above the head, m, with deviations of 0.05 m."""
    names = ('head', 'left_wrist', 'right_wrist')
    places = [SimpleNamespace(y=0.0), SimpleNamespace(y=0.9)]
    modes = [
        SimpleNamespace(
            weight=weight,
            joint_positions=[*places, SimpleNamespace(y=-height)],
            joint_covariances_relative=[0.0025] * 27,
        )
        for height, weight in zip(heights, weights, strict=True)
    ]
    return SimpleNamespace(state=1, STATE_TRACKING=1, joint_names=list(names), components=modes)


def test_a_raised_hand_is_as_probable_as_its_modes():
    told = example('raised_hand')['raised_hand']
    assert told(mixture(0.5, 0.5)) == pytest.approx(1.0, abs=1e-6)
    assert told(mixture(0.5, -0.5)) == pytest.approx(0.75, abs=1e-6)
    assert told(mixture(0.0, -0.5)) == pytest.approx(0.375, abs=1e-6)
    # One standard deviation of the difference of two joints.
    one = 0.05 * math.sqrt(2.0)
    assert told(mixture(one, one)) == pytest.approx(0.8413, abs=1e-4)
    nobody = mixture(0.5, 0.5)
    nobody.state = 3
    assert math.isnan(told(nobody))


def test_a_forearm_that_points_both_ways_leaves_both_objects_their_share():
    told = example('pointing')['pointing']
    objects = [0.0, 0.0, 1.0, 0.0, 0.0, 5.0, 2.0, 0.0, 3.0]

    def pointed(*ways, weights=(0.7, 0.3), deviation=0.02):
        modes = [
            SimpleNamespace(
                weight=weight,
                joint_positions=[
                    SimpleNamespace(x=0.0, y=0.0, z=3.0), SimpleNamespace(**dict(zip('xyz', way)))
                ],
                joint_covariances_relative=[*(deviation**2 * np.eye(3)).ravel()] * 2,
            )
            for way, weight in zip(ways, weights, strict=False)
        ]  # fmt: skip
        names = ['right_elbow', 'right_wrist']
        return SimpleNamespace(state=1, STATE_TRACKING=1, joint_names=names, components=modes)

    near, far = (0.0, 0.0, 2.75), (0.0, 0.0, 3.25)
    both = told(pointed(near, far), objects)
    assert both[:2] == pytest.approx([0.7, 0.3], abs=0.02)
    assert sum(both) == pytest.approx(1.0)
    assert told(pointed((0.0, 0.25, 3.0), weights=(1.0,)), objects)[-1] > 0.99
    # A very uncertain arm points at no object with certainty.
    vague = told(pointed(near, weights=(1.0,), deviation=0.3), objects)
    assert told(pointed(near, weights=(1.0,)), objects)[0] > vague[0] > vague[1]
    nobody = pointed(near, far)
    nobody.state = 3
    assert len(told(nobody, objects)) == 4
    assert all(map(math.isnan, told(nobody, objects)))


class StandIn(SimpleNamespace):
    """Stand-in for messages of people_msgs, which no distribution of ROS 2 has."""

    def __init__(self, **fields):
        super().__init__(people=[], velocity=SimpleNamespace(x=0.0, y=0.0, z=0.0), **fields)


def test_a_costmap_learns_where_the_person_is():
    body = load_body('human37')
    means = np.tile(body.prior_mean, (2, 1))
    means[:, 0] = [0.0, 1.0]
    velocities = np.zeros_like(means)
    velocities[:, 2] = -1.5
    modes = GaussianMixture([0.6, 0.4], means, [1e-3 * np.eye(body.dimension)] * 2)
    told = example('people_for_costmaps')['people']
    for state, moving in (
        (TrackState.TRACKING, velocities),
        (TrackState.TRACKING, None),
        (TrackState.LOST, velocities),
    ):
        content = PoseMixture.of_body(
            body, modes, MixtureKind.POSTERIOR, 10**9, 'eye', state=state, track_id=2,
            velocities=moving,
        )  # fmt: skip
        made = told(pose_mixture_message(MESSAGES, content), StandIn, StandIn)
        assert made.header.frame_id == 'eye'
        if state is TrackState.LOST:
            assert made.people == []
            continue
        (person,) = made.people
        here = content.joint_positions[0, body.joint_names.index('pelvis')]
        assert (person.name, person.reliability) == ('person_2', pytest.approx(0.6))
        assert [getattr(person.position, axis) for axis in 'xyz'] == pytest.approx(list(here))
        wanted = 0.0 if moving is None else -1.5
        assert vars(person.velocity) == pytest.approx({'x': 0.0, 'y': 0.0, 'z': wanted})


def hands(state, *deviations):
    """A mode without hands nearby, and modes whose hand is deviations of 0.1 m beyond 0.8 m."""
    along, across = np.array([0.6, 0.0, -0.8]), np.array([0.8, 0.0, 0.6])
    covariance = 0.01 * np.outer(along, along) + np.outer(across, across)
    modes = []
    for distance in (5.0, *(0.8 + 0.1 * np.array(deviations))):
        place = SimpleNamespace(**dict(zip('xyz', distance * along, strict=True)))
        modes.append(
            SimpleNamespace(
                weight=0.25 if modes else 1.0 - 0.25 * len(deviations),
                joint_positions=[place, SimpleNamespace(x=9.0, y=0.0, z=0.0), place],
                joint_covariances=[*np.eye(3).ravel(), *np.eye(3).ravel(), *covariance.ravel()],
            )
        )
    return SimpleNamespace(
        state=int(state),
        joint_names=['right_elbow', 'left_wrist', 'right_hand'],
        components=modes,
        **{f'STATE_{each.name}': int(each) for each in TrackState},
    )


def test_an_arm_stops_while_a_hand_may_be_near():
    told = example('stop_near_hand')
    near, must_stop = told['hand_near'], told['must_stop']
    # The elbow does not count.
    assert near(hands(TrackState.TRACKING, 0.0)) == pytest.approx(0.25 * 0.5, abs=1e-9)
    assert near(hands(TrackState.TRACKING, 1.0, -1.0)) == pytest.approx(0.25, abs=1e-9)
    assert near(hands(TrackState.TRACKING, 0.0), 0.9) == pytest.approx(0.25 * 0.8413, abs=1e-4)
    # 0.25 of 19 % is less than 5 %, and 0.25 of 21 % more.
    assert not must_stop(hands(TrackState.TRACKING, 0.8779))
    assert must_stop(hands(TrackState.TRACKING, 0.8064))
    assert must_stop(hands(TrackState.TRACKING, math.nan))
    # Without hands, modes or covariances a hand may be near.
    without_hands, without_modes = hands(TrackState.TRACKING, 9.0), hands(TrackState.TRACKING, 9.0)
    without_covariances = hands(TrackState.TRACKING, 9.0)
    without_hands.joint_names[1:] = ['left_knee', 'left_ankle']
    without_modes.components.clear()
    without_covariances.components[-1].joint_covariances = []
    assert all(map(must_stop, (without_hands, without_modes, without_covariances)))
    for state in TrackState:
        wanted = state not in (TrackState.TRACKING, TrackState.NOBODY)
        assert must_stop(hands(state, 9.0)) == wanted


def stamp_of(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def tracked(name, folder):
    """A bag of the repository, tracked."""
    source, target = ROOT / 'bags' / name, folder / 'tracked'
    options = ReplayOptions(
        subject=source / 'subject.yaml',
        background=source / 'background.png',
        with_smoother=False,
        quiet=True,
    )
    replay_bag(source, target, options, notify=print)
    return target


@pytest.fixture(scope='module')
def demonstration(tmp_path_factory):
    return tracked('living_room', tmp_path_factory.mktemp('demo'))


def test_raised_hands_are_seen(tmp_path):
    """A person has a hand above the head in 12 of 60 images."""
    with BagReader(tracked('reach', tmp_path)) as bag:
        mixtures = [x.message for x in bag.messages(['pose_mixture'])]
    with np.load(ROOT / 'bags' / 'reach' / 'truth.npz') as truth:
        names, joints = list(truth['joint_names']), truth['joints']
    hands = joints[:, [names.index(x) for x in ('left_wrist', 'right_wrist')], 1]
    above = hands.min(1) < joints[:, names.index('head'), 1]
    raised = example('raised_hand')['raised_hand']
    wrong = np.array([raised(x) > 0.5 for x in mixtures]) != above
    assert (above.sum(), wrong.sum() <= 3) == (12, True), wrong.sum()


def test_examples_tell_what_the_demonstration_shows(demonstration):
    """A person 3 to 4 m away points at the camera, then aside, and leaves the view."""
    with np.load(ROOT / 'bags' / 'living_room' / 'truth.npz') as truth:
        names, stamps, until = list(truth['joint_names']), truth['stamps'], truth['until']
        positions = dict(zip(stamps.tolist(), truth['joints']))
    with BagReader(demonstration) as bag:
        mixtures = {stamp_of(x.message): x.message for x in bag.messages(['pose_mixture'])}
        spaces = {stamp_of(x.message): x.message for x in bag.messages(['keep_out'])}
    assert spaces.keys() == positions.keys() > mixtures.keys()
    # While the whole person is in view.
    shown = [t for t in mixtures if t < until[0]]
    assert len(shown) == 44
    seen, joints = [mixtures[t] for t in shown], np.array([positions[t] for t in shown])
    hands = joints[:, [names.index(x) for x in ('left_wrist', 'right_wrist')]]
    raised = example('raised_hand')['raised_hand']
    assert sum(raised(x) > 0.5 for x in seen) <= 1
    pointing = example('pointing')['pointing']
    # Objects: one metre beyond the true hand along the true forearm, and its mirror image.
    elbow = joints[:, names.index('right_elbow')]
    forearm = hands[:, 1] - elbow
    beyond = hands[:, 1] + forearm / np.linalg.norm(forearm, axis=1, keepdims=True)
    found = [
        pointing(x, [*there, *(there * [1.0, 1.0, -1.0] + [0.0, 0.0, 2.0 * hand[2]])])
        for x, there, hand in zip(seen, beyond, hands[:, 1], strict=True)
    ]
    assert np.mean(found, axis=0)[0] > np.mean(found, axis=0)[1]
    stop = example('stop_near_hand')
    assert not any(stop['must_stop'](x) for x in seen)
    near = np.array([stop['hand_near'](x, 3.3) for x in seen])
    distances = np.linalg.norm(hands, axis=-1).min(1)
    assert near[distances < 3.2].mean() > 0.8
    assert near[distances > 3.45].mean() < 0.3
    speeds = {t: example('keep_distance')['speed_scale'](x) for t, x in spaces.items()}
    assert {speeds[t] for t in shown} == {1.0}
    plotted = example('plot_joint')['heights'](demonstration, 'right_wrist', 'pose_mixture')
    found = [w @ x for x, w in zip(plotted[1], plotted[3], strict=True)][: len(shown)]
    true = joints[:, names.index('pelvis'), 1] - hands[:, 1, 1]
    assert np.abs(np.array(found) - true).mean() < 0.1


def python(name):
    return [sys.executable, EXAMPLES / f'{name}.py']


@pytest.fixture(scope='module')
def standing():
    """Publishes messages of a person who stands 3 m away, or lies 1.25 m away."""
    body = load_body('human37')
    pose = body.prior_mean[None].copy()
    pose[:, 2] = 3.0
    posterior = GaussianMixture([1.0], pose, [1e-4 * np.eye(body.dimension)])
    content = PoseMixture.of_body(
        body, posterior, MixtureKind.POSTERIOR, 10**9, 'odom', state=TrackState.TRACKING
    )
    people = [DetectedPerson(name, NO_KEYPOINTS, None) for name in ('p1', 'p2')]
    return {
        'pose_mixture': pose_mixture_message(MESSAGES, content),
        'keep_out': keep_out(KeepOutState.TRACKING, 1.25, frame='odom'),
        'people': people_message(MESSAGES, people, 10**9, 'eye'),
    }


def check_answers(standing, programs):
    """Checks all programs at once, each in its own namespace and process.

    `programs` has by name the command, the topic that it takes, the topic that it publishes with
    its type, and the answer.
    """
    import rclpy
    from hmt_msgs.msg import KeepOut as KeepOutOfRos
    from hmt_msgs.msg import People2D as PeopleOfRos
    from hmt_msgs.msg import PoseMixture as MixtureOfRos

    kinds = {'pose_mixture': MixtureOfRos, 'keep_out': KeepOutOfRos, 'people': PeopleOfRos}
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node('robot', context=context)
    executor = rclpy.executors.SingleThreadedExecutor(context=context)
    executor.add_node(node)
    heard: dict[str, list[float]] = {name: [] for name in programs}
    publishers, processes = [], []

    def hear(name, told):
        if hasattr(told, 'info'):
            heard[name].append(np.mean(np.array(told.data) == 100))
        else:
            heard[name].append(float(np.sum(told.data)))

    for name, (command, source, topic, kind, _) in programs.items():
        node.create_subscription(kind, f'/{name}_lab/{topic}', partial(hear, name), 10)
        publisher = node.create_publisher(kinds[source], f'/{name}_lab/{source}', 10)
        publishers.append((publisher, serialise(standing[source])))
        if source == 'people':
            for person, away in (('p1', 1.25), ('p2', 0.875)):
                place = f'/{name}_lab/humans/bodies/{person}/keep_out'
                message = keep_out(KeepOutState.TRACKING, away, frame='odom')
                publisher = node.create_publisher(KeepOutOfRos, place, 10)
                publishers.append((publisher, serialise(message)))
        words = ['--ros-args', '-r', f'__ns:=/{name}_lab']
        processes.append(subprocess.Popen([*command, *words]))

    def silent():
        return [
            name
            for name, (*_, wanted) in programs.items()
            if not any(abs(x - wanted) < 1e-3 for x in heard[name])
        ]

    end = time.monotonic() + 60.0
    while silent() and time.monotonic() < end:
        for publisher, data in publishers:
            publisher.publish(data)
        for _ in range(4):
            executor.spin_once(timeout_sec=0.05)
    for process in processes:
        # rclpy.spin misses one SIGTERM of some hundreds.
        process.kill()
        process.wait()
    node.destroy_node()
    rclpy.shutdown(context=context)
    assert silent() == [], {name: heard[name][-3:] for name in silent()}


@pytest.mark.ros
def test_examples_answer(standing):
    from nav_msgs.msg import OccupancyGrid
    from std_msgs.msg import Bool, Float64, Float64MultiArray

    programs = {
        'keep_distance': ('keep_out', 'speed_scale', Float64, 0.5),
        'stop_near_hand': ('pose_mixture', 'stop', Bool, 0.0),
        'raised_hand': ('pose_mixture', 'raised_hand', Float64, 0.0),
        'pointing': ('pose_mixture', 'pointing', Float64MultiArray, 1.0),
        'keep_out_grid': ('keep_out', 'keep_out_grid', OccupancyGrid, LYING),
    }
    programs = {name: (python(name), *rest) for name, rest in programs.items()}
    of_people = [*python('keep_distance'), '--ros-args', '-p', 'people:=true']
    programs['keep_distance_from_people'] = (of_people, 'people', 'speed_scale', Float64, 0.25)
    check_answers(standing, programs)
