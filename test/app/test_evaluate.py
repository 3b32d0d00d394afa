"""The command evaluate, on small bags of synthetic mixtures with known truth."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from hmt_learning.app.rendered_bag import ground_truth
from hmt_ros.app.evaluate import main, table
from hmt_ros.body import load_body
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS, joint_mixtures, score
from hmt_ros.inference import GaussianMixture
from msg_tools import BagReader, BagWriter, RosbagsMessages
from msg_tools.messages.bodies import message_of_body
from msg_tools.messages.ground import GroundState, ground_message
from msg_tools.messages.headers import FRAME_ID, START_NS
from msg_tools.messages.pose_mixtures import MixtureKind, PoseMixture, pose_mixture_message
from msg_tools.messages.trajectory_mixtures import TrajectoryMixture, trajectory_mixture_message

MESSAGES = RosbagsMessages()
FRAMES = 6
STAMPS = [START_NS + i * 33_333_333 for i in range(FRAMES)]


@pytest.fixture(scope='module')
def body():
    return load_body('human37').with_stature(1.82)


@pytest.fixture(scope='module')
def poses(body):
    """True poses (T, d)."""
    rng = np.random.default_rng(0)
    poses = np.clip(rng.normal(0, 0.2, (FRAMES, body.dimension)), body.lower, body.upper)
    poses[:, 2] = 4.0
    return poses


@pytest.fixture(scope='module')
def mixtures(body, poses):
    """Mixtures of two components near the true poses."""
    rng = np.random.default_rng(1)
    return [
        GaussianMixture(
            [0.7, 0.3],
            pose + 0.05 * rng.normal(size=(2, body.dimension)),
            np.tile(0.003 * np.eye(body.dimension), (2, 1, 1)),
        )
        for pose in poses
    ]


@pytest.fixture(scope='module')
def truth_file(tmp_path_factory, body, poses):
    path = tmp_path_factory.mktemp('truth') / 'truth.npz'
    np.savez(
        path,
        stamps=np.array(STAMPS),
        joint_names=np.array(body.joint_names),
        joints=body.joint_positions(poses),
    )
    return path


def mixture_message(body, mixture, stamp, kind=MixtureKind.POSTERIOR, frame_id=FRAME_ID, name=None):
    content = PoseMixture.of_body(body, mixture, kind, stamp, frame_id)
    return pose_mixture_message(MESSAGES, replace(content, body_model=name or body.name))


def write(path, body, mixtures, *, poses=None, with_body=True, change=None):
    """A bag with the topics body, pose_mixture and, with poses, ground_truth."""
    with BagWriter(path) as bag:
        if with_body:
            bag.write('body', START_NS, message_of_body(MESSAGES, body, START_NS, FRAME_ID))
        for i, (stamp, mixture) in enumerate(zip(STAMPS, mixtures)):
            message = mixture_message(body, mixture, stamp)
            bag.write('pose_mixture', stamp, message if change is None else change(message))
            if poses is not None:
                joints = body.joint_positions(poses[i : i + 1])[0]
                bag.write(
                    'ground_truth', stamp, ground_truth(MESSAGES, body, poses[i], joints, stamp)
                )
    return path


@pytest.fixture(scope='module')
def bag(tmp_path_factory, body, poses, mixtures):
    return write(tmp_path_factory.mktemp('bags') / 'out', body, mixtures, poses=poses)


def run(capsys, *arguments):
    """Runs the command; returns its exit code, its output and its lines on stderr."""
    code = main([str(x) for x in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err.splitlines()


def report(capsys, *arguments):
    code, out, errors = run(capsys, *arguments, '--json')
    assert (code, errors) == (0, [])
    return json.loads(out)


def relative(body, joints):
    which = body.skeleton.joint_index(EVALUATED_JOINTS)
    return joints[:, which] - joints[:, [body.joint_names.index('pelvis')]]


def without_names(summary):
    """Numbers of a summary, without those of absolute positions, which are not tested here."""
    numbers = {key: value for key, value in summary.items() if not isinstance(value, (str, dict))}
    return {key: value for key, value in numbers.items() if not key.startswith('absolute')}


def test_numbers_are_those_of_the_library(capsys, bag, body, poses, mixtures, truth_file):
    result = report(capsys, bag, '--truth', truth_file)
    truth = relative(body, body.joint_positions(poses))
    wanted = score(joint_mixtures(body, mixtures), truth, seed=0).summary()
    assert list(result['topics']) == ['/pose_mixture']
    found = result['topics']['/pose_mixture']
    assert found['kind'] == 'posterior'
    assert (found['frames'], found['missing'], found['without_truth']) == (FRAMES, 0, 0)
    for key, value in without_names(wanted).items():
        assert found[key] == pytest.approx(value, rel=1e-9), key
    assert list(found['by_joint']) == list(EVALUATED_JOINTS)
    for joint, values in wanted['by_joint'].items():
        assert found['by_joint'][joint] == pytest.approx(values)


def test_truth_from_the_bag_itself_and_from_another_bag(capsys, bag, truth_file):
    from_file = report(capsys, bag, '--truth', truth_file)
    from_bag = report(capsys, bag)
    assert from_bag['topics'] == from_file['topics']
    assert from_bag['truth'] == f'{bag} (/ground_truth)'
    assert report(capsys, bag, '--truth', bag)['topics'] == from_file['topics']


def test_table_for_people(capsys, bag, truth_file):
    code, out, errors = run(capsys, bag, '--truth', truth_file)
    assert (code, errors) == (0, [])
    lines = out.splitlines()
    summary = report(capsys, bag, '--truth', truth_file)['topics']['/pose_mixture']
    (row,) = (line.split() for line in lines if line.startswith('/pose_mixture'))
    assert row[1:7] == [
        str(FRAMES),
        '0',
        '2.0',
        *(f'{summary[f"{key}_mm"]:.0f}' for key in ('heaviest', 'best', 'expected')),
    ]
    assert max(map(len, lines)) <= 120
    assert [line.split()[0] for line in lines[-13:]] == list(EVALUATED_JOINTS)


def test_a_bag_without_body(capsys, tmp_path, body, mixtures, bag, truth_file):
    """Mixtures contain the lengths of a known model; for other models only errors are scored."""

    def of_a_stranger(message):
        message.body_model = 'stranger'
        return message

    wanted = report(capsys, bag, '--truth', truth_file)['topics']['/pose_mixture']
    path = write(tmp_path / 'known', body, mixtures, with_body=False)
    found = report(capsys, path, '--truth', truth_file)['topics']['/pose_mixture']
    for name in ('best_mm', 'coverage_90', 'negative_log_likelihood'):
        assert found[name] == pytest.approx(wanted[name])
    path = write(tmp_path / 'unknown', body, mixtures, with_body=False, change=of_a_stranger)
    found = report(capsys, path, '--truth', truth_file)['topics']['/pose_mixture']
    assert found['best_mm'] == pytest.approx(wanted['best_mm'])
    assert found['coverage_90'] is None
    assert found['negative_log_likelihood'] is None
    assert 'body' in found['note']
    code, out, _ = run(capsys, path, '--truth', truth_file)
    assert code == 0
    assert out.splitlines()[-1].startswith('/pose_mixture: its body is unknown')


@pytest.mark.parametrize('torn', [False, True])
def test_mixtures_carry_the_lengths(capsys, tmp_path, body, mixtures, truth_file, torn):
    """The bag's body is of another person; joints in other places are detected."""
    path = tmp_path / 'out'
    with BagWriter(path) as bag:
        other = body.with_stature(1.6)
        bag.write('body', START_NS, message_of_body(MESSAGES, other, START_NS, FRAME_ID))
        for stamp, mixture in zip(STAMPS, mixtures):
            message = mixture_message(body, mixture, stamp)
            message.components[0].joint_positions[5].x += 0.2 * torn
            bag.write('pose_mixture', stamp, message)
    found = report(capsys, path, '--truth', truth_file)['topics']['/pose_mixture']
    note = 'joint positions are not those of the body human37 of the bag'
    assert found['note'] == (note if torn else '')
    assert (found['coverage_90'] is None) == torn


