"""`export`: the motion of a recorded run as a file."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass, replace

import numpy as np
import pytest

from hmt_learning.motion.motion_file import read_motion
from hmt_ros.app import export
from hmt_ros.inference import GaussianMixture
from msg_tools import BagReader, BagWriter, RosbagsMessages
from msg_tools.messages.ground import GroundState, ground_message
from msg_tools.messages.headers import FRAME_ID
from msg_tools.messages.pose_mixtures import (
    POSE_MIXTURE,
    MixtureKind,
    PoseMixture,
    pose_mixture_message,
    pose_mixture_of,
)
from test.app.conftest import STAMPS

MESSAGES = RosbagsMessages()
UP, HEIGHT = np.array([0.0, -0.8, -0.6]), 1.5


@dataclass(frozen=True)
class Step:
    """Weights and identities of the modes at a time; empty if nobody is visible."""

    stamp: int
    weights: tuple[float, ...] = (0.7, 0.3)
    identities: tuple[int, ...] = (1, 2)
    track: int = 1
    thigh: float = 0.41


STEPS = tuple(Step(stamp) for stamp in STAMPS)


def write_run(path, body, poses, steps, *, kind=MixtureKind.SMOOTHED, change=None, grounds=()):
    """Writes a bag of one topic; a second mode is the first with its left elbow bent."""
    elbow = body.dof_names.index('left_elbow')
    topic = kind.name.lower()
    with BagWriter(path) as bag:
        for step, pose in zip(steps, np.resize(poses, (len(steps), body.dimension)), strict=True):
            means = np.tile(pose, (len(step.weights), 1))
            means[1:, elbow] += 0.5
            covariances = np.tile(0.003 * np.eye(body.dimension), (len(means), 1, 1))
            mixture = GaussianMixture(np.array(step.weights), means, covariances)
            content = PoseMixture.of_body(
                body.with_segment_lengths({'thigh': step.thigh}),
                mixture if len(means) else None, kind, step.stamp, FRAME_ID,
                track_id=step.track, identities=np.array(step.identities),
            )  # fmt: skip
            content = content if change is None else change(content)
            bag.write(topic, step.stamp, pose_mixture_message(MESSAGES, content))
        for stamp, up, height in grounds:
            ground = ground_message(MESSAGES, GroundState(stamp, FRAME_ID, up, height=height))
            bag.write('ground', stamp, ground)
    return path


@pytest.fixture(scope='session')
def run(body, poses, tmp_path_factory):
    return write_run(tmp_path_factory.mktemp('run') / 'run', body, poses, STEPS)


def exported(bag, out, *options):
    """Runs the command and returns its file."""
    assert export.main([str(bag), '-o', str(out), '--quiet', *map(str, options)]) == 0
    return out


def arrays(bag, out, *options):
    with np.load(exported(bag, out.with_suffix('.npz'), *options)) as file:
        return dict(file)


def bvh_joints(bag, out, body, *options):
    """Joints (T, J, 3) of a written BVH, y up, and its frames per second."""
    path = exported(bag, out.with_suffix('.bvh'), *options)
    motion = read_motion(path, unit_to_m=1.0, up_axis='y')
    joints = motion.joint_positions(body.joint_names)
    return np.stack([joints[..., 0], joints[..., 2], -joints[..., 1]], axis=-1), motion.fps


def room(joints):
    """Joints in axes like the camera's, with y up."""
    return joints * [1.0, -1.0, -1.0]


def messages(bag, topic):
    with BagReader(bag) as reader:
        return [pose_mixture_of(stored.message) for stored in reader.messages([topic])]


