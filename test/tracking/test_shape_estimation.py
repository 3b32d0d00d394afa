"""Shape estimation, compared with brute force and true shapes, and its constraints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_learning.rendering.renderer import render_frames
from hmt_learning.rendering.scene import Scene
from hmt_ros.body import Camera
from hmt_ros.body.kinematics import forward
from hmt_ros.body.shape import GROWTH_SIGMAS, ShapeSpace
from hmt_ros.core import inform_shape
from hmt_ros.image.likelihood import ImageLikelihood, LikelihoodSettings
from hmt_ros.image.observation import Observation, observe
from hmt_ros.image.terms.image_term import TermSettings
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.error_model import ERRORS
from hmt_ros.tracking import TrackerSettings
from hmt_ros.tracking.posterior import Posterior
from hmt_ros.tracking.settings import (
    MAX_ANGLE_SHIFT,
    MAX_SHAPE_CHANGE,
    MAX_SHAPE_STEP,
    MAX_SIGMA,
)
from hmt_ros.tracking.shape_estimation import (
    Linearised,
    ShapeEstimate,
)
from test.oracles import numpy_likelihood as oracle
from test.oracles.numpy_contour import occluding_contour

VIEW = Viewpoint(distance=3.2)
CAMERA = Camera(330.0, 330.0, 159.5, 119.5, 320, 240)
NAMES = ('coverage',)
SILHOUETTE = {name: getattr(LikelihoodSettings(), name) for name in NAMES}
STEP = 1e-5


@pytest.fixture(scope='module')
def poses(human37):
    return procedural_motion('walk', human37, 1.2, 10.0, 3, viewpoint=VIEW)[::2]


def seen(body, poses):
    """Silhouettes of a body, as observations."""
    frames = render_frames(body, poses, CAMERA, Scene(viewpoint=VIEW, seed=2))
    return [
        replace(
            observe(x.image, x.mask, wanted=NAMES),
            magnification=CAMERA.magnification(float(pose[2])),
        )
        for x, pose in zip(frames, poses)
    ]


@pytest.fixture(scope='module')
def observation(human37, poses):
    return seen(human37, poses[:1])[0]


def exact_keypoints(body, pose, sigma=1.0):
    pixels = CAMERA.project(body.joint_positions(pose[None]))[0]
    n = len(pixels)
    return Keypoints(body.joint_names, pixels, np.tile(sigma**2 * np.eye(2), (n, 1, 1)), np.ones(n))


def deviations_of(estimate):
    """Difference from the start and standard deviation, by the name of the variable."""
    sigmas = np.sqrt(np.diagonal(estimate.covariance)).tolist()
    moved = zip(estimate._offset.tolist(), sigmas, strict=True)
    return dict(zip(estimate._space.names, moved, strict=True))


class Toy(ShapeEstimate):
    """An estimate whose images are linear measurements y = A theta + B x with noise 1.

    The pose also has a prior of precision 1 around 0; the energy is the sum of both.
    """

    def __init__(self, body, by_shape, by_pose, measured):
        super().__init__(body)
        self.by_shape, self.by_pose, self.measured = by_shape, by_pose, measured

    def theta(self):
        return np.array([moved for moved, _ in deviations_of(self).values()])

    def hessian(self):
        return self.by_pose.T @ self.by_pose + np.eye(self.by_pose.shape[1])

    def error(self, pose):
        return self.by_shape @ self.theta() + self.by_pose @ pose - self.measured

    def linearised(self, likelihood, observation, poses):
        a, b = self.by_shape, self.by_pose
        n = len(poses)
        gradients = np.array([a.T @ self.error(pose) for pose in poses])
        return Linearised(gradients, np.tile(a.T @ a, (n, 1, 1)), np.tile(a.T @ b, (n, 1, 1)))


def toy(body, seed, noise=2e-3, measurements=120, pose_size=6):
    """Measurements of a shape that differs clearly from the mean, within the range of people.

    The first `pose_size` variables of the pose are measured, too.
    """
    rng = np.random.default_rng(seed)
    size = ShapeSpace(body).size
    spread = np.sqrt(np.diagonal(ShapeEstimate(body).covariance))
    true = np.clip(0.1 * rng.normal(size=size), -0.2, 0.2) * spread
    by_shape = rng.normal(size=(measurements, size))
    by_pose = np.zeros((measurements, body.dimension))
    by_pose[:, :pose_size] = rng.normal(size=(measurements, pose_size))
    pose = 0.05 * rng.normal(size=pose_size)
    measured = (
        by_shape @ true + by_pose[:, :pose_size] @ pose + noise * rng.normal(size=measurements)
    )
    return Toy(body, by_shape, by_pose, measured), true


def update(estimate, pose, image_share=1.0):
    """One update from one mode with the energy of the toy."""
    gradient = estimate.by_pose.T @ estimate.error(pose) + pose
    covariance = np.linalg.inv(estimate.hessian())
    return estimate.update(
        None,
        None,
        pose[None],
        np.ones(1),
        gradient[None],
        covariance[None],
        image_share=image_share,
    )


@pytest.mark.parametrize('image_share', [1.0, 0.35])
@pytest.mark.parametrize('start', [0.0, 0.1])
def test_an_update_is_joint_least_squares_of_shape_and_pose(human37, image_share, start):
    """For any linearisation point of the pose, because the measurements are linear."""
    estimate, _ = toy(human37, 0)
    d = estimate.by_pose.shape[1]
    prior = np.linalg.inv(estimate.covariance)
    size = len(prior)
    update(estimate, np.full(d, start), image_share)
    root = np.sqrt(image_share * ERRORS['shape'].together(image_share))
    rows = np.block(
        [
            [root * estimate.by_shape, root * estimate.by_pose],
            [np.zeros((d, size)), root * np.eye(d)],
            [np.linalg.cholesky(prior).T, np.zeros((size, d))],
        ]
    )
    right = np.concatenate([root * estimate.measured, np.zeros(d + size)])
    wanted = np.linalg.lstsq(rows, right, rcond=None)[0][:size]
    covariance = np.linalg.inv(rows.T @ rows)[:size, :size]
    assert np.allclose(estimate.theta(), wanted, atol=1e-9)
    assert np.allclose(estimate.covariance, covariance, rtol=1e-6, atol=1e-12)


def test_information_only_shrinks_what_is_not_known(human37):
    estimate, _ = toy(human37, 2)
    for _ in range(3):
        before = estimate.covariance
        update(estimate, np.zeros(human37.dimension), image_share=0.2)
        after = estimate.covariance
        assert np.array_equal(after, after.T)
        assert np.linalg.eigvalsh(after)[0] > 0
        assert np.linalg.eigvalsh(before - after)[0] > -1e-12


def test_many_images_tell_no_more_than_their_common_error_lets_them(human37):
    """Repeated images count as 1 / c of one at most, and the prior of people remains."""
    estimate, _ = toy(human37, 2)
    prior = np.linalg.inv(estimate.covariance)
    gained = []
    for more in (1, 9, 990):
        for _ in range(more):
            update(estimate, np.zeros(human37.dimension), image_share=0.2)
        gained.append(np.trace(np.linalg.inv(estimate.covariance) - prior))
    c = ERRORS['shape'].constant
    wanted = [0.2 * n / (1.0 + 0.2 * c * n) for n in (1, 10, 1000)]
    assert np.array(gained) / gained[0] == pytest.approx(np.array(wanted) / wanted[0], rel=1e-6)
    assert wanted[-1] < 1.0 / c


def test_steps_and_shapes_have_limits(human37):
    estimate, _ = toy(human37, 3, pose_size=human37.dimension)
    estimate.measured = 1e3 * estimate.measured
    spread = np.sqrt(np.diagonal(estimate.covariance))
    update(estimate, np.zeros(human37.dimension))
    assert np.abs(estimate.theta() / spread).max() == pytest.approx(MAX_SHAPE_STEP)
    for _ in range(30):
        update(estimate, np.zeros(human37.dimension))
    furthest = np.abs(estimate.theta() / spread)
    assert furthest.max() == pytest.approx(MAX_SHAPE_CHANGE)
    assert all(min(part.radii) > 0 for part in estimate.body.flesh.parts)


# Evidence of an image on shape and pose.


def places_of(body, parts):
    """Centres and radii (P, 3) of parts."""
    rows = [body.flesh.parts[part] for part in parts]
    return np.array([x.centre for x in rows]), np.array([x.radii for x in rows])


def energy_over_shape(space, pose, observation, name):
    """Energy of a term as a function of the shape, for the points now on the contour."""
    body, term = space.body, SILHOUETTE[name]
    frames = forward(body.skeleton, pose[None])
    surface = oracle.project_surface(body, CAMERA, frames)
    contour = occluding_contour(body.flesh, frames)
    centres, radii = places_of(body, contour.parts)
    place = (contour.local[..., 0] - centres) / radii
    sigma = np.hypot(term.sigma, observation.magnification * surface.noise)

    def value(change):
        other = space.moved(change)
        centres, radii = places_of(other, contour.parts)
        moved = forward(other.skeleton, pose[None])
        points = moved.points(surface.segments, centres + place * radii)
        pixels, projection = CAMERA.project_with_derivative(points.transpose(1, 0, 2))
        held = replace(surface, points=points, pixels=pixels, projection=projection)
        ones = np.ones(len(points))
        return oracle.coverage(held, observation.evidence[name], term, sigma, ones).value[0]

    return value


@pytest.mark.parametrize('name', NAMES)
def test_gradients_over_the_shape_at_material_points(human37, poses, observation, name):
    """Points of the contour are fixed on the skin, which grows with the shape."""
    settings = LikelihoodSettings.of_terms(**{name: SILHOUETTE[name]})
    likelihood = ImageLikelihood(human37, CAMERA, settings)
    estimate, space = ShapeEstimate(human37), ShapeSpace(human37)
    rng = np.random.default_rng(5)
    for pose in poses[0] + 0.05 * rng.normal(size=(2, human37.dimension)):
        pose = np.clip(pose, human37.lower, human37.upper)
        value = energy_over_shape(space, pose, observation, name)
        (found,) = estimate.linearised(likelihood, observation, pose[None]).by_shape
        wanted = np.array([(value(x) - value(-x)) / 2e-6 for x in 1e-6 * np.eye(space.size)])
        errors = np.abs(found - wanted) / np.abs(wanted).max()
        assert np.quantile(errors, 0.95) < 1e-6
        assert errors.max() < 1e-3


def test_curvatures_of_keypoints_are_derivatives_of_their_gradients(human37, poses):
    """At the truth, where residuals vanish, the Gauss-Newton Hessian is the Hessian."""
    pose = poses[0]
    observation = Observation(keypoints=exact_keypoints(human37, pose))
    settings = LikelihoodSettings.of_terms(keypoints=TermSettings(1.0, 1.0, np.inf))
    estimate, space = ShapeEstimate(human37), ShapeSpace(human37)

    def gradient(change, pose):
        body = space.moved(change)
        other = ShapeEstimate(body)
        likelihood = ImageLikelihood(body, CAMERA, settings)
        return other.linearised(likelihood, observation, pose[None]).by_shape[0]

    likelihood = ImageLikelihood(human37, CAMERA, settings)
    found = Linearised(*(x[0] for x in estimate.linearised(likelihood, observation, pose[None])))
    assert np.allclose(found.by_shape, 0.0, atol=1e-6)
    still = np.zeros(space.size)
    for steps, wanted in (
        (lambda x: (x, pose), found.curvature),
        (lambda x: (still, pose + x), found.mixed),
    ):
        columns = [
            (gradient(*steps(x)) - gradient(*steps(-x))) / (2 * STEP)
            for x in STEP * np.eye(wanted.shape[1])
        ]
        difference = np.stack(columns, axis=1)
        assert np.allclose(difference, wanted, atol=1e-6 * np.abs(wanted).max())
    # Keypoints have no information on the flesh.
    assert not found.curvature[space.lengths :].any()


def test_gradient_and_covariance_of_poses_that_give_way(human37, poses, observation):
    posterior = Posterior(human37, CAMERA, TrackerSettings())
    near = poses[:2].copy()
    elbow = human37.dof_names.index('left_elbow')
    near[1, elbow] = human37.upper[elbow]
    energy = posterior.fit(near, observation).energy
    gradient, hessian = energy.derivatives()
    found, covariances = posterior.fit(near, observation).free_response
    held = np.diagonal(covariances, axis1=1, axis2=2) == 0
    assert not found[held].any()
    assert np.allclose(found[~held], gradient[~held])
    for k in range(2):
        free = ~held[k]
        inner = hessian[k][np.ix_(free, free)] + MAX_SIGMA**-2.0 * np.eye(free.sum())
        assert np.allclose(covariances[k][np.ix_(free, free)] @ inner, np.eye(free.sum()))
        assert not covariances[k][held[k]].any()
        assert not covariances[k][:, held[k]].any()
        assert np.linalg.eigvalsh(covariances[k])[0] > -1e-12
    assert held[1, elbow] == (gradient[1, elbow] < 0)


# Persons of known shape.


def fitted(model, person, poses, rounds=2):
    """Follows images of a person with the body of another; returns the estimate."""
    estimate = ShapeEstimate(model)
    settings = TrackerSettings()
    for _ in range(rounds):
        for pose, image in zip(poses, seen(person, poses)):
            posterior = Posterior(estimate.body, CAMERA, settings)
            pose = posterior.minimise(posterior.of_image(image), pose[None], 6).x
            gradients, covariances = posterior.fit(pose, image).free_response
            estimate.update(
                posterior.likelihood, image, pose, np.ones(1), gradients, covariances,
                image_share=0.35,
            )  # fmt: skip
    return estimate


@pytest.fixture(scope='module')
def stout(human37):
    """A person with wide trunk and pelvis, thick legs, and a longer head."""
    growth = np.zeros_like(human37.growth)
    names = [human37.skeleton.segment_names[shape.segment] for shape in human37.shapes]
    for part, name in enumerate(names):
        if name in ('trunk', 'pelvis') or name.endswith(('thigh', 'shin')):
            growth[part, :2] = 0.25
        if name == 'head':
            growth[part, 2] = 0.02
    return human37.with_growth(growth)


def test_flesh_comes_nearer_to_the_true_one(human37, stout, poses):
    """A walk seen from the side shows depths, but hardly any widths."""
    estimate = fitted(human37, stout, poses[:3])
    known = deviations_of(estimate)
    for name in ('trunk_depth', 'thigh_depth', 'shin_depth'):
        moved, sigma = known[name]
        assert 0.1 < moved < 0.35, name
        assert sigma < 0.7 * GROWTH_SIGMAS['depth']
        assert abs(moved - 0.25) < 2 * sigma, name
    assert 0 < known['thigh_width'][0] < known['thigh_depth'][0]
    assert known['thigh_width'][1] > known['thigh_depth'][1]
    assert abs(known['forearm_depth'][0]) < 0.08
    lengths = estimate.body.segment_lengths
    for name, true in stout.segment_lengths.items():
        assert abs(lengths[name] - true) < 0.03


def test_lengths_come_nearer_to_the_true_ones_with_keypoints(human37, poses):
    long = {name: 1.06 * human37.segment_lengths[name] for name in ('thigh', 'upper_arm')}
    person = human37.with_segment_lengths(long)
    estimate = ShapeEstimate(human37)
    terms = LikelihoodSettings.of_terms(keypoints=TermSettings(1.0, 1.0, 5.0))
    settings = TrackerSettings(likelihood=terms)
    for pose in poses:
        posterior = Posterior(estimate.body, CAMERA, settings)
        image = Observation(keypoints=exact_keypoints(person, pose))
        pose = posterior.minimise(posterior.of_image(image), pose[None], 6).x
        estimate.update(
            posterior.likelihood, image, pose, np.ones(1),
            *posterior.fit(pose, image).free_response, image_share=0.35,
        )  # fmt: skip
    for name, true in long.items():
        before = true - human37.segment_lengths[name]
        assert abs(estimate.body.segment_lengths[name] - true) < 0.7 * before


def test_what_is_considered_is_that_of_the_uncertain_shape(human37, poses, observation):
    posterior = Posterior(human37, CAMERA, TrackerSettings())
    estimate = ShapeEstimate(human37)
    _, covariances = posterior.fit(poses[:2], observation).free_response
    found = estimate.induced_covariances(posterior.likelihood, observation, poses[:2], covariances)
    for k in range(2):
        pose = poses[k : k + 1]
        (mixed,) = estimate.linearised(posterior.likelihood, observation, pose).mixed
        moved = -covariances[k] @ mixed.T
        assert np.allclose(found[k], moved @ estimate.covariance @ moved.T)
        assert np.linalg.eigvalsh(found[k])[0] > -1e-12
    before = np.trace(found, axis1=1, axis2=2)
    # A better known shape contributes less covariance.
    estimate.covariance = 0.25 * estimate.covariance
    found = estimate.induced_covariances(posterior.likelihood, observation, poses[:2], covariances)
    assert np.trace(found, axis1=1, axis2=2) == pytest.approx(0.25 * before)


def test_keypoints_tell_nothing_of_the_size(human37, poses):
    """A person of twice the size at twice the distance looks the same."""
    settings = TrackerSettings(
        likelihood=LikelihoodSettings.of_terms(keypoints=TermSettings(1.0, 1.0, np.inf))
    )
    posterior = Posterior(human37, CAMERA, settings)
    pixels = CAMERA.project(human37.joint_positions(poses[2:3]))[0]
    n = len(pixels)
    seen = Keypoints(human37.joint_names, pixels, np.tile(9.0 * np.eye(2), (n, 1, 1)), np.ones(n))
    observation = Observation(keypoints=seen)
    (gradient,), (covariance,) = posterior.fit(poses[:1], observation).free_response
    estimate = ShapeEstimate(human37)
    found = estimate.linearised(posterior.likelihood, observation, poses[:1])
    linear = Linearised(*(x[0] for x in found))
    whole = covariance @ gradient
    turns = human37.skeleton.dof_is_rotation
    assert np.abs(whole[turns]).max() > MAX_ANGLE_SHIFT
    lengths = human37.skeleton.lengths
    size = len(lengths)
    free, limited = linear.by_shape - linear.mixed @ whole, np.empty(len(linear.by_shape))
    modes = np.ones(1), gradient[None], covariance[None], turns, MAX_ANGLE_SHIFT
    assert inform_shape(*found, *modes, np.empty(linear.curvature.shape), limited)
    scale = float(np.abs(linear.by_shape[:size] * lengths).sum())
    assert abs(free[:size] @ lengths) < 5e-4 * scale
    assert abs(limited[:size] @ lengths) < 5e-4 * scale
    held = whole * (MAX_ANGLE_SHIFT / np.abs(whole).max())
    assert abs((linear.by_shape - linear.mixed @ held)[:size] @ lengths) > 5e-3 * scale
