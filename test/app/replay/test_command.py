"""replay, offline."""

import copy
import sys
from operator import itemgetter
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from hmt_ros.app.replay.command import main
from hmt_ros.app.replay.inputs import recorded_input
from hmt_ros.body import load_body
from hmt_ros.experts import load_predictor
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.error_model import CueErrors
from hmt_ros.sessions import track_start
from hmt_ros.sessions.smoothed_messages import TOPICS as SMOOTHED_TOPICS
from hmt_ros.sessions.track_messages import TOPICS
from hmt_ros.tracking import Status
from hmt_ros.tracking.ground import Ground
from hmt_ros.tracking.validity import Validity
from msg_tools import BagError, BagReader, BagWriter, RosbagsMessages
from msg_tools.bags.bag_metadata import absolute_name
from msg_tools.messages.bodies import body_of
from msg_tools.messages.camera_info import camera_from_info, camera_info_message
from msg_tools.messages.headers import header_message, time_message, time_ns
from msg_tools.messages.images import decode_image, depth_message, image_message
from msg_tools.messages.pose_mixtures import MixtureKind, pose_mixture_of
from test.msg_tools.conftest import limited_file_size

ROOT = Path(__file__).resolve().parents[3]
REACH = ROOT / 'bags' / 'reach'
IMAGES = 2
STARTS = ('body', 'human_description')
SUBJECT = ['--subject', str(REACH / 'subject.yaml')]
PERSON = [*SUBJECT, '--background', str(REACH / 'background.png')]
MESSAGES = RosbagsMessages()


def recorded():
    """(topic, log time, message) of the first images of a bag, with all that goes with them."""
    found, last = [], None
    with BagReader(REACH) as bag:
        for stored in bag.messages():
            name = stored.topic.removeprefix('/')
            if name == 'image/compressed':
                last = stored.log_time_ns
                if sum(topic == name for topic, _, _ in found) == IMAGES:
                    break
            # Gravity is what the bags of these tests say of it.
            if name not in ('body', 'tf_static'):
                found.append((name, stored.log_time_ns, stored.message))
    return [entry for entry in found if last is not None and entry[1] < last]


def write(folder, entries):
    with BagWriter(folder) as bag:
        for topic, time, message in entries:
            bag.write(topic, time, message)
    return folder


def read(folder):
    """Messages of a bag by the names of their topics, all of which are absolute."""
    found = {}
    with BagReader(folder) as bag:
        for stored in bag.messages():
            found.setdefault(stored.topic, []).append(stored)
    assert all(topic.startswith('/') for topic in found)
    return found


