"""The compiled likelihood, compared with numpy, finite differences and ray marching."""

from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.body import Camera, load_body
from hmt_ros.body.kinematics import directed_derivatives, forward
from hmt_ros.body.pose_prior import AnglePrior
from hmt_ros.core import BEHIND, COVER
from hmt_ros.image.likelihood import OFF, ImageLikelihood, ObservedImage
from hmt_ros.image.observation import Beliefs, observe
from hmt_ros.image.pose_energy import PoseEnergy
from hmt_ros.image.terms.image_term import TermSettings
from hmt_ros.image.terms.keypoints import Keypoints, KeypointTerm
from hmt_ros.inference.energy import Derivatives
from test.oracles import numpy_likelihood as oracle
from test.oracles.numpy_contour import occluding_contour
from test.oracles.single_terms import OneByOne, energy_of, image_energy

IMAGE_TERMS = ('coverage', 'edges')
MAGNIFICATION = 100.0  # px/m

LENSES = {
    'pinhole': ((), 'plumb_bob'),
    'plumb_bob': ((-0.25, 0.06, 0.002, -0.001, 0.01), 'plumb_bob'),
    'rational': ((0.1, 0.03, 0.001, 0.001, 0.02, 0.3, 0.02, 0.01), 'rational_polynomial'),
    'fisheye': ((0.02, -0.01, 0.003, 0.001), 'equidistant'),
}


def keypoints_of(shot, sigma=2.0, seed=0):
    rng = np.random.default_rng(seed)
    pixels = shot.camera.project(shot.body.joint_positions(shot.poses[1:]))[0]
    root = rng.normal(size=(len(pixels), 2, 2))
    covariances = sigma**2 * (root @ root.transpose(0, 2, 1) + np.eye(2))
    noise = sigma * rng.normal(size=pixels.shape)
    return Keypoints(shot.body.joint_names, pixels + noise, covariances, np.ones(len(pixels)))


@pytest.fixture(scope='module')
def observation(shot):
    found = observe(shot.images[1], shot.masks[1], keypoints_of(shot))
    return replace(found, magnification=MAGNIFICATION)


def believed(shot, observation):
    """The observation with a factor on its cues for each segment; some factors are 0."""
    rng = np.random.default_rng(12)
    count = len(shot.body.skeleton.parents)
    segments = {
        name: rng.uniform(0.0, 2.0, count) * (rng.uniform(size=count) > 0.2)
        for name in (*IMAGE_TERMS, 'keypoints')
    }
    return replace(observation, beliefs=Beliefs(0.7, np.array([0.9, 0.4, 0.6]), 1.0, segments))


def only(likelihood, *names):
    """The likelihood with some of its terms."""
    terms = {
        name: getattr(likelihood.settings, name) if name in names else OFF for name in IMAGE_TERMS
    }
    return replace(likelihood, settings=replace(likelihood.settings, **terms))


def relative_difference(found, wanted):
    """The largest difference, relative to the largest entry of each pose."""
    axes = tuple(range(1, found.ndim))
    scale = np.abs(wanted).max(axis=axes, keepdims=True) if axes else np.abs(wanted)
    return (np.abs(found - wanted) / (scale + 1e-12)).max()


def largest_difference(body, camera, poses, observation):
    """Largest relative difference between the compiled terms and numpy over poses."""
    likelihood = ImageLikelihood(body, camera)
    wanted = oracle.image_energies(likelihood, poses, observation)
    assert tuple(wanted) == IMAGE_TERMS
    differences = []
    for name, energy in wanted.items():
        found = image_energy(only(likelihood, name), poses, observation)
        differences += [
            relative_difference(found.value, energy.value),
            relative_difference(found.gradient, energy.gradient),
            relative_difference(found.hessian, energy.hessian),
        ]
    together = image_energy(only(likelihood, *IMAGE_TERMS), poses, observation)
    differences += [
        relative_difference(together.value, sum(e.value for e in wanted.values())),
        relative_difference(together.hessian, sum(e.hessian for e in wanted.values())),
    ]
    return np.max(differences)


@pytest.mark.parametrize('lens', LENSES)
def test_kernels_equal_numpy(shot, observation, lens):
    c = shot.camera
    distortion, model = LENSES[lens]
    camera = Camera(c.fx, c.fy, c.cx, c.cy, c.width, c.height, distortion, model)
    poses = shot.near(24, 1)
    assert largest_difference(shot.body, camera, poses, observation) <= 1e-9


def test_kernels_equal_numpy_far_from_the_truth(shot, observation):
    """Also if limbs leave the image or are behind the camera."""
    poses = shot.near(24, 2, spread=0.5)
    poses[:6, 2] -= 3.0
    poses[6:9, 2] = -1.0
    poses[9:12, 0] += 2.0
    depths = shot.body.joint_positions(poses)[..., 2]
    assert (depths < 0).any()
    assert largest_difference(shot.body, shot.camera, poses, observation) <= 1e-9