def test_smoothed_poses_are_the_first_choice_and_the_posterior_the_second(
    made, run, body, poses, tmp_path
):
    found = arrays(made.out, tmp_path / 'a')
    wanted = messages(made.out, 'smoothed_pose_mixture')
    heaviest = [int(np.argmax(one.weights)) for one in wanted]
    joints = [one.joint_positions[k] for one, k in zip(wanted, heaviest, strict=True)]
    np.testing.assert_array_equal(found['joints'], joints)
    np.testing.assert_array_equal(found['stamps'], STAMPS)
    assert (found['body_model'], found['frame_id']) == ('human37', FRAME_ID)
    posterior = arrays(made.out, tmp_path / 'b', '--topic', 'pose_mixture')
    assert not np.array_equal(posterior['joints'], found['joints'])
    wanted = arrays(run, tmp_path / 'c')['joints']
    for kind in (MixtureKind.POSTERIOR, MixtureKind.PREDICTION):
        alone = write_run(tmp_path / kind.name, body, poses, STEPS, kind=kind)
        np.testing.assert_array_equal(
            arrays(alone, tmp_path / 'd', '--overwrite')['joints'], wanted
        )


def test_arrays_hold_what_the_messages_hold(run, body, poses, tmp_path):
    found = arrays(run, tmp_path / 'run')
    (first, *_) = messages(run, 'smoothed')
    assert first.covariances is not None
    assert first.joint_covariances is not None
    np.testing.assert_allclose(found['poses'], poses)
    np.testing.assert_array_equal(found['weights'], [0.7] * len(STAMPS))
    np.testing.assert_array_equal(found['identities'], [1] * len(STAMPS))
    np.testing.assert_array_equal(found['covariances'][0], first.covariances[0])
    np.testing.assert_array_equal(found['joint_covariances'][0], first.joint_covariances[0])
    assert found['dof_names'].tolist() == list(body.dof_names)
    assert found['joint_names'].tolist() == list(body.joint_names)
    assert dict(zip(found['segment_names'], found['segment_lengths'][0])) == first.segment_lengths
    assert found['track_id'] == 1


def test_a_table_has_positions_and_the_radii_of_their_regions(run, body, tmp_path):
    (first, *_) = messages(run, 'smoothed')
    with exported(run, tmp_path / 'run.csv').open() as file:
        rows = list(csv.DictReader(file))
    assert [row['stamp'] for row in rows] == [f'{t // 10**9}.{t % 10**9:09d}' for t in STAMPS]
    assert {row['weight'] for row in rows} == {'0.70000'}
    wrist = body.joint_names.index('left_wrist')
    found = [float(rows[0][f'left_wrist_{axis}']) for axis in 'xyz']
    np.testing.assert_allclose(found, first.joint_positions[0, wrist], atol=1e-5)
    radius = float(rows[0]['left_wrist_radius_90'])
    drawn = np.random.default_rng(0).multivariate_normal(
        np.zeros(3), first.joint_covariances[0, wrist], 20_000
    )
    # The sphere encloses the region and contains a little more.
    assert 0.9 <= (np.linalg.norm(drawn, axis=1) < radius).mean() < 0.97


def test_skeletons_have_the_joints_of_the_messages(run, body, poses, tmp_path):
    found, fps = bvh_joints(run, tmp_path / 'run', body)
    assert fps == pytest.approx(10.0)
    wanted = arrays(run, tmp_path / 'run')['joints']
    assert np.abs(found - room(wanted)).max() < 1e-4


def test_one_motion_is_followed_through_its_gaps(body, poses, tmp_path, capsys):
    steps = list(STEPS)
    steps[2] = Step(STAMPS[2], identities=(1, 3))
    steps[3] = Step(STAMPS[3], weights=(), identities=())
    steps[-1] = Step(STAMPS[-1], identities=(2, 1))
    bag = write_run(tmp_path / 'bag', body, poses, steps)
    found = arrays(bag, tmp_path / 'two', '--identity', 2)
    left = [0, 1, 4, 5, 6]
    np.testing.assert_array_equal(found['stamps'], np.array(STAMPS)[left])
    np.testing.assert_allclose(found['weights'], [0.3, 0.3, 0.3, 0.3, 0.7])
    assert export.main([str(bag), '-o', str(tmp_path / 'two.bvh'), '--identity', '2']) == 0
    out = capsys.readouterr().out
    assert 'two.bvh: 5 poses over 0.60 s at 10 a second, of /smoothed\n' in out
    assert 'motion 2 of track 1' in out
    assert 'gaps: 1, the longest 0.30 s' in out
    # The gap is interpolated, so the number of frames is that without a gap.
    assert 'Frames: 7\n' in (tmp_path / 'two.bvh').read_text()
    assert export.main([str(bag), '-o', str(tmp_path / 'all.npz')]) == 0
    assert (
        'changes from one motion to another: 1; a joint moves by up to' in capsys.readouterr().out
    )


