from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.body import Camera, load_body
from hmt_ros.body.pose_prior import pose_prior
from hmt_ros.image.likelihood import ImageLikelihood, LikelihoodSettings
from hmt_ros.image.observation import Observation
from hmt_ros.image.pose_energy import PoseEnergy
from hmt_ros.inference.energy import Student, Sum
from hmt_ros.tracking.posterior import Posterior
from hmt_ros.tracking.proposals.kinematic_jumps import find_limb
from hmt_ros.tracking.settings import LIMB_TAILS, LimbSearchSettings, TrackerSettings

CAMERA = Camera(500.0, 500.0, 320.0, 240.0, 640, 480)


@pytest.mark.parametrize('kind', ['learned', 'angles'])
def test_without_an_image_a_limb_goes_where_the_prior_wants_it_given_the_other_limbs(kind):
    """The prior of a limb is conditional on the rest of the pose."""
    body = load_body('human37')
    settings = TrackerSettings(
        likelihood=LikelihoodSettings(pose_prior=kind, prior_weight=2.0),
        search=LimbSearchSettings(samples=24, refined=2, iterations=60),
    )
    posterior = Posterior(body, CAMERA, settings)
    pose = np.clip(body.prior_mean, body.lower + 0.05, body.upper - 0.05)
    pose[body.skeleton.dof_index(('root_tz', 'right_elbow', 'trunk_x'))] = (4.0, 0.5, -0.6)
    covariance = 0.3 * np.eye(37)
    found = find_limb(
        posterior, 'left_arm', pose, covariance, Observation(), settings.plan,
        np.random.default_rng(0),
    )  # fmt: skip
    own = np.asarray(body.skeleton.chain_dofs['left_arm'])
    assert found.shape == (2, len(own))
    prior = PoseEnergy(
        ImageLikelihood(body, CAMERA), (pose_prior(body, kind, 2.0),), None, pose, own
    )
    kept = Student(pose[own], np.linalg.inv(covariance[np.ix_(own, own)]), LIMB_TAILS)
    value, gradient, hessian = Sum((prior, kept)).energy(found, np.arange(2))
    start = Sum((prior, kept)).energy(pose[None, own], np.arange(1)).value
    assert value.min() <= start[0]
    # A further Newton step would gain less than the tolerance of the search.
    for x, g, h in zip(found, gradient, hessian, strict=True):
        free = (x > body.lower[own] + 1e-6) & (x < body.upper[own] - 1e-6)
        gain = 0.5 * g[free] @ np.linalg.solve(h[np.ix_(free, free)], g[free])
        assert gain < 0.05
