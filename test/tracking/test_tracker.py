"""The tracker on short motions with known poses: joints as keypoints, and rendered images."""

import multiprocessing
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.body.motion_prior import motion_prior
from hmt_ros.flips.interpretation_tree import enumerate_flips
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.likelihood import ImageLikelihood, LikelihoodSettings
from hmt_ros.image.observation import Observation
from hmt_ros.image.pose_energy import PoseEnergy
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.bounded_newton import resting
from hmt_ros.inference.energy import Derivatives, Energy
from hmt_ros.inference.error_model import ERRORS
from hmt_ros.tracking import (
    GroundSettings,
    PosePrediction,
    Status,
    Subject,
    Tracker,
    TrackerSettings,
)
from hmt_ros.tracking.misfit import KEYPOINTS
from hmt_ros.tracking.posterior import free_covariances
from hmt_ros.tracking.settings import MAX_SIGMA
from hmt_ros.tracking.validity import UNDECIDED_MISFITS

ONLY_KEYPOINTS = LikelihoodSettings.of_terms(keypoints=LikelihoodSettings().keypoints)
OFF = GroundSettings(0.0, 0.0)
FRAME = 100_000_000  # ns


def keypoint_settings(**values):
    return TrackerSettings(
        **{
            'candidates': 8,
            'likelihood': ONLY_KEYPOINTS,
            'flow_weight': 0.0,
            'estimate_shape': False,
            'lifter': '',  # experts have their own tests
            **values,
        }
    )


@pytest.fixture(scope='module')
def black(camera):
    return np.zeros((camera.height, camera.width, 3), np.uint8)


@pytest.fixture(scope='module')
def subject(human32, motion, keypoints_of):
    return Subject(0, keypoints_of(human32, motion[0]), dict(human32.segment_lengths))


@pytest.fixture
def mixture(motion):
    """A start around the first pose: the truth, and another pose 60 cm away."""
    means = np.stack([motion[0], motion[0]])
    means[1, 0] += 0.6
    return GaussianMixture(
        np.array([0.6, 0.4]), means, np.tile(1e-2 * np.eye(motion.shape[1]), (2, 1, 1))
    )


@pytest.fixture(scope='module')
def begun(human32, camera, black, motion, keypoints_of, subject):
    """The person's body and the poses at the first image, from the subject."""
    tracker = Tracker(human32, camera, keypoint_settings())
    tracker.reset(subject)
    posterior, _ = tracker.step(black, 0, keypoints_of(human32, motion[0], 1.0, 0))
    return tracker.estimate.body, posterior


@pytest.fixture(scope='module')
def started(begun, camera):
    """Function (seed, tracker settings) -> a tracker that starts from these poses."""

    def make(seed=0, **values):
        body, posterior = begun
        tracker = Tracker(body, camera, keypoint_settings(**values), seed=seed)
        tracker.reset(posterior)
        return tracker

    return make


@pytest.fixture(scope='module')
def follow(human32, black, motion, keypoints_of, started):
    """Function (tracker or its settings) -> mixtures, and errors of the best mode."""

    def run(frames=8, seed=0, body=human32, tracker=None, **values):
        if tracker is None:
            tracker = started(seed, **values)
        mixtures, errors = [], []
        for i in range(frames):
            seen = keypoints_of(body, motion[i], 1.0, i)
            mixtures.append(tracker.step(black, i * FRAME, seen))
            errors.append(best_error(tracker.estimate.body, mixtures[-1][0], body, motion[i]))
        return tracker, mixtures, np.array(errors)

    return run


def best_error(body, mixture, true_body, pose):
    """Mean joint error of the best mode relative to the pelvis, m."""
    joints, truth = body.joint_positions(mixture.means), true_body.joint_positions(pose[None])
    gaps = (joints - joints[:, :1]) - (truth - truth[:, :1])
    return np.linalg.norm(gaps, axis=2).mean(1).min()