def test_a_bag_of_nobody_and_a_truth_without_anybody(
    capsys, tmp_path, bag, body, poses, mixtures, truth_file
):
    empty = write(tmp_path / 'none', body, mixtures, change=without_components)
    found = report(capsys, empty, '--truth', truth_file)['topics']['/pose_mixture']
    assert (found['frames'], found['missing']) == (0, FRAMES)
    assert found['best_mm'] is None
    assert found['by_joint']['neck']['best_mm'] is None
    assert run(capsys, empty, '--truth', truth_file)[0] == 0
    # Nobody is in view at the first two times.
    joints = body.joint_positions(poses)
    joints[:2] = np.nan
    late = save(
        tmp_path / 'late.npz', stamps=STAMPS, joint_names=np.array(body.joint_names), joints=joints
    )
    found = report(capsys, bag, '--truth', late)
    assert found['truth_frames'] == FRAMES - 2
    assert found['topics']['/pose_mixture']['without_truth'] == 2
    known = write(tmp_path / 'known', body, mixtures, poses=poses)
    with BagReader(known) as source, BagWriter(tmp_path / 'truth') as out:
        for i, stored in enumerate(source.messages(['ground_truth'])):
            out.write('ground_truth', stored.log_time_ns, (
                without_components(stored.message) if i < 2 else stored.message
            ))  # fmt: skip
    assert report(capsys, bag, '--truth', tmp_path / 'truth')['truth_frames'] == FRAMES - 2