def test_the_longest_track_is_taken_or_the_one_that_is_named(body, poses, tmp_path, capsys):
    steps = [Step(t, track=3 if i < 2 else 4 if i < 5 else 5) for i, t in enumerate(STAMPS)]
    bag = write_run(tmp_path / 'bag', body, poses, steps)
    assert export.main([str(bag), '-o', str(tmp_path / 'a.csv')]) == 0
    out = capsys.readouterr().out
    assert 'a.csv: 3 poses over 0.20 s, of /smoothed\n' in out
    assert 'heaviest modes of track 4' in out
    assert 'it ends 0.20 s before the topic does' in out
    assert 'several tracks, 3 (2 poses), 4 (3 poses), 5 (2 poses): --track chooses one' in out
    found = arrays(bag, tmp_path / 'b', '--track', 3)
    np.testing.assert_array_equal(found['stamps'], STAMPS[:2])
    assert found['track_id'] == 3


def test_skeletons_stand_on_the_floor(body, poses, tmp_path, capsys):
    grounds = [(stamp, UP, HEIGHT) for stamp in STAMPS]
    bag = write_run(tmp_path / 'bag', body, poses, STEPS, grounds=grounds)
    joints = arrays(bag, tmp_path / 'a')['joints']
    found, _ = bvh_joints(bag, tmp_path / 'a', body)
    np.testing.assert_allclose(found[..., 1], joints @ UP + HEIGHT, atol=1e-4)
    # Away from the camera is -z; to the right of the image is x.
    np.testing.assert_allclose(found[..., 0], joints[..., 0], atol=1e-4)
    assert (found[..., 2] < 0).all()
    camera, _ = bvh_joints(bag, tmp_path / 'b', body, '--camera-axes')
    np.testing.assert_allclose(camera, room(joints), atol=1e-4)
    assert export.main([str(bag), '-o', str(tmp_path / 'c.bvh')]) == 0
    assert 'upright, the floor at y = 0\n' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('grounds', 'told'),
    [
        ((), 'in the axes of camera_optical_frame, turned to y up: its gravity is not known'),
        (((STAMPS[0], UP, None),), 'upright, the camera at y = 0\n'),
        (
            ((STAMPS[0], UP, None), (STAMPS[1], UP * [1, 1, -1], None)),
            'the camera moved: gravity turned by up to 37 degrees from its mean',
        ),
    ],
    ids=['none', 'no floor', 'a camera that moves'],
)
def test_what_is_known_of_gravity_is_told(body, poses, tmp_path, capsys, grounds, told):
    bag = write_run(tmp_path / 'bag', body, poses, STEPS, grounds=grounds)
    assert export.main([str(bag), '-o', str(tmp_path / 'd.bvh')]) == 0
    assert told in capsys.readouterr().out


def test_a_body_that_is_not_known_leaves_tables(body, poses, tmp_path, capsys):
    bag = write_run(
        tmp_path / 'bag', body, poses, STEPS,
        change=lambda content: replace(content, body_model='giant'),
    )  # fmt: skip
    exported(bag, tmp_path / 'a.csv')
    assert export.main([str(bag), '-o', str(tmp_path / 'a.bvh')]) == 1
    assert "the body 'giant' is not known: name its model with --body" in capsys.readouterr().err
    exported(bag, tmp_path / 'a.bvh', '--body', 'human37')