def content(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


class StandingStill:
    """A tracker that costs nothing."""

    made = []  # noqa: RUF012

    def __init__(self, body, camera, settings, background, seed, **others):
        self.body, self.camera, self.settings, self.seed = body, camera, settings, seed
        self.status, self.misfit, self.evaluations = Status.TRACKING, 0.0, 1
        self.existence_probability, self.reason = 1.0, ''
        self.likelihood = SimpleNamespace(
            values=np.zeros(1),
            errors=CueErrors(0.25, 0.125),
            shape_covariance=np.zeros((body.dimension, body.dimension)),
        )
        self.track_id, self.started_from = 1, None
        self.keypoints, self.positions, self.predictions, self.masks = [], [], [], []
        self.depths = []
        self.ground, self.contacts = Ground(np.array([0.0, -1.0, 0.0]), 0.3, None, np.inf), {}
        self.vertical, self.gravity_contradicted = None, False
        self.gravity_reversed = False
        self.silhouettes = SimpleNamespace(
            doubted=False, known='known', watch=SimpleNamespace(moved=False, shift=0.0)
        )
        self.validity = Validity()
        StandingStill.made.append(self)

    def reset(self, start, *, box=None):
        self.start = start

    @property
    def estimate(self):
        """It is its own estimate, and its own modes."""
        return self

    published = modes = estimate

    log_likelihoods, identities, velocities = np.zeros(1), np.ones(1, dtype=int), None
    forecaster, foreseen, nobody_shown = None, False, False

    @property
    def point_estimate(self):
        return self.body.prior_mean

    def step(self, image, stamp, keypoints=None, prediction=None, mask=None, depth=None, **others):
        self.keypoints.append(None if keypoints is None else keypoints.names)
        self.positions.append(None if keypoints is None else keypoints.positions)
        self.predictions.append(prediction)
        self.masks.append(None if mask is None else int(mask.sum()))
        self.depths.append(None if depth is None else float(depth.max()))
        if stamp < self.start.stamp_ns:
            return None, None
        mean = self.body.prior_mean[None].copy()
        mean[:, 2] = 4.0 + image.mean() / 256
        mixture = GaussianMixture(np.ones(1), mean, np.eye(self.body.dimension)[None])
        return mixture, mixture


@pytest.fixture
def still(monkeypatch):
    monkeypatch.setattr(track_start, 'Tracker', StandingStill)
    monkeypatch.setattr(StandingStill, 'made', [])
    return StandingStill.made


@pytest.fixture(scope='module')
def entries():
    return recorded()


@pytest.fixture(scope='module')
def short(tmp_path_factory, entries):
    return write(tmp_path_factory.mktemp('bags') / 'short', entries)


@pytest.fixture(scope='module')
def replayed(short, tmp_path_factory):
    """Tracked for good, without ROS."""
    out = tmp_path_factory.mktemp('out') / 'tracked'
    with pytest.MonkeyPatch.context() as patch:
        for missing in ('rclpy', 'hmt_msgs', 'sensor_msgs'):
            patch.setitem(sys.modules, missing, None)
        assert main([str(short), '-o', str(out), *PERSON, '--quiet']) == 0
    return out


def test_topics(replayed, entries):
    found = read(replayed)
    stamps = [time for topic, time, _ in entries if topic == 'image/compressed']
    counts = {
        **dict.fromkeys(STARTS, 1),
        'ground_truth': IMAGES,
        **{topic: IMAGES for topic in (*TOPICS, *SMOOTHED_TOPICS) if topic not in STARTS},
        # Windows are smoothed ten times a second.
        **dict.fromkeys(('trajectory_mixture', 'trajectory_markers'), 1),
    }
    # Nobody has asked for any.
    del counts['pose_forecast']
    assert {topic: len(messages) for topic, messages in found.items()} == {
        absolute_name(topic): count for topic, count in counts.items()
    }
    for topic, published in {**TOPICS, **SMOOTHED_TOPICS}.items():
        if topic not in counts:
            continue
        messages = found[absolute_name(topic)]
        assert {stored.msgtype for stored in messages} == {published.msgtype}
        if counts[topic] == IMAGES:
            assert [stored.log_time_ns for stored in messages] == stamps
    assert sorted(content(replayed)) == ['metadata.yaml', 'tracked.mcap']


def test_mixtures_explain_the_images(replayed):
    found = read(replayed)
    (body,) = (stored.message for stored in found['/body'])
    first = pose_mixture_of(found['/pose_mixture'][0].message, body.dof_names, body.joint_names)
    body_joints = body_of(first, load_body('human37')).joint_positions
    for posterior, likelihood, truth, state, overlay in zip(
        found['/pose_mixture'],
        found['/likelihood_mixture'],
        found['/ground_truth'],
        found['/human_joint_states'],
        found['/overlay/compressed'],
        strict=True,
    ):
        mixture = pose_mixture_of(posterior.message, body.dof_names, body.joint_names)
        assert mixture.kind == MixtureKind.POSTERIOR
        assert 2 <= len(mixture.mixture) <= 8
        position = np.array(state.message.position)
        shown, modes = (body_joints(x) for x in (position[None], mixture.mixture.means))
        assert np.linalg.norm(shown - modes, axis=2).mean(1).min() < 0.1
        assert pose_mixture_of(likelihood.message).kind == MixtureKind.LIKELIHOOD
        assert posterior.message.header == truth.message.header
        (known,) = truth.message.components
        joints = np.array([[p.x, p.y, p.z] for p in known.joint_positions])
        order = [list(truth.message.joint_names).index(name) for name in mixture.joint_names]
        errors = mixture.joint_positions - mixture.joint_positions[:, :1]
        errors = errors - (joints[order] - joints[order][:1])
        assert np.linalg.norm(errors, axis=2).mean(1).min() < 0.15
        assert decode_image(overlay.message).shape == (360, 480, 3)


def test_log_likelihoods_of_both_mixtures_are_known(replayed):
    found = read(replayed)
    for topic in ('/pose_mixture', '/likelihood_mixture'):
        for stored in found[topic]:
            values = [component.log_likelihood for component in stored.message.components]
            assert np.isfinite(values).all(), topic


def test_results_in_a_namespace(still, entries, tmp_path, capsys):
    """Inputs keep their names; those in the namespace are preferred to those in the root."""
    place = '/humans/bodies/anna'
    keypoints = MESSAGES.create(
        'hmt_msgs/msg/Keypoints2D',
        header=entries[0][2].header,
        names=['nose'],
        u=np.array([9.0], np.float32),
        v=np.array([9.0], np.float32),
    )
    names = ('keypoints', f'{place}/keypoints', '/detector/keypoints')
    extra = [(name, entries[0][1], keypoints) for name in names]
    bag = write(tmp_path / 'bag', [*extra, *entries])
    results = {
        f'{place}/{topic}' if topic != '/tf' else '/tf' for topic in (*TOPICS, *SMOOTHED_TOPICS)
    } - {f'{place}/pose_forecast'}
    command = [str(bag), *PERSON, '--quiet', '-o']
    for name, given in (('absolute', place), ('slash', 'humans/bodies/anna/')):
        out = tmp_path / name
        assert main([*command, str(out), '--namespace', given]) == 0
        assert read(out).keys() == {*results, '/ground_truth', f'{place}/keypoints'}
    chosen = tmp_path / 'chosen'
    arguments = ['--namespace', place, '--keypoints-topic', '/detector/keypoints']
    assert main([*command, str(chosen), *arguments]) == 0
    assert read(chosen).keys() == {*results, '/ground_truth', '/detector/keypoints'}
    assert main([*command, str(tmp_path / 'root')]) == 0
    assert '/keypoints' in read(tmp_path / 'root')
    capsys.readouterr()
    for wrong in ('/humans/7', 'a b', '/a//b'):
        assert main([*command, str(tmp_path / 'wrong'), '--namespace', wrong]) == 1
        line = capsys.readouterr().err
        assert 'wanted a namespace such as /humans/bodies/anna' in line
        assert repr(wrong) in line
    assert main([*command, str(tmp_path / 'wrong'), '--mask-topic', 'keypoints']) == 1
    assert 'wanted CompressedImage or Image' in capsys.readouterr().err.replace(
        'Image or CompressedImage', 'CompressedImage or Image'
    )


def test_bag_with_relative_names(still, entries, short, tmp_path):
    """Bags of earlier versions are read as before."""
    old = tmp_path / 'old.mcap'
    relative_names(short / 'short.mcap', old)
    with BagReader(old) as bag:
        assert set(bag.topics) == {'image/compressed', 'camera_info', 'ground_truth'}
    for source, name in ((old, 'a'), (short, 'b')):
        assert main([str(source), '-o', str(tmp_path / name / 'out'), *SUBJECT, '--quiet']) == 0
    assert content(tmp_path / 'a' / 'out') == content(tmp_path / 'b' / 'out')


def relative_names(source, target):
    """Copies an MCAP file; names of topics lose their slash."""
    with source.open('rb') as file, target.open('wb') as copy:
        writer = Writer(copy)
        writer.start(profile='ros2')
        channels = {}
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.id not in channels:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic[1:], 'cdr', known, channel.metadata
                )
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time
            )
        writer.finish()


