"""The shape of a person as a vector: derivatives compared with central differences."""

from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.body.kinematics import directed_derivatives, forward
from hmt_ros.body.shape import ShapeSpace

STEP = 1e-5


@pytest.fixture(scope='module')
def body(human37):
    """A person who differs from the model in lengths and flesh."""
    rng = np.random.default_rng(0)
    lengths = {name: x * rng.uniform(0.85, 1.15) for name, x in human37.segment_lengths.items()}
    growth = rng.normal(size=human37.growth.shape) * [0.1, 0.1, 0.01, 0.01, 0.01]
    return human37.with_segment_lengths(lengths).with_growth(growth)


@pytest.fixture(scope='module')
def space(body):
    return ShapeSpace(body)


def part_of(body, name):
    names = [body.skeleton.segment_names[shape.segment] for shape in body.shapes]
    return names.index(name)


def central_difference(space, function, size=STEP):
    """Derivatives (..., P) of a function of the body at the shape 0."""
    columns = []
    for step in size * np.eye(space.size):
        ahead, behind = (np.asarray(function(space.moved(x))) for x in (step, -step))
        columns.append((ahead - behind) / (2 * size))
    return np.stack(columns, axis=-1)


def test_left_and_right_parts_grow_alike(human37):
    space = ShapeSpace(human37)
    grown = space.moved(0.05 * np.random.default_rng(2).normal(size=space.size))
    for name in ('thigh', 'foot', 'hand'):
        left, right = (
            grown.flesh.parts[part_of(grown, f'{side}_{name}')] for side in ('left', 'right')
        )
        assert left.radii == pytest.approx(right.radii)
        assert left.centre == pytest.approx(np.array(right.centre) * [-1, 1, 1])


@pytest.mark.parametrize('name', ['human37', 'human34', 'human32'])
def test_centres_and_radii_have_their_derivatives(name):
    space = ShapeSpace(load_body(name).with_stature(1.6))
    _, _, by_centre, by_radius = space._parts
    wanted = central_difference(space, lambda body: [part.centre for part in body.flesh.parts])
    assert np.allclose(by_centre, wanted, atol=1e-8)
    wanted = central_difference(space, lambda body: [part.radii for part in body.flesh.parts])
    assert np.allclose(by_radius, wanted, atol=1e-8)


def test_points_on_the_flesh_have_their_derivatives(space, body, random_poses):
    """A point keeps its position in units of the radii around the centre of its part."""
    pose = random_poses(body, 1, 3)
    frames = forward(body.skeleton, pose)
    rng = np.random.default_rng(4)
    parts = rng.integers(0, len(body.shapes), 40)
    place = rng.uniform(-1, 1, size=(40, 3))
    directions = rng.normal(size=(40, 3))
    segments = np.array([body.shapes[part].segment for part in parts])

    def points(other):
        local = np.array(
            [
                other.flesh.parts[part].centre + at * np.array(other.flesh.parts[part].radii)
                for part, at in zip(parts, place)
            ]
        )
        return forward(other.skeleton, pose).points(segments, local)[..., 0]

    rows = residuals(segments, points(body), directions)
    moved = central_difference(space, points)
    wanted = np.einsum('mk,mkp->mp', directions, moved)
    by_pose = directed_derivatives(frames, segments, points(body), directions)
    found = space.second_order(frames, rows[None], NO_RESIDUALS)
    assert are_sums(found, wanted, by_pose, rows[1:, 7], rows[1:, 8])


def test_joints_have_their_derivatives(space, body, random_poses):
    pose = random_poses(body, 1, 5)
    joints = np.array([0, 3, 3, len(body.joint_names) - 1])
    directions = np.random.default_rng(6).normal(size=(len(joints), 3))
    frames, places = forward(body.skeleton, pose), body.joint_positions(pose)[0][joints]
    moved = central_difference(space, lambda other: other.joint_positions(pose)[0][joints])
    segments = body.skeleton.joint_segments[joints]
    by_pose = directed_derivatives(frames, segments, places, directions)
    rows = residuals(joints, places, directions)
    found = space.second_order(frames, NO_RESIDUALS, rows[None])
    wanted = np.einsum('mk,mkp->mp', directions, moved)
    assert are_sums(found, wanted, by_pose, rows[1:, 7], rows[1:, 8])
    assert not found[0][:, space.lengths :].any()


