import math
from array import array
from dataclasses import dataclass, field

import pytest

from hmt_ros.sessions.bme_parameters import BmeParameters
from hmt_ros.sessions.declared_parameters import (
    AT_LAUNCH,
    AT_ONCE,
    EFFECTS,
    NEXT_TRACK,
    declared_parameters,
    nested_parameters,
    parameter_field,
    values_of,
    with_values,
)
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.sessions.tracking_parameters import FilterParameters, PeopleParameters

ALL = (FilterParameters(), SmootherParameters(), BmeParameters())


@dataclass(frozen=True)
class Term:
    """A term.

    Attributes:
        weight: Weight of the term.
        low, high: Thresholds, of which
            the first is the lower.
    """

    weight: float = 2.0
    low: float = -1.0
    high: int = 3

    def __post_init__(self):
        if self.low >= self.high:
            raise ValueError(f'low {self.low} must be below high {self.high}')


@dataclass(frozen=True)
class Base:
    """What all have.

    Attributes:
        shared: Shared by all.
    """

    shared: bool = parameter_field(True, AT_LAUNCH)


@dataclass(frozen=True)
class Outer(Base):
    """All.

    Attributes:
        on: More: with a colon.
        own: A term.

    Raises:
        ValueError: never.
    """

    on: bool = parameter_field(True, AT_ONCE)
    own: Term = field(
        default_factory=Term,
        metadata=nested_parameters(NEXT_TRACK, {'high': (0, 9), 'low': (-math.inf, math.inf)}),
    )
    apart: Term = field(default_factory=Term)


def test_fields_that_are_listed_are_parameters():
    found = {p.name: p for p in declared_parameters(Outer())}
    assert list(found) == ['on', 'high', 'low', 'shared']
    assert {name: p.default for name, p in found.items()} == values_of(Outer())
    assert found['on'].description == 'More: with a colon.'
    assert found['high'].description == 'Thresholds, of which the first is the lower.'
    assert found['shared'].description == 'Shared by all.'
    assert (found['on'].effect, found['low'].effect) == (AT_ONCE, NEXT_TRACK)
    assert found['on'].limits is None
    assert found['high'].limits == (0, 9)
    assert found['low'].path == ('own', 'low')


def test_values_replace_defaults():
    settings = with_values(Outer(), {'low': 1, 'high': 5, 'on': False})
    assert settings == Outer(on=False, own=Term(2.0, 1.0, 5))
    assert isinstance(settings.own.low, float)
    assert with_values(Outer(), {}) == Outer()


@pytest.mark.parametrize(
    ('values', 'message'),
    [
        ({'hihg': 2}, 'no parameter hihg; is high meant?'),
        ({'zzz': 1}, 'no parameter zzz$'),
        ({'on': 1}, 'on must be a truth value, saw 1'),
        ({'high': 2.5}, 'high must be a whole number, saw 2.5'),
        ({'high': True}, 'high must be a whole number, saw True'),
        ({'low': 'x'}, "low must be a number, saw 'x'"),
        ({'weight': 1.0}, 'no parameter weight'),
        ({'high': 10}, 'high must lie between 0 and 9, saw 10'),
        ({'low': math.nan}, 'low must lie between -inf and inf, saw nan'),
    ],
)
def test_wrong_values_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        with_values(Outer(), values)


def test_values_that_do_not_go_together_are_refused():
    with pytest.raises(ValueError, match=r'low 4.0 must be below high 3'):
        with_values(Outer(), {'low': 4.0})
    assert with_values(Outer(), {'low': 4.0, 'high': 5}).own == Term(2.0, 4.0, 5)


@pytest.mark.parametrize(
    'settings', [*ALL, PeopleParameters()], ids=lambda settings: type(settings).__name__
)
def test_defaults_lie_between_limits(settings):
    for parameter in declared_parameters(settings):
        assert parameter.effect in EFFECTS
        assert (parameter.limits is None) == (type(parameter.default) in (bool, str, tuple)), (
            parameter
        )
        assert parameter.checked(parameter.default) == parameter.default


@pytest.mark.parametrize(
    ('given', 'kept'),
    [
        ([0.0, 2.0, 0.5], (0.0, 2.0, 0.5)),
        ([0, 1, 0], (0.0, 1.0, 0.0)),
        ((), ()),
        # What ROS makes of an empty list in a file, and of lists that a node is given.
        (None, ()),
        (array('d', [0.0, 0.0, 9.81]), (0.0, 0.0, 9.81)),
    ],
)
def test_a_parameter_may_be_a_list_of_numbers(given, kept):
    parameters = with_values(FilterParameters(), {'gravity': given})
    assert parameters.gravity == kept
    assert values_of(parameters)['gravity'] == list(kept)


@pytest.mark.parametrize('given', ['down', 9.81, [b'x'], ['down'], [True, False, True], {'y': 1}])
def test_what_is_no_list_of_numbers(given):
    with pytest.raises(ValueError, match='gravity must be a list of numbers, saw'):
        with_values(FilterParameters(), {'gravity': given})


@pytest.mark.parametrize(
    ('values', 'message'),
    [
        ({'gravity': [0.0, 0.0, 0.0]}, 'gravity must be three finite numbers, not all zero, saw'),
        ({'gravity': [0.0, 1.0]}, r'not all zero, saw \[0.0, 1.0\]'),
        ({'gravity': [math.nan, 1.0, 0.0]}, r'saw \[nan, 1.0, 0.0\]'),
        ({'gravity': [0.0, math.inf, 0.0]}, r'saw \[0.0, inf, 0.0\]'),
        ({'camera_height': -1.0}, 'camera_height must lie between 0 and 100, saw -1.0'),
        ({'camera_height': math.nan}, 'camera_height must lie between 0 and 100, saw nan'),
        ({'floor_in_gravity_frame': True}, 'needs the name of gravity_frame, which is empty'),
        ({'input_timeout': -0.1}, 'input_timeout must lie between 0 and 60'),
    ],
)
def test_what_is_no_ground(values, message):
    with pytest.raises(ValueError, match=message):
        with_values(FilterParameters(), values)