@pytest.mark.parametrize('name', ['human34', 'human32'])
def test_kernels_equal_numpy_for_other_bodies(shot, observation, name):
    body = load_body(name).with_stature(1.6)
    rng = np.random.default_rng(5)
    poses = np.clip(0.2 * rng.normal(size=(10, body.dimension)), body.lower, body.upper)
    poses[:, :3] = shot.poses[1, :3]
    assert largest_difference(body, shot.camera, poses, observation) <= 1e-9


def test_kernels_equal_numpy_where_the_image_cuts_the_person(shot):
    cut = [np.ascontiguousarray(x[:, 130:200]) for x in shot.images]
    masks = [np.ascontiguousarray(x[:, 130:200]) for x in shot.masks]
    assert masks[1][:, 0].any() or masks[1][:, -1].any() or masks[1].any()
    c = shot.camera
    camera = Camera(c.fx, c.fy, c.cx - 130, c.cy, 70, c.height)
    observation = observe(cut[1], masks[1])
    poses = shot.near(12, 3)
    assert largest_difference(shot.body, camera, poses, observation) <= 1e-9


def test_kernels_equal_numpy_where_segments_have_factors(shot, observation):
    own = believed(shot, observation)
    poses = np.concatenate([shot.near(12, 1), shot.near(6, 2, spread=0.5)])
    assert largest_difference(shot.body, shot.camera, poses, own) <= 1e-9
    likelihood = ImageLikelihood(shot.body, shot.camera)
    usual = replace(own, beliefs=replace(own.beliefs, segments={}))
    found, other = (image_energy(likelihood, poses, x).value for x in (own, usual))
    assert (np.abs(found - other) > 0.05 * other).any()


def test_factors_of_one_change_no_byte(shot, observation):
    likelihood, poses = ImageLikelihood(shot.body, shot.camera), shot.near(8, 1)
    ones = np.ones(len(shot.body.skeleton.parents))
    beliefs = Beliefs(0.7, np.array([0.9, 0.4, 0.6]), 0.5)
    known = replace(beliefs, segments=dict.fromkeys(('coverage', 'edges', 'keypoints'), ones))

    def energy(beliefs):
        terms = likelihood.seen(replace(observation, beliefs=beliefs))
        assert len(terms) == 2
        return PoseEnergy(likelihood, terms).energy(poses)

    for found, wanted in zip(energy(known), energy(beliefs), strict=True):
        assert np.array_equal(found, wanted)


def test_an_image_says_nothing_of_hidden_segments(shot, observation):
    own = believed(shot, observation)
    hidden = np.zeros(len(shot.body.skeleton.parents), dtype=bool)
    hidden[list(shot.body.skeleton.chains['left_leg'][1:])] = True
    names = ('coverage', 'edges', 'keypoints')
    factors = {
        x: np.where(hidden, 0.0, own.factors(x) if len(own.factors(x)) else 1.0) for x in names
    }
    told = replace(own, beliefs=replace(own.beliefs, segments=factors))
    likelihood, poses = ImageLikelihood(shot.body, shot.camera), shot.near(6, 2, spread=0.5)
    found, wanted, other = (
        PoseEnergy(likelihood, likelihood.seen(x)).energy(poses).value
        for x in (replace(own, hidden=hidden), told, own)
    )
    assert np.array_equal(found, wanted)
    assert (found < other - 0.1).all()


# Derivatives.


def numerical_gradient(function, poses, step=1e-6):
    result = np.empty_like(poses)
    for j in range(poses.shape[1]):
        shift = np.zeros(poses.shape[1])
        shift[j] = step
        result[:, j] = (function(poses + shift) - function(poses - shift)) / (2 * step)
    return result


def relative_errors(found, wanted):
    return np.abs(found - wanted) / np.abs(wanted).max(axis=1, keepdims=True)


@pytest.mark.parametrize('factors', [False, True], ids=['usual', 'factors'])
@pytest.mark.parametrize('name', IMAGE_TERMS)
def test_gradients_of_contour_terms_at_material_points(shot, observation, name, factors):
    """The gradient is that of points fixed on the skin."""
    body, camera = shot.body, shot.camera
    likelihood = only(ImageLikelihood(body, camera), name)
    poses = shot.near(6, 7)
    frames = forward(body.skeleton, poses)
    surface = oracle.project_surface(body, camera, frames)
    local = occluding_contour(body.flesh, frames).local
    term = getattr(likelihood.settings, name)
    sigma = np.hypot(term.sigma, MAGNIFICATION * surface.noise)
    if factors:
        observation = believed(shot, observation)
        term = replace(term, weight=term.weight * observation.beliefs.of_term(name))
    every = np.ones(len(body.skeleton.parents))
    own = (observation.beliefs.segments[name] if factors else every)[surface.segments]

    def value(x):
        moved = forward(body.skeleton, x).points(surface.segments, local)
        pixels, projection = camera.project_with_derivative(moved.transpose(1, 0, 2))
        held = replace(surface, points=moved, pixels=pixels, projection=projection)
        if name == 'coverage':
            return oracle.coverage(held, observation.outline, term, sigma, own).value
        return oracle.edges(held, observation.evidence[name], term, sigma, own).value

    found = image_energy(likelihood, poses, observation).gradient
    errors = relative_errors(found, numerical_gradient(value, poses))
    assert np.quantile(errors, 0.99) < 1e-6
    assert errors.max() < 1e-3


