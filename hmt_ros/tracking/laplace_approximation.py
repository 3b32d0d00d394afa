"""Gaussians around optima: the modes of the posterior and of the likelihood.

    filtered     H^-1                                      as if errors were independent
    covariance   T (H_prior + sum_g a_g(dt) H_g)^-1 + J P J'               g: image, keypoints
    state        N(pose, velocity) conditioned on the found pose; see `motion_states`

H is the Gauss-Newton Hessian of the energy at an optimum, and H_prior the Hessian of the terms of
body and ground, without the motion prior. Errors persist, so the Hessian of a cue is weighted by
its share a_g, and the covariance given all images so far is T times the covariance given one image
(`inference.error_model`). Uncertainty of the shape makes the pose uncertain: J P J'
(`shape_estimation`). A variable on its limit hardly varies.

The likelihood is published undiscounted, with the correlation time of its errors, so that a
subscriber that combines images discounts them once. The error due to the shape is the same in all
images; its covariance is published separately.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hmt_ros.core import determined, elementary, shift_modes
from hmt_ros.image.observation import Observation
from hmt_ros.image.pose_energy import PoseEnergy
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.energy import Derivatives
from hmt_ros.inference.error_model import (
    JOINT_COVARIANCE_RATIO,
    LIFTED_INFORMATION_RATIO,
    CueErrors,
    errors_of_cues,
)
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.inference.motion_states import PredictedStates, fused
from hmt_ros.tracking.hypotheses import Modes, Optimised
from hmt_ros.tracking.posterior import ImageFit, Posterior, free_covariances
from hmt_ros.tracking.settings import MAX_MODE_SHIFT
from hmt_ros.tracking.shape_estimation import ShapeEstimate
from hmt_ros.tracking.weighting import at_least, normalised

# Smallest log weight of a mode of a likelihood, nats: its exponential does not underflow.
MIN_LOG_WEIGHT = elementary.log(np.finfo(np.float64).tiny)


@dataclass(frozen=True, eq=False)
class Likelihood:
    """The likelihood of an image as a function of the pose, undiscounted.

    Attributes:
        mixture: approximation of exp(-E) up to a factor, with the energy E of the image:
            covariances S from the full curvature, weights exp(-E) |S|^(1/2); heaviest mode first.
        values: (K,) log likelihoods of the image at the means, nats.
        errors: error model of all cues together.
        shape_covariance: (d, d) covariance J P J' due to the shape at the heaviest posterior mode.
        modes: (K,) row of the posterior mode of each component.
        posterior_weights: (K,) weights of these posterior modes, given all images so far; sum 1.
        identities: (K,) persistent numbers of these posterior modes, see `Identities`.
        origins: (K, M) probability that component k continues component m of the previous image's
            likelihood; M is 0 at a start. See `LaggedWeights`.
        ancestors: (M,) identities of the previous image's components.
        ancestry_stamp: timestamp of the previous image, ns; None: the track starts.
    """

    mixture: GaussianMixture
    values: Array
    errors: CueErrors
    shape_covariance: Array
    modes: Index
    posterior_weights: Array
    identities: Index
    origins: Array
    ancestors: Index
    ancestry_stamp: int | None


def posterior_modes(
    selected: Optimised,
    log_weights: Array,
    origins: Array,
    posterior: Posterior,
    observation: Observation,
    shape: ShapeEstimate,
    dynamics: LinearGaussianDynamics,
    states: PredictedStates | None,
    dt: float,
) -> Modes:
    """Computes the modes of the posterior, without their identities and classes.

    Args:
        selected: K hypotheses at their optima, heaviest first.
        log_weights: (K,) normalised log weights.
        origins: (K, M) probability that mode k continues mode m of the previous image.
        posterior: posterior of the image.
        observation: observation of the image.
        shape: present estimate of the person's shape.
        dynamics: motion prior of the modes.
        states: predicted states of the ancestors; None: the track starts, at rest.
        dt: time since the previous image, s; infinite at a start.
    """
    h, solved = selected.hypotheses, selected.minima
    poses = solved.x
    filtered, _ = free_covariances(solved.hessian[:, None], solved.free)
    fit = posterior.fit(poses, observation)
    covariances = alone = filtered
    measured = bool(observation.evidence) or observation.keypoints is not None
    if measured:
        alone = fit.persistent_covariances(solved.free, dt)
        covariances = JOINT_COVARIANCE_RATIO * alone + shape.induced_covariances(
            posterior.likelihood, observation, poses, fit.free_response[1]
        )
    if states is None:
        velocities = np.zeros_like(poses)
        state_covariances = dynamics.states(filtered)
    else:
        found = filtered
        if states.wandered.any() and measured:
            # Errors of images persist, so the propagated covariance is discounted, too.
            found = fused(states.covariances_of(h.ancestors, h.jumped), alone)
        velocities, state_covariances = states.given(h.ancestors, h.jumped, poses, found)
    return replace(
        Modes.blank(*poses.shape),
        poses=poses,
        log_weights=log_weights,
        ancestors=h.ancestors,
        expected=h.expected,
        jumped=h.jumped,
        velocities=velocities,
        covariances=covariances,
        filtered=filtered,
        log_likelihoods=-fit.image_energy,
        state_covariances=state_covariances,
        origins=origins,
    )


def likelihood_modes(
    modes: Modes,
    posterior: Posterior,
    observation: Observation,
    shape: ShapeEstimate,
    before: tuple[int | None, Likelihood],
) -> Likelihood:
    """Computes the modes of the likelihood, without information from previous images.

    Around each mode of the posterior the energy of the image and of the body's prior is
    approximately quadratic. Its minimum and curvature give a component, and its depth and volume
    give the log weight, which is at least `MIN_LOG_WEIGHT`. Nothing is discounted, except that one
    pair (s, tau) describes keypoints and experts, with the same information per second as in the
    filter.

    Args:
        modes: K modes of the posterior, heaviest first.
        posterior: posterior of the image.
        observation: observation of the image.
        shape: present estimate of the person's shape.
        before: timestamp, ns, and likelihood of the previous image; unused at a start.
    """
    body, poses = posterior.body, modes.poses
    fit = posterior.fit(poses, observation, LIFTED_INFORMATION_RATIO)
    gradient, covariances = fit.energy.derivatives()[0], fit.covariances
    means, limits = np.empty_like(poses), np.stack([body.lower, body.upper])
    shift_modes(
        poses, gradient, fit.free, covariances, modes.covariances, MAX_MODE_SHIFT, limits, means
    )
    volumes = 0.5 * fit.log_determinants
    weights = elementary.exp(at_least(normalised(volumes - fit.energy.value), MIN_LOG_WEIGHT))
    order = np.argsort(-weights, kind='stable')
    mixture = GaussianMixture(weights[order], means[order], covariances[order])
    seen = PoseEnergy(posterior.likelihood, posterior.likelihood.seen(observation))
    values = -seen.energy(mixture.means, derivatives=Derivatives.NONE).value
    (unknown,) = shape.induced_covariances(
        posterior.likelihood, observation, poses[:1], fit.free_response[1][:1]
    )
    stamp, ancestral = before
    follows = modes.origins.shape[1] > 0
    columns = slice(None if follows else 0)
    return Likelihood(
        mixture,
        values,
        _errors(fit, weights),
        unknown,
        modes=order,
        posterior_weights=modes.mixture.weights[order],
        identities=modes.identities[order],
        origins=modes.origins[order][:, ancestral.modes[columns]],
        ancestors=ancestral.identities[columns],
        ancestry_stamp=stamp if follows else None,
    )


def _errors(fit: ImageFit, weights: Array) -> CueErrors:
    """Error model of an energy whose Hessian is H = sum_g H_g, with the inverse S, at each mode.

    Each cue has the weight tr(S H_g), the number of variables that it determines, averaged over
    modes.
    """
    amounts = np.empty(3)
    determined(weights, fit.covariances, fit.hessians, amounts)
    if not amounts.max() > 0.0:
        amounts[2] = 1.0
    names = 'image', 'keypoints', 'prior'
    return errors_of_cues(dict(zip(names, np.maximum(amounts, 0.0).tolist(), strict=True)))
