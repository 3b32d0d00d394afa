"""Energy terms: derivatives against central differences, sums, restrictions and limits."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.inference.energy import (
    Derivatives,
    EnergyFunction,
    Quadratic,
    Student,
    Sum,
)

N, D = 4, 3
RNG = np.random.default_rng(0)
FACTORS = RNG.normal(size=(N, D, D))
PRECISIONS = FACTORS @ FACTORS.swapaxes(1, 2) + np.eye(D)
CENTRES = RNG.normal(size=(N, D))
POINTS = RNG.normal(size=(6, D))
ROWS = np.array([3, 0, 0, 2, 1, 3])


def quartic(x, rows):
    """(rows + 1) sum x^4, with its exact Hessian."""
    scale = (rows + 1.0)[:, None]
    hessian = (12 * scale * x**2)[:, :, None] * np.eye(x.shape[1])
    return (scale * x**4).sum(1), 4 * scale * x**3, hessian


TERMS = {
    'diagonal': Quadratic(CENTRES[0], np.array([1.0, 2.0, 0.5])),
    'diagonal, own centres': Quadratic(CENTRES, np.array([1.0, 2.0, 0.5])),
    'full': Quadratic(CENTRES[0], PRECISIONS[0]),
    'own precisions': Quadratic(CENTRES, PRECISIONS),
    'student': Student(CENTRES[0], PRECISIONS[0], 4.0),
    'own students': Student(CENTRES, PRECISIONS, 2.5),
    'function': EnergyFunction(quartic),
    'sum': Sum((Quadratic(CENTRES, PRECISIONS), Student(CENTRES[0], PRECISIONS[1], 3.0))),
}


@pytest.mark.parametrize('name', TERMS)
def test_gradients_equal_central_differences(name):
    term = TERMS[name]
    gradient, hessian = term.energy(POINTS, ROWS).derivatives()
    h = 1e-5
    for i, step in enumerate(h * np.eye(D)):
        up, down = term.energy(POINTS + step, ROWS), term.energy(POINTS - step, ROWS)
        difference = (up.value - down.value) / (2 * h)
        np.testing.assert_allclose(gradient[:, i], difference, rtol=1e-7, atol=1e-7)
        if 'student' not in name and name != 'sum':
            slope = (up.gradient - down.gradient) / (2 * h)
            np.testing.assert_allclose(hessian[:, :, i], slope, rtol=1e-7, atol=1e-7)
    assert np.linalg.eigvalsh(hessian).min() >= 0


@pytest.mark.parametrize('name', TERMS)
def test_a_value_without_derivatives_is_the_same(name):
    term = TERMS[name]
    alone = term.energy(POINTS, ROWS, derivatives=Derivatives.NONE)
    np.testing.assert_array_equal(alone.value, term.energy(POINTS, ROWS).value)
    if name != 'function':
        with pytest.raises(ValueError, match='without derivatives'):
            alone.derivatives()


def test_a_quadratic_is_half_the_mahalanobis_distance():
    found = TERMS['own precisions'].energy(POINTS, ROWS)
    for value, x, row in zip(found.value, POINTS, ROWS):
        offset = x - CENTRES[row]
        assert value == pytest.approx(0.5 * offset @ PRECISIONS[row] @ offset)
    whole = Quadratic(CENTRES, np.diag([1.0, 2.0, 0.5])).energy(POINTS, ROWS)
    for one, other in zip(TERMS['diagonal, own centres'].energy(POINTS, ROWS), whole):
        np.testing.assert_allclose(one, other, rtol=1e-12)


def test_a_student_tends_to_the_quadratic():
    quadratic = TERMS['own precisions'].energy(POINTS, ROWS)
    for nu, tolerance in ((1e4, 1e-2), (1e8, 1e-6)):
        student = Student(CENTRES, PRECISIONS, nu).energy(POINTS, ROWS)
        for one, other in zip(student, quadratic):
            np.testing.assert_allclose(one, other, rtol=tolerance)


def test_a_student_falls_off_as_a_power():
    """Far out the energy is (nu + d)/2 times the log of the squared distance."""
    term = Student(np.zeros(D), np.eye(D), 3.0)
    far = term.energy(np.array([[1e6, 0, 0], [1e8, 0, 0]]), np.zeros(2, dtype=int)).value
    assert far[1] - far[0] == pytest.approx(0.5 * (3 + D) * np.log(1e4))


def test_a_sum_adds_what_its_terms_know():
    parts = [term.energy(POINTS, ROWS) for term in (TERMS['full'], TERMS['student'])]
    total = Sum((TERMS['full'], TERMS['student'])).energy(POINTS, ROWS)
    for one, two, both in zip(*parts, total):
        np.testing.assert_array_equal(one + two, both)
    values = Sum((TERMS['full'], TERMS['student'])).energy(
        POINTS, ROWS, derivatives=Derivatives.NONE
    )
    assert values.gradient is None
    np.testing.assert_array_equal(values.value, total.value)