def test_gradient_and_hessian_of_the_soft_prior(shot):
    prior = AnglePrior(shot.body)
    poses = shot.near(5, 10, spread=0.4)
    value, gradient, hessian = energy_of(prior, shot.body, poses)
    wanted = numerical_gradient(lambda x: energy_of(prior, shot.body, x).value, poses)
    assert np.allclose(gradient, wanted, atol=1e-6)
    known = np.isfinite(shot.body.prior_sigma)
    offset = (poses - shot.body.prior_mean)[:, known] / shot.body.prior_sigma[known]
    assert np.allclose(value, 0.5 * (offset**2).sum(1))
    assert np.allclose(hessian[0, known][:, known], np.diag(shot.body.prior_sigma[known] ** -2.0))


# Lists of residuals.


def residuals(likelihood, frames, observation):
    """Residuals (M, 9) of one pose."""
    (found,) = likelihood.recorded(frames, observation)
    return found[1 : 1 + int(found[0, 0])]


def summed(frames, segments, points, directions, pull, curvature):
    """Gradient (d,) and Hessian (d, d) over the pose of residuals at points of the skin."""
    by_pose = directed_derivatives(frames, segments, points, directions)
    return by_pose.T @ pull, (by_pose * curvature[:, None]).T @ by_pose


@pytest.mark.parametrize('factors', [False, True], ids=['usual', 'factors'])
@pytest.mark.parametrize('names', [*((name,) for name in IMAGE_TERMS), IMAGE_TERMS])
def test_listed_residuals_sum_to_gradient_and_hessian(shot, observation, names, factors):
    if factors:
        observation = believed(shot, observation)
    likelihood = only(ImageLikelihood(shot.body, shot.camera), *names)
    for pose in shot.near(4, 22, spread=0.3):
        frames = forward(shot.body.skeleton, pose[None])
        listed = residuals(likelihood, frames, observation)
        assert len(listed) > 10
        gradient, hessian = summed(
            frames, listed[:, 0].astype(int), listed[:, 1:4], listed[:, 4:7],
            listed[:, 7], listed[:, 8],
        )  # fmt: skip
        wanted = image_energy(likelihood, frames.poses, observation)
        assert np.allclose(gradient, wanted.gradient[0], rtol=1e-9, atol=1e-9)
        assert np.allclose(hessian, wanted.hessian[0], rtol=1e-9, atol=1e-9)


def test_listed_residuals_of_keypoints_sum_to_gradient_and_hessian(shot):
    keypoints = keypoints_of(shot)
    pixels, confidences = keypoints.pixels.copy(), keypoints.confidences.copy()
    pixels[3], confidences[5], confidences[7] = np.nan, 0.0, 0.4
    keypoints = replace(keypoints, pixels=pixels, confidences=confidences)
    poses = shot.near(3, 23)
    poses[2, 2] = 0.1  # some joints are behind the camera
    term = KeypointTerm(shot.body.skeleton, shot.camera, keypoints, TermSettings(2.0, 1.5, 5.0))
    for pose in poses:
        frames = forward(shot.body.skeleton, pose[None])
        joints, *found = term.residuals(frames)
        assert not {3, 5} & set(joints)
        (recorded,) = term.recorded(frames)
        assert recorded[0, 0] == len(joints)
        rows = np.column_stack([joints, *found])
        assert np.array_equal(recorded[1 : 1 + len(rows)], rows)
        segments = shot.body.skeleton.joint_segments[joints]
        gradient, hessian = summed(frames, segments, *found)
        wanted = energy_of(term, shot.body, frames.poses, camera=shot.camera)
        assert np.allclose(gradient, wanted.gradient[0], rtol=1e-9, atol=1e-7)
        assert np.allclose(hessian, wanted.hessian[0], rtol=1e-9, atol=1e-7)


# Noise of contours.


# Visibility.