def test_without_a_subject_a_prediction_starts_the_track(short, tmp_path, capsys):
    out = tmp_path / 'out'
    command = [str(short), '-o', str(out), '--background', str(REACH / 'background.png')]
    assert main(command) == 0
    assert (
        'no --subject: the track starts from a pose_prediction with components'
        in capsys.readouterr().err
    )
    found = read(out)
    assert {len(found[topic]) for topic in ('/pose_prediction', '/pose_mixture')} == {IMAGES}
    predicted = pose_mixture_of(found['/pose_prediction'][0].message)
    assert predicted.kind == MixtureKind.PREDICTION
    # The person is about as large as the model says; the first images say a little.
    model = load_predictor().body.segment_lengths
    bodies = [stored.message for stored in found['/body']]
    assert bodies
    for body in bodies:
        assert dict(zip(body.segment_names, body.segment_lengths, strict=True)) == pytest.approx(
            model, abs=0.02
        )
    again = tmp_path / 'again' / 'out'
    assert main([*command[:2], str(again), *command[3:], '--bme', '--quiet']) == 0
    assert content(again) == content(out)


def test_predictions_beside_a_subject(still, short, tmp_path):
    out = tmp_path / 'out'
    assert main([str(short), '-o', str(out), *PERSON, '--bme', '--quiet']) == 0
    assert len(read(out)['/pose_prediction']) == IMAGES
    assert [prediction is None for prediction in still[0].predictions] == [False] * IMAGES