def without_components(message):
    message.components = []
    return message


def test_every_topic_gets_a_row_and_one_can_be_chosen(
    capsys, tmp_path, body, poses, mixtures, truth_file
):
    path = tmp_path / 'out'
    kinds = {
        'p/pose_mixture': MixtureKind.POSTERIOR,
        'p/likelihood_mixture': MixtureKind.LIKELIHOOD,
        'p/smoothed_pose_mixture': MixtureKind.SMOOTHED,
    }
    with BagWriter(path) as bag:
        bag.write('p/body', START_NS, message_of_body(MESSAGES, body, START_NS, FRAME_ID))
        for stamp, mixture in zip(STAMPS, mixtures):
            for topic, kind in kinds.items():
                bag.write(topic, stamp, mixture_message(body, mixture, stamp, kind))
    result = report(capsys, path, '--truth', truth_file)['topics']
    assert {name: found['kind'] for name, found in result.items()} == {
        f'/{topic}': kind.name.lower() for topic, kind in kinds.items()
    }
    likelihood, smoothed = list(result.values())[1:]
    assert without_names(likelihood) == without_names(smoothed)
    one = report(capsys, path, '--truth', truth_file, '--topic', '/p/smoothed_pose_mixture')
    assert list(one['topics']) == ['/p/smoothed_pose_mixture']
    # A relative name is enough if one namespace has it.
    assert one == report(capsys, path, '--truth', truth_file, '--topic', 'smoothed_pose_mixture')
    code, out, _ = run(capsys, path, '--truth', truth_file)
    assert code == 0
    assert sum(line.startswith('/p/') for line in out.splitlines()) == 3


@pytest.mark.parametrize('with_covariances', [True, False])
def test_marginals_of_trajectories(capsys, tmp_path, body, mixtures, truth_file, with_covariances):
    """Windows overlap; the newest one is used for each frame."""
    path = tmp_path / 'out'

    def window(first, last, shift):
        chosen = mixtures[first:last]
        return TrajectoryMixture(
            weights=chosen[0].weights,
            means=np.stack([m.means for m in chosen], axis=1) + shift,
            marginal_covariances=np.stack([m.covariances for m in chosen], axis=1)
            if with_covariances
            else None,
            log_joint=np.zeros(2),
            inflation=np.ones(2),
            stamps_ns=tuple(STAMPS[first:last]),
            final_until_ns=STAMPS[first],
            free_energy=np.zeros(0),
            body_model=body.name,
            dof_names=body.dof_names,
            frame_id=FRAME_ID,
        )

    with BagWriter(path) as bag:
        bag.write('body', START_NS, message_of_body(MESSAGES, body, START_NS, FRAME_ID))
        for first, last, shift in ((0, 4, 0.5), (0, 5, 0.0), (3, 6, 0.0)):
            message = trajectory_mixture_message(MESSAGES, window(first, last, shift))
            bag.write('trajectory_mixture', STAMPS[last - 1], message)
        for stamp, mixture in zip(STAMPS, mixtures):
            bag.write('pose_mixture', stamp, mixture_message(body, mixture, stamp))
    topics = report(capsys, path, '--truth', truth_file)['topics']
    found, wanted = topics['/trajectory_mixture'], topics['/pose_mixture']
    assert found['kind'] == 'trajectories'
    assert found['frames'] == FRAMES
    for key in ('heaviest_mm', 'best_mm', 'expected_mm'):
        assert found[key] == pytest.approx(wanted[key])
    if with_covariances:
        assert found['negative_log_likelihood'] == pytest.approx(wanted['negative_log_likelihood'])
    else:
        assert found['coverage_90'] is None