def test_visibility_agrees_with_marching_along_the_rays(shot):
    body = shot.body
    poses = shot.near(3, 12, spread=0.4)
    frames = forward(body.skeleton, poses)
    contour = occluding_contour(body.flesh, frames)
    covered, hidden = oracle.visibility(body, frames, contour.points, contour.parts)
    assert 0.1 < hidden.mean() < 0.9
    assert (covered & ~hidden).any()
    parts = body.flesh.parts
    steps = np.linspace(0.2, 1.8, 6001)
    agree = []
    for n in range(len(poses)):
        rotations = frames.rotations()[n]
        for p in range(0, len(contour.points), 7):
            ray = contour.points[p, :, n]
            inside = np.zeros(len(steps), dtype=bool)
            for b, part in enumerate(parts):
                if b == contour.parts[p]:
                    continue
                place = frames.origins[part.segment, :, n] + rotations[part.segment] @ part.centre
                local = (steps[:, None] * ray - place) @ rotations[part.segment]
                inside |= ((local / (COVER * np.array(part.radii))) ** 2).sum(1) < 1
            seen = (inside.any(), inside[steps < 1 - BEHIND].any())
            agree.append(seen == (covered[p, n], hidden[p, n]))
    # Rays that graze a part by less than a step are missed.
    assert np.mean(agree) > 0.985


# Switches.


def test_the_number_of_threads_does_not_matter(shot, observation):
    poses = shot.near(23, 13)
    results = []
    for count in (1, 2, 3):
        likelihood = ImageLikelihood(shot.body, shot.camera, threads=count)
        results.append(image_energy(likelihood, poses, observation))
    for other in results[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(results[0], other))


def test_a_pose_does_not_depend_on_its_neighbours_in_the_batch(shot, observation):
    poses = shot.near(9, 14)
    likelihood = ImageLikelihood(shot.body, shot.camera)
    terms = OneByOne(likelihood, (*likelihood.seen(observation), *likelihood.priors))
    together = terms.energy(poses)
    for n in (0, 4, 8):
        alone = terms.energy(poses[n : n + 1])
        for a, b in zip(together, alone):
            assert relative_difference(a[n : n + 1], b) <= 1e-12


def test_the_truth_is_better_than_its_neighbours(shot, observation):
    likelihood = ImageLikelihood(shot.body, shot.camera)
    poses = np.concatenate([shot.poses[1:], shot.near(40, 17, spread=0.15)])
    terms = {x: image_energy(only(likelihood, x), poses, observation).value for x in IMAGE_TERMS}
    terms['keypoints'] = keypoint_energy(shot, observation.keypoints, poses).value
    for name, value in terms.items():
        assert np.mean(value[1:] > value[0]) > 0.95, name


def test_what_others_explain_costs_no_more_than_that(shot, observation):
    likelihood = only(ImageLikelihood(shot.body, shot.camera), 'coverage')
    poses = shot.near(4, 18)

    def found(explained):
        image = ObservedImage(likelihood, observation, explained)
        return PoseEnergy(likelihood, (image,)).by_cue(poses)

    free = found(None)
    costs = free.outline_costs
    assert np.allclose(costs.sum(1), free.energy.value)
    limit = np.random.default_rng(0).uniform(0, 2 * costs.mean(), costs.shape)
    for explained in (limit, limit[:1]):
        some = found(explained)
        assert np.allclose(some.outline_costs, np.minimum(costs, explained))
        assert np.allclose(some.energy.value, some.outline_costs.sum(1))
    nothing = found(np.zeros_like(limit)).energy
    assert not nothing.value.any()
    assert not nothing.hessian.any()


def keypoint_energy(shot, keypoints, poses, settings=None, derivatives=Derivatives.POSITIVE):
    term = KeypointTerm(
        shot.body.skeleton, shot.camera, keypoints, settings or TermSettings(1.0, 1.0, 5.0)
    )
    return energy_of(term, shot.body, poses, camera=shot.camera, derivatives=derivatives)


def test_keypoints_are_least_squares_with_their_covariances(shot):
    body, camera = shot.body, shot.camera
    keypoints = keypoints_of(shot)
    poses = shot.near(4, 20)
    found = keypoint_energy(shot, keypoints, poses, TermSettings(2.0, 1.5, np.inf))
    error = camera.project(body.joint_positions(poses)) - keypoints.pixels
    precision = np.linalg.inv(keypoints.covariances)
    square = np.einsum('nja,jab,njb->n', error, precision, error)
    assert np.allclose(found.value, 0.5 * 2.0 / 1.5**2 * square)


def test_gradient_of_keypoints(shot):
    keypoints, poses = keypoints_of(shot), shot.near(8, 6)

    def value(x):
        return keypoint_energy(shot, keypoints, x, derivatives=Derivatives.NONE).value

    found = keypoint_energy(shot, keypoints, poses)
    assert np.array_equal(found.value, value(poses))
    errors = relative_errors(found.gradient, numerical_gradient(value, poses))
    assert errors.max() < 1e-6