def test_ground_truth_is_copied(replayed, entries):
    copied = [stored.message for stored in read(replayed)['/ground_truth']]
    given = [message for topic, _, message in entries if topic == 'ground_truth']
    for one, other in zip(copied, given, strict=True):
        assert one.header == other.header
        assert np.array_equal(one.components[0].mean, other.components[0].mean)


def test_same_command_same_bytes(replayed, short, tmp_path):
    again = tmp_path / 'tracked'
    assert main([str(short), '-o', str(again), *PERSON, '--quiet']) == 0
    assert content(again) == content(replayed)


def test_file_instead_of_folder_and_summary(still, short, tmp_path, capsys):
    out = tmp_path / 'out'
    assert main([str(short / 'short.mcap'), '-o', str(out), *SUBJECT]) == 0
    assert capsys.readouterr().out == f'{out}: {IMAGES} of {IMAGES} images tracked\n'
    assert main([str(short), '-o', str(tmp_path / 'quiet'), *SUBJECT, '--quiet']) == 0
    streams = capsys.readouterr()
    assert (streams.out, streams.err) == ('', '')


def test_images_are_copied_on_demand(still, short, tmp_path, entries):
    out = tmp_path / 'out'
    assert main([str(short), '-o', str(out), *SUBJECT, '--with-images', '--quiet']) == 0
    found = read(out)
    for topic in ('image/compressed', 'camera_info'):
        given = [(time, m.header) for name, time, m in entries if name == topic]
        assert [(s.log_time_ns, s.message.header) for s in found[f'/{topic}']] == given
    # What came out can be tracked again.
    assert main([str(out), '-o', str(tmp_path / 'again'), *SUBJECT, '--quiet']) == 0
    assert read(tmp_path / 'again').keys() == read(tmp_path / 'out').keys() - {
        '/image/compressed',
        '/camera_info',
    }


def test_options_reach_the_tracker(still, short, tmp_path):
    config = tmp_path / 'config.yaml'
    config.write_text(
        '/**:\n  ros__parameters:\n    max_hypotheses: 5\n    evaluation_budget: 150\n'
        '    image_transport: raw\n    autostart: false\n    use_sim_time: true\n'
        '    qos_overrides: {/image: {subscription: {depth: 3}}}\n    random_seed: 3\n'
    )
    options = ['--config', str(config), '--set', 'evaluation_budget=120']
    options += ['--set', 'threads=1', '--seed', '7', '--body', 'human34', '--quiet']
    assert main([str(short), '-o', str(tmp_path / 'out'), *SUBJECT, *options]) == 0
    (tracker,) = still
    settings = tracker.settings
    assert (settings.max_hypotheses, settings.evaluation_budget) == (5, 120)
    assert settings.threads == 1
    assert (tracker.seed, tracker.estimate.body.name) == (7, 'human34')


def test_config_of_the_node_changes_nothing(still, short, tmp_path):
    config = str(ROOT / 'hmt_ros' / 'config' / 'filter_node.yaml')
    plain, given = tmp_path / 'a' / 'out', tmp_path / 'b' / 'out'
    assert main([str(short), '-o', str(plain), *SUBJECT, '--quiet']) == 0
    assert main([str(short), '-o', str(given), *SUBJECT, '--quiet', '--config', config]) == 0
    assert content(plain) == content(given)


def keypoints(stamp, names=('head', 'left_hip', 'right_hip')):
    return MESSAGES.create(
        'hmt_msgs/msg/Keypoints2D',
        header=header_message(MESSAGES, stamp, ''),
        names=list(names),
        u=np.full(len(names), 100.0),
        v=np.full(len(names), 100.0),
    )


