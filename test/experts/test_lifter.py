"""Experts over windows of keypoints: windows, files, poses from lifted joints, learning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp

from hmt_learning.training.detector_errors import DetectorErrors, with_errors
from hmt_learning.training.keypoint_tracks import JOINTS, assembled, keypoint_tracks, meet
from hmt_learning.training.keypoint_training import WindowSettings, training_windows
from hmt_learning.training.lifter_learning import LearningSettings, learn_lifter, lifter_scores
from hmt_learning.training.training_set import procedural_sequence
from hmt_ros.body import Camera, load_body
from hmt_ros.body.kinematics import forward
from hmt_ros.body.mirror import root_angles, root_rotations
from hmt_ros.body.skeleton import other_side
from hmt_ros.experts.lifted_fit import lift_poses, poses_of
from hmt_ros.experts.lifter import (
    EXCHANGED_INPUTS,
    EXCHANGES,
    LANDMARKS,
    MAX_COMPONENTS,
    PROPORTION_LENGTHS,
    TIMES,
    KeypointHistory,
    Lifter,
    Network,
    filled,
    landmark_offsets,
    landmark_rays,
    lifted_positions,
    load_lifter,
    places_of,
    proportions,
    window_inputs,
)
from hmt_ros.experts.pose_encoding import ray_rotations
from hmt_ros.image.keypoint_schemes import schemes
from hmt_ros.image.lifted_poses import HIPS, LiftedPoses, bone_lengths, from_positions, pooled
from hmt_ros.image.terms.keypoints import USUAL_STATURE, Keypoints

BODY = load_body('human37')
CAMERA = Camera(600.0, 600.0, 319.5, 239.5, 640, 480)
INPUTS = len(TIMES) * (3 * len(LANDMARKS) + 2) + 5 + len(PROPORTION_LENGTHS) + 1


def walking(count: int = 12) -> np.ndarray:
    sequence = procedural_sequence('walk', BODY, 2.0, 0)
    poses = sequence.poses[:count].copy()
    poses[:, :3] += np.array([0.3, 0.1, 4.0]) - poses[0, :3]
    return poses


def detected(poses: np.ndarray, scheme: str = 'mediapipe33', body=BODY) -> list[Keypoints]:
    """Exact keypoints of poses, in a scheme."""
    names = schemes()[scheme].names
    known, rows = [], []
    for i, mark in enumerate(schemes()[scheme].landmarks):
        if mark.joint:
            known.append(mark.name)
            rows.append(i)
    joints, offsets = landmark_offsets(body, known)
    which = body.skeleton.joint_index(tuple(joints))
    places = forward(body.skeleton, poses).points(
        body.skeleton.joint_segments[which], body.skeleton.joint_offsets[which] + offsets
    )
    result = []
    for t in range(len(poses)):
        pixels, sure = np.full((len(names), 2), np.nan), np.zeros(len(names))
        pixels[rows], sure[rows] = CAMERA.project(places[:, :, t]), 1.0
        unknown = np.full((len(names), 2, 2), np.nan)
        result.append(Keypoints(names, pixels, unknown, sure))
    return result


def lifted_in(lifter, stamps, keypoints, camera=CAMERA, *, causal=False):
    """The mixtures of all images of a sequence."""
    seen = [landmark_rays(camera, one) for one in keypoints]
    rays, sure = (np.array([one[i] for one in seen]) for i in range(2))
    return lifter.lift(stamps, rays, sure, stamps, causal=causal)


def network(seed: int = 0, experts: int = 3, units: int = 8) -> Network:
    rng = np.random.default_rng(seed)

    def normal(*shape: int) -> np.ndarray:
        return (0.1 * rng.standard_normal(shape)).astype(np.float32)

    return Network(
        mean=normal(INPUTS), scale=np.ones(INPUTS, np.float32),
        first=normal(INPUTS, units), first_bias=normal(units),
        hidden=normal(1, units, units), hidden_biases=normal(1, units),
        last=normal(units, experts * (1 + 6 * len(JOINTS))),
        last_bias=normal(experts * (1 + 6 * len(JOINTS))), middle=normal(len(JOINTS), 3),
    )  # fmt: skip


@pytest.fixture
def lifter() -> Lifter:
    return Lifter(network(), JOINTS, BODY, {'card': 'of a test'})


def test_network_is_the_mixture_of_its_layers(lifter):
    net, x = lifter.network, np.random.default_rng(1).standard_normal((2, INPUTS)).astype('f')
    gates, means, deviations = net(x)
    assert gates.shape == (2, 3)
    assert means.shape == deviations.shape == (2, 3, len(JOINTS), 3)
    np.testing.assert_allclose(np.exp(gates).sum(1), 1.0)
    assert (deviations > 0).all()
    leak = lambda v: np.where(v > 0, v, 0.1 * v)  # noqa: E731
    h = leak((x - net.mean) @ net.first + net.first_bias)
    h = h + leak(h @ net.hidden[0] + net.hidden_biases[0])
    out = h @ net.last + net.last_bias
    j = len(JOINTS)
    np.testing.assert_allclose(
        means, 0.3 * out[:, 3 : 3 + 9 * j].reshape(2, 3, j, 3) + net.middle, atol=1e-5
    )


def test_file_keeps_the_lifter(lifter, tmp_path):
    again = Lifter.load(lifter.save(tmp_path / 'one.npz'))
    x = np.random.default_rng(1).standard_normal((1, INPUTS)).astype('f')
    for a, b in zip(lifter.network(x), again.network(x)):
        np.testing.assert_allclose(a, b, atol=5e-3)
    assert again.notes == lifter.notes | {'numbers': again.notes['numbers']}
    assert again.joints == JOINTS


def test_files_that_are_none_are_refused(lifter, tmp_path):
    with pytest.raises(FileNotFoundError):
        load_lifter(str(tmp_path / 'none.npz'))
    path = lifter.save(tmp_path / 'one.npz')
    with np.load(path) as content:
        arrays = dict(content)
    arrays.pop('hidden')
    np.savez(tmp_path / 'less.npz', **arrays)
    with pytest.raises(ValueError, match=r'less\.npz'):
        Lifter.load(tmp_path / 'less.npz')


def test_windows_take_the_nearest_images():
    stamps = np.arange(60) / 30.0
    rows, there, times = filled(stamps, stamps[30:31], causal=False)
    assert there.all()
    assert rows[0, 0] == 30
    assert np.abs(times[0] - TIMES).max() < 0.017 + 1e-9
    _, there, _ = filled(stamps, stamps[30:31], causal=True)
    assert (there[0] == (TIMES <= 0)).all()
    slow = np.arange(6) / 2.0
    rows, there, _ = filled(slow, slow[3:4], causal=False)
    assert there[0, 0]
    assert set(rows[0][there[0]]) <= {2, 3, 4}
    _, there, _ = filled(np.zeros(1), np.zeros(1), causal=False)
    assert (there[0] == (TIMES == 0)).all()


def test_inputs_do_not_depend_on_where_the_person_is_in_the_image():
    """A rotated camera sees the same person and gives the same inputs."""
    rng = np.random.default_rng(0)
    rays = 0.1 * rng.normal(size=(1, len(TIMES), len(LANDMARKS), 2))
    sure = np.ones((1, len(TIMES), len(LANDMARKS)))
    ups, none = np.array([[0.0, -1.0, 0.0]]), np.zeros((1, len(PROPORTION_LENGTHS)))
    first = window_inputs(rays, sure, TIMES[None], ups, none)
    turn = ray_rotations(np.array([[0.0, 0.3, 1.0]]))[0]
    moved = np.concatenate([rays, np.ones((*rays.shape[:3], 1))], axis=3) @ turn.T
    second = window_inputs(moved[..., :2] / moved[..., 2:], sure, TIMES[None], ups @ turn.T, none)
    # Axes point to the mean of the trunk, which differs slightly from the mean of rotated rays.
    np.testing.assert_allclose(first.values, second.values, atol=0.05)


@pytest.mark.parametrize('degrees', [15.0, 90.0, 180.0])
def test_a_camera_on_its_side_lifts_as_an_upright_one(degrees):
    """Keypoints and gravity of a rotated camera give the same poses, rotated."""
    shipped, poses = load_lifter(), walking(8)
    turn = Rotation.from_rotvec([0.0, 0.0, np.radians(degrees)]).as_matrix()
    middle, up = np.array([CAMERA.cx, CAMERA.cy]), np.array([0.0, -np.cos(0.1), -np.sin(0.1)])
    seen = detected(poses)
    moved = [replace(x, pixels=(x.pixels - middle) @ turn[:2, :2].T + middle) for x in seen]
    stamps, ups = np.arange(8) / 30.0, np.tile(up, (8, 1))
    upright = lift_poses(shipped, BODY, CAMERA, stamps, seen, ups)
    found = lift_poses(shipped, BODY, CAMERA, stamps, moved, ups @ turn.T)
    for one, other in zip(upright, found, strict=True):
        joints = BODY.joint_positions(one.means[:1]) @ turn.T
        assert np.abs(BODY.joint_positions(other.means[:1]) - joints).max() < 5e-3
    # Nothing is rotated if gravity is unknown or the camera is level.
    unknown = lift_poses(shipped, BODY, CAMERA, stamps, seen)
    level = lift_poses(shipped, BODY, CAMERA, stamps, seen, np.zeros((8, 3)))
    assert np.array_equal(unknown[0].means, level[0].means)


def test_landmarks_have_one_place_whatever_the_scheme():
    of_mediapipe = detected(walking(1))[0]
    places = places_of(of_mediapipe)
    assert LANDMARKS[places[of_mediapipe.names.index('left_foot_index')]] == 'left_toe'
    named, _ = of_mediapipe.named_for(BODY, 'mediapipe33')
    assert {LANDMARKS[i] for i in places_of(named) if i >= 0} == {
        LANDMARKS[i] for i in places if i >= 0
    }
    joints = Keypoints(
        ('pelvis', 'left_knee', 'tail'), np.zeros((3, 2)), np.zeros((3, 2, 2)), np.ones(3)
    )
    assert [LANDMARKS[i] if i >= 0 else '' for i in places_of(joints)] == [
        'mid_hip',
        'left_knee',
        '',
    ]


def test_history_sees_what_a_causal_sequence_sees(lifter):
    poses = walking(30)
    seen, stamps = detected(poses), np.arange(30) / 30.0
    whole = lifted_in(lifter, stamps, seen, causal=True)
    history = KeypointHistory(CAMERA)
    for stamp, one in zip(stamps, seen):
        history.add(one, stamp)
        last = history.lift(lifter)
    np.testing.assert_allclose(last.means, whole[-1].means, atol=1e-5)
    later = lifted_in(lifter, stamps, seen)
    assert not np.allclose(later[5].means, whole[5].means, atol=1e-5)
    np.testing.assert_allclose(later[-1].means, whole[-1].means, atol=1e-5)


def exchanged(one: Keypoints) -> Keypoints:
    order = [one.names.index(other_side(name)) for name in one.names]
    return replace(one, pixels=one.pixels[order], confidences=one.confidences[order])


@pytest.mark.parametrize('order', range(len(EXCHANGES)))
def test_inputs_are_exchanged_as_landmarks_are(order):
    rng = np.random.default_rng(order)
    shape = (3, len(TIMES), len(LANDMARKS))
    rays, sure = rng.normal(0, 0.1, (*shape, 2)), rng.random(shape)
    known = np.tile(TIMES, (3, 1)), np.zeros((3, 3)), np.zeros((3, len(PROPORTION_LENGTHS)))
    found = window_inputs(rays, sure, *known).values[:, EXCHANGED_INPUTS[order]]
    rows = EXCHANGES[order]
    wanted = window_inputs(rays[:, :, rows], sure[:, :, rows], *known).values
    np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_exchanged_sides_are_among_the_answers():
    """Poses near the person with exchanged sides get some weight."""
    poses, stamps = turned(walking(20), [0, 1, 0], 20), np.arange(20) / 30.0
    seen = [exchanged(one) for one in detected(poses)]
    rays, sure = (np.array([landmark_rays(CAMERA, x)[i] for x in seen]) for i in range(2))
    lifter = load_lifter()
    true = truly_lifted(poses[-1:])[0].means[0]

    def weight_near(exchanges):
        (one,) = lifter.lift(stamps, rays, sure, stamps[-1:], causal=True, exchanges=exchanges)
        distances = np.linalg.norm(one.means - true, axis=2).mean(1)
        assert logsumexp(one.log_weights) == pytest.approx(0.0, abs=1e-9)
        assert len(distances) == (5 if exchanges is None else MAX_COMPONENTS)
        return np.exp(one.log_weights)[distances < 0.1].sum()

    assert weight_near(None) < 0.08
    assert 0.1 < weight_near(np.array([0.8, 0.1, 0.05, 0.05])) < 0.2


def test_history_follows_a_camera_that_turns(lifter):
    poses = walking(5)
    turn = ray_rotations(np.array([[0.1, 0.05, 1.0]]))[0]
    history = KeypointHistory(CAMERA)
    history.add(detected(poses)[0], 0.0)
    before = history._seen[0][1].copy()
    history.carry(turn)
    ray = np.append(before[5], 1.0) @ turn.T
    np.testing.assert_allclose(history._seen[0][1][5], ray[:2] / ray[2])


def test_too_few_keypoints_are_nobody(lifter):
    (one,) = detected(walking(1))
    sure = one.confidences.copy()
    sure[4:] = 0.0
    few = Keypoints(one.names, one.pixels, one.covariances, sure)
    assert lifted_in(lifter, np.zeros(1), [few]) == [None]
    none = Keypoints((), np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0))
    assert lift_poses(lifter, BODY, CAMERA, np.zeros(1), [none]) == [None]


def truly_lifted(poses: np.ndarray, body=BODY) -> list[LiftedPoses]:
    joints = body.joint_positions(poses)
    hips = joints[:, body.skeleton.joint_index(HIPS)].mean(1)
    axes = ray_rotations(hips).transpose(0, 2, 1)
    which = body.skeleton.joint_index(JOINTS)
    lengths = bone_lengths(body.skeleton, JOINTS)
    result = []
    for t in range(len(poses)):
        relative = (joints[t, which] - hips[t]) @ axes[t].T
        two = np.stack([relative, relative * [1, 1, -1]])
        spread = np.full(two.shape, 0.01)
        result.append(LiftedPoses(JOINTS, np.log([0.8, 0.2]), two, spread, axes[t], lengths))
    return result


def test_poses_have_the_lifted_joints_where_the_keypoints_are():
    poses = walking(4)
    seen = [landmark_rays(CAMERA, one) for one in detected(poses)]
    rays, sure = (np.array([x[i] for x in seen]) for i in range(2))
    found = poses_of(BODY, truly_lifted(poses), rays, sure, 0.06)
    for t, mixture in enumerate(found):
        assert mixture.weights == pytest.approx([0.8, 0.2])
        joints = BODY.joint_positions(np.stack([mixture.means[0], poses[t]]))
        assert np.linalg.norm(joints[0] - joints[1], axis=1).max() < 0.05
        assert np.linalg.eigvalsh(mixture.covariances).min() > 0
        assert (mixture.means >= BODY.lower - 1e-9).all()
        assert (mixture.means <= BODY.upper + 1e-9).all()
        # The distance of the person depends on the size.
        depth = mixture.covariances[0, 2, 2] ** 0.5
        assert depth == pytest.approx(0.06 * mixture.means[0, 2], rel=0.3)


def test_poses_of_a_long_clip_are_those_of_each_image():
    poses = walking(6)
    turning = np.tile(poses, (8, 1))
    turning[:, BODY.dof_names.index('root_z')] += np.linspace(0.0, 60.0, len(turning))
    rays = np.zeros((len(turning), len(LANDMARKS), 2))
    sure = np.zeros((len(turning), len(LANDMARKS)))
    lifted = truly_lifted(turning)
    together = poses_of(BODY, lifted, rays, sure, 0.06)
    alone = poses_of(BODY, lifted[-1:], rays[-1:], sure[-1:], 0.06)
    np.testing.assert_allclose(together[-1].means, alone[0].means, atol=1e-6)


def test_a_larger_person_is_further_away():
    poses = walking(1)
    large = BODY.with_segment_lengths({k: 1.1 * v for k, v in BODY.segment_lengths.items()})
    rays, sure = (x[None] for x in landmark_rays(CAMERA, detected(poses)[0]))
    usual, larger = (
        poses_of(body, truly_lifted(poses), rays, sure, 0.02)[0] for body in (BODY, large)
    )
    assert larger.means[0, 2] == pytest.approx(1.1 * usual.means[0, 2], rel=0.02)


def test_one_guess_has_the_depths_of_its_joints():
    (pose,) = walking(1)
    joints = BODY.joint_positions(pose[None])[0]
    hips = joints[BODY.skeleton.joint_index(HIPS)].mean(0)
    axes = ray_rotations(hips[None])[0].T
    kinds = {name.rpartition('_')[2]: 0.1 for name in JOINTS}
    which = BODY.skeleton.joint_index(JOINTS)
    guess = from_positions(JOINTS, joints[which] + 3.0, axes, kinds)
    np.testing.assert_allclose(guess.means[0], (joints[which] - hips) @ axes.T)
    np.testing.assert_allclose(guess.sized(BODY.skeleton), guess.means, atol=0.02)
    assert from_positions(JOINTS[:3], joints[:3], axes, kinds) is None
    lost = joints[which].copy()
    lost[JOINTS.index('left_knee')] = np.nan
    other = from_positions(JOINTS, lost, axes, kinds)
    # Exchanged, the right knee would be the left one.
    assert not {'left_knee', 'right_knee'} & {*other.joints}
    assert other.exchanged().joints == other.joints
    unseen = np.array(['left_knee' in x for x in JOINTS])
    guess = from_positions(JOINTS, joints[which], axes, kinds, ~unseen)
    wide = [x for x, s in zip(guess.joints, guess.deviations[0, :, 2], strict=True) if s > 0.1]
    assert wide == ['left_knee']


def test_opinions_are_pooled():
    first, second = truly_lifted(walking(2))
    both = pooled([first, second.of_joints(JOINTS[:4])])
    assert np.exp(both.log_weights) == pytest.approx([0.4, 0.1, 0.4, 0.1])
    np.testing.assert_allclose(both.means[2, :4], second.means[0, :4])
    assert (both.deviations[2, 4:] == 0.5).all()
    assert pooled([first]) is first


def tracks():
    sequences = [procedural_sequence(name, BODY, 2.0, 0) for name in ('walk', 'dance')]
    return keypoint_tracks(BODY, sequences, [1.0, 1.0], variants=3)


def test_training_windows_show_what_the_camera_sees():
    """Without errors the rays of a window are those of the joints to be learned."""
    exact = WindowSettings(
        noise=0.0, gravity=1.0, gravity_spread=0.0, lengths=1.0, lengths_spread=0.0, cut=0.0,
        unusual=0.0, near=0.0, recombined=0.0, seated=0.0,
    )  # fmt: skip
    found, rng = tracks(), np.random.default_rng(0)
    values, joints = training_windows(found, 400, rng, exact, 0)
    assert values.shape == (400, INPUTS)
    assert joints.shape == (400, len(JOINTS), 3)
    # Rays of the knees in the first image agree with the pose.
    count = len(LANDMARKS)
    plane = values[:, : 2 * count].reshape(400, count, 2)
    hips = [LANDMARKS.index(name) for name in HIPS]
    knee, of_pose = LANDMARKS.index('left_knee'), JOINTS.index('left_knee')
    seen = plane[:, knee] - plane[:, hips].mean(1)
    assert np.corrcoef(seen[:, 0], joints[:, of_pose, 0])[0, 1] > 0.9
    assert np.corrcoef(seen[:, 1], joints[:, of_pose, 1])[0, 1] > 0.7


def test_parts_of_one_track_make_the_person_again():
    found = keypoint_tracks(BODY, [procedural_sequence('walk', BODY, 2.0, 0)], [1.0], variants=1)
    poses = procedural_sequence('walk', BODY, 2.0, 0).poses
    rows = np.broadcast_to(np.arange(len(poses))[:, None], (3, len(poses), 1))
    made = assembled(found, found.joints, JOINTS, rows)[:, 0]
    wanted = BODY.joint_positions(poses)[:, BODY.skeleton.joint_index(JOINTS)]
    np.testing.assert_allclose(made - made[0, 0], wanted - wanted[0, 0], atol=1e-5)


def test_a_person_of_three_tracks_holds_together():
    found, rng = tracks(), np.random.default_rng(1)
    which = rng.integers((~found.seated).sum(), size=(3, 40))
    rows = (found.starts[which] + 5)[..., None]
    made = dict(zip(JOINTS, assembled(found, found.joints, JOINTS, rows)[:, 0].swapaxes(0, 1)))
    for above, below, length in (
        ('shoulder', 'elbow', 'upper_arm'),
        ('elbow', 'wrist', 'forearm'),
        ('hip', 'knee', 'thigh'),
    ):
        for side in ('left', 'right'):
            distance = np.linalg.norm(made[f'{side}_{above}'] - made[f'{side}_{below}'], axis=1)
            np.testing.assert_allclose(distance, BODY.segment_lengths[length], atol=1e-4)
    # The arms come from another track, the legs from this one.
    own = assembled(found, found.joints, JOINTS, np.repeat(rows[:1], 3, axis=0))[:, 0]
    other = which[2] != which[0]
    wrists = np.linalg.norm(own[:, JOINTS.index('left_wrist')] - made['left_wrist'], axis=1)
    assert np.median(wrists[other]) > 0.01
    np.testing.assert_allclose(own[:, JOINTS.index('left_knee')], made['left_knee'], atol=1e-6)


@pytest.mark.parametrize('asynchronous', [0.0, 1.0])
def test_parts_of_one_track_are_at_one_time_or_not(asynchronous):
    plain = WindowSettings(
        noise=0.0, near=0.0, recombined=0.0, seated=0.0, asynchronous=asynchronous
    )
    one = keypoint_tracks(BODY, [procedural_sequence('walk', BODY, 2.0, 0)], [1.0], variants=1)
    _, joints = training_windows(one, 60, np.random.default_rng(0), plain, 0)
    poses = procedural_sequence('walk', BODY, 2.0, 0).poses
    recorded = BODY.joint_positions(poses)[:, BODY.skeleton.joint_index(JOINTS)]

    def distances(places):
        return np.linalg.norm(places[:, :, None] - places[:, None], axis=3)

    apart = np.abs(distances(joints)[:, None] - distances(recorded)).max((2, 3))
    at_one_time = apart.min(1) < 1e-4
    assert at_one_time.all() if asynchronous == 0 else at_one_time.mean() < 0.2


def test_arms_within_the_trunk_meet():
    joints = BODY.joint_positions(np.repeat(BODY.prior_mean[None], 2, axis=0))
    joints = joints[:, BODY.skeleton.joint_index(JOINTS)]
    middle = 0.5 * (joints[1, JOINTS.index('pelvis')] + joints[1, JOINTS.index('neck')])
    joints[1, JOINTS.index('left_wrist')] = middle
    assert meet(joints.astype(np.float32)).tolist() == [False, True]


def test_people_sit_in_some_windows():
    rng, sits = np.random.default_rng(0), WindowSettings(noise=0.0, seated=1.0, unusual=0.0)
    _, joints = training_windows(tracks(), 200, rng, sits, 0)
    thigh = joints[:, JOINTS.index('left_knee')] - joints[:, JOINTS.index('left_hip')]
    # The camera looks down a little; a thigh that points ahead is far from upright.
    assert np.median(np.abs(thigh[:, 1])) < 0.6 * BODY.segment_lengths['thigh']


def test_what_is_below_the_border_is_doubted():
    rng = np.random.default_rng(0)
    rays = np.zeros((300, len(TIMES), len(LANDMARKS), 2), np.float32)
    rays[:, :, :5, 1] = 1.0
    sure = np.ones(rays.shape[:3], np.float32)
    times, far = np.tile(TIMES, (300, 1)), np.full(300, 1.0, np.float32)
    seen, confidences = with_errors(rays, sure, far, times, rng, 1.0, np.full(300, 0.8))
    below, shown = confidences[:, :, :5], confidences[:, :, 5:]
    assert np.median(below) < 0.5 < 0.8 < np.median(shown)
    errors = np.abs(seen - rays)
    assert np.median(errors[:, :, :5]) > 2.0 * np.median(errors[:, :, 5:])


def test_errors_of_detectors_are_shares():
    e = DetectorErrors()
    assert e.white + e.lasting + e.constant == pytest.approx(1.0, abs=0.05)
    assert sum(e.exchanged) == pytest.approx(1.0)


def test_windows_are_the_same_with_the_same_seed():
    found = tracks()
    one, two = (training_windows(found, 8, np.random.default_rng(3)) for _ in range(2))
    for a, b in zip(one, two):
        assert np.array_equal(a, b)
    assert np.isfinite(one[0]).all()


def test_errors_grow_with_their_factor():
    rng = np.random.default_rng(0)
    rays = np.zeros((400, len(TIMES), len(LANDMARKS), 2), np.float32)
    sure = np.ones(rays.shape[:3], np.float32)
    times, far = np.tile(TIMES, (400, 1)), np.full(400, 2.0, np.float32)
    small, _ = with_errors(rays, sure, far, times, rng, 1.0)
    large, seen = with_errors(rays, sure, far, times, rng, 2.0)
    ratio = np.median(np.abs(large)) / np.median(np.abs(small))
    assert ratio == pytest.approx(2.0, rel=0.1)
    assert ((seen >= 0) & (seen <= 1)).all()
    # Errors are correlated in time, more for neighbouring than for distant images.
    x = small[..., 0].reshape(400, len(TIMES), -1)
    near = np.corrcoef(x[:, 0].ravel(), x[:, 1].ravel())[0, 1]
    far_apart = np.corrcoef(x[:, 0].ravel(), x[:, 5].ravel())[0, 1]
    assert near > far_apart > 0.05


def test_proportions_have_no_size():
    larger = {k: 1.3 * v for k, v in BODY.segment_lengths.items()}
    np.testing.assert_allclose(proportions(BODY, larger), 0.0, atol=1e-12)


def test_learning_gains_and_repeats(tmp_path):
    pytest.importorskip('jax')
    pytest.importorskip('optax')
    found = tracks()
    settings = LearningSettings(experts=2, units=32, layers=1, steps=500, batch=64)
    windows = WindowSettings(noise=0.3)
    losses: list[float] = []
    lifter = learn_lifter(
        BODY, found, settings, windows, {}, lambda _, loss: losses.append(loss),
        tmp_path / 'mark.npz',
    )  # fmt: skip
    assert np.mean(losses[-50:]) < np.mean(losses[:50]) - 0.3
    inputs, joints = training_windows(found, 300, np.random.default_rng(9), windows)
    scores = lifter_scores(lifter, inputs, joints)
    assert scores.best <= scores.heaviest < 0.3
    # Resuming from the checkpoint of the last step gives the same lifter.
    again = learn_lifter(BODY, found, settings, windows, {}, None, tmp_path / 'mark.npz')
    assert all(
        np.array_equal(getattr(lifter.network, name), getattr(again.network, name))
        for name in ('first', 'last', 'mean')
    )
    other = LearningSettings(experts=2, units=32, layers=1, steps=500, batch=32)
    with pytest.raises(ValueError, match='other settings'):
        learn_lifter(BODY, found, other, windows, {}, None, tmp_path / 'mark.npz')


# The bundled lifter, on persons and keypoints that are rare in training or absent.


def turned(poses, axis, degrees):
    """Poses of a person rotated about an axis of the camera."""
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array(axis)).as_matrix()
    result = poses.copy()
    result[:, 3:6] = root_angles(BODY, turn @ root_rotations(BODY, poses))
    moved = poses[:, :3] - poses[0, :3]
    result[:, :3] = poses[0, :3] + moved @ turn.T
    return np.clip(result, BODY.lower, BODY.upper)


def sitting(poses):
    result = poses.copy()
    for side in ('left', 'right'):
        for dof, angle in ((f'{side}_hip_x', 85.0), (f'{side}_knee', -85.0)):
            row = BODY.dof_names.index(dof)
            result[:, row] = np.clip(np.radians(angle), BODY.lower[row], BODY.upper[row])
    return result


def only(names):
    def edit(keypoints):
        kept = np.array([name in names for name in keypoints.names])
        return replace(keypoints, confidences=keypoints.confidences * kept)

    return edit


FIVE = ('nose', 'left_shoulder', 'right_shoulder', 'left_hip', 'right_hip')
CASES = {
    'walk': (lambda w: w, {}, 0.06),
    'upside down': (lambda w: turned(w, [0, 0, 1], 180), {}, None),
    'lying sideways': (lambda w: turned(w, [0, 0, 1], 90), {}, None),
    'lying towards': (lambda w: turned(w, [1, 0, 0], 80), {}, None),
    'lying away': (lambda w: turned(w, [1, 0, 0], -80), {}, None),
    'child': (lambda w: w, {'size': 0.65}, 0.06),
    'sitting': (sitting, {}, 0.12),
    'five points': (lambda w: w, {'edit': only(FIVE)}, None),
    'once a second': (lambda w: w, {'rate': 1.0}, 0.07),
    '120 a second': (lambda w: w, {'rate': 120.0}, 0.08),
    'another camera': (lambda w: w, {'camera': replace(CAMERA, fx=1200.0, fy=1200.0)}, 0.07),
}  # fmt: skip


@pytest.mark.parametrize('name', CASES)
def test_no_confident_wrong_pose(name):
    """If the heaviest pose is wrong, its deviations are as large as its depth errors."""
    of, more, most = CASES[name]
    size = more.get('size', 1.0)
    body = BODY.with_segment_lengths({k: size * v for k, v in BODY.segment_lengths.items()})
    poses = of(walking(20))
    seen = [more.get('edit', lambda x: x)(one) for one in detected(poses, body=body)]
    stamps = np.arange(len(seen)) / more.get('rate', 30.0)
    camera = more.get('camera', CAMERA)
    found = lifted_in(load_lifter(), stamps, seen, camera, causal=True)
    errors, ratios = [], []
    for true, one in zip(truly_lifted(poses, body), found):
        assert one is not None
        off = one.sized(body.skeleton) - true.means[0]
        distance = np.linalg.norm(off, axis=2).mean(1)
        errors.append(distance[one.log_weights.argmax()])
        nearest = distance.argmin()
        ratios.append(np.mean((off[nearest, :, 2] / one.deviations[nearest, :, 2]) ** 2) ** 0.5)
    assert np.mean(ratios) < 2.5
    if most is not None:
        assert np.mean(errors) < most


def test_without_confidence_there_is_no_pose():
    seen = [only(())(one) for one in detected(walking(2))]
    assert lifted_in(load_lifter(), np.arange(2) / 30.0, seen) == [None, None]


def test_two_people_mixed_are_wide():
    """Keypoints of two people who face opposite ways give no narrow mixture."""
    poses, rng = walking(10), np.random.default_rng(0)
    pairs = zip(detected(poses), detected(turned(poses, [0, 1, 0], 180)))
    seen = [
        replace(a, pixels=np.where(rng.random((len(a.names), 1)) < 0.5, a.pixels, b.pixels))
        for a, b in pairs
    ]
    usual = lifted_in(load_lifter(), np.arange(10) / 30.0, detected(poses))
    mixed = lifted_in(load_lifter(), np.arange(10) / 30.0, seen)
    assert mixed[-1].deviations[..., 2].mean() > 2.0 * usual[-1].deviations[..., 2].mean()


@pytest.mark.parametrize('scheme', sorted(schemes()))
def test_any_networks_pose_is_a_guess_of_the_whole(scheme: str) -> None:
    """If a joint has no position, such as COCO's neck, the others still have depths."""
    pose = BODY.prior_mean.copy()
    pose[:3] = 0.2, 0.0, 4.0
    frames = forward(BODY.skeleton, pose[None])
    known = schemes()[scheme]
    marks = [x for x in known.landmarks if x.joint]
    names = [n for n, x in zip(known.names, known.landmarks, strict=True) if x.joint]
    which = BODY.skeleton.joint_index(tuple(x.joint for x in marks))
    offsets = np.array([x.offset for x in marks]) * BODY.stature / USUAL_STATURE
    places = frames.points(
        BODY.skeleton.joint_segments[which], BODY.skeleton.joint_offsets[which] + offsets
    )[..., 0]
    seen = Keypoints(
        tuple(names), CAMERA.project(places), np.full((len(names), 2, 2), np.nan),
        np.ones(len(names)), positions=places - places.mean(0),
    )  # fmt: skip
    found = lifted_positions(CAMERA, seen.named_for(BODY, scheme)[0])
    assert found is not None
    limbs = {f'{s}_{x}' for s in ('left', 'right') for x in ('elbow', 'wrist', 'knee', 'ankle')}
    assert {*found.joints} >= limbs
    joints = BODY.joint_positions(pose[None])[0]
    middle = joints[BODY.skeleton.joint_index(HIPS)].mean(0)
    true = (joints[BODY.skeleton.joint_index(found.joints)] - middle) @ found.axes.T
    off = np.abs(found.means[0, :, 2] - true[:, 2])
    # Landmarks lie on the skin; those of the wrist are farthest from their joint.
    assert off[[found.joints.index(x) for x in sorted(limbs)]].max() < 0.08