def save(path, **arrays):
    np.savez(path, **arrays)
    return path


def test_truth_that_can_not_be_used(capsys, tmp_path, bag, body):
    good = {
        'stamps': np.array(STAMPS),
        'joint_names': np.array(body.joint_names),
        'joints': np.zeros((FRAMES, len(body.joint_names), 3)),
    }
    text = tmp_path / 'text.npz'
    text.write_text('no arrays')
    infinite = good['joints'].copy()
    infinite[2, 3, 1] = math.nan
    cases = {
        'can not be read': tmp_path / 'nowhere.npz',
        'no truth file': text,
        "no ['joints']": save(
            tmp_path / 'a.npz', **{k: good[k] for k in ('stamps', 'joint_names')}
        ),
        '5 stamps': save(tmp_path / 'b.npz', **{**good, 'stamps': good['stamps'][:5]}),
        'whole nanoseconds': save(tmp_path / 'c.npz', **{**good, 'stamps': good['stamps'] * 1e-9}),
        'not finite': save(tmp_path / 'd.npz', **{**good, 'joints': infinite}),
        'neither a pelvis nor left_hip and right_hip': save(
            tmp_path / 'e.npz', **{**good, 'joint_names': np.char.add(good['joint_names'], '_')}
        ),
        'wanted at least 4': save(
            tmp_path / 'f.npz',
            stamps=good['stamps'],
            joint_names=['pelvis', 'neck'],
            joints=good['joints'][:, :2],
        ),
        'no stamp of /pose_mixture': save(
            tmp_path / 'g.npz', **{**good, 'stamps': good['stamps'] + 1}
        ),
        'wanted (19, 3)': save(tmp_path / 'h.npz', **{**good, 'joints': good['joints'][:, :5]}),
    }
    for wanted, path in cases.items():
        code, out, errors = run(capsys, bag, '--truth', path)
        assert (code, out, len(errors)) == (1, '', 1), wanted
        assert errors[0].startswith('evaluate: ')
        assert wanted in errors[0]


