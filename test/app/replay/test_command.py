"""The command `replay`, offline."""

import copy
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

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
from msg_tools.messages.headers import header_message, time_message
from msg_tools.messages.images import decode_image, depth_message
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
    """(topic, log time, message) of the first images of a bag, with all related messages."""
    found, last = [], None
    with BagReader(REACH) as bag:
        for stored in bag.messages():
            name = stored.topic.removeprefix('/')
            if name == 'image/compressed':
                last = stored.log_time_ns
                if sum(topic == name for topic, _, _ in found) == IMAGES:
                    break
            # Gravity comes from the messages of each test.
            if name not in ('body', 'tf_static'):
                found.append((name, stored.log_time_ns, stored.message))
    return [entry for entry in found if last is not None and entry[1] < last]


def write(folder, entries):
    with BagWriter(folder) as bag:
        for topic, time, message in entries:
            bag.write(topic, time, message)
    return folder


def read(folder):
    """Messages of a bag by topic name; all names are absolute."""
    found = {}
    with BagReader(folder) as bag:
        for stored in bag.messages():
            found.setdefault(stored.topic, []).append(stored)
    assert all(topic.startswith('/') for topic in found)
    return found


def content(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


class StandingStill:
    """A stub tracker with a constant pose."""

    made = []  # noqa: RUF012

    def __init__(self, body, camera, settings, background, seed, **others):
        self.body, self.camera, self.settings, self.seed = body, camera, settings, seed
        self.status, self.misfit, self.evaluations = Status.TRACKING, 0.0, 1
        self.existence_probability, self.reason = 1.0, ''
        self.likelihood = SimpleNamespace(
            values=np.zeros(1),
            errors=CueErrors(0.25, 0.125),
            shape_covariance=np.zeros((body.dimension, body.dimension)),
            identities=np.ones(1, dtype=int),
            posterior_weights=np.ones(1),
            origins=np.empty((1, 0)),
            ancestors=np.empty(0, dtype=int),
            ancestry_stamp=None,
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
        """The tracker itself, which also stands for its estimate and modes."""
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
    """A bag tracked with the real tracker, without ROS."""
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
    # Not requested.
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


def test_results_in_a_namespace(still, entries, tmp_path, capsys):
    """Inputs keep their names; those in the namespace have priority over those in the root."""
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
    # The person's lengths are close to the model's; the first images change them a little.
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


def test_same_command_same_bytes(replayed, short, tmp_path):
    again = tmp_path / 'tracked'
    assert main([str(short), '-o', str(again), *PERSON, '--quiet']) == 0
    assert content(again) == content(replayed)


def test_images_are_copied_on_demand(still, short, tmp_path, entries):
    out = tmp_path / 'out'
    assert main([str(short), '-o', str(out), *SUBJECT, '--with-images', '--quiet']) == 0
    found = read(out)
    for topic in ('image/compressed', 'camera_info'):
        given = [(time, m.header) for name, time, m in entries if name == topic]
        assert [(s.log_time_ns, s.message.header) for s in found[f'/{topic}']] == given
    # The result can be tracked again.
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


def packed(pixels, stamp):
    """A mask as PNG."""
    done, data = cv2.imencode('.png', pixels)
    assert done
    return MESSAGES.create(
        'sensor_msgs/msg/CompressedImage',
        header=header_message(MESSAGES, stamp, ''),
        format='png',
        data=data.ravel(),
    )


@pytest.mark.parametrize(
    'parameter', ['use_keypoints', 'use_keypoints_3d', 'use_mask', 'use_depth']
)
def test_inputs_of_the_bag_are_used(still, entries, tmp_path, parameter):
    """Inputs arrive late, with the first image only; --set switches each of them off."""
    _, stamp, image = next(entry for entry in entries if entry[0] == 'image/compressed')
    shape = decode_image(image).shape[:2]
    person = np.zeros(shape, np.uint8)
    person[50:150, 100:140] = 255
    depth = np.full(shape, 3000, np.uint16)
    places = MESSAGES.create(
        'hmt_msgs/msg/Keypoints3D',
        header=header_message(MESSAGES, stamp, ''),
        names=['head', 'nose'],
        **{axis: np.arange(1.0, 3.0) for axis in 'xyz'},
    )
    both = {'keypoints': keypoints(stamp), 'keypoints_3d': places}
    topics, attribute, wanted = {
        'use_keypoints': (both, 'keypoints', ('head', 'left_hip', 'right_hip')),
        'use_keypoints_3d': (both, 'positions', [[1, 1, 1], [np.nan] * 3, [np.nan] * 3]),
        'use_mask': ({'mask/compressed': packed(person, stamp)}, 'masks', 4000),
        'use_depth': ({'depth': depth_message(MESSAGES, depth, stamp, '')}, 'depths', 3.0),
    }[parameter]
    extra = [(topic, stamp + 1000, message) for topic, message in topics.items()]
    bag = write(tmp_path / 'bag', sorted(entries + extra, key=lambda entry: entry[1]))
    options = [str(bag), *SUBJECT, '--quiet', '-o']
    assert main([*options, str(tmp_path / 'out')]) == 0
    found, *later = getattr(still[-1], attribute)
    np.testing.assert_equal(found, wanted)
    assert later == [None] * (IMAGES - 1)
    kept = read(tmp_path / 'out')
    assert len(kept['/pose_mixture']) == IMAGES
    assert {f'/{topic}' for topic in topics if 'keypoints' in topic} <= kept.keys()
    assert main([*options, str(tmp_path / 'off'), '--set', f'{parameter}=false']) == 0
    assert getattr(still[-1], attribute) == [None] * IMAGES


def renamed(entries, names):
    return [(names.get(topic, topic), time, message) for topic, time, message in entries]


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
    """Inputs still belong to the earlier images with the same timestamp."""
    times = sorted({time for topic, time, _ in entries if topic == 'image/compressed'})
    seen = [('keypoints', time, keypoints(time)) for time in times]
    given = sorted([*entries, *seen], key=lambda entry: entry[1])
    without = [(topic, time, stamped(message, 0)) for topic, time, message in given]
    # A detector needs some time, and a clock may be wrong by a day.
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
            assert 'on /image/compressed have no stamps (all are 0): --times log uses' in line
    copied = {'/keypoints', '/ground_truth'}
    found = [
        [x.data for name, those in read(out).items() if name not in copied for x in those]
        for out in outs
    ]
    assert found[0] == found[1] == found[2]


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
        assert 'is the input bag' in capsys.readouterr().err
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
    """A full disk is not an error of an image that can be skipped."""
    with limited_file_size(20_000):
        assert main([str(short), '-o', str(tmp_path / 'out'), *SUBJECT, *options]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f'replay: {tmp_path / "out"} can not be written: File too large'
    assert list(tmp_path.iterdir()) == []


def test_the_last_images_do_not_wait_for_what_a_bag_does_not_have(still, entries, tmp_path):
    """For all types of detections, because no message can announce the end."""
    stamps = [time for topic, time, _ in entries if topic == 'image/compressed']
    layout = MESSAGES.create('std_msgs/msg/MultiArrayLayout', dim=[], data_offset=0)
    data = np.array([stamps[0] // 10**9, stamps[0] % 10**9, *[100.0, 100.0, 0.9] * 17], np.float32)
    extra = ('/detections', stamps[0] + 1000, MESSAGES.create(
        'std_msgs/msg/Float32MultiArray', layout=layout, data=data))  # fmt: skip
    bag = write(tmp_path / 'bag', sorted([*entries, extra], key=lambda entry: entry[1]))
    options = [*SUBJECT, '--quiet', '--set', 'source=floats', '--set', 'use_keypoints=true']
    assert main([str(bag), *options, '-o', str(tmp_path / 'out'), '--keep-going']) == 0
    assert len(read(tmp_path / 'out')['/pose_mixture']) == IMAGES