def in_bytes(mixtures):
    return [
        array.tobytes()
        for pair in mixtures
        for m in pair
        for array in (m.weights, m.means, m.covariances)
    ]


@pytest.mark.parametrize('proposals', ['kjs', 'css', 'ss'])
def test_the_truth_is_among_the_modes(follow, proposals):
    tracker, mixtures, errors = follow(proposals=proposals, samples=64)
    assert tracker.estimate.status is Status.TRACKING
    assert errors.mean() < 0.045
    assert errors.max() < 0.07
    assert all(len(posterior) > 1 for posterior, _ in mixtures)


def test_mixtures_are_normalised_sorted_and_within_limits(follow, human32):
    _, mixtures, _ = follow(max_hypotheses=5)
    for pair in mixtures:
        for mixture in pair:
            assert 1 <= len(mixture) <= 5
            assert mixture.weights.sum() == pytest.approx(1.0, abs=1e-12)
            assert (np.diff(mixture.weights) <= 0).all()
            assert (mixture.means >= human32.lower).all()
            assert (mixture.means <= human32.upper).all()
            assert np.array_equal(mixture.covariances, mixture.covariances.transpose(0, 2, 1))
            assert np.linalg.eigvalsh(mixture.covariances).min() > 0


def test_weights_of_the_likelihood_are_those_of_the_image_alone(
    follow, black, camera, human32, motion, keypoints_of
):
    """exp(-energy) at the modes of the posterior, times their volumes, with the ground off.

    The full curvature is used, without discount, so that the mixture is exp(-energy) itself.
    """
    tracker, *_ = follow(frames=3, ground=OFF)
    validity = deepcopy(tracker.estimate.validity)
    validity.predict(1e-9 * FRAME)
    keypoints = keypoints_of(human32, motion[3], 1.0, 3)
    posterior, likelihood = tracker.step(black, 3 * FRAME, keypoints)
    seen = Observation(keypoints=keypoints, beliefs=validity.beliefs)
    of_keypoints = ImageLikelihood(tracker.estimate.body, camera, ONLY_KEYPOINTS)
    terms = (*of_keypoints.seen(seen), *of_keypoints.priors)
    energy = PoseEnergy(of_keypoints, terms).energy(posterior.means)
    gradient, hessian = energy.derivatives()
    free = ~resting(posterior.means, gradient, human32.lower, human32.upper)
    volumes = np.sqrt(np.linalg.det(1e3 * free_covariances(hessian[:, None], free)[0]))
    weights = volumes * np.exp(energy.value.min() - energy.value)
    order = np.argsort(-weights, kind='stable')
    assert np.allclose(likelihood.weights, (weights / weights.sum())[order], rtol=1e-9)
    lower, upper = human32.lower + 1e-6, human32.upper - 1e-6
    for k, precision in zip(order, np.linalg.inv(likelihood.covariances), strict=True):
        inside = (posterior.means[k] > lower) & (posterior.means[k] < upper)
        wanted = energy.hessian[k] + MAX_SIGMA**-2.0 * np.eye(len(inside))
        both = np.ix_(inside, inside)
        assert inside.sum() > len(inside) / 2
        assert np.allclose(precision[both], wanted[both], rtol=1e-6, atol=1e-3)
    # All cues have the same error model, so the mean over active ones is the same.
    shares = [errors.independent for errors in ERRORS.values()]
    assert min(shares) <= tracker.estimate.likelihood.errors.independent <= max(shares)
    # Uncertain lengths add uncertainty to the position, mainly to the distance.
    unknown = tracker.estimate.likelihood.shape_covariance
    assert np.linalg.eigvalsh(unknown).min() > -1e-9
    assert np.diagonal(unknown)[:3].argmax() == 2
    # Its log at the means is the image likelihood, without the prior of the body.
    term = of_keypoints.keypoint_term(seen, None)
    values = PoseEnergy(of_keypoints, (term,)).energy(likelihood.means).value
    assert len(likelihood) > 1
    assert np.allclose(tracker.estimate.likelihood.values, -values, rtol=1e-9)