@pytest.mark.parametrize(
    ('out', 'options', 'said'),
    [
        ('a.fbx', [], "a.fbx ends in '.fbx', wanted one of .bvh .csv .npz"),
        ('a', [], "ends in '', wanted one of"),
        ('a.csv', ['--fps', '10'], '--fps is for .bvh: a .csv has the stamps of the recording'),
        ('a.bvh', ['--topic', 'elsewhere'], 'has no topic elsewhere; it has /smoothed'),
        ('a.bvh', ['--identity', '9'], 'has no motion of identity 9; the longest are 1, 2'),
        ('a.bvh', ['--track', '7'], 'has no track 7; it has [1]'),
        ('a.bvh', ['--identity', 'x'], 'wanted a whole number from 1 to 9223372036854775807'),
        ('no/a.bvh', [], 'no/a.bvh can not be written: its folder is missing or not writable'),
        ('folder.bvh', ['--overwrite'], 'folder.bvh is not replaced: it is a link or no file'),
        ('link.bvh', [], 'link.bvh exists; give another name, or --overwrite'),
        ('link.bvh', ['--overwrite'], 'link.bvh is not replaced: it is a link or no file'),
        ('there.bvh', [], 'there.bvh exists; give another name, or --overwrite'),
    ],
)
def test_bad_input_is_one_line(run, tmp_path, capsys, out, options, said):
    (tmp_path / 'folder.bvh').mkdir()
    (tmp_path / 'there.bvh').write_text('mine')
    (tmp_path / 'link.bvh').symlink_to(tmp_path / 'elsewhere')
    assert export.main([str(run), '-o', str(tmp_path / out), *options]) == 1
    error = capsys.readouterr().err
    assert said in error
    assert not (tmp_path / 'elsewhere').exists()
    assert error.count('\n') == 1
    assert (tmp_path / 'there.bvh').read_text() == 'mine'


def test_recordings_without_a_motion(made, body, poses, tmp_path, capsys):
    out = str(tmp_path / 'a.bvh')
    empty = [Step(stamp, weights=(), identities=()) for stamp in STAMPS]
    nobody = write_run(tmp_path / 'nobody', body, poses, empty)
    likely = write_run(tmp_path / 'likely', body, poses, STEPS, kind=MixtureKind.LIKELIHOOD)
    plain = write_run(tmp_path / 'plain', body, poses, [Step(x, identities=(0, 0)) for x in STAMPS])
    unmet = tmp_path / 'unmet'
    with BagWriter(unmet) as bag:
        bag.add_topic('pose_mixture', POSE_MIXTURE)
        bag.write('note', STAMPS[0], MESSAGES.create('std_msgs/msg/String', data='nobody came'))
    two = tmp_path / 'two'
    with BagWriter(two) as bag:
        for name in ('p1', 'p2'):
            for content in messages(likely, 'likelihood'):
                content = replace(content, kind=MixtureKind.SMOOTHED)
                message = pose_mixture_message(MESSAGES, content)
                bag.write(f'{name}/smoothed', content.stamp_ns, message)
    for bag, options, said in (
        (nobody, [], r'nobody is seen in any mixture$'),
        (unmet, [], r'no predictions: nobody is found in its images$'),
        (likely, [], r'no posterior and no predictions: --topic one of /likelihood$'),
        (made.images, [], r'it has no mixtures over poses$'),
        (plain, ['--identity', '1'], r'its modes have no identities$'),
        (two, [], r'has several motions: --topic one of /p1/smoothed, /p2/smoothed$'),
        (made.out, ['--topic', 'trajectory_mixture'], r'wanted PoseMixture$'),
        (tmp_path / 'nowhere', [], r'nowhere'),
    ):
        assert export.main([str(bag), '-o', out, *options]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert re.search(said, line), line
    exported(likely, out, '--topic', 'likelihood')
