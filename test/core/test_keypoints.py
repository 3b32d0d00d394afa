"""Energies of keypoints: values compared with numpy; invalid arguments are refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import log_softmax, logsumexp

from hmt_ros.body import Camera, load_body
from hmt_ros.body.kinematics import forward
from hmt_ros.core import RECORDED, exchange_posteriors, keypoint_errors, record_keypoints
from hmt_ros.image.lifted_poses import LiftedPoses
from hmt_ros.image.terms.keypoints import EXCHANGED, Keypoints, KeypointTerm
from test.core.arguments import assert_arguments_are_checked

SKELETON = load_body('human32').skeleton
CAMERA = Camera(600.0, 600.0, 320.0, 240.0, 640, 480)
NAMES = ('left_hip', 'right_hip', 'left_wrist', 'right_wrist', 'left_knee', 'right_knee')
POINTS, EXCHANGES = len(NAMES), len(EXCHANGED)
POSES = np.repeat(load_body('human32').prior_mean[None], 3, axis=0)
POSES[:, 2] = 3.0, 4.0, -4.0  # the last one is behind the camera
LOG_PRIORS = np.log([[0.4, 0.1, 0.3, 0.2]])


def inputs(factors=()):
    rng = np.random.default_rng(0)
    lifted = LiftedPoses(
        NAMES,
        np.log([0.4, 0.6]),
        0.3 * rng.normal(size=(2, POINTS, 3)),
        np.full((2, POINTS, 3), 0.1),
        np.eye(3),
        np.full(POINTS, 0.3),
    )
    pixels = rng.uniform(200.0, 400.0, (POINTS, 2))
    noise = np.tile(400.0 * np.eye(2), (POINTS, 1, 1))
    seen = Keypoints(NAMES, pixels, noise, np.ones(POINTS), lifted=lifted)
    term = KeypointTerm(SKELETON, CAMERA, seen, exchanges=LOG_PRIORS, segments=np.array(factors))
    return term.compiled


def frames():
    return dict(zip(('columns', 'origins'), forward(SKELETON, POSES).by_pose()))


def kernel(residuals, scale):
    return 0.5 * residuals**2 / (1.0 + residuals**2 / scale**2)


def places(segments, offsets, columns, origins):
    return origins[segments] + np.einsum('...ji,...j->...i', columns[segments], offsets)


def errors_of(given, columns, origins):
    """Whitened errors (P, 2, 2) of the keypoints, as named and exchanged."""
    points = given.points
    at = places(points.segments, points.offsets, columns, origins)
    gaps = CAMERA.project(at) - points.pixels[:, None]
    return np.einsum('kij,kej->kei', points.whiteners, gaps)


def posterior(given, columns, origins):
    """Log probabilities (E,) of the exchanges at a pose."""
    errors = np.where(at_back := origins[0, 2] < 0.0, 1e3, errors_of(given, columns, origins))
    assert at_back == (origins[:, 2] < 0.0).all()
    of_points = given.weights[given.points.groups, None] * kernel(errors, given.scale).sum(2)
    if len(given.factors):  # of the segment as the keypoint is called
        of_points = given.factors[given.points.segments[:, :1]] * of_points
    lifted = given.lifted
    hips = places(np.array(0), lifted.middle, columns, origins)
    behind = (places(lifted.segments, lifted.offsets, columns, origins) - hips) @ lifted.ray
    residuals = lifted.precisions * (behind - lifted.depths)
    whole = -logsumexp(lifted.log_weights - kernel(residuals, lifted.scale).sum(2), axis=1)
    own = of_points[np.arange(POINTS), given.exchanged[:, given.points.groups]].sum(1)
    return log_softmax(given.log_priors[0] - own - lifted.weight * whole[lifted.readings])


FACTORS = np.random.default_rng(1).uniform(0.0, 2.0, len(SKELETON.parents))


@pytest.mark.parametrize('factors', [(), FACTORS], ids=['usual', 'factors'])
def test_exchanges_and_errors_are_those_of_plain_sums(factors):
    given, found = inputs(factors), np.empty((len(POSES), EXCHANGES))
    exchange_posteriors(given, np.repeat(LOG_PRIORS, len(POSES), 0), *frames().values(), found)
    wanted = np.array([posterior(given, *x) for x in zip(*frames().values())])
    assert np.allclose(found, wanted, atol=1e-9)
    errors = np.empty((len(POSES), POINTS, 2))
    keypoint_errors(given, *frames().values(), errors)
    assert np.isnan(errors[2]).all()
    for pose, likeliest in enumerate(wanted[:2].argmax(1)):
        own = errors_of(given, *(x[pose] for x in frames().values()))
        exchanged = given.exchanged[likeliest, given.points.groups]
        assert np.allclose(errors[pose], own[np.arange(POINTS), exchanged])


def test_listed_residuals_have_the_factors_of_their_segments():
    usual, own = np.zeros((2, len(POSES), 1 + 2 * POINTS, RECORDED))
    joints = np.zeros((POINTS, 2), dtype=np.int64)
    still = np.log([[1.0, 1e-9, 1e-9, 1e-9]])
    for given, result in ((inputs(), usual), (inputs(FACTORS), own)):
        record_keypoints(given._replace(log_priors=still), joints, *frames().values(), result)
    count = int(usual[0, 0, 0])
    assert count == 2 * POINTS == own[0, 0, 0]
    factors = np.repeat(FACTORS[inputs().points.segments[:, 0]], 2)
    assert np.allclose(own[0, 1:, 7:], factors[:, None] * usual[0, 1:, 7:], rtol=1e-12)
    assert np.array_equal(own[0, 1:, :7], usual[0, 1:, :7])


@pytest.mark.parametrize('factors', [FACTORS[1:], -FACTORS, np.nan * FACTORS, np.inf * FACTORS])
def test_factors_of_segments_must_fit(factors):
    result = np.empty((len(POSES), EXCHANGES))
    priors = np.repeat(LOG_PRIORS, len(POSES), 0)
    with pytest.raises(ValueError, match=r'inputs\.factors: wanted'):
        exchange_posteriors(inputs(factors), priors, *frames().values(), result)


def test_keypoints_need_arguments_that_fit():
    count = len(POSES)
    given = {'inputs': inputs(), **frames()}
    rows = 'inputs.log_priors inputs.lifted.readings inputs.factors'
    priors = {'inputs': inputs(FACTORS), 'log_priors': np.repeat(LOG_PRIORS, count, 0), **frames()}
    result = {'result': np.zeros((count, EXCHANGES))}
    assert_arguments_are_checked(exchange_posteriors, priors | result, 'result', free=rows)
    errors = {'errors': np.zeros((count, POINTS, 2))}
    assert_arguments_are_checked(keypoint_errors, given | errors, 'errors', free=rows)
    listed = {
        'inputs': inputs(),
        'joints': np.zeros((POINTS, 2), dtype=np.int64),
        **frames(),
        'residuals': np.zeros((count, 1 + 2 * POINTS, RECORDED)),
    }
    assert_arguments_are_checked(record_keypoints, listed, 'residuals', free=rows, unread='joints')