def test_the_same_seed_and_images_give_identical_bytes(follow):
    for proposals in ('kjs', 'css'):
        _, first, _ = follow(4, seed=3, proposals=proposals)
        _, second, _ = follow(4, seed=3, proposals=proposals)
        assert in_bytes(first) == in_bytes(second)


def test_the_number_of_threads_does_not_change_a_byte(follow):
    _, first, _ = follow(4, seed=3, threads=1)
    for threads in (2, 4):
        _, other, _ = follow(4, seed=3, threads=threads)
        assert in_bytes(first) == in_bytes(other)


def test_trackers_in_threads_and_in_a_forked_process_give_the_same_bytes(follow):
    def run(seed):
        return in_bytes(follow(4, seed=seed, threads=2)[1])

    wanted = [run(3), run(4)]
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(run, (3, 4))) == wanted
    context = multiprocessing.get_context('fork')
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=lambda: sender.send(run(4)), daemon=True)
    child.start()
    assert receiver.poll(120.0), 'the child waits for threads that only its parent has'
    assert receiver.recv() == wanted[1]
    child.join()


def test_other_body_sizes(follow, human32, camera, motion, keypoints_of):
    """A child's lengths come from the subject; the model is the same."""
    child = human32.with_stature(1.3)
    lengths = child.segment_lengths
    subject = Subject(0, keypoints_of(child, motion[0]), lengths)
    tracker = Tracker(human32, camera, keypoint_settings(), seed=1)
    tracker.reset(subject)
    _, first, errors = follow(4, body=child, tracker=tracker)
    assert tracker.model is human32
    found = tracker.estimate.body.segment_lengths
    assert max(abs(found[name] - lengths[name]) for name in lengths) < 0.02
    assert errors.max() < 0.06
    again = Tracker(human32, camera, keypoint_settings(), seed=1)
    again.reset(subject)
    _, second, _ = follow(4, body=child, tracker=again)
    assert in_bytes(first) == in_bytes(second)


def test_reset_starts_over(follow):
    tracker, first, _ = follow(4, proposals='css', seed=7)
    tracker.reset()
    assert tracker.estimate.status is Status.WAITING
    assert len(tracker.estimate.posterior) == 0
    _, second, _ = follow(4, tracker=tracker)
    assert in_bytes(first) == in_bytes(second)


def test_waits_for_the_image_of_the_subject(human32, camera, black, subject, motion, keypoints_of):
    tracker = Tracker(human32, camera, keypoint_settings())
    assert tracker.step(black, 5) == (None, None)  # there is no start
    tracker.reset(replace(subject, stamp_ns=3 * FRAME))
    for i in range(3):
        assert tracker.step(black, i * FRAME + 7) == (None, None)
        assert tracker.estimate.status is Status.WAITING
    assert tracker.silhouettes.background.frames == 4
    seen = keypoints_of(human32, motion[0])
    posterior, likelihood = tracker.step(black, 3 * FRAME + 7, seen)
    assert tracker.estimate.status is Status.TRACKING
    assert posterior.dimension == likelihood.dimension == human32.dimension
    # No person can be separated from a black background.
    assert tracker.silhouettes.doubted


def test_start_from_a_mixture(human32, camera, black, motion, keypoints_of, mixture):
    """The image decides between the components; the body does not change."""
    tracker = Tracker(human32, camera, keypoint_settings())
    tracker.reset(mixture)
    assert tracker.estimate.status is Status.WAITING
    posterior, _ = tracker.step(black, 0, keypoints_of(human32, motion[0]))
    assert tracker.estimate.body is human32
    assert np.abs(posterior.means[0] - motion[0]).max() < 0.3
    assert np.abs(posterior.means[0, :3] - motion[0, :3]).max() < 0.05
    assert posterior.weights[0] > 0.5
    for i in range(1, 4):
        posterior, _ = tracker.step(black, i * FRAME, keypoints_of(human32, motion[i], 1.0, i))
        assert best_error(human32, posterior, human32, motion[i]) < 0.06


