"""Two people: from a bag with images to a bag with results."""

import numpy as np
import pytest

from hmt_learning.app.make_bag import main as make_bag
from hmt_learning.app.rendered_bag import PEOPLE
from hmt_ros.app.replay.command import main
from hmt_ros.app.truth import read_truth
from msg_tools import BagReader
from msg_tools.messages.detections import people_of_message
from msg_tools.messages.pose_mixtures import pose_mixture_of

SMALL = [
    'evaluation_budget=150',
    'max_hypotheses=4',
]


@pytest.fixture(scope='module')
def crossing(tmp_path_factory):
    folder = tmp_path_factory.mktemp('people') / 'crossing'
    arguments = ['--duration', '3', '--fps', '8', '--size', '240x180', '--seed', '1', '--quiet']
    assert make_bag(['crossing', '-o', str(folder), *arguments]) == 0
    return folder


def test_a_bag_of_two_people(crossing):
    with BagReader(crossing) as bag:
        assert set(bag.topics) == {
            '/image/compressed', '/camera_info', '/detections', '/tf_static',
            *(f'/humans/bodies/{name}/ground_truth' for name in PEOPLE),
        }  # fmt: skip
        messages = [x.message for x in bag.messages(['/detections'])]
    people = [people_of_message(message, 0.0) for message in messages]
    assert len(people) == 24
    assert all(person.name == '' for found in people for person in found)
    assert {len(found) for found in people} <= {1, 2}
    assert sum(len(found) == 2 for found in people) > 18
    # Neither the order nor the number of joints identifies the people.
    first = [found[0].keypoints.pixels[found[0].keypoints.seen, 0].mean() for found in people[:8]]
    assert np.ptp(first) > 60
    hidden = min(person.keypoints.seen.sum() for found in people for person in found)
    assert hidden < 15


def nearest_person(truths, bag, name, chosen):
    """The person whom a track is nearest to in most of the chosen images, and its images."""
    votes, stamps = [], set()
    for stored in bag.messages([f'/humans/bodies/{name}/pose_mixture']):
        found = pose_mixture_of(stored.message)
        stamps.add(found.stamp_ns)
        if found.stamp_ns in chosen:
            place = found.joint_positions[0, found.joint_names.index('pelvis')]
            away = [
                place - truth.joints[found.stamp_ns][truth.joint_names.index('pelvis')]
                for truth in truths
            ]
            votes.append(int(np.argmin(np.linalg.norm(away, axis=1))))
    return max(set(votes), key=votes.count), stamps


def test_both_keep_their_tracks(crossing, tmp_path, capsys):
    settings = [word for each in SMALL for word in ('--set', each)]
    target = tmp_path / 'tracked'
    command = [str(crossing), '-o', str(target), '--people', '--quiet', *settings]
    background = ['--background', str(crossing / 'background.png')]
    assert main([*command, *background]) == 0, capsys.readouterr().err
    truths = [read_truth(crossing / f'truth_{name}.npz') for name in PEOPLE]
    every = sorted(truths[0].joints)
    early, late = every[:8], every[18:]
    with BagReader(target) as bag:
        tracks = sorted(x for x in bag.topics if x.endswith('/pose_mixture'))
        assert len(tracks) == 2
        owners = []
        for name in (x.split('/')[3] for x in tracks):
            owner, stamps = nearest_person(truths, bag, name, early)
            assert nearest_person(truths, bag, name, late)[0] == owner
            assert set(late) <= stamps
            owners.append(owner)
        assert sorted(owners) == [0, 1]
        assert {'/people', '/detections', '/humans/bodies/p2/body', '/tf'} <= set(bag.topics)
        latched = bag.topics['/humans/bodies/p2/body']
        assert latched.message_count >= 1


@pytest.mark.parametrize(
    ('arguments', 'text'),
    [
        (['--live'], '--live does not go with --people'),
        (['--subject', 'x.yaml'], '--subject does not go with --people'),
        (['--set', 'use_predictions=true'], 'people_node takes no input of one person'),
        (['--set', 'max_people=0'], 'max_people must lie between 1 and 20'),
    ],
)
def test_what_does_not_go_with_people(crossing, tmp_path, capsys, arguments, text):
    assert main([str(crossing), '-o', str(tmp_path / 'x'), '--people', *arguments]) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert text in line


def test_a_bag_without_detections(tmp_path, capsys, monkeypatch):
    from test.test_docs import ROOT

    assert main([str(ROOT / 'bags' / 'reach'), '-o', str(tmp_path / 'x'), '--people']) == 1
    assert '--people needs the topic detections' in capsys.readouterr().err