def test_keypoints_of_the_bag_are_used(still, entries, tmp_path):
    stamps = [time for topic, time, _ in entries if topic == 'image/compressed']
    # The detector is late, and says nothing of the last image.
    extra = [('/keypoints', stamps[0] + 1000, keypoints(stamps[0]))]
    bag = write(tmp_path / 'bag', sorted(entries + extra, key=lambda entry: entry[1]))
    options = [*SUBJECT, '--quiet', '-o']
    assert main([str(bag), *options, str(tmp_path / 'out')]) == 0
    assert still[-1].keypoints == [('head', 'left_hip', 'right_hip'), None]
    assert len(read(tmp_path / 'out')['/pose_mixture']) == IMAGES
    assert main([str(bag), *options, str(tmp_path / 'off'), '--set', 'use_keypoints=false']) == 0
    assert still[-1].keypoints == [None] * IMAGES


def test_predictions_from_the_keypoints_of_the_bag(still, entries, tmp_path):
    """Also where the filter does not use them."""
    stamps = [time for topic, time, _ in entries if topic == 'image/compressed']
    names = [f'{side}_{x}' for x in ('shoulder', 'hip', 'knee') for side in ('left', 'right')]
    seen = keypoints(stamps[0], names)
    seen.u, seen.v = 100.0 + 10.0 * np.array([(0, 2) * 3, np.repeat((0, 4, 8), 2)])
    entries = [*entries, ('/keypoints', stamps[0] + 1000, seen)]
    bag = write(tmp_path / 'bag', sorted(entries, key=lambda entry: entry[1]))
    options = [*SUBJECT, '--quiet', '--bme', '--set', 'use_keypoints=false']
    counts = {'silhouettes': IMAGES, 'keypoints': 1, 'both': IMAGES}
    for cue, count in counts.items():
        out = tmp_path / cue
        cues = ['--set', f'bme.predict_from={cue}', '--set', 'input_timeout=0.0']
        assert main([str(bag), *options, *cues, '-o', str(out)]) == 0
        found = [pose_mixture_of(x.message) for x in read(out)['/pose_prediction']]
        assert len(found) == count
        assert (len(found[0].weights) > 0) == (cue != 'silhouettes')


def keypoints_3d(stamp, names):
    return MESSAGES.create(
        'hmt_msgs/msg/Keypoints3D',
        header=header_message(MESSAGES, stamp, ''),
        names=list(names),
        **{axis: np.arange(1.0, 1 + len(names)) for axis in 'xyz'},
    )


def test_positions_in_space_of_the_bag_are_used_and_kept(still, entries, tmp_path):
    stamps = [time for topic, time, _ in entries if topic == 'image/compressed']
    # Positions of the first image alone, and late.
    extra = [
        ('/keypoints', stamps[0] + 1000, keypoints(stamps[0])),
        ('/keypoints_3d', stamps[0] + 2000, keypoints_3d(stamps[0], ('head', 'nose'))),
        ('/keypoints', stamps[1] + 1000, keypoints(stamps[1], ('head',))),
    ]
    bag = write(tmp_path / 'bag', sorted(entries + extra, key=lambda entry: entry[1]))
    options = [*SUBJECT, '--quiet', '-o']
    assert main([str(bag), *options, str(tmp_path / 'out')]) == 0
    found, *later = still[-1].positions
    np.testing.assert_array_equal(found, [[1, 1, 1], [np.nan] * 3, [np.nan] * 3])
    assert later == [None] * (IMAGES - 1)
    kept = read(tmp_path / 'out')
    assert [len(kept[topic]) for topic in ('/keypoints', '/keypoints_3d')] == [2, 1]
    for given in ('use_keypoints', 'use_keypoints_3d'):
        target = tmp_path / f'without_{given}'
        assert main([str(bag), *options, str(target), '--set', f'{given}=false']) == 0
        assert still[-1].positions == [None] * IMAGES
        assert '/keypoints_3d' not in read(target)


def mask(picture, stamp):
    pixels = np.zeros(picture.shape[:2], np.uint8)
    pixels[50:150, 100:140] = 255
    return image_message(MESSAGES, pixels, stamp, '')


def packed(message):
    pixels = message.data.reshape(message.height, message.width)
    done, data = cv2.imencode('.png', pixels)
    assert done
    return MESSAGES.create(
        'sensor_msgs/msg/CompressedImage', header=message.header, format='png', data=data.ravel()
    )


