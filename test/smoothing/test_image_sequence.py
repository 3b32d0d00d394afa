"""Images as observations: the same energies as in the filter, and a smoothed walk."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_ros.body import Camera, load_body
from hmt_ros.image.image_sequence import ImageSequence, SeenImage
from hmt_ros.image.likelihood import ImageLikelihood
from hmt_ros.image.observation import Beliefs, Observation, observe
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.energy import Derivatives
from hmt_ros.inference.error_model import ERRORS
from hmt_ros.smoothing import LinearGaussianDynamics, MixtureSmoother
from hmt_ros.tracking import TrackerSettings
from hmt_ros.tracking.ground import GroundEstimator, KnownGround
from hmt_ros.tracking.posterior import Posterior

NAMES = ('pelvis', 'neck', 'left_knee', 'right_knee', 'left_ankle', 'right_ankle', 'left_elbow',
         'right_elbow', 'left_wrist', 'right_wrist')  # fmt: skip
STAMPS = tuple(100_000_000 * t for t in range(5))
CAMERA = Camera(330.0, 330.0, 159.5, 119.5, 320, 240)


@pytest.fixture(scope='module')
def walk():
    """Poses (5, d), their body, and the images as keypoints with noise of 2 px."""
    body = load_body('human37')
    poses = procedural_motion('walk', body, 0.8, 10.0, 3, viewpoint=Viewpoint(distance=3.2))[:5]
    rng = np.random.default_rng(0)
    at = [body.joint_names.index(name) for name in NAMES]
    observations = []
    for joints in body.joint_positions(poses):
        pixels = CAMERA.project(joints[at]) + 2.0 * rng.normal(size=(len(at), 2))
        covariances = np.tile(4.0 * np.eye(2), (len(at), 1, 1))
        observations.append(
            Observation(keypoints=Keypoints(NAMES, pixels, covariances, np.ones(len(at))))
        )
    likelihood = ImageLikelihood(body, CAMERA)
    images = [SeenImage(likelihood, one) for one in observations]
    return body, ImageSequence.of(images, STAMPS), poses


@pytest.fixture(scope='module')
def believed(walk):
    """A filter's energies, and images with silhouettes and reliabilities, with a known floor."""
    body, sequence, poses = walk
    ground = GroundEstimator(KnownGround(np.array([0.0, -1.0, 0.0]), 1.1))
    posterior = Posterior(body, CAMERA, TrackerSettings(), ground=ground)
    rng = np.random.default_rng(2)
    images = []
    for pose, image in zip(poses, sequence.images):
        left, top = CAMERA.project(body.joint_positions(pose[None])[0]).min(0).astype(int)
        right, bottom = CAMERA.project(body.joint_positions(pose[None])[0]).max(0).astype(int)
        mask = np.zeros((240, 320), dtype=bool)
        mask[max(top, 0) : bottom, max(left, 0) : right] = True
        picture = rng.integers(0, 255, (240, 320, 3), dtype=np.uint8)
        seen = observe(picture, mask, image.observation.keypoints)
        beliefs = Beliefs(0.7, np.array([0.9, 0.6, 0.8]), 0.5)
        seen = replace(seen, beliefs=beliefs, magnification=100.0)
        images.append(SeenImage(posterior.likelihood, seen, posterior.known(seen)))
    return posterior, images


def test_energies_are_those_by_which_the_filter_weighs(walk, believed):
    _, _, poses = walk
    posterior, images = believed
    sequence = ImageSequence.of(images, STAMPS)
    nearby = poses + 0.02 * np.random.default_rng(3).normal(size=poses.shape)
    both, rows = np.concatenate([poses, nearby]), np.tile(np.arange(5), 2)
    found = sequence.energy(both, rows, derivatives=Derivatives.NONE)
    assert found.gradient is None
    wanted = []
    for pose, t in zip(both, rows):
        unknown = np.full((1, 4), np.nan)
        dt = np.inf if t == 0 else 0.1
        wanted.append(posterior.evidence(pose[None], images[t].observation, unknown, dt)[0])
    np.testing.assert_allclose(found.value, wanted, rtol=1e-12)
    assert np.ptp(found.value[rows > 0]) > 0.1


def test_derivatives_are_those_of_the_energy(walk, believed):
    # Only keypoints and priors, because contour points slide along the flesh with the pose.
    body, sequence, poses = walk
    images = [replace(one, known=believed[0].known(one.observation)) for one in sequence.images]
    sequence = ImageSequence.of(images, STAMPS)
    rng = np.random.default_rng(4)
    x = np.clip(poses[1:3] + 0.05 * rng.normal(size=(2, body.dimension)), body.lower, body.upper)
    rows = np.array([1, 2])
    _, gradient, hessian = sequence.energy(x, rows, derivatives=Derivatives.EXACT)
    step = 1e-6
    for _ in range(6):
        way = rng.normal(size=body.dimension)
        ahead, behind = (sequence.energy(x + s * step * way, rows).value for s in (1.0, -1.0))
        np.testing.assert_allclose(
            (ahead - behind) / (2.0 * step), gradient @ way, rtol=2e-3, atol=1e-2
        )
    positive = sequence.energy(x, rows).hessian
    assert (np.linalg.eigvalsh(positive) > -1e-6 * np.abs(positive).max()).all()
    assert hessian.shape == positive.shape


def test_of_changes_images_count_more_and_all_else_as_before(walk):
    _, sequence, _ = walk
    changes = ImageSequence.of(sequence.images, STAMPS, of_changes=True)
    for t, (share, of_changes) in enumerate(zip(sequence.shares, changes.shares)):
        for name, errors in ERRORS.items():
            persistence_ratio = (
                errors.persistence_ratio(0.1 if t else np.inf) if name == 'image' else 1.0
            )
            assert of_changes[name] == pytest.approx(persistence_ratio * share[name])
    assert changes.shares[1]['image'] > sequence.shares[1]['image']


def test_smoothing_on_images_explains_them_better_and_within_limits(walk):
    body, sequence, poses = walk
    rng = np.random.default_rng(1)
    d = body.dimension
    mixtures = [
        GaussianMixture([1.0], [pose + 0.03 * rng.normal(size=d)], [0.01 * np.eye(d)])
        for pose in poses
    ]
    dynamics = LinearGaussianDynamics.random_walk(np.full(d, 1.0), step=0.1)
    smoother = MixtureSmoother(dynamics, body.lower, body.upper, adapt=('inflation',))
    found = smoother.smooth(mixtures, observation=sequence)
    times = np.arange(5)
    start = np.array([m.means[0] for m in mixtures])
    before = sequence.energy(start, times).value.sum()
    after = sequence.energy(found.means[0], times).value.sum()
    assert after < before
    assert ((found.means >= body.lower) & (found.means <= body.upper)).all()
    assert np.isfinite(found.log_joint).all()
    with pytest.raises(ValueError, match='5 observations for 4 mixtures'):
        smoother.smooth(mixtures[:4], observation=sequence)