def test_bags_that_can_not_be_used(capsys, tmp_path, bag, body, mixtures, truth_file):
    empty = tmp_path / 'empty'
    with BagWriter(empty) as out:
        out.write('note', START_NS, MESSAGES.create('std_msgs/msg/String', data='nothing'))
    silent = write(tmp_path / 'silent', body, mixtures)
    broken = tmp_path / 'broken.mcap'
    content = (bag / 'out.mcap').read_bytes()
    broken.write_bytes(content[: len(content) // 2])

    def in_map(message):
        message.header.frame_id = 'map'
        return message

    def nameless(message):
        message.joint_names = [f'{name}_' for name in message.joint_names]
        return message

    def heavy(message):
        message.components[0].weight = 3.0
        return message

    cases = [
        ('can not be read', [tmp_path / 'nowhere', '--truth', truth_file]),
        ('no pose mixtures', [empty, '--truth', truth_file]),
        ('no ground truth', [silent]),
        ('no ground truth', [bag, '--truth', silent]),
        ('broken.mcap', [broken, '--truth', truth_file]),
        ('no topic smoothed', [bag, '--topic', 'smoothed']),
        ('no mixtures to evaluate', [bag, '--topic', 'ground_truth']),
        ("frame 'map'", [write(tmp_path / 'map', body, mixtures, change=in_map), '--truth', bag]),
        (
            'has no joints',
            [write(tmp_path / 'joints', body, mixtures, change=nameless), '--truth', bag],
        ),
        ('sum to', [write(tmp_path / 'heavy', body, mixtures, change=heavy), '--truth', bag]),
        ('--model-sigma', [bag, '--model-sigma', '-1']),
        ('no body', [bag, '--body', 'human99']),
        ('--seed', [bag, '--seed', '-1']),
        ('unrecognized', [bag, '--frobnicate']),
    ]
    for wanted, arguments in cases:
        code, out, errors = run(capsys, *arguments)
        assert (code, out, len(errors)) == (1, '', 1), (wanted, errors)
        assert errors[0].startswith('evaluate: ')
        assert wanted in errors[0], errors[0]


def test_table_of_hostile_names_is_one_of_short_rows():
    lines = table([('a\n\x1b[2Jb', '1.0'), (10_000 * 'x', '22.0')])
    assert lines[0].rstrip() == r'a \x1b[2Jb' + 52 * ' ' + ' 1.0'
    assert lines[1].endswith('xxx  22.0')
    assert len(lines[1]) == 66


def test_feet_against_the_floor(tmp_path, body, mixtures, truth_file, capsys):
    with np.load(truth_file) as known:
        content = dict(known)
    content['gravity'] = np.tile([0.0, 1.0, 0.0], (FRAMES, 1))
    # A floor above every foot.
    feet = [i for i, name in enumerate(body.joint_names) if name.endswith(('ankle', 'toe'))]
    content['camera_height'] = np.full(FRAMES, content['joints'][:, feet, 1].min() - 0.5)
    content['contact'] = np.ones((FRAMES, 2))
    truth = tmp_path / 'truth.npz'
    np.savez(truth, **content)
    bag = write(tmp_path / 'bag', body, mixtures)
    assert main([str(bag), '--truth', str(truth), '--quiet', '--json']) == 0
    found = json.loads(capsys.readouterr().out)['topics']['/pose_mixture']['feet']
    assert found['fraction_below_floor'] == 1.0
    assert found['below_floor_mm'] > 300.0
    assert found['sliding_m_per_s'] > 0.0
    assert found['frames'] == FRAMES
    assert main([str(bag), '--truth', str(truth), '--quiet']) == 0
    assert '/pose_mixture: standing ankles slide' in capsys.readouterr().out
    assert main([str(bag), '--truth', str(truth_file), '--quiet', '--json']) == 0
    assert 'feet' not in json.loads(capsys.readouterr().out)['topics']['/pose_mixture']


def test_the_vertical_against_gravity(tmp_path, body, mixtures, truth_file, capsys):
    with np.load(truth_file) as known:
        content = dict(known)
    content['gravity'] = np.tile([0.0, 9.81, 0.0], (FRAMES, 1))
    content['camera_height'] = np.ones(FRAMES)
    truth = tmp_path / 'truth.npz'
    np.savez(truth, **content)
    path = tmp_path / 'bag'
    with BagWriter(path) as bag:
        for stamp, mixture in zip(STAMPS, mixtures):
            bag.write('pose_mixture', stamp, mixture_message(body, mixture, stamp))
            up = np.array([0.0, -np.cos(0.1), np.sin(0.1)])
            state = GroundState(stamp, FRAME_ID, up, up_sigma=0.07)
            bag.write('ground', stamp, ground_message(MESSAGES, state))
    assert main([str(path), '--truth', str(truth), '--quiet', '--json']) == 0
    found = json.loads(capsys.readouterr().out)['gravity']
    assert found == {
        '/ground': {
            'error_degrees': pytest.approx(np.degrees(0.1)),
            'said_degrees': pytest.approx(np.degrees(0.07)),
            'frames': FRAMES,
        }
    }
    assert main([str(path), '--truth', str(truth), '--quiet']) == 0
    line = (
        '/ground: the vertical errs by 5.7 degrees (median), and is said to be known to 4.0 degrees'
    )
    assert line in capsys.readouterr().out.splitlines()
    # A truth without gravity has no score.
    assert main([str(path), '--truth', str(truth_file), '--quiet', '--json']) == 0
    assert json.loads(capsys.readouterr().out)['gravity'] == {}
