from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from hmt_ros.body import Body, load_body
from hmt_ros.body.angle_mixture import AngleMixture, read_pose_prior, shipped_prior
from hmt_ros.body.learned_file import write_model
from hmt_ros.body.mirror import mirror
from hmt_ros.body.pose_prior import AnglePrior, MixturePrior, pose_prior, prior_energies
from hmt_ros.image.likelihood import LikelihoodSettings
from hmt_ros.inference.bounded_newton import minimise
from hmt_ros.inference.energy import Derivatives, EnergyFunction
from hmt_ros.inference.mixture import GaussianMixture
from test.forged_models import write_forged
from test.oracles.single_terms import energy_of

HUMAN = load_body('human37')
ARMS = tuple(
    f'{side}_{joint}'
    for side in ('right', 'left')
    for joint in ('shoulder_x', 'shoulder_y', 'shoulder_z', 'elbow')
)
COVERED = ('trunk_y', *ARMS, 'trunk_x')


def made_mixture(seed: int = 0, count: int = 4, dofs: tuple[str, ...] = COVERED) -> AngleMixture:
    rng = np.random.default_rng(seed)
    own = HUMAN.skeleton.dof_index(dofs)
    n = len(dofs)
    means = HUMAN.prior_mean[own] + rng.normal(size=(count, n)) * HUMAN.prior_sigma[own]
    factors = 0.2 * rng.normal(size=(count, n, n))
    weights = rng.uniform(0.5, 1.0, count)
    covariances = factors @ factors.transpose(0, 2, 1) + 0.05 * np.eye(n)
    mixture = GaussianMixture(weights / weights.sum(), means, covariances)
    return AngleMixture(HUMAN.skeleton, dofs, mixture, {'source': 'made up'})


def poses(count: int, seed: int = 1, body: Body = HUMAN) -> np.ndarray:
    rng = np.random.default_rng(seed)
    sigma = np.where(np.isfinite(body.prior_sigma), body.prior_sigma, 1.0)
    return body.prior_mean + sigma * rng.normal(size=(count, body.dimension))


def energy(prior, x, derivatives=Derivatives.POSITIVE):
    found = energy_of(prior, prior.body, x, derivatives=derivatives)
    if derivatives == Derivatives.POSITIVE:
        assert all(map(np.array_equal, found, prior_energies(prior, x)))
    return found


def plain_log_density(mixture: AngleMixture, x: np.ndarray) -> np.ndarray:
    """log p of poses, component by component."""
    own = HUMAN.skeleton.dof_index(mixture.dofs)
    image = mirror(HUMAN, x)[:, own]
    terms = []
    for i, (w, m, s) in enumerate(
        zip(
            mixture.components.weights,
            mixture.components.means,
            mixture.components.covariances,
            strict=True,
        )
    ):
        density = multivariate_normal(m, s)
        if i == 0:
            terms.append(np.log(w) + density.logpdf(x[:, own]))
        else:
            terms += [np.log(w / 2) + density.logpdf(side) for side in (x[:, own], image)]
    return logsumexp(terms, axis=0)


def test_values_are_those_of_the_density():
    mixture, x = made_mixture(), poses(30)
    # The broad component is symmetric if its mean and covariance are.
    prior = MixturePrior(HUMAN, mixture, 0.3)
    rest = np.setdiff1d(np.arange(37), mixture.indices)
    z = (x - HUMAN.prior_mean)[:, rest] / HUMAN.prior_sigma[rest]
    wanted = 0.3 * (mixture.highest - plain_log_density(mixture, x) + 0.5 * (z**2).sum(1))
    assert np.allclose(energy(prior, x).value, wanted, atol=1e-9)
    assert np.allclose(mixture.log_density(x), plain_log_density(mixture, x), atol=1e-9)


def numerical(function, x, step=1e-6):
    columns = []
    for j in range(x.shape[1]):
        shift = np.zeros(x.shape[1])
        shift[j] = step
        columns.append((function(x + shift) - function(x - shift)) / (2.0 * step))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize('weight', [1.0, 0.3])
