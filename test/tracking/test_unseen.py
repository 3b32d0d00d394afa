"""Legs outside the image have usual postures, and follow the evidence once they are seen."""

from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.body.keep_out import keep_out_capsules
from hmt_ros.inference import GaussianMixture
from hmt_ros.tracking import LaggedWeights, Tracker, TrackerSettings

STEP = 100_000_000  # ns
CUT, WHOLE = 6, 3  # images


def without_legs(keypoints):
    gone = np.array([any(x in y for x in ('knee', 'ankle', 'toe')) for y in keypoints.names])
    return replace(
        keypoints,
        pixels=np.where(gone[:, None], np.nan, keypoints.pixels),
        confidences=np.where(gone, 0.0, keypoints.confidences),
    )


@pytest.fixture(scope='module')
def steps(human32, camera, motion, keypoints_of):
    """Body, posterior, origins and identities of each image, and the number of modes kept."""
    tracker = Tracker(human32, camera, TrackerSettings(evaluation_budget=150))
    tracker.reset(GaussianMixture(np.ones(1), motion[:1], 0.01 * np.eye(32)[None]))
    black = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
    result = []
    for i in range(CUT + WHOLE):
        keypoints = keypoints_of(human32, motion[i], seed=i)
        seen = keypoints if i >= CUT else without_legs(keypoints)
        posterior, _ = tracker.step(black, i * STEP, seen)
        assert posterior is not None
        result.append(
            (
                tracker.estimate.body,
                posterior,
                tracker.estimate.origins,
                tracker.estimate.published.identities,
                tracker.estimate.modes,
            )
        )
    return result


def ankles(body, posterior):
    """Mean (2, 3) of the ankles relative to the pelvis and standard deviations (2,), m."""
    which = body.skeleton.joint_index(('left_ankle', 'right_ankle'))
    places = body.relative_joints(posterior.means)[:, which]
    jacobians = body.joint_jacobians(posterior.means)
    jacobians = jacobians[:, which] - jacobians[:, :1]
    within = jacobians @ posterior.covariances[:, None] @ jacobians.swapaxes(2, 3)
    mean = np.tensordot(posterior.weights, places, axes=1)
    between = ((places - mean) ** 2).sum(2) + np.trace(within, axis1=2, axis2=3)
    return mean, np.sqrt(posterior.weights @ between)


def test_ankles_spread_as_those_of_people_until_they_are_seen(steps, human32, motion):
    for body, posterior, *_ in steps[:CUT]:
        assert (ankles(body, posterior)[1] > 0.3).all()
    body, posterior, *_ = steps[CUT]
    mean, spread = ankles(body, posterior)
    which = human32.skeleton.joint_index(('left_ankle', 'right_ankle'))
    true = human32.relative_joints(motion[CUT][None])[0, which]
    assert (spread < 0.2).all()
    assert np.linalg.norm((mean - true)[:, :2], axis=1).max() < 0.05


def test_the_posterior_has_postures_and_the_track_few_modes(steps):
    for i, (_, posterior, _, identities, modes) in enumerate(steps):
        assert len(modes) <= 8
        assert len(set(identities.tolist())) == len(posterior)
        assert set(modes.identities.tolist()) <= set(identities.tolist())
        assert (len(posterior) > len(modes)) == (i < CUT)
        assert posterior.weights.sum() == pytest.approx(1.0)


def test_every_component_continues_those_of_the_image_before(steps):
    lagged = LaggedWeights(2)
    for i, (_, posterior, origins, _, _) in enumerate(steps):
        before = len(steps[i - 1][1]) if i else 0
        assert origins.shape == (len(posterior), before)
        if i:
            assert origins.sum(1) == pytest.approx(np.ones(len(posterior)))
        lagged.update(i * STEP, posterior, origins)


def test_the_space_to_keep_out_of_holds_the_legs_of_who_sits(steps, human32):
    body, posterior, *_ = steps[CUT - 1]
    pose = posterior.means[posterior.weights.argmax()].copy()
    for name, degrees in (('hip_x', 82.0), ('knee', -92.0)):
        for side in ('left', 'right'):
            pose[human32.dof_names.index(f'{side}_{name}')] = np.radians(degrees)
    which = body.skeleton.joint_index(('left_knee', 'right_knee', 'left_ankle', 'right_ankle'))
    places = body.joint_positions(pose[None])[0, which]
    assert keep_out_capsules(body, posterior).contain(places).all()
