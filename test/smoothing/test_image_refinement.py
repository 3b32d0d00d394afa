"""Motions refined on images: distinct optima, their weights, limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from hmt_ros.body import Camera, load_body
from hmt_ros.flips.interpretation_tree import enumerate_flips
from hmt_ros.image.image_sequence import ImageSequence, SeenImage
from hmt_ros.image.likelihood import ImageLikelihood
from hmt_ros.image.observation import Observation
from hmt_ros.image.pose_energy import PoseEnergy
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.energy import Derivatives, Energy
from hmt_ros.inference.error_model import CueErrors
from hmt_ros.smoothing import ImageModes, LinearGaussianDynamics, Link, MotionSmoother
from hmt_ros.smoothing.image_refinement import refined_on_images

STEP_NS = 100_000_000
TIMES = 8
INDEPENDENT = CueErrors(1.0, 0.0)


@dataclass(frozen=True)
class TwoWells:
    """E = s (x^2 - 1)^2 / 8 at every time, with minima at -1 and 1 of curvature s."""

    sharpness: float
    times: int = TIMES

    def energy(self, x, rows, *, derivatives=Derivatives.POSITIVE):
        square = x[:, 0] ** 2
        curve = 0.5 * self.sharpness * (3.0 * square - 1.0)
        if derivatives == Derivatives.POSITIVE:
            curve = np.maximum(curve, 0.0)
        slope = 0.5 * self.sharpness * x[:, 0] * (square - 1.0)
        value = self.sharpness * (square - 1.0) ** 2 / 8.0
        return Energy(value, slope[:, None], curve[:, None, None])


def chain(places, weights, sigma=0.1):
    """Constant modes (K, d), each of which continues itself."""
    places = np.asarray(places, dtype=float)
    count, d = places.shape
    result = []
    for t in range(TIMES):
        origins = np.eye(count) if t else np.empty((count, 0))
        mixture = GaussianMixture(weights, places, np.tile(sigma**2 * np.eye(d), (count, 1, 1)))
        result.append(
            ImageModes(STEP_NS * (t + 1), Link(np.array(weights), origins), mixture, INDEPENDENT)
        )
    return result


def smoother_of(**settings):
    return MotionSmoother(LinearGaussianDynamics.random_walk([0.05], step=0.1), **settings)


def refined(places, weights, likelihood=TwoWells(400.0), smoother=None, **options):
    smoother = smoother or smoother_of()
    found = smoother.motions(chain(np.array(places)[:, None], weights))
    return refined_on_images(smoother, found, likelihood, **options)


@pytest.mark.parametrize('adapt', [('inflation',), ('weights', 'inflation')])
def test_optima_of_a_symmetric_likelihood_have_the_same_weight(adapt):
    found = refined([0.8, -0.75], [0.5, 0.5], adapt=adapt)
    assert len(found) == 2
    np.testing.assert_allclose(
        np.sort(found.means[:, :, 0], axis=0), [[-1] * TIMES, [1] * TIMES], atol=2e-3
    )
    np.testing.assert_allclose(found.weights, 0.5, atol=0.02)
    np.testing.assert_allclose(found.log_joint[0], found.log_joint[1], atol=0.02)
    # The deviation of an image is 0.05, of modes 0.1; neighbouring images reduce it.
    spread = np.sqrt(found.marginal_covariances[:, TIMES // 2, 0, 0])
    assert ((spread > 0.02) & (spread < 0.05)).all()
    assert len(found.free_energy) >= 1
    assert (np.diff(found.free_energy) <= 0).all()
    assert found.free_energy_fresh[0] == pytest.approx(found.free_energy[-1], abs=2.0)


def test_the_chain_weighs_and_motions_that_come_together_are_one():
    found = refined([0.9, 1.3, -0.9], [0.4, 0.3, 0.3])
    assert len(found) == 2
    np.testing.assert_allclose(found.weights, [0.7, 0.3], atol=1e-9)
    np.testing.assert_allclose(found.means[:, :, 0], [[1.0] * TIMES, [-1.0] * TIMES], atol=1e-3)


def test_four_motions_are_refined_and_the_others_stay():
    places = [0.5, 0.7, 0.9, 1.1, 2.5]
    found = refined(places, [0.24, 0.23, 0.22, 0.21, 0.10])
    assert len(found) == 2
    np.testing.assert_allclose(found.weights, [0.9, 0.1], atol=1e-9)
    np.testing.assert_allclose(found.means[1, :, 0], 2.5, atol=1e-6)
    assert found.log_joint[0] > found.log_joint[1] + 100.0


def test_refined_motions_stay_within_limits():
    found = refined([0.8, -0.8], [0.6, 0.4], smoother=smoother_of(lower=[-0.9], upper=[0.95]))
    np.testing.assert_allclose(found.means[:, :, 0], [[0.95] * TIMES, [-0.9] * TIMES])
    samples = found.sample(50, np.random.default_rng(0))
    assert samples.min() >= -0.9
    assert samples.max() <= 0.95


def test_the_same_seed_gives_the_same_bytes():
    one, again = (refined([0.8, -0.7], [0.6, 0.4]) for _ in range(2))
    for name in ('weights', 'states', 'inflation', 'log_joint', 'free_energy'):
        assert getattr(one, name).tobytes() == getattr(again, name).tobytes()
    other = refined([0.8, -0.7], [0.6, 0.4], smoother=smoother_of(seed=1))
    assert one.free_energy_fresh != other.free_energy_fresh


def test_as_many_images_as_times_are_wanted():
    with pytest.raises(ValueError, match='5 images for 8 times'):
        refined([0.8, -0.8], [0.5, 0.5], TwoWells(400.0, times=5))


def test_both_flips_of_an_arm_are_optima_of_the_keypoints():
    """The person is far away, so arms towards and away from the camera look the same."""
    body = load_body('human37')
    camera = Camera(9000.0, 9000.0, 319.5, 239.5, 640, 480)
    likelihood = ImageLikelihood(body, camera)
    pose = np.clip(body.prior_mean, body.lower, body.upper)
    pose[:3] = [0.0, 0.0, 60.0]
    rng = np.random.default_rng(0)
    own = body.skeleton.chain_dofs['right_arm']
    wrist = body.joint_names.index('right_wrist')
    many = np.repeat(pose[None], 500, axis=0)
    many[:, own] += 1.2 * body.prior_sigma[own] * rng.normal(size=(500, len(own)))
    many = np.clip(many, body.lower, body.upper)
    flips, parents = enumerate_flips(body, many, 'right_arm')
    joints, own_joints = body.joint_positions(flips), body.joint_positions(many)[parents]
    apart = np.linalg.norm(joints[:, wrist] - own_joints[:, wrist], axis=1)
    prior = PoseEnergy(likelihood, likelihood.priors)
    cost = np.abs(prior.energy(flips).value - prior.energy(many).value[parents])
    best = np.argmin(np.where(apart > 0.35, cost, np.inf))
    both = np.stack([many[parents[best]], flips[best]])

    names = tuple(name for name in body.joint_names if 'toe' not in name)
    at = [body.joint_names.index(name) for name in names]
    pixels = camera.project(body.joint_positions(both)[0][at])
    images = []
    for _ in range(TIMES):
        seen = pixels + rng.normal(size=pixels.shape)
        covariances = np.tile(np.eye(2), (len(at), 1, 1))
        keypoints = Keypoints(names, seen, covariances, np.ones(len(at)))
        images.append(SeenImage(likelihood, Observation(keypoints=keypoints)))
    stamps = [STEP_NS * (t + 1) for t in range(TIMES)]

    dynamics = LinearGaussianDynamics.random_walk(body.rates, step=0.1)
    smoother = MotionSmoother(dynamics, body.lower, body.upper, points=body.relative_joints)
    motions = smoother.motions(chain(both, [0.5, 0.5], sigma=0.05))
    found = refined_on_images(smoother, motions, ImageSequence.of(images, stamps, of_changes=True))
    assert len(found) == 2
    np.testing.assert_allclose(found.weights, 0.5)
    wrists = body.joint_positions(found.means.reshape(-1, body.dimension))[:, wrist]
    wrists = wrists.reshape(2, TIMES, 3)
    assert np.linalg.norm(wrists[0] - wrists[1], axis=1).min() > 0.2
    assert abs(found.log_joint[0] - found.log_joint[1]) < 5.0
    assert (found.log_joint > motions.trajectories.log_joint.max() - 1e4).all()
    assert ((found.means >= body.lower) & (found.means <= body.upper)).all()
