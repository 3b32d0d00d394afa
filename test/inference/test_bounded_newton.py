"""The bounded Newton method, compared with scipy, and its guarantees for batches."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear, minimize

from hmt_ros.inference import Minimum, Status, minimise
from hmt_ros.inference.bounded_newton import TrustRegion
from hmt_ros.inference.energy import EnergyFunction


def minimum(objective, *arguments, **options) -> Minimum:
    """Minimum of an energy given as a function."""
    return minimise(EnergyFunction(objective), *arguments, **options)


def quadratics(n: int, d: int, seed: int):
    """Random convex quadratics 1/2 |A x - b|^2 with a box that cuts through most of them."""
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(n, d + 3, d)), rng.normal(size=(n, d + 3))
    hessians, gradients = a.swapaxes(1, 2) @ a, -np.einsum('nij,ni->nj', a, b)

    def objective(x, problem):
        h, g = hessians[problem], gradients[problem]
        hx = np.einsum('nij,nj->ni', h, x)
        value = 0.5 * (x * hx).sum(1) + (g * x).sum(1) + 0.5 * (b[problem] ** 2).sum(1)
        return value, hx + g, h

    return a, b, objective


@pytest.mark.parametrize('d', [1, 2, 5, 20])
def test_quadratics_in_a_box_equal_lsq_linear(d):
    a, b, objective = quadratics(30, d, d)
    lower, upper = np.full(d, -0.15), np.full(d, 0.2)
    best = minimum(objective, np.zeros((30, d)), lower, upper, tolerance=1e-14)
    assert (best.status == Status.CONVERGED).all()
    for i in range(30):
        expected = lsq_linear(a[i], b[i], (lower, upper), method='bvls', tol=1e-14)
        np.testing.assert_allclose(best.x[i], expected.x, atol=1e-6)
        assert best.value[i] == pytest.approx(expected.cost, abs=1e-9)
    assert (best.x >= lower).all()
    assert (best.x <= upper).all()
    resting = (best.x == lower) | (best.x == upper)
    assert resting.any()
    assert (resting | best.free).all()
    np.testing.assert_allclose(best.gradient[best.free], 0.0, atol=1e-6)


def test_coupled_limits_do_not_end_the_search_early():
    """A step that one limit stops must not hold back the variables coupled to it."""
    hessian = np.array([[[1.0, 0.9], [0.9, 1.0]]])

    def objective(x, problem):
        off = x - [-1.0, 1.1]
        hx = np.einsum('nij,nj->ni', np.repeat(hessian, len(x), 0), off)
        return 0.5 * (off * hx).sum(1), hx, np.repeat(hessian, len(x), 0)

    hair = np.nextafter(0.0, 1.0)
    for start in ([0.0, 0.0], [hair, 0.0], [1e-17, 1e-17], [0.5, 0.0]):
        best = minimum(objective, np.array([start]), 0.0, 2.0, tolerance=1e-14)
        np.testing.assert_allclose(best.x, [[0.0, 0.2]], atol=1e-6)
        assert best.status[0] == Status.CONVERGED


def test_limits_of_each_problem_are_its_own():
    a, b, objective = quadratics(8, 4, 1)
    rng = np.random.default_rng(2)
    lower = rng.uniform(-0.4, -0.05, (8, 4))
    upper = lower + rng.uniform(0.05, 0.5, (8, 4))
    best = minimum(objective, np.zeros((8, 4)), lower, upper, tolerance=1e-14)
    for i in range(8):
        expected = lsq_linear(a[i], b[i], (lower[i], upper[i]), method='bvls', tol=1e-14)
        np.testing.assert_allclose(best.x[i], expected.x, atol=1e-6)


def test_a_free_quadratic_needs_few_steps():
    _, _, objective = quadratics(20, 6, 3)
    best = minimum(objective, np.full((20, 6), 5.0), damping=1e-9)
    assert (best.status == Status.CONVERGED).all()
    assert best.iterations.max() <= 3
    assert best.free.all()


def rosenbrock(x, problem):
    a, b = x[:, 0], x[:, 1]
    value = (1 - a) ** 2 + 100 * (b - a * a) ** 2
    gradient = np.stack([-2 * (1 - a) - 400 * a * (b - a * a), 200 * (b - a * a)], axis=1)
    hessian = np.empty((len(x), 2, 2))
    hessian[:, 0, 0] = 2 - 400 * (b - 3 * a * a)
    hessian[:, 0, 1] = hessian[:, 1, 0] = -400 * a
    hessian[:, 1, 1] = 200
    return value, gradient, hessian


def test_rosenbrock_from_many_starts():
    starts = np.random.default_rng(4).uniform(-3, 3, (50, 2))
    best = minimum(rosenbrock, starts, max_iterations=200, tolerance=1e-14)
    assert (best.status == Status.CONVERGED).all()
    np.testing.assert_allclose(best.x, 1.0, atol=1e-5)


@pytest.mark.parametrize(
    ('lower', 'upper'), [((-2, -2), (0.5, 2)), ((1.2, -2), (2, 2)), ((-2, -2), (2, 0.3))]
)
def test_rosenbrock_at_an_active_limit_equals_scipy(lower, upper):
    start = np.array([[-1.2, 1.0], [0.0, 0.0], [1.9, 1.9]])
    best = minimum(rosenbrock, start, lower, upper, max_iterations=300, tolerance=1e-14)
    for i, x in enumerate(np.clip(start, lower, upper)):
        expected = minimize(
            lambda v: (float(rosenbrock(v[None], None)[0][0]), rosenbrock(v[None], None)[1][0]),
            x, jac=True, bounds=list(zip(lower, upper)), method='L-BFGS-B',
            options={'ftol': 1e-15, 'gtol': 1e-10},
        )  # fmt: skip
        assert best.value[i] <= expected.fun + 1e-9
        np.testing.assert_allclose(best.x[i], expected.x, atol=1e-4)
    assert not best.free.all()


def saddle(x, problem):
    """x^4 - x^2 + y^2: the Hessian is indefinite between the two valleys."""
    value = x[:, 0] ** 4 - x[:, 0] ** 2 + x[:, 1] ** 2
    gradient = np.stack([4 * x[:, 0] ** 3 - 2 * x[:, 0], 2 * x[:, 1]], axis=1)
    hessian = np.zeros((len(x), 2, 2))
    hessian[:, 0, 0] = 12 * x[:, 0] ** 2 - 2
    hessian[:, 1, 1] = 2
    return value, gradient, hessian


def test_an_indefinite_start_descends_into_its_valley():
    starts = np.array([[0.01, 0.5], [-0.01, 0.5], [0.1, -3.0], [1e-6, 0.0]])
    best = minimum(saddle, starts, max_iterations=100, tolerance=1e-12)
    assert (best.status == Status.CONVERGED).all()
    expected = np.sqrt(0.5) * np.array([1, -1, 1, 1])
    np.testing.assert_allclose(best.x[:, 0], expected, atol=1e-4)
    np.testing.assert_allclose(best.x[:, 1], 0.0, atol=1e-5)


def test_the_energy_never_rises():
    values: dict[int, list[float]] = {}

    def watched(x, problem):
        result = rosenbrock(x, problem)
        for i, v in zip(problem, result[0]):
            values.setdefault(int(i), []).append(float(v))
        return result

    starts = np.random.default_rng(5).uniform(-2, 2, (10, 2))
    best = minimum(watched, starts, max_iterations=100)
    for i in range(10):
        assert best.value[i] == min(values[i])
        assert len(values[i]) == best.iterations[i] + 1


def test_converged_problems_leave_the_batch():
    rows: list[int] = []

    def watched(x, problem):
        rows.append(len(x))
        assert len(x) == len(problem)
        return rosenbrock(x, problem)

    starts = np.array([[1.0, 1.0], [1.1, 1.2], [-3.0, 3.0]])
    best = minimum(watched, starts, max_iterations=200, tolerance=1e-12)
    assert (best.status == Status.CONVERGED).all()
    assert rows[0] == 3
    assert rows[1] == 2  # the first starts at its minimum
    assert rows[-1] == 1
    assert sorted(rows, reverse=True) == rows
    assert best.iterations[0] == 0


def wells(x, problem):
    """Elementwise arithmetic only, so that a row does not depend on other rows."""
    value = (0.1 * x**4 - x**2 + 0.3 * x * (problem[:, None] % 5)).sum(1)
    gradient = 0.4 * x**3 - 2 * x + 0.3 * (problem[:, None] % 5)
    hessian = np.zeros((*x.shape, x.shape[1]))
    i = np.arange(x.shape[1])
    hessian[:, i, i] = 1.2 * x * x - 2
    hessian[:, 0, -1] = hessian[:, -1, 0] = 0.0
    return value, gradient, hessian


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), d=st.integers(1, 9))
def test_a_problem_alone_gives_the_bits_it_gives_in_a_batch(seed, d):
    starts = np.random.default_rng(seed).uniform(-3, 3, (11, d))
    together = minimum(wells, starts, -2.0, 2.5)
    again = minimum(wells, starts, -2.0, 2.5)
    np.testing.assert_array_equal(together.x, again.x)
    for i in (0, 4, 10):
        alone = minimum(lambda x, _, i=i: wells(x, np.full(len(x), i)), starts[i], -2.0, 2.5)
        np.testing.assert_array_equal(alone.x[0], together.x[i])
        assert alone.value[0] == together.value[i]
        assert alone.iterations[0] == together.iterations[i]
        assert alone.status[0] == together.status[i]


def test_coupled_problems_alone_give_the_bits_they_give_in_a_batch():
    a, b, _ = quadratics(9, 37, 6)
    hessians, gradients = a.swapaxes(1, 2) @ a, -np.einsum('nij,ni->nj', a, b)

    def objective(x, problem):
        hx = np.stack([hessians[p] @ row for p, row in zip(problem, x)])
        g = gradients[problem]
        value = np.array([0.5 * u @ v + w @ u for u, v, w in zip(x, hx, g)])
        return value, hx + g, hessians[problem]

    starts = np.random.default_rng(7).uniform(-1, 1, (9, 37))
    together = minimum(objective, starts, -0.2, 0.3)
    for i in range(9):
        alone = minimum(lambda x, _, i=i: objective(x, np.full(len(x), i)), starts[i], -0.2, 0.3)
        np.testing.assert_array_equal(alone.x[0], together.x[i])
        assert alone.iterations[0] == together.iterations[i]


@pytest.mark.parametrize('bad', [np.nan, np.inf])
def test_a_start_without_finite_energy_stays_where_it_is(bad):
    def objective(x, problem):
        value, gradient, hessian = rosenbrock(x, problem)
        value = np.where(problem == 1, bad, value)
        return value, gradient, hessian

    starts = np.array([[0.0, 0.0], [0.5, 0.5], [2.0, 2.0]])
    best = minimum(objective, starts, max_iterations=100, tolerance=1e-12)
    assert best.status.tolist() == [Status.CONVERGED, Status.NOT_FINITE, Status.CONVERGED]
    np.testing.assert_array_equal(best.x[1], starts[1])
    assert best.iterations[1] == 0
    np.testing.assert_allclose(best.x[[0, 2]], 1.0, atol=1e-5)


def test_a_step_into_nan_is_refused_and_shortened():
    """-log(x) + x beyond the domain of the logarithm."""

    def objective(x, problem):
        with np.errstate(invalid='ignore', divide='ignore'):
            value = x[:, 0] - np.log(x[:, 0])
            return value, 1 - 1 / x, (1 / x**2)[:, :, None]

    best = minimum(objective, np.array([[8.0], [0.01]]), max_iterations=100, tolerance=1e-14)
    assert (best.status == Status.CONVERGED).all()
    np.testing.assert_allclose(best.x, 1.0, atol=1e-6)


def test_a_start_outside_the_box_is_brought_inside():
    best = minimum(rosenbrock, np.array([[9.0, -9.0]]), (-2, -2), (0.5, 2), max_iterations=0)
    np.testing.assert_array_equal(best.x, [[0.5, -2.0]])
    assert best.status[0] == Status.ITERATION_LIMIT


def test_a_box_without_room_holds_a_variable():
    best = minimum(
        rosenbrock,
        np.array([[0.0, 0.0]]),
        (-2, 0.25),
        (2, 0.25),
        max_iterations=100,
        tolerance=1e-12,
    )
    assert best.x[0, 1] == 0.25
    slope = rosenbrock(best.x, None)[1][0, 0]
    assert slope == pytest.approx(0.0, abs=1e-4)


def test_a_wrong_gradient_stalls_and_ends():
    def objective(x, problem):
        value, gradient, _ = rosenbrock(x, problem)
        return value, -gradient, np.tile(np.eye(2), (len(x), 1, 1))

    best = minimum(objective, np.array([[-1.0, 1.0]]), max_iterations=500)
    assert best.status[0] in (Status.STALLED, Status.CONVERGED)
    assert best.iterations[0] < 100
    np.testing.assert_array_equal(best.x, [[-1.0, 1.0]])


def test_the_iteration_limit_is_kept():
    best = minimum(rosenbrock, np.array([[-3.0, 3.0]]), max_iterations=3)
    assert best.status[0] == Status.ITERATION_LIMIT
    assert best.iterations[0] == 3


def test_units_of_the_variables_do_not_matter_with_their_step_scale():
    scale = np.array([1000.0, 1.0])

    def scaled(x, problem):
        value, gradient, hessian = rosenbrock(x / scale, problem)
        return value, gradient / scale, hessian / np.outer(scale, scale)

    start = np.array([[-1.2, 1.0]])
    plain = minimum(rosenbrock, start, step_scale=1.0, tolerance=1e-12, max_iterations=100)
    other = minimum(scaled, start * scale, step_scale=scale, tolerance=1e-12, max_iterations=100)
    np.testing.assert_allclose(other.x / scale, plain.x, atol=1e-8)
    assert other.iterations[0] == plain.iterations[0]


def test_inputs_are_not_changed():
    start = np.array([[9.0, 9.0]])
    minimum(rosenbrock, start, -1.0, 0.5)
    np.testing.assert_array_equal(start, [[9.0, 9.0]])


def test_damping_follows_the_ratio_of_actual_to_predicted_decrease():
    region = TrustRegion(5, 1.0, limit=30.0, least_factor=0.25, least_refused=2.0)
    rows = np.arange(5)
    decrease = np.array([1.0, 0.5, 0.1, -1.0, np.nan])
    better = region.accept(rows, decrease, np.ones(5))
    assert better.tolist() == [True, True, True, False, False]
    assert len(region.refuse(rows[~better])) == 0
    np.testing.assert_allclose(region.damping, [0.25, 1.0, 1.0 + 0.8**3, 4.0, 4.0])
    assert len(region.refuse(rows[3:])) == 0
    np.testing.assert_allclose(region.damping[3:], 16.0)
    assert region.refuse(rows[3:4]).tolist() == [3]
    assert region.damping[3] == 16.0 * 8.0
