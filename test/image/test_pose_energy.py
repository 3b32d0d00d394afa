"""Compiled energies and minima, compared with the sum of single terms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_learning.rendering.renderer import render_frames
from hmt_learning.rendering.scene import Scene
from hmt_ros.body import Camera, load_body
from hmt_ros.body.ground_terms import FloorPlane, GroundSettings, GroundTerm
from hmt_ros.body.kinematics import forward
from hmt_ros.image.likelihood import ImageLikelihood, LikelihoodSettings, ObservedImage
from hmt_ros.image.observation import observe
from hmt_ros.image.optical_flow import FlowTerm
from hmt_ros.image.pose_energy import PoseEnergy
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.surface_points import seen_points
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.bounded_newton import minimise
from hmt_ros.inference.energy import Derivatives, Energy, Quadratic, Student, Sum
from test.inference.restricted import Restricted
from test.oracles.single_terms import OneByOne

CAMERA = Camera(330.0, 330.0, 159.5, 119.5, 320, 240)
SOLVER = {'step_scale': 0.3, 'damping': 1.0, 'tolerance': 0.02}
COUNT = 12


@pytest.fixture(scope='module')
def body():
    return load_body('human37')


@pytest.fixture(scope='module')
def seen(body):
    """An image of a waving person with keypoints, and the pose."""
    view = Viewpoint(distance=3.4)
    pose = procedural_motion('dance', body, 0.5, 10.0, 3, viewpoint=view)[4]
    (frame,) = render_frames(body, pose[None], CAMERA, Scene(viewpoint=view, seed=4))
    pixels = CAMERA.project(body.joint_positions(pose[None]))[0]
    pixels += 2.0 * np.random.default_rng(1).normal(size=pixels.shape)
    covariances = np.tile(4.0 * np.eye(2), (len(pixels), 1, 1))
    keypoints = Keypoints(body.joint_names, pixels, covariances, np.ones(len(pixels)))
    return observe(frame.image, frame.mask, keypoints=keypoints), pose


@pytest.fixture(scope='module')
def poses(body, seen):
    rng = np.random.default_rng(0)
    around = seen[1] + 0.15 * rng.normal(size=(COUNT, body.dimension))
    around[:, :3] = seen[1][:3] + 0.05 * rng.normal(size=(COUNT, 3))
    return np.clip(around, body.lower, body.upper)


@pytest.fixture(scope='module')
def terms(body, seen):
    """By name: a likelihood and the terms of an image."""
    rng = np.random.default_rng(1)
    exchanges = np.log(rng.dirichlet(np.ones(4), COUNT))
    likelihood = ImageLikelihood(body, CAMERA)
    angles = ImageLikelihood(body, CAMERA, LikelihoodSettings(pose_prior='angles'))
    up = np.array([0.0, -np.cos(0.2), -np.sin(0.2)])
    ground = GroundTerm(body, GroundSettings(), FloorPlane(up, 0.05, 1.2, 0.02))
    image, keypoints = likelihood.seen(seen[0], exchanges=exchanges)
    limb = replace(likelihood, parts=(5, 6, 7), occluders=(0, 1, 2, 5, 6, 7))
    samples = len(seen[0].outline.pixels)
    before = seen[1] + 0.02 * rng.normal(size=(COUNT, body.dimension))
    flow = FlowTerm(
        seen_points(body, CAMERA, forward(body.skeleton, before)),
        ImageMap(rng.normal(0.0, 3.0, (2, 240, 320)).astype(np.float32)), 5.0,
    )  # fmt: skip
    of_limb = ObservedImage(limb, seen[0], np.full((1, samples), 0.2))
    return {
        'all': (likelihood, (image, keypoints, *likelihood.priors, ground)),
        'image': (likelihood, (image,)),
        'keypoints and prior': (likelihood, (keypoints, likelihood.pose_prior)),
        'flow and prior': (likelihood, (flow, likelihood.pose_prior)),
        'independent angles': (angles, (image, *angles.priors)),
        'limb': (limb, (of_limb, *likelihood.seen(seen[0])[1:], likelihood.pose_prior)),
    }


class Strange:
    """A term that is not compiled: a parabola over the angles of the pose."""

    def energy(self, frames, rows, *, derivatives=Derivatives.POSITIVE):
        x = frames.poses - 0.1 * np.asarray(rows)[:, None]
        value = 3.0 * (x * x).sum(1)
        if not derivatives:
            return Energy(value)
        return Energy(value, 6.0 * x, np.broadcast_to(6.0 * np.eye(x.shape[1]), (*x.shape, 37)))


def motion_of(poses, kind, f):
    rng = np.random.default_rng(3)
    roots = rng.normal(size=(COUNT, f, f))
    precisions = 5.0 * np.eye(f) + roots @ roots.transpose(0, 2, 1)
    centres = rng.normal(size=(COUNT, f))
    return {
        'none': None,
        'gaussian': Quadratic(centres, precisions),
        'one for all': Quadratic(centres[0], precisions[0]),
        'diagonal': Quadratic(centres[0], np.full(f, 4.0)),
        'student': Student(centres[0], precisions[0], 4.0),
    }[kind]


def plain(likelihood, terms, motion, point=None, free=None):
    posed = OneByOne(likelihood, terms)
    if point is not None:
        posed = Restricted(posed, point, free)
    return posed if motion is None else Sum((posed, motion))


def check_same(found, wanted):
    for a, b in zip(found, wanted, strict=True):
        assert (a is None) == (b is None)
        if a is not None:
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * max(np.abs(b).max(), 1.0))


@pytest.mark.parametrize('motion', ['none', 'gaussian', 'one for all', 'diagonal', 'student'])
@pytest.mark.parametrize(
    'name',
    ['all', 'image', 'keypoints and prior', 'flow and prior', 'independent angles', 'limb'],
)
@pytest.mark.parametrize('derivatives', [Derivatives.NONE, Derivatives.POSITIVE, Derivatives.EXACT])
def test_energies_are_those_of_the_terms(terms, poses, name, motion, derivatives):
    likelihood, some = terms[name]
    expected = motion_of(poses, motion, 37)
    rows = np.random.default_rng(2).permutation(COUNT)
    own = PoseEnergy(likelihood, some, expected)
    found = own.energy(poses, rows, derivatives=derivatives)
    assert (found.hessian is None) == (derivatives == Derivatives.NONE)
    check_same(
        found, plain(likelihood, some, expected).energy(poses, rows, derivatives=derivatives)
    )


@pytest.mark.parametrize('strange', [False, True])
def test_energies_by_cue_are_those_of_the_terms(terms, poses, strange):
    likelihood, (image, keypoints, *known) = terms['all']
    known = [*known, Strange()] if strange else known
    own = PoseEnergy(likelihood, (image, keypoints, *known))
    found = own.by_cue(poses)
    for cue, some in enumerate(([image], [keypoints], known)):
        wanted = plain(likelihood, tuple(some), None).energy(poses, np.arange(COUNT))
        check_same((found.values[:, cue], found.hessians[:, cue]), (wanted.value, wanted.hessian))
    check_same(found.energy, own.energy(poses))
    costs = PoseEnergy(likelihood, (image,)).by_cue(poses, derivatives=False).outline_costs
    assert np.array_equal(found.outline_costs, costs)
    values = own.by_cue(poses, derivatives=False)
    np.testing.assert_allclose(values.values, found.values, rtol=1e-12)
    assert values.energy.hessian is None


@pytest.mark.parametrize('motion', ['none', 'student'])
def test_energies_over_some_variables(terms, poses, body, motion):
    likelihood, some = terms['limb']
    free = body.skeleton.chain_dofs['left_arm']
    expected = motion_of(poses, motion, len(free))
    own = PoseEnergy(likelihood, some, expected, poses[0], free)
    reference = plain(likelihood, some, expected, poses[0], free)
    # In the order used by the tracker, for which the code is compiled.
    x, rows = np.ascontiguousarray(poses[:, free]), np.arange(COUNT)
    check_same(own.energy(x, rows), reference.energy(x, rows))
    found = own.minimise(x, max_iterations=6, **SOLVER)
    wanted = minimise(
        reference, x, body.lower[free], body.upper[free], max_iterations=6, **SOLVER
    )  # fmt: skip
    np.testing.assert_allclose(found.x, wanted.x, atol=1e-8)


@pytest.mark.parametrize('name', ['all', 'keypoints and prior', 'flow and prior'])
@pytest.mark.parametrize('iterations', [0, 1, 7])
def test_minima_are_those_of_the_solver_step_by_step(terms, poses, body, name, iterations):
    likelihood, some = terms[name]
    expected = motion_of(poses, 'gaussian', 37)
    counts = []
    own = PoseEnergy(likelihood, some, expected, counted=counts.append)
    found = own.minimise(poses, max_iterations=iterations, **SOLVER)
    reference = plain(likelihood, some, expected)
    wanted = minimise(
        reference, poses, body.lower, body.upper, max_iterations=iterations, **SOLVER
    )  # fmt: skip
    np.testing.assert_allclose(found.x, wanted.x, atol=1e-7)
    # At the same poses, because steep energies amplify the last digits of poses.
    value, gradient, _ = reference.energy(found.x, np.arange(COUNT))
    check_same((found.value, found.gradient), (value, gradient))
    for part in ('free', 'status', 'iterations'):
        assert np.array_equal(getattr(found, part), getattr(wanted, part))
    assert counts == [COUNT + int(wanted.iterations.sum())]


def test_each_pose_is_worked_on_alone(terms, poses):
    """Results do not depend on other poses in a batch or on the number of threads."""
    likelihood, some = terms['all']
    own = PoseEnergy(likelihood, some, motion_of(poses, 'gaussian', 37))
    together = own.energy(poses)
    for n in (0, COUNT - 1):
        alone = own.energy(poses[n : n + 1], np.array([n]))
        for a, b in zip(alone, together, strict=True):
            assert np.array_equal(a[0], b[n])


def test_a_term_without_a_kernel_is_added(terms, poses, body):
    likelihood, some = terms['image']
    own = PoseEnergy(likelihood, (*some, Strange()), motion_of(poses, 'gaussian', 37))
    reference = plain(likelihood, (*some, Strange()), motion_of(poses, 'gaussian', 37))
    rows = np.arange(COUNT)
    check_same(own.energy(poses, rows), reference.energy(poses, rows))
    found = own.minimise(poses, max_iterations=3, **SOLVER)
    wanted = minimise(reference, poses, body.lower, body.upper, max_iterations=3, **SOLVER)
    np.testing.assert_allclose(found.x, wanted.x, atol=1e-8)


def test_a_pose_that_has_no_energy_is_left_where_it_is(terms, poses):
    likelihood, some = terms['image']
    centres = poses.copy()
    centres[1] = np.inf
    motion = Quadratic(centres, np.tile(np.eye(37), (COUNT, 1, 1)))
    found = PoseEnergy(likelihood, some, motion).minimise(poses, max_iterations=3, **SOLVER)
    assert np.array_equal(found.x[1], poses[1])
    assert not np.isfinite(found.value[1])
    assert np.isfinite(np.delete(found.value, 1)).all()


@pytest.mark.parametrize(
    ('x', 'message'),
    [
        (np.zeros((2, 5)), r'poses must have shape \(N, 37\), saw \(2, 5\)'),
        (np.full((1, 37), np.nan), 'x: wanted finite numbers'),
    ],
)
def test_poses_that_are_none_are_refused(terms, x, message):
    likelihood, some = terms['image']
    with pytest.raises(ValueError, match=message):
        PoseEnergy(likelihood, some).energy(x)
    with pytest.raises(ValueError, match=message):
        PoseEnergy(likelihood, some).minimise(x, max_iterations=1, **SOLVER)
