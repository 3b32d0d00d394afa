"""Gravity and floor as energies of poses."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hmt_ros.body import load_body
from hmt_ros.body.ground_terms import (
    LEAN_TAILS,
    PELVIS_SIGMA,
    TRUNK_LEAN,
    TRUNK_SIGMA,
    FloorPlane,
    GroundSettings,
    GroundTerm,
    soles,
)
from hmt_ros.body.kinematics import forward
from hmt_ros.body.mirror import root_angles, root_rotations
from hmt_ros.inference.energy import Derivatives
from test.oracles.single_terms import energy_of

TERMS = ('upright', 'floor')
UP = np.array([0.1, -0.95, -0.25]) / np.linalg.norm([0.1, -0.95, -0.25])
PLANE = FloorPlane(UP, 0.01, 0.8, 0.02)
LEVEL = np.array([0.0, -1.0, 0.0])


def only(name):
    off = {f'{term}_weight': 0.0 for term in TERMS}
    return GroundSettings(**{**off, f'{name}_weight': 1.0})


@pytest.fixture(scope='module')
def body():
    return load_body('human37')


@pytest.fixture(scope='module')
def poses(body):
    """Poses (12, d), some that lean, are off balance, or have feet below the floor."""
    rng = np.random.default_rng(0)
    sigma = np.where(np.isfinite(body.prior_sigma), body.prior_sigma, 0.0)
    x = body.prior_mean + sigma * rng.normal(size=(12, body.dimension))
    x[:, :3] = [0.0, 0.0, 3.0] + 0.2 * rng.normal(size=(12, 3))
    x[:, body.skeleton.dof_index(('root_z',))] = rng.uniform(-3, 3, (12, 1))
    return np.clip(x, body.lower, body.upper)


@pytest.fixture(scope='module')
def standing(body):
    """An upright pose (1, d), both feet on the floor below a level camera."""
    pose = np.zeros((1, body.dimension))
    pose[0, 2] = 3.0
    return pose


def level_plane(body, pose):
    """The floor under the soles of a pose (1, d), for a level camera."""
    feet = soles(body)
    points = forward(body.skeleton, pose).points(feet.segments, feet.local)[..., 0]
    return FloorPlane(LEVEL, 0.0, float(-(points @ LEVEL).min()), 0.0)


@pytest.mark.parametrize('name', TERMS)
def test_derivatives_are_those_of_finite_differences(name, body, poses):
    term = GroundTerm(body, only(name), PLANE)

    def value(x):
        found = energy_of(term, body, x, derivatives=Derivatives.NONE)
        assert found.gradient is None
        return found.value

    energy = energy_of(term, body, poses)
    assert energy.value == pytest.approx(value(poses))
    assert (energy.value > 0.1).sum() >= len(poses) // 2
    step, numeric = 1e-6, np.empty_like(poses)
    for j, unit in enumerate(step * np.eye(body.dimension)):
        numeric[:, j] = (value(poses + unit) - value(poses - unit)) / (2.0 * step)
    gradient, hessian = energy.derivatives()
    assert gradient == pytest.approx(numeric, abs=1e-5)
    assert hessian == pytest.approx(hessian.transpose(0, 2, 1))
    assert np.linalg.eigvalsh(hessian).min() > -1e-8


@pytest.mark.parametrize('name', TERMS)
def test_a_camera_that_turns_with_the_vertical_changes_nothing(name, body, poses):
    turn = Rotation.from_rotvec([0.2, -0.1, 0.15]).as_matrix()
    turned = poses.copy()
    turned[:, :3] = poses[:, :3] @ turn.T
    which = body.skeleton.dof_index(('root_z', 'root_y', 'root_x'))
    turned[:, which] = root_angles(body, turn @ root_rotations(body, poses))
    before = GroundTerm(body, only(name), PLANE)
    after = GroundTerm(body, only(name), replace(PLANE, up=turn @ UP))
    assert energy_of(after, body, turned).value == pytest.approx(
        energy_of(before, body, poses).value
    )


def test_who_stands_on_both_feet_costs_nothing_but_the_lean(body, standing):
    plane = level_plane(body, standing)
    upright, floor = (energy_of(GroundTerm(body, only(x), plane), body, standing) for x in TERMS)
    both = energy_of(GroundTerm(body, GroundSettings(), plane), body, standing)
    assert upright.value > 0
    assert floor.value == pytest.approx(0.0, abs=1e-9)
    assert both.value == pytest.approx(upright.value + floor.value)


@pytest.mark.parametrize('name', ['human32', 'human34', 'human37'])
def test_the_usual_lean_costs_nothing_and_heavy_tails_let_people_bend(name):
    body = load_body(name)
    skeleton = body.skeleton
    neck = skeleton.joint_index(('neck',))[0]
    trunk = skeleton.parents[skeleton.joint_segments[neck]]
    term = GroundTerm(body, only('upright'), FloorPlane(LEVEL, 0.0, None, np.inf))
    bends = bool(skeleton.segment_dofs[trunk])

    def leaning(pelvis, spine):
        """Cost and lean of the trunk (N,), from leans of the pelvis and angles of the spine."""
        poses = np.zeros((len(pelvis), body.dimension))
        poses[:, 2] = 3.0
        poses[:, skeleton.dof_index(('root_x',))[0]] = pelvis
        if bends:
            poses[:, skeleton.dof_index(('trunk_x',))[0]] = spine
        frames = forward(skeleton, poses)
        axis = frames.joints()[neck] - frames.origins[trunk]
        # The person at rest faces the camera: forwards is -z.
        cost = energy_of(term, body, poses).value
        return cost, np.arctan2(-axis[2], -axis[1])

    # A grid of two degrees over all leans, then finer ones around the best.
    centre, width = np.radians([-30.0, -30.0 if bends else 0.0]), np.radians(60.0)
    for _ in range(3):
        offsets = np.linspace(-width, width, 61)
        steps = np.stack(np.meshgrid(offsets, offsets if bends else [0.0]), axis=-1)
        grid = centre + steps.reshape(-1, 2)
        cost, lean = leaning(*grid.T)
        best = int(np.argmin(cost))
        centre, width = grid[best], width / 12.0
    assert cost[best] == pytest.approx(0.0, abs=1e-4)
    assert lean[best] == pytest.approx(TRUNK_LEAN, abs=2e-3)
    small, turned = leaning(grid[best, 0] + np.array([-0.01, -np.pi / 3]), grid[best, 1])[0]
    square = 0.01**2 * (TRUNK_SIGMA[1] ** -2 + bends * PELVIS_SIGMA[1] ** -2)
    assert small == pytest.approx(0.5 * (LEAN_TAILS + 2) / LEAN_TAILS * square, rel=0.03)
    assert turned < 16.0


@pytest.mark.parametrize('angle', [-1.2, 0.9])
def test_a_hidden_shank_is_upright_and_another_leans_as_it_likes(body, angle):
    """Compared with a visible leg; the gradient equals differences."""
    hip = body.skeleton.dof_index(('left_hip_x',))[0]
    shank = body.skeleton.chains['left_leg'][1]
    poses = np.zeros((2, body.dimension))
    poses[:, 2], poses[1, hip] = 3.0, angle
    shown = GroundTerm(body, only('upright'), FloorPlane(LEVEL, 0.0, None, np.inf))
    hidden = replace(shown, hidden=(shank,))
    costs = [[energy_of(term, body, pose).value for pose in poses] for term in (shown, hidden)]
    assert costs[0][1] - costs[0][0] == pytest.approx(0.0, abs=1e-9)
    assert costs[1][1] - costs[1][0] > 2.0
    found = energy_of(hidden, body, poses[1]).gradient[0, hip]
    moved = [poses[1] + s * 1e-6 * np.eye(body.dimension)[hip] for s in (1.0, -1.0)]
    differences = [energy_of(hidden, body, pose).value[0] for pose in moved]
    assert found == pytest.approx((differences[0] - differences[1]) / 2e-6, rel=1e-5)
