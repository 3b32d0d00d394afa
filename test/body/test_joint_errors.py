"""Errors of the joints of a body that are the same in every pose."""

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.body.model_file import joint_errors_of

NAMES = ('pelvis', 'left_knee', 'right_knee', 'head')


@pytest.mark.parametrize('name', ['human32', 'human34', 'human37'])
def test_every_body_has_errors_relative_to_the_pelvis(name):
    body = load_body(name)
    assert body.joint_errors.shape == (len(body.joint_names),)
    assert body.joint_errors[body.joint_names.index('pelvis')] == 0.0
    assert (np.delete(body.joint_errors, body.joint_names.index('pelvis')) > 0.0).all()


def test_both_sides_have_the_error_and_a_joint_without_one_the_worst():
    table = {'pelvis': 0.0, '{side}_knee': 0.02}
    assert joint_errors_of(NAMES, table).tolist() == [0.0, 0.02, 0.02, 0.02]


@pytest.mark.parametrize(
    ('table', 'says'),
    [
        ({'pelvis': -0.01}, 'numbers of at least 0'),
        ({'pelvis': float('nan')}, 'numbers of at least 0'),
        ({}, 'numbers of at least 0'),
        ({'tail': 0.02}, "names .'tail'., which the body does not have"),
    ],
)
def test_a_wrong_table_is_refused(table, says):
    with pytest.raises(ValueError, match=says):
        joint_errors_of(NAMES, table)
