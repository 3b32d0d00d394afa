"""A small model of every kind stored in files, and checks of each."""

from __future__ import annotations

import numpy as np

from hmt_ros.body import Camera, load_body
from hmt_ros.body.angle_mixture import shipped_prior
from hmt_ros.body.motion_prior import shipped_motion
from hmt_ros.body.rasterisation import render_silhouettes
from hmt_ros.experts import (
    CalibratedExperts,
    ConditionalExperts,
    JointExperts,
    LocalExperts,
    NearestNeighbours,
    NetworkExperts,
    PosePredictor,
    lift_poses,
    load_lifter,
    load_predictor,
)
from hmt_ros.experts.calibrated_experts import Calibration
from hmt_ros.experts.lifter import Lifter, Network
from hmt_ros.experts.network_experts import Layers
from hmt_ros.experts.pose_predictor import BY_EXPERTS
from hmt_ros.experts.training_pairs import Standardisation
from hmt_ros.image.keypoint_schemes import schemes
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference import GaussianMixture

BODY = load_body('human37')
CAMERA = Camera(400.0, 400.0, 199.5, 149.5, 400, 300)


def _network() -> NetworkExperts:
    rng, m, p, d, h = np.random.default_rng(0), 2, 4, 3, 6
    made = NetworkExperts(m, units=h, layers=1)
    made.n_inputs_, made.n_outputs_ = p, d
    shapes = {
        'first': (p, h),
        'first_bias': (h,),
        'hidden': (1, h, h),
        'hidden_biases': (1, h),
        'last': (h, m * (2 + d)),
        'last_bias': (m * (2 + d),),
    }
    layers = {k: rng.normal(size=shape).astype(np.float32) for k, shape in shapes.items()}
    of_inputs, of_targets = Standardisation(np.zeros(p), np.ones(p)), np.full(d, 0.7)
    roots = rng.normal(size=(m, d, d))
    made.set_parts(
        Layers(**layers),
        of_inputs,
        Standardisation(np.zeros(d), of_targets),
        roots @ roots.transpose(0, 2, 1) + np.eye(d),
        rng.normal(size=(5, p)),
        1.0,
    )
    return made


def _calibrated(model) -> CalibratedExperts:
    made = CalibratedExperts(model)
    made.n_inputs_, made.n_outputs_ = model.n_inputs_, model.n_outputs_
    made.calibration_ = Calibration(1.5, 0.1 * np.eye(model.n_outputs_), 1.2)
    return made


def densities() -> dict[str, object]:
    """A model of each kind, for inputs and targets unrelated to bodies."""
    rng = np.random.default_rng(1)
    x = rng.normal(size=(80, 4))
    y = np.c_[np.sin(2.0 * x[:, :2]), x[:, 2] * x[:, 3]] + 0.1 * rng.normal(size=(80, 3))
    fast = {'max_iterations': 2, 'n_starts': 1, 'max_kernels': 12}
    return {
        'nearest': NearestNeighbours(3).fit(x, y),
        'local': LocalExperts(2, 10, 4).fit(x, y),
        'conditional': ConditionalExperts(2, width=2.0, **fast).fit(x, y),
        'conditional, linear': ConditionalExperts(2, 'linear', **fast).fit(x, y),
        'joint': JointExperts(2, 'linear', **fast).fit(x, y),
        'one expert': ConditionalExperts(1, width=2.0, **fast).fit(x, y),
        'network': _network(),
        'calibrated': _calibrated(_network()),
    }


def small_predictor() -> PosePredictor:
    """A predictor with a model for rule (1), from a few samples of the bundled one."""
    shipped, rng = load_predictor(), np.random.default_rng(2)
    x = rng.normal(size=(40, shipped.descriptor.size))
    z = np.array([one.mean() for one in shipped.model.predict(x)])
    before = z + 0.1 * rng.normal(size=z.shape)
    return PosePredictor(
        shipped.body,
        shipped.descriptor,
        _calibrated(LocalExperts(2, 10, 4).fit(x, z)),
        shipped.target_basis,
        shipped.equilibrium,
        NearestNeighbours(3).fit(np.hstack([before, x]), z),
        {'source': 'drawn'},
    )