def test_a_mode_goes_on_whatever_is_proposed(
    human32, camera, black, motion, keypoints_of, monkeypatch
):
    """A limb and its flip have the same image; only near the first one are there proposals."""

    def first_alone(search, sources, rng):
        still = np.zeros((1, 32), dtype=bool)
        return sources.proposed(np.zeros(1, dtype=int), search.base.x[:1], still)

    flips = enumerate_flips(human32, motion[6:7], 'left_arm')[0]
    wrists = human32.relative_joints(flips)[:, human32.joint_names.index('left_wrist')]
    far = np.linalg.norm(wrists - wrists[0], axis=1).argmax()
    both = flips[[0, far]]
    monkeypatch.setattr('hmt_ros.tracking.filter.propose', lambda _, *given: first_alone(*given))
    tracker = Tracker(human32, camera, keypoint_settings())
    tracker.reset(GaussianMixture(np.full(2, 0.5), both, np.tile(0.01 * np.eye(32), (2, 1, 1))))
    for i in range(3):
        posterior, _ = tracker.step(black, i * FRAME, keypoints_of(human32, motion[6], 1.0, i))
    found = human32.relative_joints(posterior.means)[:, human32.joint_names.index('left_wrist')]
    assert np.linalg.norm(wrists[far] - wrists[0]) > 0.2
    for wrist in wrists[[0, far]]:
        assert np.linalg.norm(found - wrist, axis=1).min() < 0.1


def test_modes_move_on_where_nothing_is_seen(human37, camera, black, motion, keypoints_of):
    """Keypoints with errors of 10^5 px have no information: modes follow their velocities."""
    free = replace(ONLY_KEYPOINTS, prior_weight=0.0, self_intersection_sigma=np.inf)
    settings = keypoint_settings(likelihood=free, max_hypotheses=1, ground=OFF)
    tracker = Tracker(human37, camera, settings)
    pose = human37.prior_mean.copy()
    pose[:6] = motion[0, :6]
    start = GaussianMixture(np.ones(1), pose[None], 1e-4 * np.eye(len(pose))[None])
    tracker.reset(start)
    speed, first = 0.6, pose[0]  # m/s, across
    for i in range(8):
        pose[0] = first + speed * i * 0.1
        tracker.step(black, i * FRAME, keypoints_of(human37, pose, 0.5, i))
    before = tracker.estimate.modes
    assert before.velocities[0, 0] == pytest.approx(speed, abs=0.1)
    seen = keypoints_of(human37, pose, 0.0)
    covariances = np.tile(1e10 * np.eye(2), (len(seen.names), 1, 1))
    faint = Keypoints(seen.names, seen.pixels, covariances, seen.confidences)
    posterior, _ = tracker.step(black, 8 * FRAME, faint)
    transition, _ = motion_prior(human37).transition(0.1)
    wanted = transition @ np.concatenate([before.poses[0], before.velocities[0]])
    wanted = np.clip(wanted[: len(pose)], human37.lower, human37.upper)
    assert np.abs(posterior.means[0] - wanted).max() < 1e-4
    # Without velocity they stay.
    still = Tracker(human37, camera, settings)
    still.reset(start)
    for i in range(3):
        posterior, _ = still.step(black, i * FRAME, faint)
    assert np.abs(posterior.means[0] - start.means[0]).max() < 1e-4


