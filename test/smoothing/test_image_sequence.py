"""The images themselves as observations: keypoints of a walking person, smoothed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_ros.body import Camera, load_body
from hmt_ros.image.likelihood import ImageLikelihood
from hmt_ros.image.observation import Observation
from hmt_ros.image.pose_energy import PoseEnergy
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.energy import Derivatives, Energy
from hmt_ros.smoothing import LinearGaussianDynamics, MixtureSmoother

NAMES = ('pelvis', 'neck', 'left_knee', 'right_knee', 'left_ankle', 'right_ankle', 'left_elbow',
         'right_elbow', 'left_wrist', 'right_wrist')  # fmt: skip


@dataclass(frozen=True)
class ImageSequence:
    """p(r_t | x_t) of the images themselves, the likelihood that the tracker minimises (VMS 5)."""

    likelihood: ImageLikelihood
    observations: list[Observation]

    @property
    def times(self) -> int:
        return len(self.observations)

    def energy(self, x, rows, *, derivatives=Derivatives.POSITIVE) -> Energy:
        n, d = x.shape
        value, gradient, hessian = np.empty(n), np.empty((n, d)), np.empty((n, d, d))
        for t in np.unique(rows):
            at = rows == t
            terms = (*self.likelihood.seen(self.observations[t]), *self.likelihood.priors)
            found = PoseEnergy(self.likelihood, terms).energy(x[at])
            value[at], gradient[at], hessian[at] = found
        return Energy(value, gradient, hessian)


@pytest.fixture(scope='module')
def walk():
    """Poses (5, d), their body, and the images as keypoints with noise of 2 px."""
    body = load_body('human37')
    camera = Camera(330.0, 330.0, 159.5, 119.5, 320, 240)
    poses = procedural_motion('walk', body, 0.8, 10.0, 3, viewpoint=Viewpoint(distance=3.2))[:5]
    rng = np.random.default_rng(0)
    at = [body.joint_names.index(name) for name in NAMES]
    observations = []
    for joints in body.joint_positions(poses):
        pixels = camera.project(joints[at]) + 2.0 * rng.normal(size=(len(at), 2))
        covariances = np.tile(4.0 * np.eye(2), (len(at), 1, 1))
        observations.append(
            Observation(keypoints=Keypoints(NAMES, pixels, covariances, np.ones(len(at))))
        )
    return body, ImageSequence(ImageLikelihood(body, camera), observations), poses


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