@pytest.mark.parametrize('topic', ['mask', 'mask/compressed'])
def test_masks_of_the_bag_are_used(still, entries, tmp_path, topic):
    """The segmenter is late, and drops the last image; the images are not named as usual."""
    pictures = [entry for entry in entries if entry[0] == 'image/compressed']
    stamp = pictures[0][1]
    message = mask(decode_image(pictures[0][2]), stamp)
    extra = [(topic, stamp + 1000, message if topic == 'mask' else packed(message))]
    names = {'image/compressed': '/cam/image_raw/compressed'}
    given = renamed(entries, names) + extra
    bag = write(tmp_path / 'bag', sorted(given, key=lambda entry: entry[1]))
    options = [*SUBJECT, '--quiet', '-o']
    assert main([str(bag), *options, str(tmp_path / 'out')]) == 0
    assert still[-1].masks == [4000, None]
    assert len(read(tmp_path / 'out')['/pose_mixture']) == IMAGES
    assert main([str(bag), *options, str(tmp_path / 'off'), '--set', 'use_mask=false']) == 0
    assert still[-1].masks == [None] * IMAGES


@pytest.mark.parametrize('kind', [np.uint16, np.float32])
def test_depth_of_the_bag_is_used(still, entries, tmp_path, capsys, kind):
    """The depth camera drops the last image; --set switches it off."""
    pictures = [entry for entry in entries if entry[0] == 'image/compressed']
    stamp = pictures[0][1]
    unit = 1000 if kind is np.uint16 else 1
    depth = np.full(decode_image(pictures[0][2]).shape[:2], 3 * unit, kind)
    extra = [('depth', stamp + 1000, depth_message(MESSAGES, depth, stamp, ''))]
    at = itemgetter(1)
    bag = write(tmp_path / 'bag', sorted(entries + extra, key=at))
    options = [*SUBJECT, '--quiet', '-o']
    assert main([str(bag), *options, str(tmp_path / 'out')]) == 0
    assert still[-1].depths == [3.0, *[None] * (IMAGES - 1)]
    assert len(read(tmp_path / 'out')['/pose_mixture']) == IMAGES
    assert 'no depth has come for the image of' in capsys.readouterr().err
    aligned = '/camera/aligned_depth_to_color/image_raw'
    bag = write(tmp_path / 'robot', renamed(sorted(entries + extra, key=at), {'depth': aligned}))
    assert main([str(bag), *options, str(tmp_path / 'named'), '--depth-topic', aligned]) == 0
    assert still[-1].depths == [3.0, *[None] * (IMAGES - 1)]
    assert main([str(bag), *options, str(tmp_path / 'off'), '--set', 'use_depth=false']) == 0
    assert still[-1].depths == [None] * IMAGES


def renamed(entries, names):
    return [(names.get(topic, topic), time, message) for topic, time, message in entries]


def test_raw_images(still, entries, tmp_path):
    def raw(message):
        stamp = time_ns(message.header.stamp)
        return image_message(MESSAGES, decode_image(message), stamp, message.header.frame_id)

    changed = [
        ('/image', time, raw(message)) if topic == 'image/compressed' else (topic, time, message)
        for topic, time, message in entries
    ]
    both = [tmp_path / name / 'out' for name in ('raw', 'compressed')]
    for out, given in zip(both, (changed, entries), strict=True):
        bag = write(out.parent / 'bag', given)
        assert main([str(bag), '-o', str(out), *SUBJECT, '--quiet']) == 0
    assert content(both[0]) == content(both[1])


def test_calibration_of_larger_images_is_scaled(still, entries, tmp_path, capsys):
    larger = []
    for topic, time, message in copy.deepcopy(entries):
        if topic == 'camera_info':
            camera = camera_from_info(message)
            camera = camera.scaled(2 * camera.width, 2 * camera.height)
            message = camera_info_message(MESSAGES, camera, time, message.header.frame_id)
        larger.append((topic, time, message))
    outs = [tmp_path / name / 'out' for name in ('larger', 'given')]
    for out, given in zip(outs, (larger, entries), strict=True):
        bag = write(out.parent / 'bag', given)
        assert main([str(bag), '-o', str(out), *SUBJECT, '--quiet']) == 0
        if given is larger:
            (line,) = capsys.readouterr().err.splitlines()
            assert 'for images of 960x720 pixels is scaled to 480x360' in line
    assert content(outs[0]) == content(outs[1])
    assert still[0].camera == still[1].camera