def test_without_keypoints_and_background_it_still_runs(human32, camera, motion, subject):
    """With edges and texture of noise, poses stay near and weights are valid."""
    rng = np.random.default_rng(0)
    settings = TrackerSettings(candidates=8, max_hypotheses=4)
    tracker = Tracker(human32, camera, settings)
    tracker.reset(subject)
    for i in range(4):
        image = rng.integers(0, 255, (camera.height, camera.width, 3), dtype=np.uint8)
        pair = tracker.step(image, i * FRAME)
        for mixture in pair:
            assert mixture.weights.sum() == pytest.approx(1.0)
            assert np.linalg.eigvalsh(mixture.covariances).min() > 0
    assert tracker.silhouettes.background.frames == 0
    assert best_error(tracker.estimate.body, pair[0], human32, motion[3]) < 0.3


# Images, including three good ones, until a track with jumped keypoints is lost: 0.4 s.
LOST_WITHIN = 15


def jumped(motion):
    """Another pose, rotated and two steps aside."""
    pose = motion[11].copy()
    pose[0] += 0.9
    pose[3] += 2.5
    return pose


def test_a_lost_track_starts_anew_from_keypoints(human32, started, black, motion, keypoints_of):
    tracker = started()
    other = jumped(motion)
    seen, misfits, errors, begins, places = [], [], [], [], []
    for i in range(18):
        pose = motion[i] if i < 3 else other
        posterior, _ = tracker.step(black, i * FRAME, keypoints_of(human32, pose, 1.0, i))
        seen.append(tracker.estimate.status)
        begins.append(tracker.estimate.origins.shape[1] == 0)
        places.append(tracker.estimate.point_estimate[:3])
        misfits.append(tracker.estimate.misfit)
        errors.append(best_error(tracker.estimate.body, posterior, human32, pose))
    tracking, lost = Status.TRACKING, Status.LOST
    found = seen.index(lost) + 1
    assert 5 <= found <= LOST_WITHIN
    assert seen == [tracking] * (found - 1) + [lost] + [tracking] * (len(seen) - found)
    assert max(misfits[:3]) < 0.1
    assert min(misfits[3:found]) > UNDECIDED_MISFITS[KEYPOINTS]
    assert max(misfits[found:]) < 0.1
    assert min(errors[3:found]) > 0.08
    assert max(errors[found:]) < 0.065
    # The position, not only the posture.
    assert np.abs(posterior.means[:, :3] - other[:3]).max(1).min() < 0.25
    # Replaced modes have no history, and the point estimate jumps to them.
    # One image determines the depth to about a tenth.
    assert begins == [i in (0, found) for i in range(len(begins))]
    assert np.abs(places[found][:2] - other[:2]).max() < 0.15
    assert abs(places[found][2] - other[2]) < 0.4


def predicted(body, pose):
    """A regression's prediction of a pose: near it, or with front and back exchanged."""
    means = np.stack([pose, pose])
    means[0, 6:] += 0.05
    means[1, 5] += np.pi
    covariances = np.tile(0.02 * np.eye(len(pose)), (2, 1, 1))
    return PosePrediction(GaussianMixture([0.5, 0.5], means, covariances), body)


def test_a_prediction_starts_a_track(human32, camera, black, motion, keypoints_of):
    tracker = Tracker(human32, camera, keypoint_settings())
    assert tracker.step(black, 0, keypoints_of(human32, motion[0])) == (None, None)
    for i in (1, 2):
        seen = keypoints_of(human32, motion[i], 1.0, i)
        posterior, _ = tracker.step(black, i * FRAME, seen, predicted(human32, motion[1]))
        assert best_error(human32, posterior, human32, motion[i]) < 0.06
    # The next track has no other start, either.
    tracker.reset()
    assert tracker.step(black, 0, keypoints_of(human32, motion[0])) == (None, None)


