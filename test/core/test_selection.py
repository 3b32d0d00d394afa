"""Choice of hypotheses: invalid arguments are refused; the tests of `tracking` check values."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.core import choose_representatives, keep_apart
from test.core.arguments import assert_arguments_are_checked

N = 5


def arguments(**changes):
    joints = np.random.default_rng(0).normal(size=(N, 4, 3))
    given = {
        'joints': joints,
        'log_weights': np.zeros(N),
        'same': 0.02,
        'cap': 0.3,
        'first': np.array([3]),
        'chosen': np.zeros(3, dtype=np.int64),
        'owner': np.zeros(N, dtype=np.int64),
        'groups': np.zeros(3),
    }
    return given | changes


def test_a_choice_needs_arguments_that_fit():
    assert_arguments_are_checked(
        choose_representatives,
        arguments(),
        'chosen owner groups',
        free='first',
        unread='chosen owner',
    )
    for changes in (
        {'chosen': np.zeros(N + 1, dtype=np.int64), 'groups': np.zeros(N + 1)},
        {'joints': np.zeros((N, 0, 3))},
    ):
        with pytest.raises(ValueError, match=next(iter(changes))):
            choose_representatives(*arguments(**changes).values())


def test_those_that_are_kept_in_any_case_follow_the_heaviest():
    given = arguments(log_weights=np.log([0.1, 0.2, 0.5, 0.1, 0.1]), first=np.array([3, 0]))
    assert choose_representatives(*given.values()) == 3
    assert list(given['chosen']) == [2, 3, 0]
    weights = [np.exp(given['log_weights'])[given['owner'] == k].sum() for k in range(3)]
    np.testing.assert_allclose(np.exp(given['groups']), weights, rtol=1e-12)


def test_none_is_kept_that_changes_nothing():
    given = arguments(joints=np.zeros((N, 4, 3)), first=np.zeros(0, dtype=np.int64))
    assert choose_representatives(*given.values()) == 1
    assert not given['owner'].any()


def test_those_that_are_apart_from_all_before_are_kept():
    joints = np.zeros((N, 2, 3))
    joints[:, 1, 0] = [0.0, 0.1, 1.0, 1.05, 3.0]
    given = {
        'joints': joints,
        'order': np.array([3, 1, 0, 2, 4]),
        'same': 0.25,
        'kept': np.zeros(N, dtype=np.int64),
    }
    assert_arguments_are_checked(keep_apart, given, 'kept', unread='kept')
    assert keep_apart(*given.values()) == 3
    assert given['kept'][:3].tolist() == [3, 1, 4]
