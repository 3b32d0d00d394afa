"""The point estimate minimises the expected distance, and is never between two facings."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.body.mirror import left_directions, reverse_depth
from hmt_ros.image.likelihood import LikelihoodSettings
from hmt_ros.inference import GaussianMixture
from hmt_ros.tracking import Tracker, TrackerSettings
from hmt_ros.tracking.point_estimate import point_estimate


@pytest.fixture
def pose(human37):
    result = human37.prior_mean.copy()
    result[:3] = (0.1, 0.0, 4.0)
    return np.clip(result, human37.lower + 0.2, human37.upper - 0.2)


def mixture(poses, weights=(1.0,)):
    poses = np.atleast_2d(poses)
    k, d = poses.shape
    return GaussianMixture(np.array(weights), poses, np.tile(1e-3 * np.eye(d), (k, 1, 1)))


def various(body, pose, rng, spread, weights):
    """Modes around a pose with the same facing."""
    poses = pose + spread * rng.normal(size=(len(weights), len(pose)))
    return mixture(np.clip(poses, body.lower, body.upper), weights)


def expected_distance(body, posterior, pose):
    """Mean distance of the joints from those of the modes, m."""
    own, joints = body.relative_joints(pose[None]), body.relative_joints(posterior.means)
    return posterior.weights @ np.linalg.norm(joints - own, axis=2).mean(1)


def test_one_mode_is_itself_and_none_is_nothing(human37, pose):
    assert point_estimate(human37, mixture(pose)) == pytest.approx(pose, abs=1e-9)
    assert point_estimate(human37, mixture(pose)[:0]).shape == (0,)


@pytest.mark.parametrize('seed', range(5))
def test_no_mode_and_no_mean_is_nearer_to_the_modes(human37, pose, seed):
    weights = np.array([0.4, 0.3, 0.2, 0.1])
    posterior = various(human37, pose, np.random.default_rng(seed), 0.2, weights)
    found = point_estimate(human37, posterior)
    assert (found >= human37.lower).all()
    assert (found <= human37.upper).all()
    distance = expected_distance(human37, posterior, found)
    others = [*posterior.means, weights @ posterior.means]
    assert distance < min(expected_distance(human37, posterior, x) for x in others)
    # The person's position is the mean.
    assert found[:3] == pytest.approx(weights @ posterior.means[:, :3], abs=1e-9)


def test_few_wrong_modes_hardly_move_it(human37, pose):
    wrong = pose.copy()
    elbow = human37.dof_names.index('left_elbow')
    wrong[elbow] = human37.lower[elbow] + human37.upper[elbow] - pose[elbow]
    posterior = mixture([pose, pose, wrong], (0.4, 0.35, 0.25))
    mean = posterior.weights @ posterior.means
    found = point_estimate(human37, posterior)
    assert abs(mean[elbow] - pose[elbow]) > 0.1
    assert abs(found[elbow] - pose[elbow]) < 0.5 * abs(mean[elbow] - pose[elbow])


def test_it_trembles_less_than_the_modes(human37, pose):
    rng, weights = np.random.default_rng(0), np.array([0.4, 0.3, 0.3])
    shown, given = [], []
    for _ in range(40):
        posterior = various(human37, pose, rng, 0.03, weights)
        for kept, x in ((shown, point_estimate(human37, posterior)), (given, posterior.means[0])):
            kept.append(human37.relative_joints(x[None])[0])
    tremble = [np.linalg.norm(np.diff(x, n=2, axis=0), axis=2).mean() for x in (shown, given)]
    assert tremble[0] < 0.75 * tremble[1]


@pytest.mark.parametrize(('weights', 'wanted'), [((0.3, 0.3, 0.4), 0), ((0.25, 0.2, 0.55), 1)])
def test_it_faces_the_likelier_way(human37, pose, weights, wanted):
    both = np.concatenate([pose[None], reverse_depth(human37, pose[None])])
    found = point_estimate(human37, mixture(both[[0, 0, 1]], weights))
    # No pose between the two facings.
    assert found == pytest.approx(both[wanted], abs=1e-9)


def test_a_turn_over_half_a_circle_is_the_short_way(human37, pose):
    root_z = human37.dof_names.index('root_z')
    poses = np.stack([pose, pose])
    poses[:, root_z] = np.pi - 0.02, -np.pi + 0.02
    found = point_estimate(human37, mixture(poses, (0.6, 0.4)))
    ways = left_directions(human37, np.stack([poses[0], found, poses[1]]))
    assert min(ways[1] @ ways[0], ways[1] @ ways[2]) > ways[0] @ ways[2]


def test_while_nothing_is_seen_it_goes_on_as_the_modes(human37, pose, camera, keypoints_of):
    cues = LikelihoodSettings()
    settings = TrackerSettings(
        candidates=8,
        likelihood=LikelihoodSettings.of_terms(keypoints=cues.keypoints, coverage=cues.coverage),
        flow_weight=0.0,
        estimate_shape=False,
        lifter='',
    )
    tracker = Tracker(human37, camera, settings)
    tracker.reset(GaussianMixture(np.ones(1), pose[None], 0.01 * np.eye(len(pose))[None]))
    black = np.zeros((camera.height, camera.width, 3), np.uint8)
    shown = []
    for t in range(4):
        now = pose.copy()
        now[0] += 0.08 * t
        inputs = [keypoints_of(human37, now, 1.0, t)] if t < 3 else []
        mask = None if t < 3 else np.zeros(black.shape[:2], np.bool_)
        expected, _ = tracker.step(black, 100_000_000 * t, *inputs, mask=mask)
        shown.append(tracker.estimate.point_estimate)
    assert tracker.estimate.foreseen
    assert shown[3] == pytest.approx(point_estimate(human37, expected), abs=1e-9)
    assert 0.02 < shown[3][0] - shown[2][0] < 0.1