def test_a_lost_track_starts_anew_from_a_prediction(human32, started, black, motion, keypoints_of):
    few = ('left_hip', 'right_knee', 'left_wrist', 'right_elbow', 'left_toe')
    other = jumped(motion)
    errors = {}
    for given in (False, True):
        tracker = started()
        statuses = []
        for i in range(LOST_WITHIN):
            seen = keypoints_of(human32, motion[i] if i < 3 else other, 1.0, i)
            rows = [seen.names.index(name) for name in few]
            # Too few to start from.
            seen = Keypoints(few, seen.pixels[rows], seen.covariances[rows], np.ones(len(few)))
            lost = tracker.estimate.status is Status.LOST
            prediction = predicted(human32, other) if given and lost else None
            posterior, _ = tracker.step(black, i * FRAME, seen, prediction)
            statuses.append(tracker.estimate.status)
            if lost:
                break
        assert statuses[-2] is Status.LOST
        assert (statuses[-1] is Status.TRACKING) == given
        errors[given] = best_error(tracker.estimate.body, posterior[:1], human32, other)
    # With few keypoints the prior of the angles pulls the pose away from the prediction.
    assert errors[True] < 0.6 * errors[False]


def test_nothing_becomes_certain_while_a_lost_track_is_sought(
    human32, started, black, motion, keypoints_of
):
    other, tracker = jumped(motion), started()
    for i in range(LOST_WITHIN + 20):
        seen = keypoints_of(human32, motion[i] if i < 3 else other, 1.0, i)
        # Restarts in each image, at a place without a person.
        prediction = (
            predicted(human32, motion[0]) if tracker.estimate.status is Status.LOST else None
        )
        joints = seen.names if prediction is None else ('left_hip', 'right_knee')
        rows = [seen.names.index(name) for name in joints]
        seen = Keypoints(joints, seen.pixels[rows], seen.covariances[rows], np.ones(len(rows)))
        tracker.step(black, i * FRAME, seen, prediction)
    chances = np.concatenate(
        [[tracker.estimate.validity.track], *tracker.estimate.validity.cues.values()]
    )
    assert chances.min() > 1e-4
    assert chances.max() < 0.9999


def test_predictions_are_among_the_hypotheses(human32, started, black, motion, keypoints_of):
    """No other proposal finds the jump in its image."""
    errors = {}
    for given in (False, True):
        tracker = started()
        for i in range(4):
            pose = motion[i] if i < 3 else jumped(motion)
            prediction = predicted(human32, pose) if given else None
            seen = keypoints_of(human32, pose, 1.0, i)
            posterior, _ = tracker.step(black, i * FRAME, seen, prediction)
        errors[given] = best_error(tracker.estimate.body, posterior, human32, pose)
    assert errors[False] > 0.15
    assert errors[True] < 0.06


def test_who_jumps_is_found_where_the_keypoints_are(human32, started, black, motion, keypoints_of):
    """The new pose is found as soon as the track is lost, and not before."""
    tracker, errors, lost = started(), [], []
    for i in range(LOST_WITHIN + 3):
        pose = motion[i] if i < 3 else jumped(motion)
        posterior, _ = tracker.step(black, i * FRAME, keypoints_of(human32, pose, 1.0, i))
        errors.append(best_error(tracker.estimate.body, posterior, human32, pose))
        lost.append(tracker.estimate.status is Status.LOST)
    found = lost.index(True) + 1
    assert min(errors[3:found]) > 0.08
    assert max(errors[found:]) < 0.065


def test_one_bad_image_is_forgiven(human32, started, black, motion, keypoints_of):
    tracker = started()
    rng = np.random.default_rng(0)
    for i in range(6):
        seen = keypoints_of(human32, motion[i], 1.0, i)
        if i == 3:
            anywhere = rng.uniform(0, 240, seen.pixels.shape)
            seen = Keypoints(seen.names, anywhere, seen.covariances, seen.confidences)
        posterior, _ = tracker.step(black, i * FRAME, seen)
        assert tracker.estimate.status is Status.TRACKING
        assert (tracker.estimate.misfit > UNDECIDED_MISFITS[KEYPOINTS]) == (i == 3)
    assert best_error(tracker.estimate.body, posterior, human32, motion[5]) < 0.07


