"""The energy of keypoints: derivatives, exchanged sides, lifted poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.body import Camera, load_body
from hmt_ros.body.kinematics import forward
from hmt_ros.body.skeleton import other_side
from hmt_ros.experts.lifter import lifted_positions
from hmt_ros.image.keypoint_schemes import schemes, usual_exchanges
from hmt_ros.image.terms.keypoints import KEYPOINTS, Keypoints, KeypointTerm
from hmt_ros.inference.energy import Derivatives
from test.oracles.single_terms import energy_of

CAMERA = Camera(600.0, 600.0, 320.0, 240.0, 640, 480)
BODY = load_body('human37')
NONE, ALL, ARMS, LEGS = range(4)
EVERYONE = np.zeros(1, dtype=np.intp)


@pytest.fixture
def pose():
    result = BODY.prior_mean.copy()
    result[:3], result[3] = (0.1, 0.0, 4.0), 0.4
    return result + 0.1 * np.random.default_rng(0).standard_normal(BODY.dimension)


def seen(pose, *, lifted=True, noise=0.0, rng=None):
    """Keypoints of a detector with MediaPipe's landmarks for a pose."""
    scheme = schemes()['mediapipe33']
    n = len(scheme.names)
    unknown = Keypoints(
        scheme.names, np.zeros((n, 2)), np.full((n, 2, 2), np.nan), np.ones(n), np.zeros((n, 3))
    )
    known, _ = unknown.named_for(BODY, 'mediapipe33')
    joints = BODY.skeleton.joint_index(known.names)
    frames = forward(BODY.skeleton, pose[None])
    columns, origins = (x[0] for x in frames.by_pose())
    segments = BODY.skeleton.joint_segments[joints]
    offsets = BODY.skeleton.joint_offsets[joints] + known.offsets
    places = origins[segments] + np.einsum('kji,kj->ki', columns[segments], offsets)
    centres = frames.joints()[joints][..., 0]
    pixels = CAMERA.project(places)
    if rng is not None:
        pixels = pixels + noise * rng.standard_normal(pixels.shape)
    made = replace(known, pixels=pixels, positions=centres)
    return replace(made, lifted=lifted_positions(CAMERA, made) if lifted else None)


def exchanged(keypoints, words):
    """The keypoints with left and right swapped for names that contain one of some words."""
    names = tuple(
        other_side(name) if any(word in name for word in words) else name
        for name in keypoints.names
    )
    return replace(keypoints, names=names, offsets=keypoints.offsets * (-1, 1, 1))


def energy(one, poses, rows=EVERYONE, **more):
    return energy_of(one, BODY, poses, rows, camera=CAMERA, **more)


def term(keypoints, *, exchanges=True):
    log_prior = usual_exchanges() if exchanges else None
    return KeypointTerm(BODY.skeleton, CAMERA, keypoints, KEYPOINTS, 150.0, log_prior)


@pytest.mark.parametrize('factors', [False, True], ids=['usual', 'factors'])
@pytest.mark.parametrize('exchanges', [True, False])
def test_derivatives(pose, exchanges, factors):
    rng = np.random.default_rng(1)
    one = term(seen(pose, noise=8.0, rng=rng), exchanges=exchanges)
    if factors:
        one = replace(one, segments=rng.uniform(0.0, 2.0, len(BODY.skeleton.parents)))
    x = pose + 0.05 * rng.standard_normal(BODY.dimension)

    def value(poses):
        rows = np.zeros(len(poses), dtype=np.intp)
        return energy(one, poses, rows, derivatives=Derivatives.NONE).value

    found = energy(one, x)
    step = 1e-6 * np.eye(BODY.dimension)
    numerical = (value(x + step) - value(x - step)) / 2e-6
    np.testing.assert_allclose(found.gradient[0], numerical, rtol=1e-5, atol=1e-4)
    assert (np.linalg.eigvalsh(found.hessian[0]) > -1e-6).all()


@pytest.mark.parametrize(
    ('words', 'kind'),
    [
        ((), NONE),
        (('shoulder', 'elbow', 'wrist', 'hand', 'hip', 'knee', 'ankle', 'toe'), ALL),
        (('shoulder', 'elbow', 'wrist', 'hand'), ARMS),
        (('hip', 'knee', 'ankle', 'toe'), LEGS),
    ],
)
def test_exchanged_sides_are_recognised(pose, words, kind):
    one = term(exchanged(seen(pose, lifted=False), words))
    log_probabilities = one.exchanged(forward(BODY.skeleton, pose[None]), EVERYONE)[0]
    assert np.argmax(log_probabilities) == kind
    assert np.exp(log_probabilities[kind]) > 0.9
    assert (one.distances(forward(BODY.skeleton, pose[None])) < 4.0).all()


def test_an_exchange_costs_its_prior_and_no_more(pose):
    plain = seen(pose, lifted=False)
    words = ('shoulder', 'elbow', 'wrist', 'hand', 'hip', 'knee', 'ankle', 'toe')
    cost = energy(term(exchanged(plain, words)), pose).value - energy(term(plain), pose).value
    usual = usual_exchanges()[0]
    assert cost == pytest.approx(usual[NONE] - usual[ALL], abs=1.0)
    # Without an exchange they would cost more than any prior.
    assert energy(term(exchanged(plain, words), exchanges=False), pose).value > 50.0


def test_lifted_poses_tell_towards_from_away(pose):
    """Without them, forearms towards and away from the camera look the same."""
    elbow = BODY.dof_names.index('right_elbow')
    other = pose.copy()
    other[elbow] += 0.6
    both, rows = np.stack([pose, other]), np.zeros(2, dtype=np.intp)
    flat, lifted = (energy(term(seen(pose, lifted=x)), both, rows).value for x in (False, True))
    assert lifted[1] - lifted[0] > flat[1] - flat[0]


def test_residuals_have_the_derivatives_of_the_energy(pose):
    rng = np.random.default_rng(2)
    one = term(seen(pose, lifted=False, noise=3.0, rng=rng), exchanges=False)
    frames = forward(BODY.skeleton, pose[None])
    joints, _, directions, pull, curvature = one.residuals(frames)
    assert len(joints) == 2 * len(one.keypoints.names)
    # A translation of the person moves all landmarks equally.
    np.testing.assert_allclose(directions.T @ pull, energy(one, pose).gradient[0, :3])
    assert (curvature > 0).all()