def stamped(message, stamp):
    message = copy.deepcopy(message)
    message.header.stamp = time_message(MESSAGES, stamp)
    return message


def test_times_of_recording_replace_missing_stamps(still, entries, tmp_path, capsys):
    """Inputs go on belonging to the images that came before them with the same stamp."""
    times = sorted({time for topic, time, _ in entries if topic == 'image/compressed'})
    seen = [('keypoints', time, keypoints(time)) for time in times]
    given = sorted([*entries, *seen], key=lambda entry: entry[1])
    without = [(topic, time, stamped(message, 0)) for topic, time, message in given]
    # A detector takes its time, and a clock may be wrong by a day.
    later = {'keypoints': 5_000_000}
    wrong = [
        (topic, time + later.get(topic, 0), stamped(message, time - 86_400_000_000_000))
        for topic, time, message in given
    ]
    outs = []
    for name, bag in (('given', given), ('without', without), ('wrong', wrong)):
        outs.append(tmp_path / name / 'out')
        write(outs[-1].parent / 'bag', bag)
        options = [] if name == 'given' else ['--times', 'log']
        command = [str(outs[-1].parent / 'bag'), '-o', str(outs[-1]), *SUBJECT, '--quiet']
        assert main([*command, *options]) == 0
        assert [x is not None for x in still[-1].keypoints] == [True] * IMAGES
        if name == 'without':
            command[2] = str(tmp_path / 'none')
            assert main(command) == 1
            (line,) = capsys.readouterr().err.splitlines()
            assert 'on /image/compressed have no stamps (all are 0): --times log takes' in line
    copied = {'/keypoints', '/ground_truth'}
    found = [
        [x.data for name, those in read(out).items() if name not in copied for x in those]
        for out in outs
    ]
    assert found[0] == found[1] == found[2]


def test_images_of_a_video(still, entries, tmp_path, monkeypatch):
    """A stand-in for the library of videos, whose pictures are JPEG files."""

    class Decoder:
        def decode(self, packet):
            if packet is None:
                return []
            picture = cv2.imdecode(np.frombuffer(packet.data, np.uint8), cv2.IMREAD_COLOR)
            frame = SimpleNamespace(pts=packet.pts, key_frame=True)
            frame.to_ndarray = lambda format: picture  # noqa: A006
            return [frame]

    av = SimpleNamespace(
        CodecContext=SimpleNamespace(create=lambda codec, mode: Decoder()),
        Packet=lambda data: SimpleNamespace(data=data, pts=None),
        error=SimpleNamespace(FFmpegError=ValueError),
    )
    monkeypatch.setitem(sys.modules, 'av', av)
    changed = copy.deepcopy(entries)
    for topic, _, message in changed:
        if topic == 'image/compressed':
            message.format = 'h264'
    both = [tmp_path / name / 'out' for name in ('video', 'plain')]
    for out, given in zip(both, (changed, entries), strict=True):
        bag = write(out.parent / 'bag', given)
        assert main([str(bag), '-o', str(out), *SUBJECT, '--quiet']) == 0
    assert content(both[0]) == content(both[1])
    # Whoever has no library is told by one line.
    monkeypatch.setitem(sys.modules, 'av', None)
    bag = both[0].parent / 'bag'
    with BagReader(bag) as opened, pytest.raises(BagError, match='needs PyAV'):
        recorded_input(opened)


def test_topics_are_found_by_their_names(entries, tmp_path):
    names = {'image/compressed': '/cam/image_raw/compressed', 'camera_info': '/cam/camera_info'}
    others = {'image/compressed': '/other/image/compressed', 'camera_info': '/other/camera_info'}
    one = write(tmp_path / 'one', renamed(entries, names))
    with BagReader(one) as bag:
        found = recorded_input(bag)
        assert found.image.name == '/cam/image_raw/compressed'
        assert found.camera_info.name == '/cam/camera_info'
        assert found.ground_truth.name == '/ground_truth'
        assert (found.of('keypoints'), found.transport) == (None, 'compressed')
    several = write(tmp_path / 'several', renamed(entries, names) + renamed(entries, others))
    with BagReader(several) as bag:
        with pytest.raises(BagError, match='several topics of CompressedImage or Image') as caught:
            recorded_input(bag)
        assert 'name one of /cam/image_raw/compressed, ' in str(caught.value)
        assert str(caught.value).endswith(' by --image-topic')
        for name in ('/other/image/compressed', 'other/image/compressed'):
            found = recorded_input(bag, name)
            assert found.camera_info.name == '/other/camera_info'
        found = recorded_input(bag, '/other/image/compressed', '/cam/camera_info')
        assert found.camera_info.name == '/cam/camera_info'
    usual = write(tmp_path / 'usual', renamed(entries, others) + entries)
    with BagReader(usual) as bag:
        assert recorded_input(bag).image.name == '/image/compressed'
        assert recorded_input(bag).camera_info.name == '/camera_info'