def test_bad_images_are_refused_and_change_nothing(follow, human32, black, motion, keypoints_of):
    tracker, first, _ = follow(3)
    with pytest.raises(ValueError, match=r'images of \(240, 320\), saw \(120, 320\)'):
        tracker.step(black[::2], 3 * FRAME)
    for stamp in (2 * FRAME, FRAME):
        with pytest.raises(ValueError, match=f'stamps must increase, saw {stamp} after'):
            tracker.step(black, stamp, keypoints_of(human32, motion[3]))
    again, second, _ = follow(3)
    assert in_bytes(first) == in_bytes(second)
    seen = keypoints_of(human32, motion[3], 1.0, 3)
    pairs = [t.step(black, 3 * FRAME, seen) for t in (tracker, again)]
    assert in_bytes(pairs[:1]) == in_bytes(pairs[1:])


@pytest.mark.parametrize(
    ('values', 'said'),
    [
        ({'motion': 'still'}, r"motion must be one of .*learned.* saw 'still'"),
        ({'max_hypotheses': 0}, 'max_hypotheses must be at least 1, saw 0'),
        ({'evaluation_budget': 0}, 'evaluation_budget must be at least 1, saw 0'),
    ],
)
def test_settings_that_are_refused(values, said):
    with pytest.raises(ValueError, match=said):
        TrackerSettings(**values)


def test_a_proposal_that_is_not_in_the_list_is_refused(human32, camera):
    with pytest.raises(ValueError, match=r"proposals must be one of .*kjs.* saw 'magic'"):
        Tracker(human32, camera, TrackerSettings(proposals='magic'))


@pytest.fixture(scope='module')
def film(filmed, camera):
    """Poses, images and the empty scene of a walking person."""
    return filmed('walk', 0.6, camera)


def test_images_alone(film, human32, camera, keypoints_of):
    """After the first image only pixels are used; equal seeds give identical bytes."""
    poses, images, empty = film
    runs = []
    for seed in (5, 5, 6):
        settings = TrackerSettings(candidates=8, max_hypotheses=4)
        tracker = Tracker(human32, camera, settings, BackgroundModel.from_image(empty), seed=seed)
        tracker.reset(Subject(0, keypoints_of(human32, poses[0]), dict(human32.segment_lengths)))
        runs.append([tracker.step(image, i * FRAME) for i, image in enumerate(images)])
        assert tracker.estimate.status is Status.TRACKING
        assert tracker.estimate.misfit < 0.2
    errors = [
        best_error(tracker.estimate.body, posterior, human32, pose)
        for (posterior, _), pose in zip(runs[0], poses)
    ]
    assert max(errors) < 0.1
    assert in_bytes(runs[0]) == in_bytes(runs[1])
    assert in_bytes(runs[0]) != in_bytes(runs[2])


class KnownHeight:
    """A term that only measures the height of the root above the floor."""

    def __init__(self, height):
        self.height = height

    def energy(self, frames, rows, *, derivatives=Derivatives.POSITIVE):
        n, d = frames.poses.shape
        offset = frames.poses[:, 1] - self.height
        gradient, hessian = np.zeros((n, d)), np.zeros((n, d, d))
        gradient[:, 1], hessian[:, 1, 1] = 1e8 * offset, 1e8
        value = 0.5e8 * offset**2
        return Energy(value, gradient, hessian) if derivatives else Energy(value)


def test_a_further_term_takes_part_in_the_posterior(human32, camera, black, motion, subject):
    height = motion[0, 1] + 0.1
    tracker = Tracker(human32, camera, keypoint_settings(), extra=[KnownHeight(height)])
    tracker.reset(subject)
    posterior, likelihood = tracker.step(black, 0)
    for mixture in (posterior, likelihood):
        assert mixture.means[:, 1] == pytest.approx(np.full(len(mixture), height), abs=1e-3)
        assert (mixture.covariances[:, 1, 1] < 1e-7).all()
