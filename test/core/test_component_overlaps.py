import numpy as np
import pytest
from scipy.optimize import approx_fprime
from scipy.special import logsumexp

from hmt_ros.core import add_component_overlaps

COUNT, SIZE, WIDTH, SAMPLES = 3, 9, 4, 5


def factors(bands):
    """L (M, D, D) of bands (M, D, width)."""
    return np.array(
        [sum(np.diag(band[: SIZE - b, b], -b) for b in range(min(WIDTH, SIZE))) for band in bands]
    )


def log_density(x, means, log_inflation, log_weights, bands):
    """log q of a sample by dense matrices."""
    logs = []
    for a, mean, s, factor in zip(log_weights, means, np.exp(log_inflation), factors(bands)):
        white = factor.T @ (x - mean) / s
        scale = np.log(np.diag(factor)).sum() - SIZE * (np.log(s) + 0.5 * np.log(2 * np.pi))
        logs.append(a + scale - 0.5 * white @ white)
    return logsumexp(logs)


def mixture(own=1, seed=0, **other):
    rng = np.random.default_rng(seed)
    bands = 0.3 * rng.normal(size=(COUNT, SIZE, WIDTH))
    bands[:, :, 0] = rng.uniform(0.8, 1.2, (COUNT, SIZE))
    means, inflation = 0.5 * rng.normal(size=(COUNT, SIZE)), rng.uniform(0.8, 1.3, COUNT)
    noise = rng.normal(size=(SAMPLES, SIZE))
    roots = np.linalg.solve(factors(bands)[own].T, noise[:, :, None])[:, :, 0]
    scales = np.log(bands[:, :, 0]).sum(1) - SIZE * (np.log(inflation) + 0.5 * np.log(2 * np.pi))
    # In the order of the arguments.
    given = {
        'own': own,
        'samples': means[own] + inflation[own] * roots,
        'noise': noise,
        'log_weights': np.log(rng.dirichlet(np.ones(COUNT))),
        'log_scales': scales,
        'means': means,
        'inflation': inflation,
        'bands': bands,
        'near': np.ones(COUNT, bool),
        'begin': np.arange(COUNT) * 4,
        'derivatives': True,
        'share': 0.25,
        'log_density': np.full(SAMPLES, np.nan),
        'gradient': np.full((SAMPLES, SIZE), np.nan),
        'mean_gradient': np.zeros((COUNT, SIZE)),
        'inflation_gradient': np.zeros(COUNT),
        'weight_gradient': np.zeros(COUNT),
    }
    return {**given, **other}


def evaluate(given):
    add_component_overlaps(*given.values())
    return given


@pytest.mark.parametrize('own', range(COUNT))
def test_density_and_derivatives_are_those_of_dense_matrices(own):
    found = evaluate(mixture(own))
    rest = [found['means'], np.log(found['inflation']), found['log_weights']]
    sums = [0.0, 0.0, 0.0]
    for s, x in enumerate(found['samples']):
        value = log_density(x, *rest, found['bands'])
        assert found['log_density'][s] == pytest.approx(value, abs=1e-12)
        slope = approx_fprime(x, log_density, 1e-7, *rest, found['bands'])
        np.testing.assert_allclose(found['gradient'][s], slope, atol=1e-5)
        for i, of in enumerate(rest):

            def moved(flat, i=i, of=of, x=x):
                parts = [flat.reshape(of.shape) if k == i else p for k, p in enumerate(rest)]
                return log_density(x, *parts, found['bands'])

            sums[i] += 0.25 * approx_fprime(of.ravel(), moved, 1e-7).reshape(of.shape)
    for name, total in zip(list(found)[-3:], sums):
        np.testing.assert_allclose(found[name], total, atol=1e-5)


def test_components_that_are_not_near_or_far_away_do_not_count():
    alone = mixture(near=np.zeros(COUNT, bool))
    far = mixture()
    far['means'][[0, 2]] += 1e3
    for given in (evaluate(alone), evaluate(far)):
        own = given['log_weights'][1] + given['log_scales'][1]
        square = (given['noise'] ** 2).sum(1)
        np.testing.assert_allclose(given['log_density'], own - 0.5 * square, atol=1e-12)
        np.testing.assert_allclose(given['weight_gradient'], [0.0, 0.25 * SAMPLES, 0.0])


def test_without_derivatives_only_the_density_is_written():
    found = evaluate(mixture(derivatives=False))
    assert np.isfinite(found['log_density']).all()
    assert np.isnan(found['gradient']).all()
    assert not found['mean_gradient'].any()


@pytest.mark.parametrize('name', [n for n in mixture() if n not in ('own', 'derivatives', 'share')])
def test_arguments_that_do_not_fit_are_named(name):
    array = mixture()[name]
    wrong = [array.astype(np.float32), np.repeat(array, 2, -1)[..., ::2], array[:0]]
    # Samples and means define the sizes that the others are compared with.
    for bad in wrong[:2] if name in ('samples', 'means') else wrong:
        with pytest.raises((ValueError, TypeError), match=f'^{name}: wanted'):
            evaluate(mixture(**{name: bad}))


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('own', -1),
        ('own', COUNT),
        ('begin', np.full(COUNT, SIZE)),
        ('begin', np.full(COUNT, -1)),
        ('bands', np.zeros((COUNT, SIZE, 0))),
    ],
)
def test_numbers_out_of_range_are_refused(name, value):
    with pytest.raises(ValueError, match=f'^{name}: wanted'):
        evaluate({**mixture(), name: value})


def test_no_numbers_are_survived():
    found = {
        name: evaluate(mixture(**{name: np.full_like(mixture()[name], np.nan)}))['log_density']
        for name in ('samples', 'log_weights', 'inflation', 'bands')
    }
    assert not np.isfinite(found['log_weights']).any()
    # The density of the component itself does not need the others.
    assert np.isfinite(found['samples']).all()
    assert np.array_equal(found['samples'], found['bands'])
    assert np.array_equal(found['samples'], found['inflation'])