def small_lifter() -> Lifter:
    """A lifter with random weights."""
    shipped, rng, h, k = load_lifter(), np.random.default_rng(3), 5, 2
    net, numbers = shipped.network, k * (1 + 6 * len(shipped.joints))
    p = len(net.mean)

    def drawn(*shape):
        return (0.1 * rng.normal(size=shape)).astype(np.float32)

    network = Network(
        mean=net.mean,
        scale=net.scale,
        first=drawn(p, h),
        first_bias=drawn(h),
        hidden=drawn(1, h, h),
        hidden_biases=drawn(1, h),
        last=drawn(h, numbers),
        last_bias=drawn(numbers),
        middle=net.middle,
    )
    return Lifter(network, shipped.joints, BODY, {'source': 'drawn'})


def models() -> dict[str, object]:
    """A model of every kind stored in files."""
    return {
        **densities(),
        'silhouettes': load_predictor(),
        'predictor': small_predictor(),
        'lifter': small_lifter(),
        'pose prior': shipped_prior(BODY),
        'motion prior': shipped_motion('human37'),
    }


def _person() -> tuple[np.ndarray, Keypoints]:
    pose = BODY.prior_mean.copy()
    pose[:3] = 0.1, 0.1, 4.0
    mask = render_silhouettes(BODY, pose[None], CAMERA)[0]
    scheme = schemes()['coco17']
    rng = np.random.default_rng(4)
    pixels = np.array([200.0, 150.0]) + 40.0 * rng.normal(size=(len(scheme.names), 2))
    unknown = np.full((len(pixels), 2, 2), np.nan)
    return mask, Keypoints(scheme.names, pixels, unknown, np.ones(len(pixels)))


MASK, KEYPOINTS = _person()


def predictions(model: object) -> list[GaussianMixture]:
    """Mixtures that a model predicts for inputs near to and far from its training data.

    Raises:
        AssertionError: derivatives or supports are not finite.
    """
    if isinstance(model, PosePredictor):
        first = model.observe(MASK, CAMERA).mixture
        if model.dynamics is None:
            return [first]
        return [first, model.observe(MASK, CAMERA, first, 0.1, propagation=BY_EXPERTS).mixture]
    if isinstance(model, Lifter):
        rng = np.random.default_rng(6)
        inputs = [s * rng.normal(size=len(model.network.mean)) for s in (0.0, 1.0, 5.0)]
        lifted = lift_poses(model, BODY, CAMERA, np.arange(2) / 30.0, [KEYPOINTS] * 2)
        return [model.answer(x) for x in inputs] + lifted
    if hasattr(model, 'dynamics'):
        state = np.zeros(model.dynamics.state_dimension)
        wide = model.dynamics.states(np.eye(model.dynamics.dimension)[None])
        return [model.answer(state)] + [
            GaussianMixture(np.ones(1), *model.dynamics.predict(state[None], wide, t))
            for t in (1e-3, 0.1, 10.0)
        ]
    if hasattr(model, 'whole'):
        poses = BODY.prior_mean + 0.3 * np.random.default_rng(7).normal(size=(4, BODY.dimension))
        assert np.isfinite(model.log_density(poses)).all()
        assert np.isfinite(model.highest)
        assert np.isfinite(model.precisions).all()
        return [model.whole]
    rng = np.random.default_rng(5)
    inputs = np.concatenate([s * rng.normal(size=(4, model.n_inputs_)) for s in (0.0, 1.0, 30.0)])
    assert np.isfinite(model.jacobians(inputs)).all()
    support = model.support(inputs)
    assert ((support >= 0.0) & (support <= 1.0)).all()
    return model.predict(inputs)


def check_predictions(model: object) -> None:
    """Raises an error unless a model predicts mixtures whose covariances are positive definite."""
    for found in predictions(model):
        assert abs(found.weights.sum() - 1.0) < 1e-3
        assert np.allclose(found.covariances, found.covariances.transpose(0, 2, 1), rtol=1e-6)
        found.cholesky()
