"""What the figures of smoothing are made of."""

import numpy as np
import pytest

from benchmarks.clip_trajectories import (
    PATHS,
    clip_trajectories,
    descent,
    pose_covariance,
)
from benchmarks.smoothing_clips import Seen
from hmt_ros.body import load_body
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.error_model import CueErrors
from hmt_ros.smoothing.trajectory_refinement import Status

TIMES = 6


@pytest.fixture(scope='module')
def seen():
    """A person who stands still, whose left elbow may be bent or straight in every image."""
    body, rng = load_body('human37'), np.random.default_rng(0)
    pose = np.clip(body.prior_mean, body.lower, body.upper)
    pose[body.skeleton.dof_index(['root_tx', 'root_ty', 'root_tz'])] = 0.0, 0.0, 3.0
    elbow = body.dof_names.index('left_elbow')
    pose[elbow] = 0.3
    unknown = np.zeros((body.dimension, body.dimension))
    result = []
    for t in range(TIMES):
        means = np.tile(pose, (2, 1)) + 0.03 * rng.normal(size=(2, len(pose)))
        means[1, elbow] += 1.0
        means = np.clip(means, body.lower, body.upper)
        mixture = GaussianMixture([0.6, 0.4], means, np.tile(1e-3 * np.eye(len(pose)), (2, 1, 1)))
        result.append(
            Seen(t * 66_000_000, body, mixture, mixture, CueErrors(0.15, 0.019), unknown, pose)
        )
    return result


def test_paths_lead_to_smoother_optima(seen):
    found = clip_trajectories(seen)
    d = found.body.dimension
    assert len(found.paths) <= PATHS
    assert (found.refined.status == Status.CONVERGED).all()
    # Bent all the time and straight all the time are optima.
    elbow = found.body.dof_names.index('left_elbow')
    bends = found.distinct.states[:, :, elbow].mean(1)
    assert len(found.distinct) >= 2
    assert np.ptp(bends) > 0.7
    rough = [
        np.square(np.diff(x[..., :d], n=2, axis=1)).mean()
        for x in (found.refined.states, found.starts)
    ]
    assert rough[0] < 0.5 * rough[1]
    # Optima give up likelihood for smoothness.
    assert (found.refined.observation_energies > found.start_energies - 1e-6).all()
    for table in found.visiting:
        np.testing.assert_allclose(table.sum(1)[table.sum(1) > 0], 1.0)


def test_more_images_make_a_pose_more_certain(seen):
    found = clip_trajectories(seen)
    d = found.body.dimension
    one, many = (pose_covariance(found, images) for images in (1, TIMES))
    assert many.shape == (TIMES * d, TIMES * d)
    assert np.linalg.eigvalsh(many)[0] > 0
    assert np.trace(many[:d, :d]) < 0.9 * np.trace(one)


def test_the_node_counts_less_of_an_image(seen):
    ours, node = (clip_trajectories(seen, independent=x) for x in (True, False))
    assert (
        node.sequence.mixtures[1].covariances[0, 0, 0]
        > 2 * ours.sequence.mixtures[1].covariances[0, 0, 0]
    )


def test_the_free_energy_does_not_rise(seen):
    found = descent(clip_trajectories(seen))
    assert (np.diff(found.free_energy) <= 1e-9).all()


def test_one_image_is_no_sequence(seen):
    with pytest.raises(ValueError, match='wanted at least 2 images with a likelihood, saw 1'):
        clip_trajectories(seen[:1])