def test_sums_over_residuals_are_those_of_each_pose(space, body, random_poses):
    poses = random_poses(body, 3, 7)
    rng = np.random.default_rng(8)
    segments = np.array([shape.segment for shape in body.shapes])
    rows = np.stack([residuals(segments, *rng.normal(size=(2, len(segments), 3))) for _ in poses])
    rows[1, 0, 0] = 5  # later entries are not read
    none = np.zeros((3, 1, 9))
    together = space.second_order(forward(body.skeleton, poses), rows, none)
    for n in range(3):
        frames = forward(body.skeleton, poses[n : n + 1])
        alone = space.second_order(frames, rows[n : n + 1], NO_RESIDUALS)
        assert all(np.array_equal(x[n], y[0]) for x, y in zip(together, alone))


NO_RESIDUALS = np.zeros((1, 1, 9))


def residuals(owners, points, directions):
    """Residual rows of one pose for `ShapeSpace.second_order`."""
    rng = np.random.default_rng(9)
    rows = np.column_stack([owners, points, directions, rng.normal(size=(len(points), 2))])
    rows[:, 8] = np.abs(rows[:, 8])
    return np.concatenate([np.array([[len(rows), *8 * [0.0]]]), rows])


def are_sums(found, by_shape, by_pose, pull, curvature):
    """Whether the found sums are those over rows (M, P), (M, d) of each residual."""
    weighed = (curvature[:, None] * by_shape).T
    wanted = (pull @ by_shape, weighed @ by_shape, weighed @ by_pose)
    return all(np.allclose(x[0], y, atol=1e-7) for x, y in zip(found, wanted, strict=True))


# Growth of a body.


def test_growth_of_a_part(human37):
    part = part_of(human37, 'left_thigh')
    growth = np.zeros_like(human37.growth)
    growth[part] = [0.1, -0.2, 0.03, 0.01, 0.004]
    before, after = human37.flesh.parts[part], human37.with_growth(growth).flesh.parts[part]
    rx, ry, rz = before.radii
    assert after.radii == pytest.approx((rx * np.exp(0.1), ry * np.exp(-0.2), rz + 0.02))
    moved = np.subtract(after.centre, before.centre)
    assert moved == pytest.approx(np.array([0.0, 0.004, 0.01]))
    # The start (z up) moves outwards by 0.03 and the end by 0.01.
    tops = [x.centre[2] + x.radii[2] for x in (before, after)]
    bottoms = [x.centre[2] - x.radii[2] for x in (before, after)]
    assert tops[1] - tops[0] == pytest.approx(0.03)
    assert bottoms[1] - bottoms[0] == pytest.approx(-0.01)


@pytest.mark.parametrize(
    'growth', [np.zeros(5), np.zeros((3, 5)), np.full((17, 5), np.nan), np.zeros((17, 4))]
)
def test_growth_of_another_body_is_refused(human37, growth):
    with pytest.raises(ValueError, match=r'growth must be \(\d+, 5\) finite numbers'):
        human37.with_growth(growth)


# Size of a part.


def test_parts_grow_with_the_length_that_they_belong_to(human37):
    trunk, thigh, head = (part_of(human37, x) for x in ('trunk', 'left_thigh', 'head'))
    name = 'shoulder_width'
    wide = human37.with_segment_lengths({name: 1.2 * human37.segment_lengths[name]})
    before, after = human37.flesh.parts, wide.flesh.parts
    assert after[trunk].radii[:2] == pytest.approx(1.2 * np.array(before[trunk].radii[:2]))
    assert after[thigh] == before[thigh]
    assert after[head] == before[head]
    name = 'thigh'
    long = human37.with_segment_lengths({name: 1.1 * human37.segment_lengths[name]})
    assert long.flesh.parts[thigh].radii == pytest.approx(1.1 * np.array(before[thigh].radii))
    assert long.flesh.parts[trunk] == before[trunk]


@pytest.mark.parametrize('whole', [False, True])
def test_scales_of_parts_have_their_derivatives(body, whole):
    names = body.skeleton.length_names
    for shape in body.shapes[:6]:
        own = replace(shape, size=None) if whole else shape
        rates = body.scale_rates(own)
        for length, name in enumerate(names):
            at = body.segment_lengths[name]
            ahead, behind = (
                body.with_segment_lengths({name: at + x}).scale_of(own) for x in (STEP, -STEP)
            )
            difference = (ahead - behind) / (2 * STEP)
            assert rates.get(length, 0.0) == pytest.approx(difference, abs=1e-8)
