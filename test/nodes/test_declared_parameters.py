import math
from dataclasses import dataclass, field, replace

import pytest

from hmt_ros.sessions.declared_parameters import (
    AT_ONCE,
    EFFECT,
    EFFECTS,
    FLAT,
    LIMITS,
    NEXT_TRACK,
    ParameterError,
    declared_parameters,
    described_fields,
    values_of,
    with_values,
)
from hmt_ros.sessions.filter_parameters import FilterParameters
from hmt_ros.tracking import TrackerSettings


@dataclass(frozen=True)
class Term:
    """A term.

    Attributes:
        weight: of the term.
        low, high: thresholds, of which
            the first is the lower.
    """

    weight: float = 2.0
    low: float = -1.0
    high: int = 3

    def __post_init__(self):
        if self.low >= self.high:
            raise ValueError(f'low {self.low} must be below high {self.high}')


@dataclass(frozen=True)
class Inner:
    """Settings.

    Attributes:
        method: 'a' or 'b'.
        edges: contours lie on edges.
    """

    method: str = 'a'
    edges: Term = field(default_factory=Term)


@dataclass(frozen=True)
class Outer:
    """All.

    Attributes:
        on: whether.
        inner: settings of the part.
        own: more: with a colon.

    Raises:
        ValueError: never.
    """

    on: bool = field(default=True, metadata={EFFECT: AT_ONCE})
    inner: Inner = field(
        default_factory=Inner, metadata={FLAT: True, LIMITS: {'edges.weight': (0.5, 9.0)}}
    )
    own: Term = field(default_factory=Term)


def test_fields_of_dataclasses_are_parameters():
    found = {p.name: p for p in declared_parameters(Outer())}
    assert list(found) == [
        'on', 'method', 'edges.weight', 'edges.low', 'edges.high', 'own.weight', 'own.low',
        'own.high',
    ]  # fmt: skip
    assert {name: p.default for name, p in found.items()} == values_of(Outer())
    assert found['method'].description == "'a' or 'b'."
    assert found['edges.weight'].description == 'contours lie on edges: of the term.'
    assert found['own.high'].description == (
        'more: with a colon: thresholds, of which the first is the lower.'
    )
    assert found['on'].effect == AT_ONCE
    assert found['edges.low'].effect == NEXT_TRACK
    assert found['on'].limits is None
    assert found['edges.weight'].limits == (0.5, 9.0)
    # Otherwise numbers keep the sign of their defaults.
    assert found['own.weight'].limits == (0.0, math.inf)
    assert found['own.low'].limits == (-math.inf, math.inf)
    assert found['own.high'].limits == (0.0, 2**31 - 1)


def test_values_replace_defaults():
    settings = with_values(Outer(), {'edges.low': 1, 'own.high': 5, 'method': 'b', 'on': False})
    assert settings == Outer(
        on=False, inner=Inner('b', replace(Term(), low=1.0)), own=replace(Term(), high=5)
    )
    assert isinstance(settings.inner.edges.low, float)
    assert with_values(Outer(), {}) == Outer()


@pytest.mark.parametrize(
    ('values', 'message'),
    [
        ({'metod': 'b'}, 'no parameter metod; is method meant?'),
        ({'zzz': 1}, 'no parameter zzz$'),
        ({'on': 1}, 'on must be a truth value, saw 1'),
        ({'own.high': 2.5}, 'own.high must be a whole number, saw 2.5'),
        ({'own.high': True}, 'own.high must be a whole number, saw True'),
        ({'own.low': 'x'}, "own.low must be a number, saw 'x'"),
        ({'method': None}, 'method must be a text, saw None'),
        ({'edges.weight': 9.5}, 'edges.weight must lie between 0.5 and 9, saw 9.5'),
        ({'own.weight': math.nan}, 'own.weight must lie between 0 and inf, saw nan'),
    ],
)
def test_wrong_values_are_refused(values, message):
    with pytest.raises(ParameterError, match=message):
        with_values(Outer(), values)


def test_values_that_do_not_go_together_are_refused():
    with pytest.raises(ValueError, match=r'low 4.0 must be below high 3'):
        with_values(Outer(), {'edges.low': 4.0})
    assert with_values(Outer(), {'edges.low': 4.0, 'edges.high': 5}).inner.edges.high == 5


def test_types_that_no_parameter_has_are_refused():
    @dataclass(frozen=True)
    class Wrong:
        pair: tuple[int, int] = (1, 2)

    with pytest.raises(TypeError, match=r'Wrong.pair is a tuple'):
        declared_parameters(Wrong())


def test_names_that_two_parts_share_are_refused():
    @dataclass(frozen=True)
    class Twice:
        weight: float = 1.0
        term: Term = field(default_factory=Term, metadata={FLAT: True})

    with pytest.raises(TypeError, match=r"\['weight'\] twice"):
        declared_parameters(Twice())


def test_docstrings_without_attributes_describe_nothing():
    class Bare:
        """Nothing."""

    assert described_fields(Bare) == {}
    assert described_fields(Outer) == {
        'on': 'whether.',
        'inner': 'settings of the part.',
        'own': 'more: with a colon.',
    }


def test_every_setting_of_the_tracker_is_a_parameter_of_the_node():
    names = {p.name for p in declared_parameters(FilterParameters())}
    assert set(values_of(TrackerSettings())) < names
    for name in ('max_hypotheses', 'hypothesis_merge_distance', 'random_seed', 'proposals'):
        assert name in names
    parameters = with_values(FilterParameters(), {'likelihood.edges.weight': 7, 'candidates': 20})
    assert parameters.tracker.likelihood.edges.weight == 7.0
    assert parameters.tracker.candidates == 20


def test_every_parameter_of_the_node_is_described():
    parameters = declared_parameters(FilterParameters())
    assert [p.name for p in parameters if not p.description] == []
    assert {p.effect for p in parameters} <= EFFECTS.keys()
    outside = [
        p.name
        for p in parameters
        if p.limits is not None and not p.limits[0] <= p.default <= p.limits[1]
    ]
    assert outside == []


def test_limits_belong_to_parameters_that_exist():
    names = {p.name for p in declared_parameters(FilterParameters())}
    for entry in FilterParameters.__dataclass_fields__.values():
        limits = entry.metadata.get(LIMITS)
        if isinstance(limits, dict):
            prefix = '' if entry.metadata.get(FLAT) else f'{entry.name}.'
            assert {f'{prefix}{name}' for name in limits} <= names


@pytest.mark.parametrize(
    ('values', 'message'),
    [
        ({'max_hypotheses': 0}, 'max_hypotheses must lie between 1 and 64, saw 0'),
        ({'max_hypotheses': 50}, 'max_hypotheses <= candidates'),
        ({'proposals': 'guess'}, "proposals must be one of .* saw 'guess'"),
        ({'dynamics.model': 'guess'}, "saw 'guess'"),
        ({'background.method': 'guess'}, "saw 'guess'"),
        ({'image_transport': 'theora'}, "image_transport must be one of .* saw 'theora'"),
        ({'body_model': ''}, 'body_model must be a name or a file'),
        ({'likelihood.edges.sigma': 0.0}, 'sigma > 0'),
    ],
)
def test_wrong_parameters_of_the_node(values, message):
    with pytest.raises(ValueError, match=message):
        with_values(FilterParameters(), values)
