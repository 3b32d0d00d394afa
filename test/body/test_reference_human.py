"""The reference model of REP 155 passes through the joint positions of a body."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.body.reference_human import (
    ADDED_JOINTS,
    REFERENCE_JOINTS,
    SIDES,
    fit_reference_human,
)

# Links of the model whose origins are joints of the body.
PAIRS = {'torso': 'neck', 'head': 'head'} | {
    f'{letter}_{joint}': f'{side}_{joint}'
    for letter, (side, _) in SIDES.items()
    for joint in ('shoulder', 'elbow', 'wrist', 'hip', 'knee', 'ankle')
}
# REP 155 and urdf/human-tpl.xacro of human_description: joint, parent, child, axis; left side.
REFERENCE = (
    ('waist', 'body', 'waist', (0, 1, 0)),
    ('torso', 'waist', 'torso', None),
    ('r_head', 'torso', 'r_head', (1, 0, 0)),
    ('y_head', 'r_head', 'y_head', (0, 0, 1)),
    ('p_head', 'y_head', 'p_head', (0, -1, 0)),
    ('head', 'p_head', 'head', None),
    ('l_y_shoulder', 'torso', 'l_y_shoulder', (0, 0, -1)),
    ('l_p_shoulder', 'l_y_shoulder', 'l_p_shoulder', (1, 0, 0)),
    ('l_r_shoulder', 'l_p_shoulder', 'l_shoulder', (0, 0, 1)),
    ('l_elbow', 'l_shoulder', 'l_elbow', (0, -1, 0)),
    ('l_wrist', 'l_elbow', 'l_wrist', None),
    ('l_y_hip', 'body', 'l_y_hip', (0, 0, -1)),
    ('l_p_hip', 'l_y_hip', 'l_p_hip', (1, 0, 0)),
    ('l_r_hip', 'l_p_hip', 'l_hip', (0, -1, 0)),
    ('l_knee', 'l_hip', 'l_knee', (0, -1, 0)),
    ('l_ankle', 'l_knee', 'l_ankle', None),
)
# Axes of the right side that differ from those of the left.
RIGHT = {
    'r_y_shoulder': (0, 0, 1),
    'r_p_shoulder': (-1, 0, 0),
    'r_r_shoulder': (0, 0, -1),
    'r_p_hip': (-1, 0, 0),
}


def errors(body, positions, **options):
    """Distances (N, 14) of the links from the joints, m."""
    result = []
    for places in positions:
        human = fit_reference_human(body.joint_names, places, **options)
        names, _, origins = human.links()
        found = origins @ human.rotation.T + human.origin
        result.append(
            [
                np.linalg.norm(found[names.index(link)] - places[body.joint_names.index(joint)])
                for link, joint in PAIRS.items()
            ]
        )
    return np.array(result)


@pytest.mark.parametrize('name', ['human32', 'human34', 'human37'])
def test_it_passes_through_all_joints(name, random_poses):
    body = load_body(name)
    lengths = {'hip_drop': 0.12, 'upper_arm': 0.31, 'shoulder_rise': -0.03}
    for each in (body, body.with_segment_lengths(lengths)):
        positions = each.joint_positions(random_poses(each, 100, 3))
        assert errors(each, positions).max() < 1e-4


def test_without_added_joints_it_is_the_reference(human37, random_poses):
    body = human37
    positions = body.joint_positions(random_poses(body, 50, 4))
    human = fit_reference_human(body.joint_names, positions[0], additions=False)
    axes = {
        joint.name: (joint.parent, joint.child, None if joint.axis is None else tuple(joint.axis))
        for joint in human.joints
    }
    right = (
        (name.replace('l_', 'r_', 1), *(x.replace('l_', 'r_', 1) for x in links), axis)
        for name, *links, axis in REFERENCE
        if name.startswith('l_')
    )
    wanted = {name: (parent, child, axis) for name, parent, child, axis in (*REFERENCE, *right)}
    for name, axis in RIGHT.items():
        parent, child, _ = wanted[name]
        wanted[name] = (parent.replace('l_', 'r_', 1), child, axis)
    assert axes == wanted
    assert sorted(human.angles) == sorted(REFERENCE_JOINTS)
    # Legs start at the reference's hips; limbs keep their directions.
    found = errors(body, positions, additions=False)
    legs = [i for i, link in enumerate(PAIRS) if link[2:] in ('hip', 'knee', 'ankle')]
    assert found[:, legs].max() < 1e-4
    shoulder, wrist = list(PAIRS).index('l_shoulder'), list(PAIRS).index('l_wrist')
    np.testing.assert_allclose(found[:, shoulder], found[:, wrist], atol=1e-4)
    assert found[:, shoulder].max() > 0.1


def test_angles_of_known_poses(human37):
    body = human37
    pose = np.zeros(body.dimension)
    pose[2] = 4.0
    human = fit_reference_human(body.joint_names, body.joint_positions(pose[None])[0])
    assert list(human.angles)[:3] == ['waist', 'r_torso', 'y_torso']
    for name in ('waist', 'r_torso', 'y_torso', 'p_head', 'l_knee', 'r_r_hip', 'l_elbow'):
        assert human.angles[name] == pytest.approx(0.0, abs=1e-6)
    # At rest a person faces the camera (x right, y down, z forward): x of the body comes nearer.
    np.testing.assert_allclose(human.rotation, [[0, 1, 0], [0, 0, -1], [-1, 0, 0]], atol=1e-9)
    for name, turn in (('left_elbow', 1.0), ('right_knee', -1.2), ('trunk_x', -0.4)):
        pose[body.dof_names.index(name)] = turn
    human = fit_reference_human(body.joint_names, body.joint_positions(pose[None])[0])
    assert human.angles['l_elbow'] == pytest.approx(1.0)
    assert human.angles['r_knee'] == pytest.approx(-1.2)
    # The reference measures forward lean from upright.
    assert human.angles['waist'] == pytest.approx(0.4)


def test_positions_of_nobody_are_refused(human37):
    body = human37
    places = body.joint_positions(body.prior_mean[None])[0].copy()
    names = list(body.joint_names)
    with pytest.raises(ValueError, match='positions of left_knee are missing'):
        fit_reference_human([x.replace('left_knee', 'knee') for x in names], places)
    places[names.index('left_knee')] = places[names.index('left_ankle')]
    with pytest.raises(ValueError, match='left_knee and left_ankle are at one place'):
        fit_reference_human(names, places)
    assert set(ADDED_JOINTS).isdisjoint(REFERENCE_JOINTS)
