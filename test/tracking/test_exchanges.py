"""Exchanged sides of keypoints from image to image."""

from __future__ import annotations

import numpy as np

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_ros.body.mirror import left_directions
from hmt_ros.image.keypoint_schemes import usual_exchanges
from hmt_ros.image.likelihood import ImageLikelihood, LikelihoodSettings
from hmt_ros.image.observation import Observation
from hmt_ros.image.terms.keypoints import KEYPOINTS
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.tracking import Tracker, TrackerSettings
from hmt_ros.tracking.classes import known_exchanges, predicted_exchanges, seen_exchanges
from hmt_ros.tracking.posterior import Posterior
from test.image.test_keypoints import BODY, CAMERA, exchanged, seen

ARMS = ('shoulder', 'elbow', 'wrist', 'hand')
LEGS = ('hip', 'knee', 'ankle', 'toe')
ALL = LIMBS = (*ARMS, *LEGS)
LIKELIHOOD = LikelihoodSettings.of_terms(keypoints=KEYPOINTS)


def standing():
    pose = BODY.prior_mean.copy()
    pose[:3], pose[3] = (0.1, 0.0, 4.0), 0.4
    return pose


def after(observation, count, dt=1.0 / 30.0, exchanges=None):
    """Log probabilities of exchanges (1, E) after `count` images of one pose."""
    if exchanges is None:
        exchanges = np.full((1, usual_exchanges().shape[1]), np.nan)
    likelihood = ImageLikelihood(BODY, CAMERA)
    for _ in range(count):
        exchanges = predicted_exchanges(exchanges, dt)
        exchanges = seen_exchanges(likelihood, observation, standing()[None], exchanges)
    return exchanges


def test_nothing_is_known_at_first():
    nothing = after(Observation(), 2)
    assert np.isnan(nothing).all()
    np.testing.assert_array_equal(known_exchanges(nothing), usual_exchanges())


def test_an_exchange_is_expected_to_stay_and_is_forgotten():
    turned = Observation(keypoints=exchanged(seen(standing()), LIMBS))
    known = after(turned, 3)
    assert np.exp(known[0, 1]) > 0.9
    assert np.exp(predicted_exchanges(known, 1.0 / 30.0)[0, 1]) > 0.6
    assert np.exp(predicted_exchanges(known, 60.0)[0, 1]) < 0.1


def test_what_is_known_of_the_detector_counts_whole_beside_energies_that_last():
    pose = standing()[None]
    posterior = Posterior(BODY, CAMERA, TrackerSettings(likelihood=LIKELIHOOD))
    # Positions would show that nothing is exchanged.
    turned = Observation(keypoints=exchanged(seen(standing(), lifted=False), LIMBS))
    sure = np.log(np.array([[1e-3, 1.0 - 3e-3, 1e-3, 1e-3]]))
    unsure = np.log(np.array([[1.0 - 3e-3, 1e-3, 1e-3, 1e-3]]))
    dt = 1.0 / 30.0
    costs = posterior.evidence(pose, turned, unsure, dt) - posterior.evidence(
        pose, turned, sure, dt
    )
    # However little an image counts, an unexpected exchange costs its improbability.
    assert costs[0] > 0.7 * np.log(1e3)


# A whole track.

FRAME = 33_333_333
IMAGES = 40
# Images in which a detector exchanges the sides of all limbs, the arms or the legs: 30 %.
RUNS = {4: ALL, 5: ALL, 6: ALL, 12: ARMS, 13: ARMS, 20: ALL, 21: ALL, 22: ALL, 23: ALL, 30: LEGS,
        31: LEGS, 32: LEGS}  # fmt: skip


def tracked(motion, *, exchanged_sides):
    """Mean error of the heaviest mode, m, and in how many images it faces the wrong way."""
    rng = np.random.default_rng(0)
    settings = TrackerSettings(likelihood=LIKELIHOOD)
    tracker = Tracker(BODY, CAMERA, settings)
    tracker.reset(GaussianMixture(np.ones(1), motion[:1], 1e-3 * np.eye(BODY.dimension)[None]))
    black = np.zeros((CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
    errors, wrong = [], 0
    for t, pose in enumerate(motion):
        keypoints = seen(pose, lifted=False, noise=3.0, rng=rng)
        if exchanged_sides:
            keypoints = exchanged(keypoints, RUNS.get(t, ()))
        posterior, _ = tracker.step(black, t * FRAME, keypoints)
        joints, true = (BODY.joint_positions(x)[0] for x in (posterior.means[:1], pose[None]))
        errors.append(np.linalg.norm((joints - joints[0]) - (true - true[0]), axis=1).mean())
        left = left_directions(BODY, np.stack([posterior.means[0], pose]))
        wrong += left[0] @ left[1] < 0
    return float(np.mean(errors)), wrong


def test_a_track_survives_a_detector_that_exchanges_sides_in_runs():
    motion = procedural_motion(
        'walk', BODY, IMAGES / 30.0, 30.0, 3, viewpoint=Viewpoint(distance=4.0)
    )[:IMAGES]
    straight, never = tracked(motion, exchanged_sides=False)
    confused, wrong = tracked(motion, exchanged_sides=True)
    assert never == 0
    # Both facings are equally likely for a moment: the person is seen from the side.
    assert wrong <= 3
    assert confused < straight + 0.03