def test_learned_background_needs_images_before_the_track(still, short, tmp_path, entries):
    subject = tmp_path / 'late.yaml'
    stamps = [time for topic, time, _ in entries if topic == 'image/compressed']
    text = (REACH / 'subject.yaml').read_text()
    subject.write_text(text.replace(str(stamps[0]), str(stamps[1])))
    out = tmp_path / 'out'
    assert main([str(short), '-o', str(out), '--subject', str(subject), '--quiet']) == 0
    assert [stored.log_time_ns for stored in read(out)['/pose_mixture']] == stamps[1:]


def test_nothing_is_overwritten_unasked(still, short, tmp_path, capsys):
    out = tmp_path / 'out'
    command = [str(short), '-o', str(out), *SUBJECT, '--quiet']
    assert main(command) == 0
    before = content(out)
    assert main([*command, '--seed', '1']) == 1
    assert 'exists; give another name' in capsys.readouterr().err
    assert content(out) == before
    assert main([*command, '--overwrite', '--set', 'frame_prefix=a/']) == 0
    assert content(out) != before
    (out / 'notes.txt').write_text('mine')
    assert main([*command, '--overwrite']) == 1
    assert (out / 'notes.txt').read_text() == 'mine'
    assert sorted(path.name for path in tmp_path.iterdir()) == ['out']


def test_the_bag_that_is_read_is_never_replaced(still, entries, tmp_path, capsys):
    bag = write(tmp_path / 'bag', entries)
    before = content(bag)
    for given in (bag, bag / 'bag.mcap'):
        assert main([str(given), '-o', str(bag), *SUBJECT, '--overwrite']) == 1
        assert 'is the bag that is read' in capsys.readouterr().err
    assert content(bag) == before


def test_interruption_leaves_nothing(short, tmp_path, monkeypatch, capsys):
    def interrupted(self, *_inputs, **_named):
        raise KeyboardInterrupt

    monkeypatch.setattr(track_start, 'Tracker', StandingStill)
    monkeypatch.setattr(StandingStill, 'step', interrupted)
    assert main([str(short), '-o', str(tmp_path / 'out'), *SUBJECT]) == 130
    assert capsys.readouterr().err == 'replay: interrupted, nothing is written\n'
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('options', [[], ['--keep-going']])
def test_full_disk(still, short, tmp_path, capsys, options):
    """It is no fault of an image that could be passed over."""
    with limited_file_size(20_000):
        assert main([str(short), '-o', str(tmp_path / 'out'), *SUBJECT, *options]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f'replay: {tmp_path / "out"} can not be written: File too large'
    assert list(tmp_path.iterdir()) == []


def test_the_last_images_do_not_wait_for_what_a_bag_does_not_have(still, entries, tmp_path):
    """Whatever the type of the detections: no message can say that there are no more."""
    stamps = [time for topic, time, _ in entries if topic == 'image/compressed']
    layout = MESSAGES.create('std_msgs/msg/MultiArrayLayout', dim=[], data_offset=0)
    data = np.array([stamps[0] // 10**9, stamps[0] % 10**9, *[100.0, 100.0, 0.9] * 17], np.float32)
    extra = ('/detections', stamps[0] + 1000, MESSAGES.create(
        'std_msgs/msg/Float32MultiArray', layout=layout, data=data))  # fmt: skip
    bag = write(tmp_path / 'bag', sorted([*entries, extra], key=lambda entry: entry[1]))
    options = [*SUBJECT, '--quiet', '--set', 'source=floats', '--set', 'use_keypoints=true']
    assert main([str(bag), *options, '-o', str(tmp_path / 'out'), '--keep-going']) == 0
    assert len(read(tmp_path / 'out')['/pose_mixture']) == IMAGES