def test_gradient_and_exact_hessian_against_differences(weight):
    prior, x = MixturePrior(HUMAN, made_mixture(), weight), poses(6)
    x[:, prior.mixture.indices] = prior.mixture.whole.sample(6, np.random.default_rng(2))
    _, gradient, hessian = energy(prior, x, Derivatives.EXACT)
    values = numerical(lambda y: energy(prior, y, Derivatives.NONE).value, x)
    assert np.allclose(gradient, values, atol=1e-5, rtol=1e-6)
    slopes = numerical(lambda y: energy(prior, y).gradient, x)
    assert np.allclose(hessian, slopes, atol=1e-5, rtol=1e-6)


def test_positive_hessian_weighs_precisions_and_lies_above_the_exact_one():
    mixture, x = made_mixture(), poses(20)
    prior = MixturePrior(HUMAN, mixture)
    whole, own = mixture.whole, mixture.indices
    log = whole.component_log_densities(x[:, own]) + np.log(whole.weights)
    shares = np.exp(log - logsumexp(log, axis=1, keepdims=True))
    wanted = np.einsum('nc,cij->nij', shares, np.linalg.inv(whole.covariances))
    positive, exact = energy(prior, x).hessian, energy(prior, x, Derivatives.EXACT).hessian
    assert np.allclose(positive[:, own[:, None], own], wanted, atol=1e-6)
    scale = np.abs(positive).max()
    assert np.linalg.eigvalsh(positive).min() > -1e-12 * scale
    assert np.linalg.eigvalsh(positive - exact).min() > -1e-9 * scale
    # The tangent quadratic lies above the energy everywhere.
    value, gradient, _ = energy(prior, x)
    step = 0.7 * np.random.default_rng(3).normal(size=x.shape)
    above = value + (gradient * step).sum(1)
    above += 0.5 * np.einsum('ni,nij,nj->n', step, positive, step)
    assert (energy(prior, x + step).value <= above + 1e-9).all()


def test_the_most_probable_pose_costs_nothing():
    mixture = made_mixture(5)
    prior = MixturePrior(HUMAN, mixture)
    term = EnergyFunction(lambda y, _: tuple(energy(prior, y)))
    starts = np.repeat(HUMAN.prior_mean[None], len(mixture.whole), axis=0)
    starts[:, mixture.indices] = mixture.whole.means
    wide = np.full(37, 50.0)
    found = minimise(term, starts, -wide, wide, step_scale=np.full(37, 0.5), max_iterations=200)
    assert found.value.min() == pytest.approx(0.0, abs=1e-6)
    assert energy(prior, poses(500, 9)).value.min() > 0.0


# The bundled prior.


def test_the_shipped_prior_is_its_own_mirror_image_and_small():
    mixture = shipped_prior(HUMAN)
    assert isinstance(mixture, AngleMixture)
    x = poses(200)
    assert np.allclose(mixture.log_density(x), mixture.log_density(mirror(HUMAN, x)), atol=1e-9)
    assert np.allclose(mixture.log_density(x), plain_log_density(mixture, x), atol=1e-6)
    assert 'mocap.cs.cmu.edu' in mixture.card['source']
    assert 'NSF EIA-0196217' in mixture.card['source']
    assert shipped_path().stat().st_size < 150_000


def shipped_path():
    from importlib import resources

    return resources.files('hmt_ros.body') / 'models' / 'human37_prior.npz'


def test_which_bodies_have_a_learned_prior():
    assert isinstance(pose_prior(HUMAN, 'learned', 0.5), MixturePrior)
    assert isinstance(pose_prior(HUMAN, 'angles', 0.5), AnglePrior)
    assert isinstance(pose_prior(load_body('human34'), 'learned', 0.5), AnglePrior)
    tall = HUMAN.with_stature(1.9).with_segment_lengths({'forearm': 0.3})
    assert pose_prior(tall, 'learned', 1.0).mixture is shipped_prior(HUMAN)
    # Another body with the same name, but other rest frames.
    mounts = HUMAN.skeleton.mounts.copy()
    mounts[5] = mounts[5][:, [1, 2, 0]]
    other = replace(HUMAN, skeleton=replace(HUMAN.skeleton, mounts=mounts))
    assert isinstance(pose_prior(other, 'learned', 1.0), AnglePrior)
    with pytest.raises(ValueError, match=r"pose_prior must be one of .*learned.*, saw 'none'"):
        pose_prior(HUMAN, 'none', 1.0)
    with pytest.raises(ValueError, match='pose_prior must be one of'):
        LikelihoodSettings(pose_prior='none')


# Files.


def written(path):
    mixture = made_mixture()
    read = partial(AngleMixture.from_arrays, skeleton=HUMAN.skeleton)
    return write_model(path, mixture, read, mixture.card, np.zeros(0))


def test_a_file_gives_the_mixture_back(tmp_path):
    mixture = made_mixture()
    found = read_pose_prior(written(tmp_path / 'prior'), HUMAN)
    assert found.dofs == mixture.dofs
    assert found.card['source'] == 'made up'
    x = poses(20)
    assert np.allclose(found.log_density(x), mixture.log_density(x), rtol=1e-3)


def parameters(**changes):
    own = {'body': 'human37', 'dofs': list(made_mixture().dofs)}
    return {'parameters': np.array(json.dumps(own | changes))}


FIRST = np.float32(np.tril_indices(10)[1] == 0)


def single(*shape, value=0.0):
    return np.full(shape, value, dtype=np.float32)


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'format': np.array('secret')}, 'it is none of hmt_ros'),
        ({'weights': None}, 'KeyError'),
        ({'version': np.array(1)}, 'of another version'),
        (parameters(body='secret'), 'for another body than human37, or other frames at rest'),
        ({'mounts': single(2, 3, 3)}, 'broadcast'),
        ({'mounts': np.zeros(HUMAN.skeleton.mounts.shape, 'f')}, 'other frames at rest'),
        ({'card': np.array('[' * 100_000)}, 'RecursionError'),
        ({'means': single(4, 3)}, 'IndexError'),
        ({'means': single(4, 10, value=np.nan)}, 'not finite'),
        ({'factors': single(4, 55)}, 'not positive definite'),
        # Every row has only the first column, so all angles are equal.
        ({'factors': single(4, 55) + FIRST}, 'not positive definite'),
        ({'factors': single(4, 55, value=np.inf)}, 'not finite'),
        ({'weights': single(4, value=0.5)}, 'weights must be positive and sum to 1'),
        ({'weights': np.array(1.0)}, 'not a model file that can be used'),
        (parameters(dofs=['trunk_q'] * 10), 'degrees of freedom that human37 has not'),
        (parameters(dofs=['trunk_x'] * 10), 'wanted different angles'),
        (parameters(dofs=1), 'not a model file that can be used'),
        ({'card': np.array('{')}, 'not a model file that can be used'),
        ({'card': np.array('[]')}, 'card are no mapping'),
    ],
)
def test_faults_of_a_file_are_named(tmp_path, change, message):
    path = written(tmp_path / 'p')
    write_forged(path, path, change)
    with pytest.raises(ValueError, match=message) as caught:
        read_pose_prior(path, HUMAN)
    assert str(path) in str(caught.value)
    assert '\n' not in str(caught.value)
    assert 'secret' not in str(caught.value)


def test_mixtures_without_their_mirror_image_are_refused():
    with pytest.raises(ValueError, match='mirror images of'):
        made_mixture(dofs=('left_elbow', 'left_knee'))
    with pytest.raises(ValueError, match='wanted different angles'):
        made_mixture(dofs=('trunk_x', 'trunk_x'))
    with pytest.raises(ValueError, match='wanted 2 to'):
        made_mixture(count=1)
